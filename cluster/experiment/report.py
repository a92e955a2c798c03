"""The report of an experiment: medians with spread, a plot, scaling, ours beside the paper's, what failed and why."""

from __future__ import annotations

from typing import Any

from ..report import Report
from .grid import Experiment, describe
from .journal import Journal
from .table import Row, beside_paper

_SHOWN = ("latency_ms", "culling_ms", "sampling_ms", "render_ms", "entries", "points")
_UNITS = {"frames_per_s": "frames/s", "latency_ms": "latency, ms"}


def make_report(experiment: Experiment, journal: Journal, rows: list[Row], medians: list[Row]) -> Report:
    """The report of what has been measured so far."""
    settings = experiment.config.experiment
    report = Report(settings.title or experiment.file.stem, f"splatpipe experiment {experiment.file.name}")
    if settings.notes:
        report.text(settings.notes)
    measured = len({row["point"] for row in rows})
    report.text(
        f"{len(rows)} runs of {measured} of {len(experiment.points)} points, each in a fresh process, "
        f"repeats interleaved. Base configuration {settings.base}; "
        f"the same in every point: {describe(experiment.config.set)}."
    )
    _medians(report, experiment, medians)
    if medians:
        report.plot(_figure(experiment, medians), f"{settings.measure}: median, bars from least to largest")
    _paper(report, experiment, rows)
    report.heading("What failed, and why")
    if journal.failures:
        report.table(
            ["point", "settings", "why"],
            [[i + 1, describe(experiment.points[i]), why] for i, why in sorted(journal.failures.items())],
        )
    else:
        report.text("Nothing.")
    return report


def _medians(report: Report, experiment: Experiment, medians: list[Row]) -> None:
    report.heading("Medians")
    measure = experiment.config.experiment.measure
    scaling = ["speed_up", "efficiency"] if experiment.config.scaling else []
    others = [name for name in _SHOWN if name != measure]
    columns = [*experiment.keys, "repeats", measure, "least", "largest", *scaling, *others]
    rows = [[_cell(row[column]) for column in columns] for row in medians]
    report.table(columns, rows, "Stage times are means over the frames of a run; counts are a frame's, medians.")


def _paper(report: Report, experiment: Experiment, rows: list[Row]) -> None:
    if not experiment.config.paper:
        return
    report.heading("Beside the paper")
    table = []
    for figure, ours in beside_paper(experiment, rows):
        low, high = figure.value if isinstance(figure.value, tuple) else (figure.value, figure.value)
        theirs = f"{low:g}" if low == high else f"{low:g}–{high:g}"
        ratio = ours / ((low + high) / 2) if ours is not None and low + high > 0 else None
        table.append([figure.source, describe(figure.where), figure.measure, theirs, ours, ratio])
    report.table(["source", "where", "measure", "paper", "ours", "ours / paper"], table)


def _figure(experiment: Experiment, medians: list[Row]) -> Any:
    """The main measure over the first key that varies, one line for each setting of the others."""
    from matplotlib.figure import Figure

    measure = experiment.config.experiment.measure
    varied = [key for key in experiment.keys if len({repr(row[key]) for row in medians}) > 1] or experiment.keys[:1]
    over = experiment.config.scaling.over if experiment.config.scaling else (varied[0] if varied else "point")
    lines: dict[str, list[Row]] = {}
    for row in medians:
        name = ", ".join(f"{key.partition('.')[2]} {_short(row[key])}" for key in varied if key != over)
        lines.setdefault(name, []).append(row)
    figure = Figure(figsize=(7, 4.2))
    axes = figure.add_subplot()
    numbers = all(isinstance(row[over], int | float) for row in medians)
    for name, rows in lines.items():
        if numbers:
            rows = sorted(rows, key=lambda row: row[over])
        x = [row[over] if numbers else _short(row[over]) for row in rows]
        y = [row[measure] for row in rows]
        spread = [[v - row["least"] for v, row in zip(y, rows, strict=True)]]
        spread.append([row["largest"] - v for v, row in zip(y, rows, strict=True)])
        axes.errorbar(x, y, yerr=spread, marker="o", capsize=3, label=name or None)
    axes.set_xlabel(over)
    axes.set_ylabel(_UNITS.get(measure, measure))
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    if len(lines) > 1:
        axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.01, 1))
    return figure


def _cell(value: Any) -> Any:
    return value if value is None or isinstance(value, str | int | float) else str(value)


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 24 else "…" + text[-23:]
