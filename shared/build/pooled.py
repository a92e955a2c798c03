"""The pooled form of cells that gain by it, beside their points."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from ..codecs import streams
from ..codecs.autocorrelation import FLOAT32_POINTS
from ..octree import cell_centers
from ..pooled import LEAST_POINTS, CellGrid, points_of
from ..process_memory import resident_bytes
from .parallel import Workers
from .settings import BuildSettings, available_memory_bytes
from .shares import consecutive
from .writer import ColumnFolder, writing

LONGEST = 12
"""Translations looked for, along an axis. Longer ones changed the bytes of pools by at most 3 % on three scans and the
demo city, to either side; to look until none can be more common took two to five times as long."""

_CELLS = 32
"""Cells a thread that are encoded before their codes are written."""
_POINT_BYTES = 100
"""A distinct grid point while its cell is encoded: table, tags and order."""


def suited_bits(points_per_cell: int) -> int:
    """Bits an axis of the pooled form's grid, 4 … 8, with which frames read least, about.

    On √n bins an axis, a cell of n points may still be drawn pooled where it is as large as its own set suffices for:
    6 bits for 4096 points. Of larger cells few are drawn that large; fewer bins than √n are filled, so that nearly all
    cells keep their pools, which save 2.6 times the bytes rather than 1.7, in a fifth of the time. So: half a bit for
    each four times the points.

    Bytes that frames read with pools, over those without, geometric mean over distances, mean of lion, dragon, buddha
    and demo city at a threshold of 32 pixels (* lion and dragon only):

    ======  ======  ======  ======  ======
    points  5 bits  6 bits  7 bits  8 bits
    ======  ======  ======  ======  ======
    4096    0.80    0.75    0.98*
    16384   1.00*   0.75    0.80
    65536   1.00*   0.98*   0.74    0.93*
    ======  ======  ======  ======  ======
    """
    return int(np.clip(np.round(np.log2(points_per_cell) / 4 + 2.9), 4, 8))


def pool_positions(
    cells: dict[str, np.ndarray],
    origin: np.ndarray,
    edge: float,
    block_first_point: np.ndarray,
    block_origin: np.ndarray,
    columns: Callable[[int, int], Iterable[np.ndarray]],
    bits: int,
    settings: BuildSettings,
    writer: ColumnFolder,
    workers: Workers,
    progress: Callable[[int, int], None],
    *,
    share: tuple[int, int] = (0, 1),
) -> dict[str, np.ndarray]:
    """Write ``pool_codes``; the new cell arrays ``cell_pool_points`` and ``cell_pool_bytes``.

    columns : x, y, z of a range of the points as they will be read from the scene.
    progress : called with the points done, and in all.
    share : (rank, ranks) among which consecutive cells are shared; the arrays are zero for those of other ranks.
    Cost: 2 to 4 µs a point and core, more where points are few for the grid. Memory: cells at the same time on as many
    threads as ``settings.memory_bytes`` has room for, one at least.
    """
    level, first, count = cells["cell_level"], cells["cell_first_point"], cells["cell_n_points"]
    pool_points, pool_bytes = np.zeros(len(level), np.uint32), np.zeros(len(level), np.uint32)
    owns = count > 0 if settings.point_order == "layered" else cells["cell_first_child"] < 0
    tried = np.flatnonzero(owns & (count >= LEAST_POINTS))
    tried = tried[np.argsort(first[tried])]
    tried = tried[consecutive(count[tried], *share)]
    edges = np.ldexp(edge, -level.astype(np.int64))
    lower = cell_centers(origin, edge, level, cells["cell_code"]) - edges[:, None] / 2
    blocks = np.searchsorted(block_first_point, first, side="right") - 1

    def encode(cell: int) -> tuple[np.ndarray, int] | None:
        grid = CellGrid(block_origin[blocks[cell]] - lower[cell], float(edges[cell]), bits)
        keys = grid.distinct_keys(columns, int(first[cell]), int(first[cell] + count[cell]))
        return _encode(points_of(keys, bits), bits, settings.n_pools)

    codes = writer.open_column("pool_codes", np.dtype("u1"))
    done, total = 0, int(count[tried].sum())
    most = int(count[tried].max(initial=0))
    with Workers(_threads(most, bits, settings, workers.n_threads)) as encoders:
        for start in range(0, len(tried), _CELLS * encoders.n_threads):
            some = tried[start : start + _CELLS * encoders.n_threads].tolist()
            for cell, found in zip(some, encoders.map(encode, [(cell,) for cell in some]), strict=True):
                if found is not None:
                    data, pool_points[cell] = found
                    pool_bytes[cell] = len(data)
                    with writing(writer.partial):
                        codes.write(data)
            done += int(count[some].sum())
            progress(done, total)
    return {"cell_pool_points": pool_points, "cell_pool_bytes": pool_bytes}


def _encode(points: np.ndarray, bits: int, n_pools: int) -> tuple[np.ndarray, int] | None:
    """The code of distinct grid points and their number; None where it does not pay."""
    data = streams.encode(points, bits, n_pools, longest=LONGEST).data
    return (data, len(points)) if streams.keeps_pools(streams.read_pools(data, bits, len(points))) else None


def _threads(most_points: int, bits: int, settings: BuildSettings, n_threads: int) -> int:
    """How many cells are encoded at a time, the largest one being of that many points."""
    n_points = min(most_points, 8**bits)
    padded = (2**bits + LONGEST) ** 3
    cell_bytes = padded * (16 if n_points <= FLOAT32_POINTS else 32) + _POINT_BYTES * n_points
    left = (settings.memory_bytes or available_memory_bytes() // 2) - resident_bytes()
    return int(np.clip(left // cell_bytes, 1, n_threads))
