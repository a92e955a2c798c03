"""The pooled form of a scene's cells (``codecs.streams``): which points it holds, and reading it.

The pooled form of a cell holds the grid points of its own range, each once. Positions are rounded to the grid as they
are stored, relative to their block, so that whoever builds and whoever loads finds the same grid points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .codecs import streams
from .codecs.grid import to_grid
from .errors import CodecError, StoreError
from .octree import Octree

if TYPE_CHECKING:
    from .store import Scene

LEAST_POINTS = 256
"""A cell of fewer points has no pooled form: the palette that is read with it would be a quarter of their bytes."""

_CHUNK = 1 << 20
"""Points whose bins are looked up at a time."""


class PoolCounts(NamedTuple):
    """How many of the cells that own points have a pooled form, and why the others have none.

    pooled : they have one.  too_few : of fewer than ``LEAST_POINTS`` points, not tried.  no_gain : dropped by the gate
    (``streams.keeps_pools``).
    """

    pooled: int
    too_few: int
    no_gain: int

    @classmethod
    def of(cls, octree: Octree) -> PoolCounts:
        """Those of an octree loaded with pools."""
        assert octree.pool_points is not None
        owns = octree.is_leaf if octree.point_order == "depth-first" else octree.n_points > 0
        without = owns & (octree.pool_points == 0)
        too_few = int(np.count_nonzero(without & (octree.n_points < LEAST_POINTS)))
        n_without = int(np.count_nonzero(without))
        return cls(int(np.count_nonzero(owns)) - n_without, too_few, n_without - too_few)

    def texts(self) -> list[str]:
        """The counts, for people."""
        return [
            f"{self.pooled:,} of {sum(self):,} cells with points have a pooled form",
            f"too few points (below {LEAST_POINTS}): {self.too_few:,}",
            f"saving less than {1 - 1 / streams.LEAST_GAIN:.0%} of three bytes a point: {self.no_gain:,}",
        ]


class PooledCell(NamedTuple):
    """A cell that has a pooled form.

    cell : its index.  lower : (3,) float64, lower corner of its cube, world frame.  edge : of the cube, world units.
    first_point, n_points : its own range in the point-array.  pool_points : points of the form.
    begin, end : its code in ``pool_codes``.
    """

    cell: int
    lower: np.ndarray
    edge: float
    first_point: int
    n_points: int
    pool_points: int
    begin: int
    end: int


def pooled_cells(octree: Octree) -> list[PooledCell]:
    """The cells that have a pooled form, in stored order, of an octree loaded with pools."""
    assert octree.pool_points is not None
    assert octree.pool_bytes is not None
    cells = np.flatnonzero(octree.pool_points)
    cells = cells[np.argsort(octree.first_point[cells])]
    edges = np.ldexp(octree.edge, -octree.level[cells].astype(np.int64))
    lower = octree.centers[cells] - edges[:, None] / 2
    ends = np.cumsum(octree.pool_bytes[cells], dtype=np.int64)
    return [
        PooledCell(cell, corner, *numbers)
        for cell, corner, *numbers in zip(
            cells.tolist(),
            lower,
            edges.tolist(),
            octree.first_point[cells].tolist(),
            octree.n_points[cells].tolist(),
            octree.pool_points[cells].tolist(),
            (ends - octree.pool_bytes[cells]).tolist(),
            ends.tolist(),
            strict=True,
        )
    ]


@dataclass(frozen=True)
class CellGrid:
    """The grid of a cell, over stored points.

    offset : (3,) float64, origin of the block that its points are relative to, from the lower corner of its cube.
    edge : of the cube; world units.  bits : an axis.  A grid point's *key* is x · 4**bits + y · 2**bits + z.
    """

    offset: np.ndarray
    edge: float
    bits: int

    def keys(self, columns: Iterable[np.ndarray]) -> np.ndarray:
        """(n,) int64 of the grid points of stored points; columns : x, y, z, each (n,) float32."""
        stored = np.column_stack(list(columns)).astype(np.float64)
        return keys_of(to_grid(stored + self.offset, np.zeros(3), self.edge, self.bits), self.bits)

    def distinct_keys(self, columns: Callable[[int, int], Iterable[np.ndarray]], begin: int, end: int) -> np.ndarray:
        """(m,) int64, ascending: the grid points of the stored points ``begin`` … ``end`` − 1, each once.

        columns : x, y, z of a range.  Memory: a byte for each grid point there could be, and some for a chunk.
        """
        occupied = np.zeros(8**self.bits, np.bool_)
        for at in range(begin, end, _CHUNK):
            occupied[self.keys(columns(at, min(at + _CHUNK, end)))] = True
        return np.flatnonzero(occupied)


def keys_of(points: np.ndarray, bits: int) -> np.ndarray:
    """(n,) int64 keys of (n, 3) grid points."""
    x, y, z = points.T.astype(np.int64)
    return x << 2 * bits | y << bits | z


def points_of(keys: np.ndarray, bits: int) -> np.ndarray:
    """(n, 3) uint32 grid points of (n,) int64 keys."""
    last = (1 << bits) - 1
    return np.column_stack([keys >> 2 * bits, keys >> bits & last, keys & last]).astype(np.uint32)


def read_pooled(scene: Scene, codes: np.ndarray, cell: PooledCell) -> tuple[streams.PooledPoints, np.ndarray]:
    """The pooled form of a cell, and (n,) int64 keys of its points in coded order.

    codes : ``pool_codes`` of the scene.  Raises StoreError naming the cell if its code is damaged.
    """
    bits = scene.info.pool_bits
    try:
        pooled, points = streams.read_with_points(np.asarray(codes[cell.begin : cell.end]), bits, cell.pool_points)
    except CodecError as error:
        raise StoreError(f"{scene.path}/pool_codes.npy: cell {cell.cell}: {error}") from error
    if len(pooled) != cell.pool_points:
        raise StoreError(
            f"{scene.path}/pool_codes.npy: cell {cell.cell}: found {len(pooled)} points, expected {cell.pool_points}"
        )
    return pooled, keys_of(points, bits)


def verify_pools(scene: Scene, octree: Octree, progress: Callable[[str, int, int | None], None] | None = None) -> None:
    """Hold every pooled form against the points of its cell: it decodes, and holds their grid points, each once.

    octree : of the scene, loaded with pools.  progress : called with ``pools``, the cells done, and in all.
    Raises StoreError naming the cell.  Cost: some 50 ns a point, one cell at a time.
    """
    cells, codes, read = pooled_cells(octree), scene.pool_codes(), scene.position_reader()
    first, origin = scene.blocks()
    for done, cell in enumerate(cells, 1):
        block = np.searchsorted(first, cell.first_point, side="right") - 1
        grid = CellGrid(origin[block] - cell.lower, cell.edge, scene.info.pool_bits)
        _, keys = read_pooled(scene, codes, cell)
        keys.sort()
        if not np.array_equal(keys, grid.distinct_keys(read, cell.first_point, cell.first_point + cell.n_points)):
            raise StoreError(f"{scene.path}/pool_codes.npy: cell {cell.cell}: found other grid points than the cell's")
        if progress:
            progress("pools", done, len(cells))
