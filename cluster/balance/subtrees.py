"""Borders of subtrees move so that the parts of a stage take even time.

What a part takes is first thought to be spread over its subtrees by their cells. Borders that move tell more: the
weights that were thought right for the parts before are scaled until they are for those of now, so that a subtree with
all the work is found in a few moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np

from ...shared.octree_parts import balanced_borders
from ..layout import Lane, Plan
from . import Seconds

LEAST_FORGOTTEN = 0.01
"""Share of what was learned that gives way to the even spread at each measurement, at least: nothing is ruled out."""
NOISE = 0.1
"""Share of their sum by which times of the same parts may differ where the view has not changed."""
Selecting = Literal["culling", "sampling"]


class SubtreeBorders:
    """The parts of a stage of a lane; of both stages where the same ranks have them, since then one rank does both.

    cells : (s,) number of cells of each of the lane's subtrees, > 0.
    """

    def __init__(self, i: int, lane: Lane, stages: Sequence[Selecting], cells: np.ndarray) -> None:
        self.name = "+".join(stages)
        self._lane, self._stages = i, stages
        self._ranks: tuple[int, ...] = getattr(lane, stages[0])
        self._cells = np.asarray(cells, np.float64)
        self._weights = self._cells.copy()
        self._borders: tuple[int, ...] = ()

    def parts(self, seconds: Seconds) -> np.ndarray:
        """As of ``Policy``."""
        return np.array([sum(seconds[rank][stage] for stage in self._stages) for rank in self._ranks])

    def proposal(self, plan: Plan, seconds: Seconds) -> tuple[Plan, np.ndarray]:
        """As of ``Policy``."""
        held: tuple[tuple[int, ...], ...] = getattr(plan, self._stages[0])
        parts, at = self.parts(seconds), held[self._lane]
        thought = np.array([self._weights[a:b].sum() for a, b in pairwise(at)])
        self._weights = learned(self._weights, self._cells, at, parts, forgotten(thought, parts, at == self._borders))
        self._borders = at
        borders = tuple(balanced_borders(self._weights, len(self._ranks)).tolist())
        moved = (*held[: self._lane], borders, *held[self._lane + 1 :])
        expected = np.array([self._weights[a:b].sum() for a, b in pairwise(borders)])
        return replace(plan, **dict.fromkeys(self._stages, moved)), expected


def forgotten(thought: np.ndarray, measured: np.ndarray, same: bool) -> float:
    """Share of what was learned to forget: where the (n,) seconds of the same parts are no longer those that they were,
    the view has changed. Of other parts they only tell more.
    """
    total = float(measured.sum())
    changed = float(np.abs(measured - thought).sum()) / total if same and total > 0 else 0.0
    return min(changed, 1.0) if changed > NOISE else LEAST_FORGOTTEN


def learned(
    weights: np.ndarray, even: np.ndarray, borders: Sequence[int], parts: np.ndarray, forgotten: float
) -> np.ndarray:
    """(s,) float64 seconds of subtrees that sum to those of parts, (n,).

    weights : (s,) what was thought before.  even : (s,) > 0, what to think of a part of which nothing is known.
    forgotten : share of the even spread.
    """
    out = np.zeros(len(even))
    for (a, b), measured in zip(pairwise(borders), parts, strict=True):
        if a < b:
            spread = even[a:b] / even[a:b].sum()
            known = weights[a:b].sum()
            shape = weights[a:b] / known if known > 0 else spread
            out[a:b] = measured * ((1 - forgotten) * shape + forgotten * spread)
    return out
