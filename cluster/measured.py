"""Whole runs as measurements: a fresh process each, its ``run.json`` returned, its output thrown away."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from ..shared.errors import SplatpipeError


def measured_run(config: Path, overrides: list[str], *, keep: Path | None = None) -> dict[str, Any]:
    """The ``run.json`` of ``splatpipe run CONFIG --set …``; nothing is encoded unless the overrides ask for it.

    keep : directory that the output is written to and stays in; None for one that is removed.
    Raises SplatpipeError with the run's own line if it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = keep or Path(folder) / "out"
        nothing = [f"output.{kind}=false" for kind in ("png", "mp4", "depth", "normals")]
        sets = [*nothing, *overrides, f"output.directory={out}"]
        command = [sys.executable, "-m", "splatpipe.cluster", "run", str(config)]
        command += [part for item in sets for part in ("--set", item)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SplatpipeError(done.stderr.strip().removeprefix("splatpipe: "))
        return json.loads((out / "run.json").read_text())
