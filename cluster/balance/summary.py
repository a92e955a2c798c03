"""What ``run.json`` says of load balance: how even ranks were, frame by frame, and what was moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..layout import Layout
from . import BUSY_STAGES
from .balancer import Balancer, make_policies
from .hysteresis import imbalance

ENDS = 16
"""Frames at the beginning and at the end of a run that are looked at apart."""


def balance_record(
    layout: Layout, work_s: Mapping[int, Mapping[str, Sequence[float]]], balancer: Balancer | None
) -> dict[str, Any]:
    """JSON-able.

    work_s : by rank and stage, seconds of each frame.  balancer : of the run; None where it was not balanced.
    ``busy_s`` is the work of each rank; ``slowest_s`` that of the slowest rank, frame by frame: on a core of its own
    for each rank a frame takes at least this. ``imbalance`` is the slowest part over the mean of all, in medians of
    frames.
    """
    ranks = layout.workers
    busy = {rank: np.sum([work_s[rank][s] for s in BUSY_STAGES if s in work_s[rank]], axis=0) for rank in ranks}
    n = max(len(of) for of in busy.values())
    uneven = {}
    for policy in make_policies(layout, [np.ones(1)] * len(layout.lanes), 1, 1):  # for their parts alone
        uneven[policy.name] = {
            name: imbalance(policy.parts(_medians(work_s, frames)))
            for name, frames in (("first", slice(0, ENDS)), ("last", slice(-ENDS, None)), ("all", slice(0, n)))
        }
    return {
        "policy": "measured" if balancer else "off",
        "busy_s": [float(busy[rank].sum()) for rank in ranks],
        "slowest_s": np.max(list(busy.values()), axis=0).tolist(),
        "imbalance": uneven,
        "changes": balancer.changes if balancer else [],
    }


def _medians(work_s: Mapping[int, Mapping[str, Sequence[float]]], frames: slice) -> dict[int, dict[str, float]]:
    return {
        rank: {stage: float(np.median(values[frames])) for stage, values in of.items() if stage in BUSY_STAGES}
        for rank, of in work_s.items()
    }
