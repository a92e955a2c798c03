"""The report: work–precision diagrams, the table, and what was left out.

A diagram has error upwards and cost to the right, both logarithmic: one line a method, and a ring around each point
that no other beats in both (the Pareto front). Exact points, whose error is zero, stand on a line of their own below.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..report import Report
from .config import ErrorConfig
from .sweep import Sweep

Row = dict[str, Any]


@dataclass(frozen=True)
class Axis:
    """A column of the rows as an axis of the diagrams.

    sections : methods that sweep a key of these sections are drawn against it; others do not change it.
    """

    column: str
    label: str
    sections: tuple[str, ...] = ()


COSTS = (
    Axis("frame_ms", "frame time, ms (median)", ("sampling", "render", "culling", "splats")),
    Axis("read_bytes", "bytes of points read a frame", ("sampling", "culling", "positions")),
    Axis("message_bytes", "message bytes a frame (between ranks)", ("sampling", "culling")),
    Axis("frame_bytes", "bytes a frame (messages + picture)", ("sampling", "render", "culling", "splats", "image")),
    Axis("position_bytes", "bytes a position (resident)", ("positions",)),
)
ERRORS = (
    Axis("flip", "FLIP, mean"),
    Axis("dissimilarity", "1 − SSIM"),
    Axis("rmse", "colour RMSE, whole picture"),
    Axis("coverage_error", "coverage error: holes + false pixels"),
    Axis("colour_rmse", "colour RMSE, reference's foreground"),
    Axis("depth_rmse", "depth RMSE / scene radius"),
)

COLUMNS = {
    "method": "method",
    "value": "value",
    "order": "order",
    "frame_ms": "frame ms",
    "frame_q1_ms": "1st quartile",
    "frame_q3_ms": "3rd",
    "culling_ms": "cull ms",
    "sampling_ms": "sample ms",
    "render_ms": "render ms",
    "encode_ms": "encode ms",
    "points": "points drawn",
    "pooled_points": "from pools",
    "read_bytes": "bytes read",
    "message_bytes": "message bytes",
    "picture_bytes": "picture bytes",
    "flip": "FLIP",
    "ssim": "SSIM",
    "psnr_db": "PSNR dB",
    "colour_psnr_db": "foreground PSNR dB",
    "holes": "holes",
    "false_pixels": "false px",
    "depth_rmse": "depth RMSE / radius",
}

_LEGEND = (
    "Reference: every input point in float64, no level of detail, no rounding, at the same cameras and point size; "
    "positions are the stored ones, within 2⁻²⁵ of a block's edge of the source's. "
    "Frame time: culling, sampling and drawing by one rank, warm, mean over the cameras; median and quartiles of "
    "the repeats. Encoding is timed apart, errors are computed in a pass of their own. "
    "Bytes read: positions and colours of the points of a frame; of those from pools, vertices, translations, tags, "
    "palettes and a byte of colour each. "
    "Bytes a frame: camera (twice), visibility bits and render-points as sent, and the encoded picture. "
    "Errors are means over the cameras. FLIP (0…1, 67 pixels a degree), SSIM (Gaussian window, σ = 1.5 px) and "
    "PSNR (range 255, 100 dB where equal) are of the whole picture; foreground PSNR, holes and false pixels (shares) "
    "of the pixels that the reference covers; depth RMSE of the pixels that both cover, as a share of the scene's "
    "radius. "
    "Ringed in the diagrams: the Pareto front, the points that no other beats in both; a dotted line is zero error, "
    "grey bars are quartiles."
)

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000", "#7f7f7f")  # Okabe and Ito
_MARKERS = "osD^vP*X"
_FRONT = "Pareto front"


def error_report(sweep: Sweep, config: ErrorConfig, command: str) -> Report:
    """Diagrams and a table for each scene, then the omissions."""
    report = Report("Error against run time", command)
    report.text(_LEGEND)
    for scene in config.scene:
        rows = [row for row in sweep.rows if row["scene"] == scene.name]
        report.heading(scene.name)
        if not rows:
            report.text("No point of this scene could be measured.")
            continue
        size = f"{rows[0]['width']}×{rows[0]['height']} px, frames {config.frames}, {config.repeats} repeats"
        for cost in COSTS:
            drawn = [row for row in rows if _section(row) in cost.sections]
            if drawn:
                report.plot(_diagrams(drawn, cost), f"{scene.name}: error against {cost.label}. {size}.")
        fronts = _front_names(rows)
        cells = [[*(row[key] for key in COLUMNS), front] for row, front in zip(rows, fronts, strict=True)]
        report.table([*COLUMNS.values(), "FLIP front"], cells, f"{scene.name}, {size}")
    report.heading("Omissions")
    report.table(["left out", "why"], [[omission.what, omission.why] for omission in sweep.omissions])
    return report


def pareto_front(cost: Sequence[float], error: Sequence[float]) -> list[int]:
    """Indices of the points that no other beats: none has less cost and no more error, or less error and no more cost.

    Ascending in cost. Of equal points the first.
    """
    front: list[int] = []
    for i in sorted(range(len(cost)), key=lambda i: (cost[i], error[i], i)):
        if not front or error[i] < error[front[-1]]:
            front.append(i)
    return front


def _section(row: Row) -> str:
    return row["key"].partition(".")[0]


def _front_names(rows: list[Row]) -> list[str]:
    """For each row, the costs in whose diagram against FLIP it is on the front."""
    names: list[list[str]] = [[] for _ in rows]
    for cost, name in zip(COSTS, ("time", "bytes read", "message bytes", "bytes", "position bytes"), strict=True):
        drawn = [i for i, row in enumerate(rows) if _section(row) in cost.sections]
        for i in pareto_front([rows[i][cost.column] for i in drawn], [rows[i]["flip"] for i in drawn]):
            names[drawn[i]].append(name)
    return [", ".join(found) for found in names]


def _diagrams(rows: list[Row], cost: Axis) -> Any:
    """A diagram for each error of which some row has a value."""
    from matplotlib.figure import Figure

    errors = [error for error in ERRORS if any(row[error.column] is not None for row in rows)]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    n_rows = -(-len(errors) // 3)
    figure = Figure(figsize=(15, 4 * n_rows))
    panels = figure.subplots(n_rows, 3, squeeze=False, gridspec_kw={"wspace": 0.3, "hspace": 0.28}).ravel()
    for panel, error in zip(panels, errors, strict=False):
        _diagram(panel, [row for row in rows if row[error.column] is not None], methods, cost, error)
    for panel in panels[len(errors) :]:
        panel.set_axis_off()
    handles = {}
    for panel in panels:
        handles |= {label: handle for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
    order = [label for label in (*methods, _FRONT) if label in handles]
    figure.legend(
        [handles[label] for label in order],
        order,
        loc="lower center",
        bbox_to_anchor=(0.5, 0.9),
        ncols=4,
        frameon=False,
    )
    return figure


def _diagram(panel: Any, rows: list[Row], methods: list[str], cost: Axis, error: Axis) -> None:
    from matplotlib.ticker import EngFormatter, LogFormatter

    class ShortFormatter(LogFormatter):
        """2M for 2e+06: neighbouring labels of an axis of bytes would overlap."""

        def __call__(self, x: float, pos: int | None = None) -> str:
            text = super().__call__(x, pos)
            return EngFormatter(sep="")(x) if text and x >= 1e4 else text

    panel.set(xscale="log", yscale="log", xlabel=cost.label, ylabel=error.label)
    for axis in (panel.xaxis, panel.yaxis):  # plain numbers: typesetting powers of ten is most of the cost of a figure
        axis.set_major_formatter(ShortFormatter())
        axis.set_minor_formatter(ShortFormatter(minor_thresholds=(1.0, 0.5)))
    panel.grid(which="both", alpha=0.25, linewidth=0.5)
    panel.margins(x=0.14, y=0.08)
    positive = [row[error.column] for row in rows if row[error.column] > 0]
    exact = 0.3 * min(positive, default=1.0)
    x = np.array([row[cost.column] for row in rows])
    y = np.array([row[error.column] or exact for row in rows])
    if len(positive) < len(rows):
        panel.axhline(exact, color="#999999", linewidth=0.8, linestyle=":")
        panel.annotate("0", (1.005, exact), xycoords=("axes fraction", "data"), va="center", fontsize=9)
    if cost.column == "frame_ms":
        quartiles = [[row[key] for row in rows] for key in ("frame_q1_ms", "frame_q3_ms")]
        panel.hlines(y, *quartiles, color="#999999", linewidth=1.0)
    front = pareto_front(x.tolist(), y.tolist())
    ring = {"markersize": 12, "markerfacecolor": "none", "markeredgecolor": "black", "markeredgewidth": 0.8}
    panel.plot(x[front], y[front], "o", label=_FRONT, **ring)
    first = [*front, *(i for i in range(len(rows)) if i not in front)]
    for k, method in enumerate(methods):
        own = [i for i, row in enumerate(rows) if row["method"] == method]
        if own:
            line = "" if isinstance(rows[own[0]]["value"], str) else "-"  # there is nothing between two names
            panel.plot(
                x[own],
                y[own],
                _MARKERS[k % len(_COLOURS)] + line,
                color=_COLOURS[k % len(_COLOURS)],
                label=method,
                markersize=5,
            )
    _write_values(panel, [rows[i] for i in first], x[first], y[first], methods)


def _write_values(panel: Any, rows: list[Row], x: np.ndarray, y: np.ndarray, methods: list[str]) -> None:
    """The swept value beside each point; one that would cover an earlier one is left out."""
    panel.autoscale_view()  # else the limits are found when the figure is drawn, and positions before that are wrong
    places = panel.transAxes.inverted().transform(panel.transData.transform(np.column_stack([x, y])))
    written: list[tuple[float, float, float]] = []  # left end, right end, height; shares of the diagram
    for row, (across, up), point in zip(rows, places, zip(x, y, strict=True), strict=True):
        text = str(row["value"])
        length = 0.022 * len(text) + 0.01
        at_edge = across + length > 0.97
        left = across - length - 0.02 if at_edge else across + 0.02
        if all(left > end or left + length < start or abs(up - height) > 0.05 for start, end, height in written):
            written.append((left, left + length, up))
            colour = _COLOURS[methods.index(row["method"]) % len(_COLOURS)]
            offset, side = ((-6, 4), "right") if at_edge else ((6, 4), "left")
            panel.annotate(text, point, offset, textcoords="offset points", ha=side, fontsize=8, color=colour)
