"""Render-points entries → pieces: short runs of points that lie in one segment of the point-array.

A segment is what a kernel cannot cross: a block (one matrix) or a chunk (one device buffer). Pieces keep the entries'
order, and each holds at most ``limit`` points, so they are even units of work for workgroups or threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ...shared.errors import MessageError

PIECE = np.dtype([("first", "<i8"), ("count", "<u4"), ("stride", "<u4"), ("segment", "<i8")])
"""The points first, first + stride, … (count of them), all in one segment."""


def check_entries(entries: np.ndarray, n_points: int) -> None:
    """Raise MessageError for an entry beyond the point-array or with stride 0, pooled points. Cost: O(m)."""
    limit = np.uint64(n_points)
    offset, length, stride = entries["offset"], entries["range"].astype(np.uint64), entries["stride"]
    bad = (stride == 0) | (offset > limit) | (length > limit - np.minimum(offset, limit))
    if bad.any():
        i = int(bad.argmax())
        raise MessageError(
            f"render-points entry {i}: found offset {offset[i]}, range {length[i]}, stride {stride[i]}, "
            f"expected a range within {n_points} points and a stride ≥ 1"
        )


def split_forms(entries: np.ndarray, first_pooled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(r,) RENDER_POINT: those of (m,) entries that are ranges; (k,) int64: the pooled cells that the others name.

    first_pooled : (c + 1,) int64, ascending from 0: number of the first pooled point of each cell, and of them all.
    Raises MessageError for pooled points that are not there, or are not whole cells.  Cost: O(m log c + k).
    """
    pooled = entries["stride"] == 0
    if not pooled.any():
        return entries, np.empty(0, np.int64)
    which = np.flatnonzero(pooled)
    offset, length = entries["offset"][which], entries["range"][which].astype(np.uint64)
    borders = first_pooled.view(np.uint64)
    begin = np.minimum(offset, borders[-1])
    end = np.minimum(begin + length, borders[-1])
    first, last = np.searchsorted(borders, [begin, end])
    good = (begin == offset) & (end - begin == length) & (borders[first] == begin) & (borders[last] == end)
    if not good.all():
        i = int(good.argmin())
        raise MessageError(
            f"render-points entry {which[i]}: found offset {offset[i]}, range {length[i]}, stride 0, "
            f"expected whole cells within {borders[-1]} pooled points"
        )
    count = last - first
    start = np.cumsum(count) - count
    return entries[~pooled], np.arange(count.sum()) + np.repeat(first - start, count)


def split_entries(entries: np.ndarray, segment_first: np.ndarray, n_points: int, limit: int) -> np.ndarray:
    """(p,) PIECE: the points of (m,) RENDER_POINT entries, cut at segment borders and after ``limit`` points.

    segment_first : (s,) int64, ascending, the first is 0: first point of each segment; the last one ends at n_points.
    Raises MessageError as ``check_entries`` does.  Cost: O(m log s + p), two compiled passes.
    """
    check_entries(entries, n_points)
    offset, length, stride = (entries[k].copy() for k in ("offset", "range", "stride"))  # one type for numba
    borders = np.append(segment_first[1:], n_points).astype(np.int64)
    none = np.empty(0, PIECE)
    out = np.empty(_split(offset.view(np.int64), length, stride, borders, limit, none), PIECE)
    _split(offset.view(np.int64), length, stride, borders, limit, out)
    return out


@njit(nogil=True, cache=True)
def _split(
    offset: np.ndarray, length: np.ndarray, stride: np.ndarray, borders: np.ndarray, limit: int, out: np.ndarray
) -> int:
    """Number of pieces; written to ``out`` unless that is empty. ``borders``: end of each segment."""
    n, segment = 0, 0
    for i in range(len(offset)):
        first, step = offset[i], np.int64(stride[i])
        end = first + length[i]
        while first < end:
            # most often the segment of the last piece or the one after it
            segment = min(segment + (first >= borders[segment]), len(borders) - 1)
            if first >= borders[segment] or (segment > 0 and first < borders[segment - 1]):
                segment = np.searchsorted(borders, first, side="right")
            count = min((min(end, borders[segment]) - first + step - 1) // step, limit)
            if len(out):
                out[n].first, out[n].count, out[n].stride, out[n].segment = first, count, stride[i], segment
            first += count * step
            n += 1
    return n
