"""What was predicted, for people: costs and residuals, forecasts, ranks on paper, predicted beside measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..experiment.grid import describe
from ..report import Report
from .costs import Costs
from .forecast import Forecast
from .parts import MOST_COUNTED
from .scaling import OnPaper
from .validate import MEDIAN_GOAL, WORST_GOAL, Comparison, errors

ASSUMPTIONS = (
    "Stage costs are linear in cells, entries, points and pixels; on cores that ranks share, work takes busy cores / "
    "cores times as long, and each further busy core slows the others by the fitted contention. Output is off: "
    "encoding pictures and films is not predicted. Bytes between ranks of a host travel at an assumed 10 GB/s unless "
    "told otherwise, those between hosts at the rate of their links; messages are taken to be uncoded, tiles even."
)

MOST_SHOWN = 4
"""Ranks and links whose utilisation a row says."""

BEST = " Of each setting the fastest repeat counts: the machine was shared, and what others take only ever slows a run."


def add_costs(report: Report, costs: Costs) -> None:
    """The fitted costs with their residuals."""
    rows = [
        [stage, feature, 1e9 * seconds if seconds else None, cost.residual if i == 0 else None]
        for stage, cost in costs.stages.items()
        for i, (feature, seconds) in enumerate(cost.seconds.items())
    ]
    report.table(["stage", "of one", "ns", "residual (rms, of the mean)"], rows)
    report.text(
        f"Outside the stages {1e3 * costs.loop_s:.3g} ms a frame; {1e6 * costs.message_s:.3g} µs a message sent or "
        f"received; each further busy core slows a core by {costs.contention:.1%}; other ranks on the cores of a rank "
        f"with a thread on each cost it {1e3 * costs.late_s:.3g} ms a frame."
    )


def add_forecasts(report: Report, forecasts: Sequence[tuple[str, Forecast]]) -> None:
    """One row a case; the first is what the others are compared with."""
    base = forecasts[0][1].frames_per_s
    rows = []
    for name, found in forecasts:
        shares = sorted(found.schedule.utilisation.items(), key=lambda of: -of[1])[:MOST_SHOWN]
        use = ", ".join(f"{on} {share:.0%}" for on, share in shares)
        setting = f"{found.setting.topology}, {found.setting.size} ranks, {found.setting.threads} threads"
        rate = found.frames_per_s
        rows.append([name, setting, rate, rate / base, found.latency_ms, *found.limit, use])
    columns = ["case", "setting", "frames/s", "of the first", "latency, ms", "bottleneck", "inequality", "busiest"]
    report.table(columns, rows)


def add_scaling(report: Report, cases: dict[str, dict[str, dict[int, OnPaper]]]) -> None:
    """Case → topology → ranks → what it would do: all of the first case with a curve each, the most of the others."""
    from matplotlib.figure import Figure

    report.heading("On paper: every topology on more ranks")
    report.text(
        "Each rank with a core and a link of its own and one thread, its part counted from the scene as far as "
        f"{MOST_COUNTED} ranks and continued from there, messages as dear as measured here, framebuffers sent to the "
        "display rank. The limit is what has most to do in a frame, and the condition of the thesis (3.3.1) that the "
        "largest part of that breaks first."
    )
    rows = [
        [case, found.said, ranks, found.frames_per_s, 1e3 * found.latency_s, *found.limit]
        for i, (case, topologies) in enumerate(cases.items())
        for of_topology in topologies.values()
        for ranks, found in of_topology.items()
        if i == 0 or ranks == max(of_topology)
    ]
    report.table(["case", "topology", "ranks", "frames/s", "latency, ms", "limiting", "limiting inequality"], rows)
    figure = Figure(figsize=(6, 4))
    axes = figure.add_subplot()
    for topology, found in next(iter(cases.values())).items():
        axes.loglog(list(found), [of.frames_per_s for of in found.values()], marker="o", markersize=3, label=topology)
    axes.set_xlabel("ranks")
    axes.set_ylabel("frames/s, predicted")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small")
    report.plot(figure, "Predicted frames/s of every topology on so many ranks")


def add_comparisons(report: Report, comparisons: Sequence[Comparison]) -> None:
    """Predicted beside measured, in the order of the experiment."""
    median, worst = errors(comparisons)
    verdict = "within" if median <= MEDIAN_GOAL and worst <= WORST_GOAL else "outside"
    report.heading("Predicted beside measured")
    report.text(
        f"{len(comparisons)} settings: median error {median:.1%}, worst {worst:.1%}; {verdict} the goal of "
        f"{MEDIAN_GOAL:.0%} and {WORST_GOAL:.0%}. The costs were fitted on other runs."
    )
    rows = [
        [
            describe(c.point),
            float(np.median(c.measured)),
            f"{min(c.measured):.4g}–{max(c.measured):.4g}",
            c.predicted.frames_per_s,
            f"{c.error:+.1%}",
            *c.predicted.limit,
        ]
        for c in comparisons
    ]
    report.table(["setting", "measured, frames/s", "spread", "predicted", "error", "bottleneck", "inequality"], rows)
    if comparisons:
        report.plot(_scatter(comparisons), "Predicted over measured; the band is the goal for the worst")


def _scatter(comparisons: Sequence[Comparison]) -> Any:
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    figure = Figure(figsize=(5, 5))
    axes = figure.add_subplot()
    x = np.array([np.median(c.measured) for c in comparisons])
    for topology in dict.fromkeys(c.predicted.setting.topology for c in comparisons):
        own = [i for i, c in enumerate(comparisons) if c.predicted.setting.topology == topology]
        axes.loglog(x[own], [comparisons[i].predicted.frames_per_s for i in own], "o", label=topology)
    ends = np.array([x.min() / 1.5, x.max() * 1.5])
    axes.plot(ends, ends, color="grey")
    axes.fill_between(ends, ends * (1 - WORST_GOAL), ends * (1 + WORST_GOAL), color="grey", alpha=0.15)
    for axis in (axes.xaxis, axes.yaxis):  # plain numbers, few enough not to touch
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(ScalarFormatter())
        axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("measured, frames/s")
    axes.set_ylabel("predicted, frames/s")
    axes.legend()
    return figure
