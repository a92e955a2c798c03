"""Render-points entries → pieces of a pool of pages, and what to draw where a page is not there.

A page is a run of ``page_points`` stored points, a slot the place of one in the pool. Pieces are those of ``pieces``,
cut at page borders too, with the slot's points in place of the stored ones.

Where a page is not resident, the nearest ancestor of each of its cells whose own set is resident, whole, is drawn in
place of it: its points are some of the same surface, farther apart (layered order).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from .paged_points import SetTable
from .pieces import PIECE, check_entries


class PagedPieces(NamedTuple):
    """What a frame draws of the pages that are there.

    pieces : (p,) PIECE, first points counted in the pool.
    used, missing : pages that pieces are of; pages that entries want and are not there; each once, as they are met.
    n_wanted, n_missing : points of the entries; of these, the ones on missing pages.
    """

    pieces: np.ndarray
    used: np.ndarray
    missing: np.ndarray
    n_wanted: int
    n_missing: int


class PageCutter:
    """Cuts entries into pieces; holds the marks by which a page or a cell is met once.

    page_points : points of a page, a power of two.  segment_first : as of ``split_entries``.
    """

    def __init__(self, n_points: int, page_points: int, segment_first: np.ndarray, sets: SetTable, limit: int) -> None:
        self.n_pages = -(-n_points // page_points)
        self._n_points, self._limit = n_points, limit
        self._shift = page_points.bit_length() - 1
        self._borders = np.append(segment_first[1:], n_points).astype(np.int64)
        self._sets = sets
        self._page_marks = np.zeros(self.n_pages, np.int64)
        self._set_marks = np.zeros(len(sets.parent), np.int64)
        self._mark = 0

    def pages(self, entries: np.ndarray) -> np.ndarray:
        """(k,) int64: the pages that (m,) RENDER_POINT entries want, each once, as they are met.

        Raises MessageError as ``check_entries`` does.  Cost: O(m + pages met).
        """
        offset, length, _ = self._columns(entries)
        self._mark += 1
        out = np.empty(self.n_pages, np.int64)
        return out[: _pages(offset, length, self._shift, self._page_marks, self._mark, out)].copy()

    def cut(self, entries: np.ndarray, slot_of_page: np.ndarray, *, fallback: bool) -> PagedPieces:
        """The pieces of (m,) RENDER_POINT entries that are resident.

        slot_of_page : (n_pages,) int32, below 0 for a page that is not there.
        fallback : draw ancestors in place of what is missing.
        Raises MessageError as ``check_entries`` does.  Cost: O(m log s + p), two compiled passes.
        """
        columns = self._columns(entries)
        used, missing = np.empty((2, self.n_pages), np.int64)
        counts = np.zeros(5, np.int64)
        pieces = np.empty(0, PIECE)
        for _ in range(2):  # to know how many pieces there are, then to write them
            self._mark += 1
            counts[:] = 0
            _cut(
                *columns,
                self._borders,
                self._shift,
                slot_of_page,
                self._sets,
                fallback,
                self._limit,
                self._page_marks,
                self._set_marks,
                self._mark,
                pieces,
                used,
                missing,
                counts,
            )
            if not len(pieces):
                pieces = np.empty(counts[0], PIECE)
        _, n_used, n_absent, n_wanted, n_missing = counts.tolist()
        return PagedPieces(pieces, used[:n_used].copy(), missing[:n_absent].copy(), n_wanted, n_missing)

    def _columns(self, entries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        check_entries(entries, self._n_points)
        offset, length, stride = (entries[k].copy() for k in ("offset", "range", "stride"))  # one type for numba
        return offset.view(np.int64), length, stride


@njit(nogil=True, cache=True)
def _pages(offset, length, shift, marks, mark, out):
    n = 0
    for i in range(len(offset)):
        if length[i] == 0:
            continue
        for page in range(offset[i] >> shift, ((offset[i] + length[i] - 1) >> shift) + 1):
            if marks[page] != mark:
                marks[page] = mark
                out[n] = page
                n += 1
    return n


@njit(nogil=True, cache=True)
def _cut(
    offset,
    length,
    stride,
    borders,
    shift,
    slot_of_page,
    sets,
    fallback,
    limit,
    page_marks,
    set_marks,
    mark,
    pieces,
    used,
    missing,
    counts,
):
    """``counts``: pieces, pages used, pages missing, points wanted, points missing. No pieces are written to none."""
    segment = 0
    for i in range(len(offset)):
        first, step = offset[i], np.int64(stride[i])
        end = first + length[i]
        counts[3] += (length[i] + step - 1) // step
        while first < end:
            page = first >> shift
            stop = min(end, (page + 1) << shift)
            count = (stop - first + step - 1) // step
            if slot_of_page[page] >= 0:
                segment = _take(
                    first,
                    stop,
                    step,
                    borders,
                    segment,
                    shift,
                    slot_of_page,
                    limit,
                    page_marks,
                    mark,
                    pieces,
                    used,
                    counts,
                )
            else:
                counts[4] += count
                if page_marks[page] != mark:
                    page_marks[page] = mark
                    missing[counts[2]] = page
                    counts[2] += 1
                if fallback:
                    _take_ancestors(
                        first,
                        stop,
                        borders,
                        shift,
                        slot_of_page,
                        sets,
                        limit,
                        page_marks,
                        set_marks,
                        mark,
                        pieces,
                        used,
                        counts,
                    )
            first += count * step


@njit(nogil=True, cache=True)
def _take(first, end, step, borders, segment, shift, slot_of_page, limit, page_marks, mark, pieces, used, counts):
    """Add the pieces of points that lie on one resident page; the segment of the last one. ``segment``: a guess."""
    page = first >> shift
    if page_marks[page] != mark:
        page_marks[page] = mark
        used[counts[1]] = page
        counts[1] += 1
    moved = (np.int64(slot_of_page[page]) - page) << shift
    while first < end:
        segment = min(segment + (first >= borders[segment]), len(borders) - 1)
        if first >= borders[segment] or (segment > 0 and first < borders[segment - 1]):
            segment = np.searchsorted(borders, first, side="right")
        count = min((min(end, borders[segment]) - first + step - 1) // step, limit)
        if len(pieces):
            piece = pieces[counts[0]]
            piece.first, piece.count, piece.stride, piece.segment = first + moved, count, step, segment
        first += count * step
        counts[0] += 1
    return segment


@njit(nogil=True, cache=True)
def _take_ancestors(
    first, stop, borders, shift, slot_of_page, sets, limit, page_marks, set_marks, mark, pieces, used, counts
):
    """Add the pieces of the nearest resident ancestor of each cell that owns some of the points, once a frame."""
    cell = np.searchsorted(sets.first, first, side="right") - 1
    while cell < len(sets.parent) and sets.first[cell] < stop:
        ancestor = sets.parent[cell]
        while ancestor >= 0 and set_marks[ancestor] != mark:
            begin, end = sets.first[ancestor], sets.first[ancestor + 1]
            resident = True
            for page in range(begin >> shift, ((end - 1) >> shift) + 1):
                resident &= slot_of_page[page] >= 0
            if resident:
                set_marks[ancestor] = mark
                segment = 0
                while begin < end:
                    border = min(end, ((begin >> shift) + 1) << shift)
                    segment = _take(
                        begin,
                        border,
                        1,
                        borders,
                        segment,
                        shift,
                        slot_of_page,
                        limit,
                        page_marks,
                        mark,
                        pieces,
                        used,
                        counts,
                    )
                    begin = border
                break
            ancestor = sets.parent[ancestor]
        cell += 1
