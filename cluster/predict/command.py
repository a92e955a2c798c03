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
from .calibrate import OWN_RANKS, all_costs, calibration_experiment, extended, measured_points
from .costs import Measured
from .forecast import Forecast
from .machine import Machine, measured_machine
from .report import ASSUMPTIONS, BEST, add_comparisons, add_costs, add_forecasts, add_scaling
from .scaling import OnPaper, scaling_table
from .setting import Setting
from .validate import Comparison, compare, errors
from .whatif import Case, changed

LAYOUTS = (("single", 1), ("single", 0), ("pipelined", 1), ("pipelined", 0))
"""Topology and threads (0: all cores) that every prediction shows."""


def predict_command(
    config: Path, overrides: list[str], what_if: list[str], ranks: int, repeats: int, output: Path, *,
    fresh: bool = False, best: bool = False, links: bool = False, json_path: Path | None = None,
    runner: Runner = measured_run,
) -> None:  # fmt: skip
    """Predict frames/s of a run configuration as it is, laid out otherwise, changed, and on ``ranks`` ranks.

    links : whether to measure the link between hosts first.
    """
    job = Job(load_config(config, overrides))
    if job.config.render.rasterizer not in ("auto", "cpu"):
        raise InputError(
            f"{config}: render.rasterizer = {job.config.render.rasterizer!r}, expected cpu: no other model"
        )
    machine = _machine(Setting.of(job.config).size, links)
    experiment = calibration_experiment(config, overrides, output / "calibration", repeats)
    costs = all_costs(list(_measure(experiment, fresh, best, runner).values()), machine)
    case = Case.of(job, costs, machine)
    forecasts = [("as configured", case.predict())]
    for topology, threads in LAYOUTS:
        layout = [f"pipeline.topology={topology}", *(f"{key}={value}" for key, value in OWN_RANKS.items())]
        other = changed(case, str(config), [*overrides, *layout], f"render.threads={threads}")
        forecasts.append((f"{topology}, {threads or 'all'} threads", other.predict()))
    others = {change: changed(case, str(config), overrides, change) for change in what_if}
    forecasts += [(change, other.predict()) for change, other in others.items()]
    paper = {"as configured": scaling_table(case.costs, case.parts, case.machine, ranks)}
    for name, of in others.items():
        paper[name] = scaling_table(of.costs, of.parts, of.machine, ranks, ["hybrid"])

    report = Report(f"What {config.stem} would do", f"splatpipe predict {config.name}")
    report.text(ASSUMPTIONS + (BEST if best else ""))
    report.heading("Forecasts")
    add_forecasts(report, forecasts)
    add_scaling(report, paper)
    report.heading("What it rests on")
    add_costs(report, costs)
    console = Console(highlight=False, soft_wrap=True)
    for name, found in forecasts:
        console.print(f"{name:28} {found.frames_per_s:9.1f} frames/s, {found.schedule.bottleneck} limits")
    for found in paper["as configured"].values():
        last = found[max(found)]
        console.print(
            f"{last.said}, {max(found)} ranks on paper: {last.frames_per_s:.1f} frames/s, {last.limit[0]} limits by "
            f"inequality {last.limit[1]}"
        )
    for path in report.write(output / "report"):
        console.print(f"wrote {path}")
    if json_path is not None:
        table = [
            {"case": case, "topology": topology, "ranks": n} | _plain_on_paper(found)
            for case, of_case in paper.items()
            for topology, of_topology in of_case.items()
            for n, found in of_topology.items()
        ]
        rows = [_plain(name, found) for name, found in forecasts]
        write_json(json_path, {"forecasts": rows, "ranks": table, "costs": asdict(costs), "machine": asdict(machine)})


def validate_command(
    file: Path, output: Path | None = None, *, fresh: bool = False, best: bool = False, links: bool = False,
    json_path: Path | None = None, runner: Runner = measured_run,
) -> None:  # fmt: skip
    """Run an experiment and the calibration of its scenes, interleaved; say how far the predictions were off.

    output : for runs and report, if not where the experiment says.
    links : whether to measure the link between hosts first.
    """
    own = load_experiment(file, output)
    machine = _machine(max(Setting.of(run).size for run in own.runs), links)
    experiment = extended(own)
    measured = _measure(experiment, fresh, best, runner)
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
        rows = [_plain(str(c.point), c.predicted) | _compared(c) for c in comparisons]
        found = {"comparisons": rows, "median_error": median, "worst_error": worst}
        write_json(json_path, found | {"costs": asdict(costs), "machine": asdict(machine)})


def _machine(ranks: int, links: bool) -> Machine:
    """What the ranks of this launcher have; without ``links`` as if they all were on this host."""
    return measured_machine(max(ranks, 2)) if links else Machine(cores=len(os.sched_getaffinity(0)))


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
        "inequality": found.limit[1],
        "utilisation": found.schedule.utilisation,
        "inflation": found.inflation,
    }


def _compared(comparison: Comparison) -> dict[str, Any]:
    """What was measured: frames/s of each repeat; of the median's, latency, bytes a frame, memory of each rank."""
    records = sorted(comparison.records, key=lambda record: record["frames_per_s"])
    record = records[len(records) // 2]
    sent = sum(kind["bytes"] for kind in record.get("messages", {}).values())
    return {
        "point": comparison.point,
        "measured": comparison.measured,
        "measured_latency_ms": record.get("latency_ms", {}).get("median"),
        "bytes_per_frame": sent / len(record["per_frame"]["render_s"]),
        "peak_rss_bytes": [rank["peak_rss_bytes"] for rank in record.get("ranks", ())],
        "hosts": [rank["host"] for rank in record.get("ranks", ())],
        "error": comparison.error,
    }


def _plain_on_paper(found: OnPaper) -> dict[str, Any]:
    return {
        "used": found.setting.size,
        "frames_per_s": found.frames_per_s,
        "latency_ms": 1e3 * found.latency_s,
        "limiting": found.limit[0],
        "inequality": found.limit[1],
    }
