"""``splatpipe predict``: fit the costs of a configuration, then forecast other settings, machines and ranks."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from ...shared.config import load_config
from ...shared.errors import InputError, SplatpipeError
from ...shared.files import write_json
from ..experiment.command import run_experiment
from ..experiment.grid import Experiment, load_experiment
from ..experiment.runner import Runner
from ..job import Job
from ..measured import measured_run
from ..report import Report
from .calibrate import all_costs, calibration_experiment, extended, measured_points
from .costs import Measured
from .forecast import Forecast, Machine
from .hybrid import Split, scaling
from .report import ASSUMPTIONS, BEST, add_comparisons, add_costs, add_forecasts, add_ranks
from .validate import compare, errors
from .whatif import Case, changed
from .workload import count_workload

LAYOUTS = (("single", 1), ("single", 0), ("pipelined", 1), ("pipelined", 0))
"""Topology and threads (0: all cores) that every prediction shows."""


def predict_command(
    config: Path, overrides: list[str], what_if: list[str], ranks: int, repeats: int, output: Path, *,
    fresh: bool = False, best: bool = False, json_path: Path | None = None, runner: Runner = measured_run,
) -> None:  # fmt: skip
    """Predict frames/s of a run configuration as it is, laid out otherwise, changed, and on ``ranks`` ranks."""
    job = Job(load_config(config, overrides))
    machine = Machine(cores=len(os.sched_getaffinity(0)))
    if job.config.render.rasterizer not in ("auto", "cpu"):
        raise InputError(
            f"{config}: render.rasterizer = {job.config.render.rasterizer!r}, expected cpu: no other model"
        )
    experiment = calibration_experiment(config, overrides, output / "calibration", repeats)
    costs = all_costs(list(_measure(experiment, fresh, best, runner).values()), machine)
    case = Case(job.config, costs, count_workload(job), machine, job.scene.info.n_points)
    forecasts = [("as configured", case.predict())]
    for topology, threads in LAYOUTS:
        other = changed(case, str(config), [*overrides, f"pipeline.topology={topology}"], f"render.threads={threads}")
        forecasts.append((f"{topology}, {threads or 'all'} threads", other.predict()))
    others = {change: changed(case, str(config), overrides, change) for change in what_if}
    forecasts += [(change, other.predict()) for change, other in others.items()]
    splits = {
        name: scaling(of.costs, of.load, of.machine, ranks) for name, of in ({"as configured": case} | others).items()
    }

    report = Report(f"What {config.stem} would do", f"splatpipe predict {config.name}")
    report.text(ASSUMPTIONS + (BEST if best else ""))
    report.heading("Forecasts")
    add_forecasts(report, forecasts)
    add_ranks(report, splits)
    report.heading("What it rests on")
    add_costs(report, costs)
    console = Console(highlight=False, soft_wrap=True)
    for name, found in forecasts:
        console.print(f"{name:28} {found.frames_per_s:9.1f} frames/s, {found.schedule.bottleneck} limits")
    for name, found in splits.items():
        last = found[max(found)]
        console.print(
            f"{name}, {max(found)} ranks on paper: {last.frames_per_s:.1f} frames/s on {last.k} : {last.m} : {last.n}, "
            f"{last.limit[0]} limits by inequality {last.limit[1]}"
        )
    for path in report.write(output / "report"):
        console.print(f"wrote {path}")
    if json_path is not None:
        paper = [
            {"case": name, "ranks": ranks} | _plain_split(split)
            for name, found in splits.items()
            for ranks, split in found.items()
        ]
        rows = [_plain(name, found) for name, found in forecasts]
        write_json(json_path, {"forecasts": rows, "ranks": paper, "costs": asdict(costs)})


def validate_command(
    file: Path, *, fresh: bool = False, best: bool = False, json_path: Path | None = None, runner: Runner = measured_run
) -> None:
    """Run an experiment and the calibration of its scenes, interleaved; say how far the predictions were off."""
    own = load_experiment(file)
    experiment = extended(own)
    measured = _measure(experiment, fresh, best, runner)
    machine = Machine(cores=len(os.sched_getaffinity(0)))
    comparisons, costs = compare(experiment, measured, len(own.points), machine)
    report = Report(
        f"Predicted and measured: {own.config.experiment.title}", f"splatpipe predict --validate {file.name}"
    )
    report.text(ASSUMPTIONS + (BEST if best else ""))
    add_comparisons(report, comparisons)
    report.heading("What it rests on")
    add_costs(report, costs)
    console = Console(highlight=False, soft_wrap=True)
    median, worst = errors(comparisons)
    console.print(f"{len(comparisons)} settings: median error {median:.1%}, worst {worst:.1%}")
    for path in report.write(experiment.output / "predicted"):
        console.print(f"wrote {path}")
    if json_path is not None:
        rows = [_plain(str(c.point), c.predicted) | {"measured": c.measured, "error": c.error} for c in comparisons]
        write_json(json_path, {"comparisons": rows, "median_error": median, "worst_error": worst})


def _measure(experiment: Experiment, fresh: bool, best: bool, runner: Runner) -> dict[int, Measured]:
    """Run what is missing of an experiment; what was measured. A point that failed is an error here."""
    journal = run_experiment(experiment, fresh=fresh, runner=runner)
    for point, why in journal.failures.items():
        raise SplatpipeError(f"point {point + 1} failed: {why}")
    return measured_points(experiment, journal, best=best)


def _plain(name: str, found: Forecast) -> dict[str, Any]:
    return {
        "case": name,
        "frames_per_s": found.frames_per_s,
        "latency_ms": found.latency_ms,
        "bottleneck": found.schedule.bottleneck,
        "utilisation": found.schedule.utilisation,
        "inflation": found.inflation,
    }


def _plain_split(split: Split) -> dict[str, Any]:
    stage, inequality = split.limit
    figures = {"used": split.ranks, "k": split.k, "m": split.m, "n": split.n, "frames_per_s": split.frames_per_s}
    return figures | {"limiting_stage": stage, "inequality": inequality, "parts_s": split.parts_s}
