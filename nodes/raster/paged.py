"""The ``cpu`` rasterizer over points that stay on disk: it draws from a pool of their pages (``page_pool``).

A frame is drawn at once from what is there, or, where it is to be complete, waits for its points. One that needs more
than the pool holds is then drawn in several passes, whose words meet in the minimum: the bits are those of a resident
scene either way.
"""

from __future__ import annotations

from collections import deque
from functools import partial

import numpy as np

from ...shared.camera import Camera
from ...shared.messages import points_of
from . import PointSize, kernels
from .blocks import Blocks
from .cpu import PIECE_POINTS
from .framebuffers import FramebufferRasterizer
from .page_pieces import PageCutter, PagedPieces
from .page_pool import PagePool, n_slots_of
from .paged_points import PagedPoints, Residency, SetTable
from .threads import read_only

PINNED_SHARE = 1 / 4
"""Most of the pool that the coarsest levels take, which stay in it to be drawn where finer cells are missing."""


class PagedCpuRasterizer(FramebufferRasterizer):
    """Draws points that stay on disk; a context manager that owns its threads, framebuffers and pool.

    points : the render rank's half of a scene.  width, height, threads : as of ``CpuRasterizer``.
    Raises InputError if the viewport or the number of threads is out of range, or the budget is smaller than a page.
    Memory: the budget, width · height · 8 bytes for the frame, as much again for each thread that a frame is worth, 13
    bytes a cell, 32 bytes a block and 29 bytes a page of the scene.
    """

    name = "cpu"

    def __init__(
        self, points: PagedPoints, width: int, height: int, size: PointSize, threads: int | None = None
    ) -> None:
        super().__init__(width, height, size, threads)
        paging = points.paging
        self._complete = paging.complete
        block_first = np.asarray(points.block_first_point, np.int64)
        self._cutter = PageCutter(len(points), paging.page_points, block_first, points.sets, PIECE_POINTS)
        n_slots = n_slots_of(len(points), paging.page_points, paging.budget_bytes, points.one_colour)
        level = points.sets.level[_set_of_pages(points.sets, self._cutter.n_pages, paging.page_points)]
        self._level_of_page = level
        self.pool = PagePool(
            len(points),
            paging.page_points,
            paging.budget_bytes,
            points.read,
            one_colour=points.one_colour,
            pinned=None if paging.complete else coarsest_pages(level, int(n_slots * PINNED_SHARE)),
        )
        none = np.empty(0, np.uint32)
        columns = {"x": self.pool.x, "y": self.pool.y, "z": self.pool.z, "colour": self.pool.colour}
        columns |= {"high": none, "low": none}
        self._points = kernels.Points(**{name: read_only(column) for name, column in columns.items()}, filtered=False)
        origin = np.ascontiguousarray(points.block_origin, np.float64)
        nothing = np.empty((0, 3))
        self._blocks = Blocks(origin, np.full(len(origin), size.world), nothing, nothing)
        self._expected: deque[tuple[int, np.ndarray]] = deque()
        self._counted = self.pool.loaded_bytes, self.pool.n_evicted
        self.residency = Residency()
        self._found = 0, 0

    def expect(self, frame: int, entries: np.ndarray) -> None:
        """Say what a frame that follows those expected so far will draw, so that its pages are loaded meanwhile.

        entries : (m,) RENDER_POINT.  Raises MessageError for an entry beyond the point-array.
        """
        self._expected.append((frame, self._coarse_first(self._cutter.pages(entries))))
        if len(self._expected) == 1:  # nothing has been drawn for which more would be loading
            with self.pool.lock:
                self.pool.need(self._pages_ahead())

    def draw(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(height, width) uint64 framebuffer words, row 0 on top; valid until the next call.

        entries : (m,) RENDER_POINT.  Raises MessageError for an entry beyond the point-array, for pooled points and for
        a camera of another viewport, StoreError for points that cannot be read.
        """
        while self._expected and self._expected[0][0] <= camera.frame:
            self._expected.popleft()
        words = self._draw_complete(camera, entries) if self._complete else self._draw_at_once(camera, entries)
        loaded, evicted = self.pool.loaded_bytes, self.pool.n_evicted
        self.residency = Residency(*self._found, loaded - self._counted[0], evicted - self._counted[1])
        self._counted = loaded, evicted
        return words

    def close(self) -> None:
        """End the threads."""
        self.pool.close()
        super().close()

    def _draw_at_once(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        with self.pool.lock:
            cut = self._cutter.cut(entries, self.pool.slot_of_page, fallback=True)
            self.pool.need([cut.used, self._coarse_first(cut.missing), *self._pages_ahead()])
        self._found = cut.n_wanted, cut.n_missing
        return self._draw_pieces(camera, cut)

    def _draw_complete(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        self._found = int(points_of(entries).sum()), 0
        left, words = self._cutter.pages(entries), None
        while words is None or len(left):
            with self.pool.lock:
                left = left[np.argsort(self.pool.slot_of_page[left] < 0, kind="stable")]  # resident ones first
                batch, left = left[: self.pool.capacity], left[self.pool.capacity :]
                self.pool.need([batch, left, *self._pages_ahead()])
            self.pool.wait(batch)
            slots = np.full(self._cutter.n_pages, -1, np.int32)
            slots[batch] = self.pool.slot_of_page[batch]
            drawn = self._draw_pieces(camera, self._cutter.cut(entries, slots, fallback=False))
            if words is not None:
                np.minimum(words, drawn, out=words)
            else:
                words = drawn.copy() if len(left) else drawn
        return words

    def _draw_pieces(self, camera: Camera, cut: PagedPieces) -> np.ndarray:
        kernel = partial(kernels.draw, self._points, self._blocks, cut.pieces)
        n_points = int(cut.pieces["count"].sum(dtype=np.int64))
        return self._draw_frame(camera, n_points, (kernel, len(cut.pieces)))

    def _coarse_first(self, pages: np.ndarray) -> np.ndarray:
        return pages[np.argsort(self._level_of_page[pages], kind="stable")]

    def _pages_ahead(self) -> list[np.ndarray]:
        return [pages for _, pages in self._expected]


def coarsest_pages(level: np.ndarray, most: int) -> np.ndarray:
    """(k,) int64: the pages of the coarsest levels, whole levels only, k ≤ ``most``.

    level : (n_pages,) uint8, of the cells on a page.
    """
    end = np.cumsum(np.bincount(level))
    whole = int(np.searchsorted(end, most, side="right"))
    return np.flatnonzero(level < whole)


def _set_of_pages(sets: SetTable, n_pages: int, page_points: int) -> np.ndarray:
    """(n_pages,) int64: the set that the first point of each page is in."""
    return np.searchsorted(sets.first, np.arange(n_pages) * page_points, side="right") - 1
