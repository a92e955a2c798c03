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
    Axis("frame_ms", "frame time, ms (median)", ("sampling", "render", "culling")),
    Axis("frame_bytes", "bytes a frame (messages + picture)", ("sampling", "render", "culling", "image")),
    Axis("position_bytes", "bytes a position (resident)", ("positions",)),
)
ERRORS = (
    Axis("flip", "FLIP, mean"),
    Axis("dissimilarity", "1 − SSIM"),
    Axis("coverage_error", "coverage error (holes + false)"),
    Axis("colour_rmse", "colour RMSE on the foreground"),
)

COLUMNS = {
    "method": "method",
    "value": "value",
    "order": "order",
    "frame_ms": "frame ms",
    "frame_min_ms": "min",
    "frame_max_ms": "max",
    "culling_ms": "cull ms",
    "sampling_ms": "sample ms",
    "render_ms": "render ms",
    "encode_ms": "encode ms",
    "points": "points drawn",
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
    "Frame time: culling, sampling and drawing by one rank, warm, mean over the cameras; median, least and greatest "
    "of the repeats. Encoding is timed apart, errors are computed in a pass of their own. "
    "Bytes a frame: camera (twice), visibility bits and render-points as sent, and the encoded picture. "
    "Errors are means over the cameras. FLIP (0…1, 67 pixels a degree), SSIM (Gaussian window, σ = 1.5 px) and "
    "PSNR (range 255, 100 dB where equal) are of the whole picture; foreground PSNR, holes and false pixels (shares) "
    "of the pixels that the reference covers; depth RMSE of the pixels that both cover, as a share of the scene's "
    "radius."
)

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000", "#7f7f7f")  # Okabe and Ito
_MARKERS = "osD^vP*X"


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
        report.plot(_diagrams(rows), f"{scene.name}, {size}. Ringed: the Pareto front.")
        fronts = _front_names(rows)
        cells = [[*(row[key] for key in COLUMNS), fronts[i]] for i, row in enumerate(rows)]
        report.table([*COLUMNS.values(), "FLIP front"], cells, f"{scene.name}, {rows[0]['rasterizer']}")
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


def _drawn(rows: list[Row], cost: Axis, error: Axis) -> list[Row]:
    """The rows that have a place in a diagram."""
    return [row for row in rows if row["key"].partition(".")[0] in cost.sections and row[error.column] is not None]


def _front_names(rows: list[Row]) -> list[str]:
    """For each row, the costs in whose diagram against FLIP it is on the front."""
    names: list[list[str]] = [[] for _ in rows]
    for cost, name in zip(COSTS, ("time", "bytes", "position bytes"), strict=True):
        drawn = [i for i, row in enumerate(rows) if row in _drawn([row], cost, ERRORS[0])]
        for i in pareto_front([rows[i][cost.column] for i in drawn], [rows[i]["flip"] for i in drawn]):
            names[drawn[i]].append(name)
    return [", ".join(found) for found in names]


def _diagrams(rows: list[Row]) -> Any:
    """One scene: a row of diagrams for each error, a column for each cost that some method changes."""
    from matplotlib.figure import Figure

    costs = [cost for cost in COSTS if any(row["key"].partition(".")[0] in cost.sections for row in rows)]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    figure = Figure(figsize=(4.6 * len(costs), 3.2 * len(ERRORS)), layout="constrained")
    panels = figure.subplots(len(ERRORS), len(costs), squeeze=False, sharex="col")
    for i, error in enumerate(ERRORS):
        for j, cost in enumerate(costs):
            _diagram(panels[i, j], _drawn(rows, cost, error), methods, cost, error)
            panels[i, j].set_ylabel(error.label)
            if i == len(ERRORS) - 1:
                panels[i, j].set_xlabel(cost.label)
    handles = {}
    for panel in panels.flat:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def _diagram(panel: Any, rows: list[Row], methods: list[str], cost: Axis, error: Axis) -> None:
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.grid(which="both", alpha=0.25, linewidth=0.5)
    positive = [row[error.column] for row in rows if row[error.column] > 0]
    exact = 0.3 * min(positive) if positive else 1e-3
    height = np.array([row[error.column] or exact for row in rows])
    width = np.array([row[cost.column] for row in rows])
    if len(positive) < len(rows):
        panel.axhline(exact, color="#999999", linewidth=0.8, linestyle=":")
        panel.annotate(
            "0: equal", (0.99, exact), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=7
        )
    for k, method in enumerate(methods):
        own = [i for i, row in enumerate(rows) if row["method"] == method]
        if not own:
            continue
        ordered = all(not isinstance(rows[i]["value"], str) for i in own)  # names have no line between them
        style = {"color": _COLOURS[k % len(_COLOURS)], "marker": _MARKERS[k % len(_MARKERS)], "markersize": 5}
        panel.plot(width[own], height[own], linestyle="-" if ordered else "", linewidth=1.2, label=method, **style)
        for i in own:
            panel.annotate(
                str(rows[i]["value"]),
                (width[i], height[i]),
                (4, 3),
                textcoords="offset points",
                fontsize=6,
                color=style["color"],
            )
    front = pareto_front(width.tolist(), height.tolist())
    ring = {"marker": "o", "markersize": 11, "markerfacecolor": "none", "markeredgecolor": "black", "linestyle": ""}
    panel.plot(width[front], height[front], markeredgewidth=0.8, label="Pareto front", **ring)
