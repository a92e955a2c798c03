"""What ``run.json`` says of load balance: how even ranks were, frame by frame, and what was moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..layout import Layout
from .balancer import Balancer, make_policies
from .hysteresis import imbalance

ENDS = 16
"""Frames at the beginning and at the end of a run that are looked at apart."""


def balance_record(
    layout: Layout, told: Sequence[Mapping[str, Any]], balancer: Balancer | None, tiles_stay: bool = False
) -> dict[str, Any]:
    """JSON-able.

    told : of each rank, ``taken_s`` by stage, seconds of each frame as they are balanced by, and ``adopting_s`` of each
    plan, the first included.  balancer : of the run; None where it was not balanced.

    ``busy_s`` is the work of each rank; ``slowest_s`` that of the slowest rank, frame by frame: what a frame takes at
    least where each rank has cores of its own. ``imbalance`` is the slowest part over the mean of all: of the medians
    of the first and the last frames, and the median of that of ``each`` frame. ``adopting_ms`` is what the slowest rank
    took for a change of plan, in the median.
    """
    taken_s = {of["rank"]["rank"]: of["taken_s"] for of in told}
    busy = np.array([np.sum(list(of.values()), axis=0) for of in taken_s.values()])
    n = busy.shape[1]
    uneven = {}
    for policy in make_policies(layout, [np.ones(1)] * len(layout.lanes), 1, 1, tiles_stay):  # for their parts alone
        each = [imbalance(policy.parts(_medians(taken_s, slice(i, i + 1)))) for i in range(n)]
        uneven[policy.name] = {
            "first": imbalance(policy.parts(_medians(taken_s, slice(0, ENDS)))),
            "last": imbalance(policy.parts(_medians(taken_s, slice(-ENDS, None)))),
            "each": float(np.median(each)),
        }
    adopted = np.array([of["adopting_s"] for of in told])[:, 1:]
    return {
        "policy": "measured" if balancer else "off",
        "busy_s": busy.sum(axis=1).tolist(),
        "slowest_s": busy.max(axis=0).tolist(),
        "imbalance": uneven,
        "adopting_ms": 1e3 * float(np.median(adopted.max(axis=0))) if adopted.size else None,
        "changes": balancer.changes if balancer else [],
    }


def _medians(taken_s: Mapping[int, Mapping[str, Sequence[float]]], frames: slice) -> dict[int, dict[str, float]]:
    return {
        rank: {stage: float(np.median(values[frames])) for stage, values in of.items()} for rank, of in taken_s.items()
    }
