"""What was predicted, for people: costs and residuals, forecasts, ranks on paper, predicted beside measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..experiment.grid import describe
from ..report import Report
from .costs import Costs
from .forecast import Forecast
from .hybrid import Split
from .validate import MEDIAN_GOAL, WORST_GOAL, Comparison, errors

ASSUMPTIONS = (
    "Stage costs are linear in cells, entries, points and pixels; on cores that ranks share, work takes busy cores / "
    "cores times as long, and each further busy core slows the others by the fitted contention. Output is off: "
    "encoding pictures and films is not predicted. Message bytes travel at an assumed 10 GB/s unless told otherwise."
)

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
        use = ", ".join(f"{stage} {share:.0%}" for stage, share in found.schedule.utilisation.items())
        setting = f"{found.setting.topology}, {found.setting.threads} threads"
        bottleneck = found.schedule.bottleneck
        rows.append([name, setting, found.frames_per_s, found.frames_per_s / base, found.latency_ms, bottleneck, use])
    report.table(["case", "setting", "frames/s", "of the first", "latency, ms", "bottleneck", "utilisation"], rows)


def add_ranks(report: Report, cases: dict[str, dict[int, Split]]) -> None:
    """Case → ranks → best split: all of the first case, the most ranks of the others, a curve for each."""
    from matplotlib.figure import Figure

    report.heading("On paper: k culling, m sampling, n render ranks")
    report.text(
        "Each rank with a core of its own and its share of subtrees or points, messages as dear as measured here, "
        "pictures composited by binary swap. No more ranks are used than pay. The limit is the largest part of the "
        "slowest kind of rank, and the condition of the thesis (3.3.1) that it breaks first."
    )
    columns = ["case", "ranks", "used, k : m : n", "frames/s", "latency, ms", "limiting stage", "limiting inequality"]
    rows = [
        [case, ranks, f"{s.k} : {s.m} : {s.n}", s.frames_per_s, 1e3 * s.latency_s, *s.limit]
        for i, (case, splits) in enumerate(cases.items())
        for ranks, s in splits.items()
        if i == 0 or ranks == max(splits)
    ]
    report.table(columns, rows)
    figure = Figure(figsize=(6, 4))
    axes = figure.add_subplot()
    for case, splits in cases.items():
        axes.loglog(list(splits), [s.frames_per_s for s in splits.values()], marker="o", markersize=3, label=case)
    axes.set_xlabel("ranks")
    axes.set_ylabel("frames/s, predicted")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small")
    report.plot(figure, "Predicted frames/s of the best split of so many ranks")


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
            c.predicted.schedule.bottleneck,
        ]
        for c in comparisons
    ]
    report.table(["setting", "measured, frames/s", "spread", "predicted", "error", "bottleneck"], rows)
    if comparisons:
        report.plot(_scatter(comparisons), "Predicted over measured; the band is the goal for the worst")


def _scatter(comparisons: Sequence[Comparison]) -> Any:
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    figure = Figure(figsize=(5, 5))
    axes = figure.add_subplot()
    x = np.array([np.median(c.measured) for c in comparisons])
    for topology in ("single", "pipelined"):
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
