"""What ``splatpipe model`` says: console tables, JSON record, report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table

from ..record import machine_record
from ..report import Report, as_text
from .command import Model
from .errata import COLUMNS, ERRATA
from .inequalities import Condition, bottleneck
from .parameters import Quantity, parameters

_PLOTTED_MS = (1e-9, 1e12)
"""Times beyond these are drawn at the edge: for ever has to stand somewhere."""

_COLUMNS = ("", "condition", "where", "needed ms", "1/F ms", "margin ms", "verdict", "largest F", "largest D", "unit")


def record(model: Model) -> dict[str, Any]:
    """Everything, for JSON; numbers that are not finite become the text "inf"."""
    return _finite(
        {
            "command": "model",
            "origin": model.origin,
            "frames_per_s": model.application.frames_per_s,
            "system": asdict(model.system),
            "application": asdict(model.application),
            "conditions": [_condition_record(c) for c in model.conditions],
            "bottleneck": _bottleneck_text(model),
            "run": model.run,
            "samples": model.samples,
            "errata": [dict(zip(COLUMNS, row, strict=True)) for row in ERRATA],
            "machine": machine_record(),
        }
    )


def print_model(model: Model, console: Console) -> None:
    """The conditions as a table, what needs nothing in one line, and the bottleneck."""
    table = Table(title=f"conditions of thesis 3.3.1 at F = {model.application.frames_per_s:g} frames/s")
    for column in _COLUMNS:
        number = column[-2:] in ("ms", " F", " D")
        table.add_column(column, justify="right" if number else "left", no_wrap=number)
    for row in _rows(model):
        table.add_row(*map(as_text, row))
    console.print(table)
    console.print(f"left out, nothing to do: {_left_out(model)}")
    console.print(f"bottleneck: {_bottleneck_text(model)}")
    if model.run:
        console.print(_run_text(model))
    console.print(model.origin)


def make_report(model: Model, command: str) -> Report:
    """The report: conditions, parameters with unit and source, errata of the thesis."""
    report = Report("Performance model: does each rank keep up?", command)
    report.text(
        f"{model.origin}. A rank keeps up with F = {model.application.frames_per_s:g} frames/s if k latencies l and D "
        "data at rate B fit into a frame: k·l + D/B ≤ 1/F. Each condition stands alone (thesis 3.3.1): a rank that "
        "meets them all may still be late with their sum."
    )
    report.text(f"Bottleneck: {_bottleneck_text(model)}.")
    if model.run:
        report.text(f"{_run_text(model).capitalize()}.")
    report.heading("Conditions")
    report.plot(_figure(model), "Time that each condition needs in a frame; the line is 1/F")
    report.table(
        _COLUMNS, _rows(model), "(2′) is (2) with the program's own messages, whose receiver sleeps as it waits"
    )
    report.text(f"Left out, nothing to do: {_left_out(model)}.")
    report.heading("System parameters (thesis Table 3-1 A)")
    report.text(f"P_n = {len(model.system.ranks)} ranks. Those that share a host share its figures.")
    report.table(*_parameter_table(model.system.ranks, [rank.role for rank in model.system.ranks]))
    if model.system.links:
        names = [f"{link.sender} – {link.receiver}" for link in model.system.links]
        report.table(*_parameter_table(model.system.links, names), "Between two ranks, either way")
    report.heading("Application parameters (thesis Table 3-1 B)")
    report.table(*_parameter_table(model.application.ranks, [rank.role for rank in model.application.ranks]))
    if model.application.traffic:
        names = [f"{traffic.sender} → {traffic.receiver}" for traffic in model.application.traffic]
        report.table(*_parameter_table(model.application.traffic, names), "From rank to rank, at most")
    report.text(
        "O_CPU counts no instructions: it is the time of the rank's stage (95th percentile) in multiply-adds of S_CPU, "
        "so that (7) says how long the stage takes here, and a system file with another S_CPU how long it would take "
        "there. N_m counts reads that do not follow the one before; data read in order is fetched ahead and pays no "
        "latency. D_CP is every array of the stage once, an upper bound. Where a "
        "GPU draws, (7) of the render rank holds the GPU's time as well; (3) and (6) state it alone."
    )
    report.heading("Misprints of the thesis")
    report.table(COLUMNS, ERRATA)
    return report


def _run_text(model: Model) -> str:
    run = model.run
    return (
        f"the instrumented run reached {run['frames_per_s']:.4g} frames/s over {run['frames']} frames, "
        f"{run['topology']}, {run['rasterizer']}"
    )


def _figure(model: Model) -> Any:
    """A dot for the time that each condition needs, on a logarithmic axis; violated ones stand out."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    shown = [c for c in reversed(model.conditions) if c.need is not None and c.need.seconds > 0]
    figure = Figure(figsize=(8, 0.6 + 0.28 * len(shown)))
    axes = figure.subplots()
    times = [_within_plot(c.need.seconds * 1e3) for c in shown if c.need is not None]
    budget_ms = _within_plot(1e3 / model.application.frames_per_s)
    colours = ["#c0392b" if c.verdict == "violated" else "#4a7fb5" for c in shown]
    axes.scatter(times, [f"({c.number}) {c.what}, {c.where}" for c in shown], c=colours, s=40, zorder=2)
    axes.axvline(budget_ms, color="black", linewidth=1)
    axes.set_xscale("log")
    decades = [math.log10(t) for t in (*times, budget_ms)]
    axes.set_xlim(10.0 ** math.floor(min(decades)), 10.0 ** math.ceil(max(decades) + 0.1))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(f"ms a frame; 1/F = {budget_ms:.4g} ms")
    axes.grid(alpha=0.3)
    return figure


def _within_plot(ms: float) -> float:
    return min(max(ms, _PLOTTED_MS[0]), _PLOTTED_MS[1])


def _rows(model: Model) -> list[list[Any]]:
    """A row for each condition that needs something or cannot be evaluated."""
    rows = []
    for c in model.conditions:
        label = [f"({c.number})", c.what, f"{c.where}"]
        if c.need is None:
            if c.verdict == "unknown":
                rows.append([*label, None, c.budget_s * 1e3, None, c.verdict, None, None, c.unit])
        elif c.need.seconds > 0:
            times = [c.need.seconds * 1e3, c.budget_s * 1e3, (c.margin_s or 0.0) * 1e3]
            limits = [c.need.largest_frames_per_s, c.need.largest_data(c.frames_per_s)]
            rows.append([*label, *times, c.verdict, *limits, c.unit])
    return rows


def _left_out(model: Model) -> str:
    idle: dict[str, list[str]] = {}
    for c in model.conditions:
        if c.verdict == "not applicable" or (c.need is not None and c.need.seconds == 0):
            idle.setdefault(c.where, []).append(f"({c.number})")
    return "; ".join(f"{where} {' '.join(numbers)}" for where, numbers in idle.items()) or "none"


def _bottleneck_text(model: Model) -> str:
    limiting = bottleneck(model.conditions)
    if limiting is None or limiting.need is None:
        return "none: nothing limits the frame rate"
    rate = limiting.need.largest_frames_per_s
    return f"({limiting.number}) {limiting.what}, {limiting.where}: at most {as_text(rate)} frames/s"


def _parameter_table(parts: Sequence[Any], names: Sequence[str]) -> tuple[list[str], list[list[Any]]]:
    """Columns and rows: one parameter a row, its values, and where they come from."""
    columns = ["symbol", "meaning", "unit", *names, "source"]
    rows = []
    for item in parameters(parts[0]):
        quantities: list[Quantity] = [getattr(part, item.name) for part in parts]
        telling = [q for q in quantities if q.value] or quantities  # a 0 beside other values says nothing
        said = {f"{q.source} ({q.note})" if q.note else str(q.source) for q in telling}
        values = [q.value for q in quantities]
        rows.append(
            [item.metadata["symbol"], item.metadata["meaning"], item.metadata["unit"], *values, "; ".join(sorted(said))]
        )
    return columns, rows


def _condition_record(c: Condition) -> dict[str, Any]:
    content = {"number": c.number, "what": c.what, "rank": c.rank, "where": c.where, "verdict": c.verdict}
    content |= {"budget_s": c.budget_s}
    if c.need is not None:
        content |= {
            "need": asdict(c.need),
            "needed_s": c.need.seconds,
            "margin_s": c.margin_s,
            "largest_frames_per_s": c.need.largest_frames_per_s,
            "largest_data": c.need.largest_data(c.frames_per_s),
            "unit": c.unit,
        }
    return content


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return str(content)
    return content
