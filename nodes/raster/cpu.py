"""The ``cpu`` rasterizer: compiled kernels over the resident point-array, on all allowed cores.

Each thread draws into a framebuffer of its own, so no word is shared and no atomic is needed while drawing; then the
threads merge the framebuffers and leave them empty for the next frame. Minimum is commutative and associative, so the
picture does not depend on the number of threads or on which thread drew what.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ...shared.camera import Camera
from ...shared.errors import InputError
from ...shared.messages import FRAMEBUFFER_EMPTY
from . import MAX_SIDE_PX, PointSize, ResidentPoints, check_viewport, pixel_from_blocks
from .pieces import split_entries

PIECE_POINTS = 1 << 14
"""Most points of a piece, the unit of work that threads take in turn."""

TURNS_PER_THREAD = 32
"""How often a thread comes back for pieces in a frame: often enough to level the threads' work."""

MERGED_PIXELS_PER_POINT = 2.5
"""Words of one framebuffer that are merged in the time of drawing a point: measured 2 at 1024² … 6 at 4096²."""


class CpuRasterizer:
    """Draws a resident point-array on the CPU; a context manager that owns its threads and framebuffers.

    points : the render rank's half of a scene. Not modified, not copied if its arrays have the documented dtypes.
    width, height : viewport, 1…32768 px.
    threads : at most this many; None: all cores this process may run on.
    Raises InputError if the viewport or the number of threads is out of range.
    Memory: width · height · 8 bytes for the frame, as much again for each thread that a frame is worth.
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
        if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
            raise InputError(f"viewport: found {width}×{height}, expected 1…{MAX_SIDE_PX} px a side")
        self._threads = len(os.sched_getaffinity(0)) if threads is None else threads
        if self._threads < 1:
            raise InputError(f"threads: found {threads}, expected at least 1")
        self.device = f"{self._threads} CPU thread" + "s" * (self._threads > 1)
        self._size = size
        self._x, self._y, self._z = map(_read_only, (points.x, points.y, points.z))
        self._colour = _read_only(points.colour)
        self._block_first_point = np.asarray(points.block_first_point, np.int64)
        self._block_origin = points.block_origin
        self._rows = np.zeros((len(points.block_origin), 3, 4), np.float32)
        # one row a thread, followed by the word that points outside the image are sent to; memory is taken when used
        self._framebuffers = np.empty((self._threads, width * height + 1), np.uint64)
        self._n_clean = 0
        self._frame = np.empty((height, width), np.uint64)
        self._executor = ThreadPoolExecutor(self._threads, "raster")

    def draw(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(height, width) uint64 framebuffer words, row 0 on top; valid until the next call.

        entries : (m,) RENDER_POINT.  Raises MessageError for an entry beyond the point-array or with stride 0, and
        for a camera of another viewport.
        """
        from . import kernels

        height, width = self._frame.shape
        check_viewport(camera, width, height)
        pieces = split_entries(entries, self._block_first_point, len(self._x), PIECE_POINTS)
        used = np.flatnonzero(np.bincount(pieces["segment"], minlength=len(self._rows)))
        self._rows[used] = pixel_from_blocks(camera, self._block_origin[used])
        view = np.float32(camera.near), np.float32(width), np.float32(height)
        size = _side_range(self._size, camera)

        framebuffers = self._clean_framebuffers(int(pieces["count"].sum(dtype=np.int64)))
        turn = max(1, len(pieces) // (len(framebuffers) * TURNS_PER_THREAD))
        self._n_clean, n_clean = 0, max(self._n_clean, len(framebuffers))  # none, until the frame is complete
        counter = np.zeros(1, np.int64)
        self._run(
            len(framebuffers),
            lambda i: kernels.draw(
                self._x, self._y, self._z, self._colour, pieces, self._rows, view, size, framebuffers[i], turn, counter
            ),
        )
        counter = np.zeros(1, np.int64)
        out = self._frame.reshape(-1)
        self._run(
            min(self._threads, -(-len(out) // kernels.MERGE_RUN)),
            lambda _: kernels.merge(framebuffers, out, counter),
        )
        self._n_clean = n_clean
        return self._frame

    def _clean_framebuffers(self, n_points: int) -> np.ndarray:
        """(t, width · height + 1) empty framebuffers, as many as make the frame shortest.

        With t of them the threads draw n_points / t points each and merge t · pixels / threads words each.
        """
        best = math.sqrt(MERGED_PIXELS_PER_POINT * n_points * self._threads / self._frame.size)
        framebuffers = self._framebuffers[: min(max(round(best), 1), self._threads)]
        framebuffers[self._n_clean :, :-1] = FRAMEBUFFER_EMPTY
        framebuffers[self._n_clean :, -1] = 0
        return framebuffers

    def _run(self, n: int, work: Callable[[int], None]) -> None:
        """Call ``work(0)`` … ``work(n − 1)``, each on its own thread."""
        for _ in self._executor.map(work, range(n)):
            pass

    def close(self) -> None:
        """End the threads."""
        self._executor.shutdown()

    def __enter__(self) -> CpuRasterizer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _side_range(size: PointSize, camera: Camera) -> tuple[np.float32, np.float32, np.float32]:
    """Smallest side, side at depth 1 (0: the smallest always), largest side."""
    largest = max(size.pixels, size.maximum)
    return np.float32(size.pixels), np.float32(size.world * camera.focal_px), np.float32(largest)


def _read_only(column: np.ndarray) -> np.ndarray:
    """A read-only view, so that memory-mapped and fresh arrays are one type to the compiler.

    A column of one repeated value (stride 0) stays one value in memory; the kernels are compiled for it apart.
    """
    view = column.view() if column.strides == (0,) else np.ascontiguousarray(column).view()
    view.flags.writeable = False
    return view


def kernels_cached() -> bool:
    """Whether the first frame will load the kernels instead of compiling them (some seconds).

    True if the compiled files are younger than the source, as far as numba's cache folder tells.
    """
    from . import kernels, pieces

    def cached(kernel: Any) -> bool:
        folder, source = Path(kernel.stats.cache_path), Path(kernel.py_func.__code__.co_filename)
        index = folder.glob(f"{source.stem}.{kernel.py_func.__qualname__}-*.nbi")
        return any(file.stat().st_mtime > source.stat().st_mtime for file in index)

    return all(map(cached, (kernels.draw, kernels.merge, pieces._split)))
