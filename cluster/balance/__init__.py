"""Load balance at run time: borders of subtrees and of tiles move by what ranks were measured to take.

Which cells can be seen changes with the view, so that parts of even size seldom take even time (thesis 5.3.1: "As
visibility calculations are view dependent runtime load balancing will give better results"). Points stay where they
are; what moves is who selects which subtrees, and who draws which tile. One policy a file:

``subtrees``    borders of the subtrees of culling and sampling ranks
``tiles``       borders of the tiles of render ranks, or of whole lanes

``hysteresis``  when a proposal is worth changing to
``times``       how rank 0 hears of stage times, some frames to a note
``balancer``    on rank 0: from times to the plan of the next frame
``summary``     what ``run.json`` says of it

A rank's time is what its stages of culling, sampling, rasterizing and composing pictures take. Compositing is left out:
most of it is waiting for others. Pictures have the same bits under any plan.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from ...shared.config import PipelineSection
from ..layout import Layout, Plan

BUSY_STAGES = ("culling", "sampling", "render", "picture")
"""Stages whose seconds are a rank's work."""
Seconds = Mapping[int, Mapping[str, float]]
"""By rank and stage: seconds of a frame."""


class Policy(Protocol):
    """Moves the borders of one kind of parts. It holds what it has learned of where the work is, and nothing else."""

    name: str

    def parts(self, seconds: Seconds) -> np.ndarray:
        """(n,) seconds that each part takes of a frame."""
        ...

    def proposal(self, plan: Plan, seconds: Seconds) -> tuple[Plan, np.ndarray]:
        """Learn what the parts of a plan took; (the plan with borders moved, (n,) seconds expected of its parts).

        The number of the plan stays.
        """
        ...


def can_balance(layout: Layout, tiles_stay: bool = False) -> bool:
    """Whether there are parts between which a border can move. tiles_stay : they are the screens of a wall."""
    parts = max(len(ranks) for lane in layout.lanes for ranks in (lane.culling, lane.sampling))
    return parts > 1 or (layout.split == "tiles" and len(layout.render) > 1 and not tiles_stay)


def is_on(pipeline: PipelineSection, layout: Layout, tiles_stay: bool = False) -> bool:
    """Whether a run of this layout is balanced."""
    return pipeline.balance == "measured" and can_balance(layout, tiles_stay)
