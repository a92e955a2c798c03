"""Points that stay on disk: what is known of them, how they are held, and what a frame found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

ReadPoints = Callable[[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray | None], None]
"""Fills x, y, z (float32) and colour words (uint32; None: not wanted) with the stored points from a first one on."""


PAGE_POINTS = 1 << 14
"""Points of a page: some neighbouring cells of one level."""


class SetTable(NamedTuple):
    """The sets of a scene's cells, in stored order, without gaps: what a fallback needs of the octree.

    first : (c + 1,) int64, first point of each set, and their end.
    parent : (c,) int32, set of the parent of each cell, −1 where it has none.
    level : (c,) uint8, of the cell.
    """

    first: np.ndarray
    parent: np.ndarray
    level: np.ndarray


@dataclass(frozen=True)
class Paging:
    """How points are held. budget_bytes : of the pool.  complete : frames wait for their points."""

    budget_bytes: int
    complete: bool = False
    page_points: int = PAGE_POINTS


@dataclass(frozen=True)
class PagedPoints:
    """The render rank's half of a scene that stays on disk; what it has in common with ``ResidentPoints`` is as there.

    read : reads points and colours them.  one_colour : the colour word of all of them; None: they differ.
    sets : of the scene's cells.
    """

    n_points: int
    read: ReadPoints
    one_colour: np.uint32 | None
    block_first_point: np.ndarray
    block_origin: np.ndarray
    sets: SetTable
    paging: Paging

    def __len__(self) -> int:
        return self.n_points


@dataclass(frozen=True)
class Residency:
    """What the last frame found.

    wanted_points, missing_points : of its entries; of these, the ones that were not there.
    loaded_bytes, evicted_pages : read into the pool and dropped from it since the frame before.
    """

    wanted_points: int = 0
    missing_points: int = 0
    loaded_bytes: int = 0
    evicted_pages: int = 0

    @property
    def missing(self) -> float:
        """Share of the points that were not there, 0 … 1."""
        return self.missing_points / max(self.wanted_points, 1)
