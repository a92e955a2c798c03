"""Framebuffers of the CPU's rasterizers of points: one a thread, then merged.

Each thread draws into a framebuffer of its own, so no word is shared and no atomic is needed while drawing; then the
threads merge the framebuffers and leave them empty for the next frame. Minimum is commutative and associative, so the
picture does not depend on the number of threads or on which thread drew what.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ...shared.camera import Camera
from ...shared.messages import FRAMEBUFFER_EMPTY
from . import PointSize, check_viewport, kernels
from .blocks import Frustum, frustum
from .threads import ThreadedRasterizer

TURNS_PER_THREAD = 32
"""How often a thread comes back for work in a frame: often enough to level the threads' work."""

MERGED_PIXELS_PER_POINT = 2.5
"""Words of one framebuffer that are merged in the time of drawing a point: measured 2 at 1024² … 6 at 4096²."""

Kernel = Callable[[Frustum, kernels.View, np.ndarray, np.ndarray, int, np.ndarray], object]
"""Draws into one framebuffer until no work is left: the last six arguments of ``kernels.draw``."""


class FramebufferRasterizer(ThreadedRasterizer):
    """Owns the threads and framebuffers of a rasterizer of points; a context manager.

    width, height : viewport, 1…32768 px.  size : of points.
    threads : at most this many; None: all cores this process may run on.
    Raises InputError if the viewport or the number of threads is out of range.
    Memory: width · height · 8 bytes for the frame, as much again for each thread that a frame is worth.
    """

    def __init__(self, width: int, height: int, size: PointSize, threads: int | None) -> None:
        super().__init__(width, height, threads)
        self._sides = size.pixels, max(size.pixels, size.maximum) if size.world or size.adaptive else size.pixels
        pitch = kernels.pitch_of(width)
        n_runs = height * pitch // kernels.RUN
        # one row a thread, followed by the word that points outside the image are sent to; memory is taken when used
        self._framebuffers = np.empty((self._threads, height * pitch + 1), np.uint64)
        self._dirty = np.zeros((self._threads, n_runs + 1), np.uint8)
        self._n_clean = 0
        self._frame = np.empty((height, width), np.uint64)
        self._filled = np.ones(n_runs, np.uint8)

    def _draw_frame(self, camera: Camera, n_points: int, *work: tuple[Kernel, int]) -> np.ndarray:
        """(height, width) uint64 framebuffer words of ``n_points`` points, drawn by kernels one after the other.

        work : kernels, and how many units each of them takes by turns.
        Raises MessageError for a camera of another viewport.
        """
        height, width = self._frame.shape
        check_viewport(camera, width, height)
        seen, view = frustum(camera, self._sides[1] / 2 + 1), self._view(camera)
        framebuffers = self._clean_framebuffers(n_points)
        dirty = self._dirty[: len(framebuffers)]
        turns = [max(1, n_units // (len(framebuffers) * TURNS_PER_THREAD)) for _, n_units in work]
        self._n_clean, n_clean = 0, max(self._n_clean, len(framebuffers))  # none, until the frame is complete
        counters = np.zeros((len(work), 1), np.int64)

        def draw(i: int) -> None:
            for (kernel, _), turn, counter in zip(work, turns, counters, strict=True):
                kernel(seen, view, framebuffers[i], dirty[i], turn, counter)

        self._run(draw, len(framebuffers))
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
