"""Pooled cells of a scene, coloured, in the form they are drawn from."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..shared.codecs.order import distinct, sorted_order
from ..shared.codecs.palette import to_palette
from ..shared.errors import StoreError
from ..shared.pooled import CellGrid, PooledCell, pooled_cells, read_pooled
from ..shared.store import Scene
from .raster import ResidentPoints
from .raster.pools import PoolCell, PoolCells, pool_cells


def load_pools(scene: Scene, points: ResidentPoints) -> PoolCells:
    """The cells of a scene that have a pooled form, in stored order, with the colours of ``points``.

    A pooled point gets the colour of the first point of its cell's range that lies in its bin. ``world_side`` is 0.
    points : those of the scene, none of them filtered out.  Checksums are the caller's (``Scene.check`` of
    ``pool_codes``).
    Raises StoreError if the scene was built without pools, and naming the cell whose code is damaged or holds a point
    that its range does not.
    """
    cells = pooled_cells(scene.octree(pools=True))
    codes = scene.pool_codes()
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as executor:
        return pool_cells(list(executor.map(lambda cell: _load(scene, codes, points, cell), cells)))


def _load(scene: Scene, codes: np.ndarray, points: ResidentPoints, cell: PooledCell) -> PoolCell:
    pooled, keys = read_pooled(scene, codes, cell)
    bits = scene.info.pool_bits
    own = slice(cell.first_point, cell.first_point + cell.n_points)
    block = np.searchsorted(points.block_first_point, cell.first_point, side="right") - 1
    grid = CellGrid(points.block_origin[block] - cell.lower, cell.edge, bits)
    first = _first_of(keys, grid.keys((points.x[own], points.y[own], points.z[own])), bits)
    if first is None:
        raise StoreError(
            f"{scene.path}/pool_codes.npy: cell {cell.cell}: found a pooled point that is not one of the cell's"
        )
    palette, colour = to_palette(np.asarray(points.colour[own])[first])
    return PoolCell(pooled, cell.lower, float(np.ldexp(cell.edge, -bits)), palette, colour)


def _first_of(wanted: np.ndarray, keys: np.ndarray, bits: int) -> np.ndarray | None:
    """(m,) int64: where each of the (m,) wanted keys comes first among the (n,) keys; None if one does not."""
    order = sorted_order(keys, 3 * bits)
    first, _ = distinct(keys[order])
    place = np.searchsorted(keys[order[first]], wanted)
    found = order[first[np.minimum(place, len(first) - 1)]]
    return found if np.array_equal(keys[found], wanted) else None
