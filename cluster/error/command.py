"""``splatpipe error CONFIG``."""

from __future__ import annotations

import csv
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from ...shared.files import write_json, write_whole
from ..progress import FrameProgress
from ..record import machine_record
from .config import load_error_config
from .report import error_report
from .sweep import Sweep, run_sweep


def error_command(config_path: Path, json: Path | None) -> None:
    """Measure, and write errors.csv, errors.html and errors.md into the output directory."""
    config = load_error_config(config_path)
    output = Path(config.run.output.directory)
    with FrameProgress(None) as progress:
        sweep = run_sweep(config, str(config_path), progress)
    write_whole(output / "errors.csv", lambda part: _write_csv(part, sweep))
    written = [
        output / "errors.csv",
        *error_report(sweep, config, f"splatpipe error {config_path}").write(output / "errors"),
    ]
    if json is not None:
        omissions = [asdict(omission) for omission in sweep.omissions]
        content = {"config": config.model_dump(mode="json"), "rows": sweep.rows, "omissions": omissions}
        write_json(json, {**content, "machine": machine_record()})
        written.append(json)
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"{len(sweep.rows)} points on {len(config.scene)} scenes; wrote {', '.join(map(str, written))}")


def _write_csv(path: Path, sweep: Sweep) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, sweep.rows[0].keys() if sweep.rows else ["scene"])
        writer.writeheader()
        writer.writerows(sweep.rows)
