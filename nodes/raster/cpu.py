"""The ``cpu`` rasterizer: compiled kernels over the resident point-array, on all allowed cores.

Each thread draws into a framebuffer of its own, so no word is shared and no atomic is needed while drawing; then the
threads merge the framebuffers and leave them empty for the next frame. Minimum is commutative and associative, so the
picture does not depend on the number of threads or on which thread drew what.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ...shared.camera import Camera
from ...shared.messages import FRAMEBUFFER_EMPTY
from . import PointSize, ResidentPoints, check_viewport, kernels, world_sides
from .blocks import Blocks, frustum
from .pieces import split_entries
from .threads import ThreadedRasterizer, read_only

PIECE_POINTS = 1 << 14
"""Most points of a piece, the unit of work that threads take in turn."""

TURNS_PER_THREAD = 32
"""How often a thread comes back for pieces in a frame: often enough to level the threads' work."""

MERGED_PIXELS_PER_POINT = 2.5
"""Words of one framebuffer that are merged in the time of drawing a point: measured 2 at 1024² … 6 at 4096²."""


class CpuRasterizer(ThreadedRasterizer):
    """Draws a resident point-array on the CPU; a context manager that owns its threads and framebuffers.

    points : the render rank's half of a scene. Not modified, not copied if its arrays have the documented dtypes.
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
        super().__init__(width, height, threads)
        self._sides = size.pixels, max(size.pixels, size.maximum) if size.world or size.adaptive else size.pixels
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
        pitch = kernels.pitch_of(width)
        n_runs = height * pitch // kernels.RUN
        # one row a thread, followed by the word that points outside the image are sent to; memory is taken when used
        self._framebuffers = np.empty((self._threads, height * pitch + 1), np.uint64)
        self._dirty = np.zeros((self._threads, n_runs + 1), np.uint8)
        self._n_clean = 0
        self._frame = np.empty((height, width), np.uint64)
        self._filled = np.ones(n_runs, np.uint8)

    def draw(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(height, width) uint64 framebuffer words, row 0 on top; valid until the next call.

        entries : (m,) RENDER_POINT.  Raises MessageError for an entry beyond the point-array or with stride 0, and
        for a camera of another viewport.
        """
        height, width = self._frame.shape
        check_viewport(camera, width, height)
        pieces = split_entries(entries, self._block_first_point, self._n_points, PIECE_POINTS)
        seen, view = frustum(camera, self._sides[1] / 2 + 1), self._view(camera)
        framebuffers = self._clean_framebuffers(int(pieces["count"].sum(dtype=np.int64)))
        dirty = self._dirty[: len(framebuffers)]
        turn = max(1, len(pieces) // (len(framebuffers) * TURNS_PER_THREAD))
        self._n_clean, n_clean = 0, max(self._n_clean, len(framebuffers))  # none, until the frame is complete
        counter = np.zeros(1, np.int64)
        self._run(
            lambda i: kernels.draw(
                self._points, self._blocks, pieces, seen, view, framebuffers[i], dirty[i], turn, counter
            ),
            len(framebuffers),
        )
        counter = np.zeros(1, np.int64)
        self._run(
            lambda _: kernels.merge(framebuffers, dirty, self._frame, self._filled, counter),
            min(self._threads, height),
        )
        self._n_clean = n_clean
        return self._frame

    def _view(self, camera: Camera) -> kernels.View:
        height, width = self._frame.shape
        near, columns, rows, smallest, largest = map(np.float32, (camera.near, width, height, *self._sides))
        pitch = np.int32(kernels.pitch_of(width))
        return kernels.View(near, columns, rows, smallest, largest, pitch, self._sides == (1, 1))

    def _clean_framebuffers(self, n_points: int) -> np.ndarray:
        """(t, height · pitch + 1) empty framebuffers, as many as make the frame shortest."""
        n = framebuffers_worth(n_points, self._threads, self._frame.size)
        if n > self._n_clean:
            self._framebuffers[self._n_clean : n, :-1] = FRAMEBUFFER_EMPTY
            self._framebuffers[self._n_clean : n, -1] = 0
            self._dirty[self._n_clean : n] = 0
            self._filled[:] = 1  # whatever a frame that failed left in the picture
        return self._framebuffers[:n]


def framebuffers_worth(n_points: int, threads: int, n_pixels: int) -> int:
    """How many framebuffers make a frame shortest, 1 … ``threads``.

    With t of them the threads draw n_points / t points each and merge t · n_pixels / threads words each.
    """
    best = math.sqrt(MERGED_PIXELS_PER_POINT * n_points * threads / n_pixels)
    return min(max(round(best), 1), threads)


def kernels_cached() -> bool:
    """Whether the first frame will load the kernels instead of compiling them (some seconds).

    True if the compiled files are younger than the source, as far as numba's cache folder tells.
    """
    from . import pieces

    def cached(kernel: Any) -> bool:
        folder, source = Path(kernel.stats.cache_path), Path(kernel.py_func.__code__.co_filename)
        index = folder.glob(f"{source.stem}.{kernel.py_func.__qualname__}-*.nbi")
        return any(file.stat().st_mtime > source.stat().st_mtime for file in index)

    return all(map(cached, (kernels.draw, kernels.merge, pieces._split)))
