"""What entries of stride 0 name: the numbers of pooled points, the cells they belong to, and what drawing them reads.

Pooled points are numbered cell after cell, in stored order, over the cells that have a pooled form; those of a cell in
coded order (``codecs.streams``). An entry names whole cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..shared.messages import RENDER_POINT, points_of
from ..shared.octree import Octree

POINT_BYTES = 16
"""What drawing a point of a range reads: three float32 and a colour word."""

PALETTE_BYTES = 1024
"""What drawing a cell's pooled form reads beside it and a byte of colour for each of its points."""


@dataclass(frozen=True)
class PooledForms:
    """The pooled forms of a scene, in stored order.

    cell : (c,) int32, cells that have one.  first : (c + 1,) int64, number of each one's first pooled point.
    n_bytes : (c,) int64, what drawing it reads.
    """

    cell: np.ndarray
    first: np.ndarray
    n_bytes: np.ndarray

    @classmethod
    def of(cls, octree: Octree) -> PooledForms:
        """Those of an octree; none where it was loaded without pools."""
        if octree.pool_points is None or octree.pool_bytes is None:
            return cls(np.empty(0, np.int32), np.zeros(1, np.int64), np.empty(0, np.int64))
        cell = np.flatnonzero(octree.pool_points).astype(np.int32)
        cell = cell[np.argsort(octree.first_point[cell], kind="stable")]
        n_points = octree.pool_points[cell].astype(np.int64)
        first = np.concatenate([[0], np.cumsum(n_points)])
        return cls(cell, first, octree.pool_bytes[cell].astype(np.int64) + n_points + PALETTE_BYTES)

    def __len__(self) -> int:
        return len(self.cell)

    def drawn(self, entries: np.ndarray) -> np.ndarray:
        """(k,) int64 indices of the forms that (m,) RENDER_POINT entries draw, which are not checked."""
        pooled = entries[entries["stride"] == 0]
        begin = pooled["offset"].astype(np.int64)
        ends = np.searchsorted(self.first, begin + pooled["range"].astype(np.int64))
        begins = np.searchsorted(self.first, begin)
        return np.concatenate([np.empty(0, np.int64), *map(np.arange, begins, ends)])

    def read_bytes(self, entries: np.ndarray, point_bytes: float = POINT_BYTES) -> float:
        """Bytes of points that drawing entries reads.  point_bytes : of a point of a range."""
        n_ranged = int(points_of(entries[entries["stride"] != 0]).sum())
        return n_ranged * point_bytes + int(self.n_bytes[self.drawn(entries)].sum())

    def as_ranges(self, octree: Octree, entries: np.ndarray) -> np.ndarray:
        """Entries with pooled points replaced by as many stored ones of the same cells, for estimates.

        They lie in the same cells, so they are about as near and as large, but some are others.
        """
        drawn = self.drawn(entries)
        ranges = np.empty(len(drawn), RENDER_POINT)
        ranges["offset"] = octree.first_point[self.cell[drawn]]
        ranges["range"] = np.diff(self.first)[drawn]
        ranges["stride"] = 1
        return np.concatenate([entries[entries["stride"] != 0], ranges])
