"""The ``cpu`` rasterizer: compiled kernels over the resident point-array, on all allowed cores."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...shared.camera import Camera
from . import PointSize, ResidentPoints, kernels, world_sides
from .blocks import Blocks
from .framebuffers import FramebufferRasterizer, Kernel
from .pieces import split_entries, split_forms
from .threads import read_only

PIECE_POINTS = 1 << 14
"""Most points of a piece, the unit of work that threads take in turn."""


class CpuRasterizer(FramebufferRasterizer):
    """Draws a resident point-array on the CPU; a context manager that owns its threads and framebuffers.

    points : the render rank's half of a scene. Not modified, not copied if its arrays have the documented dtypes. Pools
        are drawn if it has them.
    width, height : viewport, 1…32768 px.
    threads : at most this many; None: all cores this process may run on.
    compact : hold positions in fixed point (``compact``) instead of using those given. Needs finite positions; frames
        are fastest, and as exact as there said, if blocks are single cells.
    Raises InputError if the viewport or the number of threads is out of range, or if ``size`` is adaptive and the
    points have no ``block_spacing``.
    Memory: width · height · 8 bytes for the frame, as much again for each thread that a frame is worth; compact: 8
    bytes a point.
    """

    name = "cpu"

    def __init__(
        self,
        points: ResidentPoints,
        width: int,
        height: int,
        size: PointSize = PointSize(),  # noqa: B008 (frozen)
        threads: int | None = None,
        *,
        compact: bool = False,
    ) -> None:
        super().__init__(width, height, size, threads)
        self._n_points = len(points)
        self._block_first_point = np.asarray(points.block_first_point, np.int64)
        none = np.empty((0, 3))
        lower, step = none, none
        columns = dict.fromkeys("xyz", np.empty(0, np.float32)) | dict.fromkeys(("high", "low"), np.empty(0, np.uint32))
        if compact:
            from .compact import compact_positions

            positions = compact_positions(points, self._threads)
            lower, step = positions.lower, positions.step
            columns |= {"high": positions.high, "low": positions.low}
        else:
            columns |= {"x": points.x, "y": points.y, "z": points.z}
        columns["colour"] = points.colour
        filtered = bool(columns["high"].max(initial=0) >= kernels.FILTERED)
        self._points = kernels.Points(
            **{name: read_only(column) for name, column in columns.items()}, filtered=filtered
        )
        self._blocks = Blocks(
            np.ascontiguousarray(points.block_origin, np.float64), world_sides(points, size), lower, step
        )
        self._first_pooled, self._draw_pools = np.zeros(1, np.int64), None
        if points.pools:
            from .pools import draw_pools, sized

            self._first_pooled = points.pools.first_point
            self._draw_pools = partial(draw_pools, sized(points.pools, size))

    def draw(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(height, width) uint64 framebuffer words, row 0 on top; valid until the next call.

        entries : (m,) RENDER_POINT.  Raises MessageError for an entry beyond the point-array, for pooled points that
        are not there or not whole cells, and for a camera of another viewport.
        """
        entries, cells = split_forms(entries, self._first_pooled)
        pieces = split_entries(entries, self._block_first_point, self._n_points, PIECE_POINTS)
        n_points = int(pieces["count"].sum(dtype=np.int64))
        work: list[tuple[Kernel, int]] = [(partial(kernels.draw, self._points, self._blocks, pieces), len(pieces))]
        if self._draw_pools:
            n_points += int((self._first_pooled[cells + 1] - self._first_pooled[cells]).sum())
            work.append((partial(self._draw_pools, cells), len(cells)))
        return self._draw_frame(camera, n_points, *work)


def kernels_cached(*, pools: bool = False, groups: bool = False, paged: bool = False) -> bool:
    """Whether the first frame will load the kernels instead of compiling them (some seconds).

    pools : whether pools are drawn, too.  groups : whether linear groups are drawn instead.
    paged : whether points are paged.
    True if the compiled files are younger than the source, as far as numba's cache folder tells.
    """
    from . import pieces

    def cached(kernel: Any) -> bool:
        folder, source = Path(kernel.stats.cache_path), Path(kernel.py_func.__code__.co_filename)
        index = folder.glob(f"{source.stem}.{kernel.py_func.__qualname__}-*.nbi")
        return any(file.stat().st_mtime > source.stat().st_mtime for file in index)

    if groups:
        from .groups import draw_groups

        return cached(draw_groups) and cached(kernels.merge)
    needed = [kernels.draw, kernels.merge, pieces._split]
    if paged:
        from . import page_pieces

        needed[-1] = page_pieces._cut
    if pools:
        from .pools import draw_pools

        needed.append(draw_pools)
    return all(map(cached, needed))
