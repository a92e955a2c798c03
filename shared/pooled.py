"""The pooled form of a scene's cells (``codecs.streams``): which points it holds, and reading it.

The pooled form of a cell holds the grid points of its own range, each once. Positions are rounded to the grid as they
are stored, relative to their block, so that whoever builds and whoever loads finds the same grid points.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .codecs import streams
from .codecs.grid import to_grid
from .errors import CodecError, StoreError
from .octree import Octree
from .store import Scene

Columns = Callable[[int, int], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""x, y, z of the points begin … end − 1, relative to their block."""


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


def grid_keys(
    columns: tuple[np.ndarray, np.ndarray, np.ndarray], offset: np.ndarray, edge: float, bits: int
) -> np.ndarray:
    """(n,) int64: x · 4**bits + y · 2**bits + z of the grid point of each of n stored points of a cell.

    columns : x, y, z, (n,) float32, relative to the origin of their block.  offset : (3,) float64, that origin
    relative to the lower corner of the cell's cube.
    """
    stored = np.column_stack(columns).astype(np.float64)
    x, y, z = to_grid(stored + offset, np.zeros(3), edge, bits).T.astype(np.int64)
    return x << 2 * bits | y << bits | z


def grid_points(keys: np.ndarray, bits: int) -> np.ndarray:
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
    x, y, z = points.T.astype(np.int64)
    return pooled, x << 2 * bits | y << bits | z
