"""A pool of pages of the point-array: a fixed number of slots, filled in the background (thesis 5.3.2).

Whoever draws says which pages it needs, in the order in which it needs them: those of the frame at hand, then those of
frames to come. Threads read the ones that are not there into slots whose page nobody needs, the least recently needed
first. A page that is needed is never evicted, so what is being drawn stays where it is.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from typing import Self

import numpy as np

from ...shared.errors import InputError
from .paged_points import ReadPoints

ABSENT, LOADING = -1, -2
"""What ``PagePool.slot_of_page`` says of a page that is in no slot (yet)."""

LOADERS = 8
"""Threads that read pages, and mostly wait for the disk: 64 KiB at random places came at 170 MB/s to one of them, 340
to four, 550 to eight."""


class PagePool:
    """Owns the slots and the threads that fill them; a context manager.

    n_points : of the point-array.  page_points : of a page; the last one may have fewer.
    budget_bytes : of all slots; there are never more slots than pages.
    read : fills a slot, called from threads.
    one_colour : the colour word of all points, which then take 12 bytes instead of 16; None: they differ.
    pinned : pages that stay, once they are there; at most as many as ``n_slots_of`` says, less one.
    Raises InputError if the budget is smaller than a page.

    Methods are called by one thread, the one that draws, which holds ``lock`` around ``need`` and what follows from it.
    What a loader fails with is raised by ``need`` and ``wait``.
    """

    def __init__(
        self,
        n_points: int,
        page_points: int,
        budget_bytes: int,
        read: ReadPoints,
        *,
        one_colour: np.uint32 | None = None,
        pinned: np.ndarray | None = None,
        loaders: int = LOADERS,
    ) -> None:
        self.page_points = page_points
        self.page_bytes = page_points * point_bytes(one_colour)
        self.n_slots = n_slots_of(n_points, page_points, budget_bytes, one_colour)
        n_pages = -(-n_points // page_points)
        size = self.n_slots * page_points
        # touched only as it is filled
        self.x, self.y, self.z = (np.empty(size, np.float32) for _ in range(3))
        self.colour = np.empty(size, np.uint32) if one_colour is None else np.broadcast_to(one_colour, size)
        self.slot_of_page = np.full(n_pages, ABSENT, np.int32)
        self.lock = threading.Condition()
        self.loaded_bytes = 0
        self.n_evicted = 0
        self._n_points, self._read, self._one_colour = n_points, read, one_colour is not None
        self._page_of_slot = np.full(self.n_slots, ABSENT, np.int64)
        self._last_need = np.full(self.n_slots, -1, np.int64)
        self._clock = 0
        self._pinned = np.zeros(n_pages, bool)
        self._pinned[[] if pinned is None else pinned] = True
        self._needed = np.empty(0, np.int64)
        self._is_needed = np.zeros(n_pages, bool)
        self._wanted: deque[int] = deque()
        self._victims: deque[int] = deque()
        self._n_loading = 0
        self._failure: BaseException | None = None
        self._closed = False
        self._threads = [threading.Thread(target=self._load, name=f"page-{i}", daemon=True) for i in range(loaders)]
        for thread in self._threads:
            thread.start()
        if pinned is not None and len(pinned):
            with self.lock:
                self.need([pinned])
            self.wait(pinned)

    @property
    def capacity(self) -> int:
        """Pages that can be needed at once: slots without those of pinned pages."""
        return self.n_slots - int((self._pinned & (self.slot_of_page >= 0)).sum())

    def need(self, pages: Sequence[np.ndarray]) -> None:
        """Say which pages are needed, in order; what was said before does not count. ``lock`` is held.

        pages : int64 arrays, the more urgent first. As many distinct pages as the pool holds are needed, the others
            not: nothing is loaded for them, and they may be evicted.
        """
        self._raise_failure()
        self._clock += 1
        asked = np.concatenate([*pages, np.empty(0, np.int64)])
        _, first = np.unique(asked, return_index=True)
        needed = asked[np.sort(first)]
        there = self.slot_of_page[needed] >= 0
        needed = needed[~(self._pinned[needed] & there)][: self.capacity]
        self._is_needed[self._needed] = False
        self._is_needed[needed] = True
        self._needed = needed
        slots = self.slot_of_page[needed]
        held = slots[slots >= 0]
        self._last_need[held] = self._clock
        self._wanted = deque(needed[slots == ABSENT].tolist())
        self._victims = deque(self._evictable(held).tolist() if self._wanted else ())
        if self._wanted:
            self.lock.notify_all()

    def wait(self, pages: np.ndarray) -> None:
        """Wait until pages that are needed are there."""
        with self.lock:
            while (self.slot_of_page[pages] < 0).any():
                self._raise_failure()
                self.lock.wait()

    def settle(self) -> None:
        """Wait until every page that is needed is there."""
        self.wait(self._needed)

    def close(self) -> None:
        """End the threads."""
        with self.lock:
            self._closed = True
            self.lock.notify_all()
        for thread in self._threads:
            thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _evictable(self, held: np.ndarray) -> np.ndarray:
        """Slots that may be filled anew: empty ones, then the least recently needed first."""
        page = self._page_of_slot
        kept = (page != ABSENT) & (self._pinned[page] | (self.slot_of_page[page] == LOADING))
        kept[held] = True
        order = np.argsort(np.where(kept, np.iinfo(np.int64).max, self._last_need), kind="stable")
        return order[: self.n_slots - int(kept.sum())]

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _load(self) -> None:
        """A loader: until the pool is closed or a read fails."""
        while True:
            with self.lock:
                while not (self._closed or self._failure or (self._wanted and self._victims)):
                    self.lock.wait()
                if self._closed or self._failure:
                    return
                page, slot = self._wanted.popleft(), self._victims.popleft()
                self._take(page, slot)
            failure: BaseException | None = None
            try:
                self._fill(page, slot)
            except BaseException as error:
                failure = error
            with self.lock:
                self._put(page, slot, failure)
                self.lock.notify_all()

    def _take(self, page: int, slot: int) -> None:
        evicted = self._page_of_slot[slot]
        if evicted != ABSENT:
            self.slot_of_page[evicted] = ABSENT
            self.n_evicted += 1
        self._page_of_slot[slot], self.slot_of_page[page] = page, LOADING

    def _fill(self, page: int, slot: int) -> None:
        first, at = page * self.page_points, slot * self.page_points
        part = slice(at, at + min(self.page_points, self._n_points - first))
        colour = None if self._one_colour else self.colour[part]
        self._read(first, self.x[part], self.y[part], self.z[part], colour)

    def _put(self, page: int, slot: int, failure: BaseException | None) -> None:
        if failure is not None:
            self._failure = failure
            self._page_of_slot[slot], self.slot_of_page[page] = ABSENT, ABSENT
            return
        self.slot_of_page[page] = slot
        self._last_need[slot] = self._clock
        self.loaded_bytes += self.page_bytes
        if not (self._is_needed[page] or self._pinned[page]):
            self._victims.append(slot)  # needed no longer; somebody may wait for room


def point_bytes(one_colour: np.uint32 | None) -> int:
    """Bytes of a point in a pool."""
    return 12 if one_colour is not None else 16


def n_slots_of(n_points: int, page_points: int, budget_bytes: int, one_colour: np.uint32 | None = None) -> int:
    """Slots of a pool, at most one for each page. Raises InputError if the budget is smaller than a page."""
    page_bytes = page_points * point_bytes(one_colour)
    if budget_bytes < page_bytes:
        raise InputError(
            f"memory.budget: found {budget_bytes} bytes, expected at least {page_bytes}, a page of {page_points} points"
        )
    return min(budget_bytes // page_bytes, -(-n_points // page_points))
