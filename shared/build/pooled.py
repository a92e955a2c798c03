"""The pooled form of cells that gain by it, beside their points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..codecs import streams
from ..octree import cell_centers
from ..pooled import Columns, grid_keys, grid_points
from .parallel import Workers
from .settings import BuildSettings
from .writer import SceneWriter, writing

_CHUNK = 1 << 18
_CELLS = 64
"""Cells of a thread that are encoded before their codes are written."""


def suited_bits(points_per_cell: int) -> int:
    """Bits an axis of the grid on which cells of a surface with that many points are about saturated."""
    return int(np.clip(np.round(np.log2(points_per_cell) / 2), 4, 8))


def pool_positions(
    cells: dict[str, np.ndarray],
    origin: np.ndarray,
    edge: float,
    block_first_point: np.ndarray,
    block_origin: np.ndarray,
    columns: Columns,
    bits: int,
    settings: BuildSettings,
    writer: SceneWriter,
    workers: Workers,
    progress: Callable[[int, int], None],
) -> dict[str, np.ndarray]:
    """Write ``pool_codes``; the new cell arrays ``cell_pool_points`` and ``cell_pool_bytes``.

    columns : positions as they will be read from the scene.  progress : called with the points done, and in all.
    """
    n = len(cells["cell_level"])
    first, count = cells["cell_first_point"], cells["cell_n_points"]
    pool_points, pool_bytes = np.zeros(n, np.uint32), np.zeros(n, np.uint32)
    owners = np.flatnonzero(count if settings.point_order == "layered" else cells["cell_first_child"] < 0)
    owners = owners[np.argsort(first[owners])]
    edges = np.ldexp(edge, -cells["cell_level"].astype(np.int64))
    lower = cell_centers(origin, edge, cells["cell_level"], cells["cell_code"]) - edges[:, None] / 2
    blocks = np.searchsorted(block_first_point, first, side="right") - 1

    def encode(cell: int) -> tuple[np.ndarray, int] | None:
        begin, end = int(first[cell]), int(first[cell] + count[cell])
        offset = block_origin[blocks[cell]] - lower[cell]
        return _encode(columns, begin, end, offset, float(edges[cell]), bits, settings.n_pools)

    codes = writer.open_column("pool_codes", np.dtype("u1"))
    done, total = 0, int(count[owners].sum())
    step = _CELLS * workers.n_threads
    for start in range(0, len(owners), step):
        some = owners[start : start + step].tolist()
        for cell, found in zip(some, workers.map(encode, [(cell,) for cell in some]), strict=True):
            if found is not None:
                data, pool_points[cell] = found
                pool_bytes[cell] = len(data)
                with writing(writer.partial):
                    codes.write(data)
        done += int(count[some].sum())
        progress(done, total)
    return {"cell_pool_points": pool_points, "cell_pool_bytes": pool_bytes}


def _encode(
    columns: Columns, begin: int, end: int, offset: np.ndarray, edge: float, bits: int, n_pools: int
) -> tuple[np.ndarray, int] | None:
    """The code of the points begin … end − 1 and the number of its points; None where it does not pay."""
    occupied = np.zeros(8**bits, np.bool_)
    for at in range(begin, end, _CHUNK):
        occupied[grid_keys(columns(at, min(at + _CHUNK, end)), offset, edge, bits)] = True
    points = grid_points(np.flatnonzero(occupied), bits)
    data = streams.encode(points, bits, n_pools).data
    pooled = streams.read_pools(data, bits, len(points))
    return (data, len(points)) if streams.keeps_pools(pooled) else None
