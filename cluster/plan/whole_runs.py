"""Ablation of what only a whole run shows: ranks, the film, and what the start of the program costs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..job import Job
from ..launch import mpi_available
from ..measured import measured_run
from ..record import spread_ms
from .ablation import Ablation
from .part import COLOUR_MAPS, FILM, MPI, OPENGL

_MODULES = {OPENGL: "moderngl", COLOUR_MAPS: "matplotlib", MPI: "mpi4py.MPI", FILM: "av"}
_FRAMES = 40
_CHECKED_FRAMES = 3


def ablate_runs(job: Job, config: Path, overrides: list[str], repeats: int = 3) -> list[Ablation]:
    """Run ``config`` on one rank without and with three ranks, a film, each in turn; milliseconds a frame."""
    base = [*overrides, f"output.frames={_FRAMES}", "pipeline.topology=single"]
    found = []
    if mpi_available():
        found.append(_ablate(MPI, config, base, ["pipeline.topology=pipelined"], repeats))
    if not job.config.output.mp4 and _import_s("av"):
        found.append(_ablate(FILM, config, base, ["output.mp4=true"], repeats))
    return found


def _ablate(part: str, config: Path, base: list[str], added: list[str], repeats: int) -> Ablation:
    runs = [(measured_run(config, base), measured_run(config, [*base, *added])) for _ in range(repeats)]
    without, with_part = np.array([[run["seconds"] / run["frames"] for run in pair] for pair in runs]).T
    return Ablation(
        part=part,
        once=False,
        without_ms=spread_ms(without.tolist()),
        with_ms=spread_ms(with_part.tolist()),
        saved_ms=float(np.median(with_part - without)) * 1e3,
        identical=same_pictures(config, base, added),
        repeats=repeats,
    )


def same_pictures(config: Path, base: list[str], added: list[str]) -> bool:
    """Whether the first frames' PNG files are the same bytes with and without ``added``."""
    with TemporaryDirectory() as folder:
        written = []
        for name, sets in (("without", base), ("with", [*base, *added])):
            kept = Path(folder) / name
            measured_run(config, [*sets, "output.png=true", f"output.frames={_CHECKED_FRAMES}"], keep=kept)
            written.append([path.read_bytes() for path in sorted(kept.glob("frame_*.png"))])
        return len(written[0]) == _CHECKED_FRAMES and written[0] == written[1]


def import_times(repeats: int = 3) -> list[dict[str, Any]]:
    """Seconds that importing each optional module takes in a fresh process; modules that are missing are left out."""
    rows = []
    for part, module in _MODULES.items():
        seconds = [s for s in (_import_s(module) for _ in range(repeats)) if s is not None]
        if seconds:
            rows.append({"part": part, "module": module, "ms": spread_ms(seconds)})
    return rows


def _import_s(module: str) -> float | None:
    program = f"import time, numpy\nt = time.perf_counter()\nimport {module}\nprint(time.perf_counter() - t)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    return float(done.stdout) if done.returncode == 0 else None
