"""Every topology on more ranks than there are: each rank with a core and a link of its own, one thread.

A frame's means go through the steps of the layout; what has most to do in a frame sets the rate, and the largest part
of that is the inequality (thesis 3.3.1) that the topology breaks first. Pipelines fill: nothing waits but for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import get_args

import numpy as np

from ...shared.config import Topology
from ..topologies import FRAME_PARALLEL
from .costs import Costs
from .forecast import picture_step
from .hybrid import best_split
from .machine import Machine
from .parts import EvenParts, Kind, Part, Parts
from .recurrence import Stage, run_schedule
from .setting import Setting
from .steps import Steps, largest_part
from .workload import Workload

TOPOLOGIES = tuple(name for name in get_args(Topology) if name != "auto")
IN_FLIGHT = 4


@dataclass(frozen=True)
class OnPaper:
    """A topology on so many ranks.

    limit : (rank's role or link, inequality) that bounds the rate.
    """

    setting: Setting
    frames_per_s: float
    latency_s: float
    limit: tuple[str, str]

    @property
    def said(self) -> str:
        """The topology, with what is special about it, for people."""
        s = self.setting
        split = f" {s.culling_ranks} : {s.sampling_ranks} : {s.render_ranks}, {s.render_split}"
        return s.topology + (split if s.topology == "hybrid" else "")


class MeanParts:
    """Parts whose only frame has the mean of all frames."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self.whole = _mean_load(parts.whole)
        self._means: dict[tuple[Kind, int], list[Part]] = {}

    def of(self, kind: Kind, n: int) -> Sequence[Part]:
        """As of ``Parts``. Equal parts stay the same object."""
        if (kind, n) not in self._means:
            parts = self._parts.of(kind, n)
            means = {key: _mean_part(part) for key, part in {id(part): part for part in parts}.items()}
            self._means[kind, n] = [means[id(part)] for part in parts]
        return self._means[kind, n]


def on_paper(costs: Costs, parts: Parts, setting: Setting, machine: Machine) -> OnPaper:
    """One setting, every rank a host of its own. Cost: some 0.1 ms a rank.

    parts : of one frame.
    """
    ranks = setting.size
    link = machine.link_bytes_per_s if math.isfinite(machine.link_bytes_per_s) else machine.bandwidth_bytes_per_s
    apart = replace(machine, cores=1, hosts=ranks, link_bytes_per_s=link, shared_cores=False)
    if setting.topology == FRAME_PARALLEL:
        step = picture_step(costs, parts.whole, apart, 1, 1, ranks - 1)
        frame_s = float(step.seconds(1)[0])
        return OnPaper(setting, ranks / frame_s, frame_s, ("rank 0", largest_part([step])))
    made = Steps(setting, parts, costs, apart, named=False)
    steps, layout = made.steps, made.layout
    busy: dict[str, float] = {}
    for step in steps:
        busy[step.on] = busy.get(step.on, 0.0) + float(step.seconds(1)[0])
    limiting = max(busy, key=lambda on: busy[on])
    stages = [Stage(step.on, step.seconds(1), link_s=step.link_s, after=step.after) for step in steps]
    schedule = run_schedule(stages, in_flight=1)
    rate = 1 / busy[limiting] if busy[limiting] else np.inf
    limit = limiting, largest_part([step for step in steps if step.on == limiting])
    rank = next(step.rank for step in steps if step.on == limiting)
    if rank in layout.workers and ranks > 1:
        limit = f"{limiting}, {layout.role_of(rank)}", limit[1]
    return OnPaper(setting, rate, schedule.total_s, limit)


def scaling_table(
    costs: Costs, load: Workload | Parts, machine: Machine, largest: int, topologies: Sequence[str] = TOPOLOGIES
) -> dict[str, dict[int, OnPaper]]:
    """Topology → ranks (4, 16, … ``largest``) → what it would do; ``single`` and ``pipelined`` on theirs alone.

    Of ``hybrid`` the best of 1 : 1 : 1 and of what the closed formula finds for so many ranks or fewer
    (``hybrid.best_split``), into tiles and into shares.
    """
    whole = EvenParts(load) if isinstance(load, Workload) else load
    parts = MeanParts(whole)
    sizes = [4**i for i in range(1, 16) if 4**i < largest] + [largest]
    found: dict[str, dict[int, OnPaper]] = {}
    for topology in topologies:
        fixed = {"single": [1], "pipelined": [3]}.get(topology, sizes)
        found[topology] = {ranks: _best(costs, parts, machine, topology, ranks) for ranks in fixed}
    if "hybrid" in found:
        of_hybrid: list[OnPaper] = list(found["hybrid"].values())
        best = list(accumulate(of_hybrid, lambda a, b: a if a.frames_per_s >= b.frames_per_s else b))
        found["hybrid"] = dict(zip(found["hybrid"], best, strict=True))
    return found


def _best(costs: Costs, parts: Parts, machine: Machine, topology: str, ranks: int) -> OnPaper:
    settings = [Setting(topology, 1, IN_FLIGHT, ranks)]
    if topology == "hybrid":
        split = best_split(costs, parts.whole, machine, ranks)
        settings = [
            Setting(topology, 1, IN_FLIGHT, k + m + n, k, m, n, kind)
            for k, m, n in ((1, 1, 1), (split.k, split.m, split.n))
            for kind in ("tiles", "shares")
        ]
    return max((on_paper(costs, parts, of, machine) for of in settings), key=lambda of: of.frames_per_s)


def _mean_load(load: Workload) -> Workload:
    names = ("cells_visible", "entries", "points", "cold", "covered", "render_points_bytes")
    return replace(load, **{name: getattr(load, name).mean(keepdims=True) for name in names})


def _mean_part(part: Part) -> Part:
    filled, filled_bytes = (values.mean(keepdims=True) for values in (part.filled, part.filled_bytes))
    return Part(_mean_load(part.load), part.pixels, filled, filled_bytes)
