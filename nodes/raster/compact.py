"""Positions in fixed point inside their block's bounding box: 4 bytes a point where a block is small on the screen.

A position is 20 bits an axis, the number of a bin of the block's box. The 10 high bits of the three axes are one word,
the 10 low bits another, which is read only in frames where the high bits alone would move a point of the block by more
than ``blocks.HIGH_BITS_ERROR_PX``. That depends on the camera and the block alone, so a picture is the same for
any threads, topology and cut of the entries. Where the grid lies is folded into the block's matrix, so that drawing
decodes by mask, shift and conversion.

Source: Schütz, Kerbl, Wimmer, "Software Rasterization of 2 Billion Points in Real Time" (2022): batches of points with
a bounding box each, coordinates whose precision follows the batch's size on the screen.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit

from . import ResidentPoints
from .atomic import fetch_add
from .blocks import BITS
from .kernels import FILTERED


@dataclass(frozen=True)
class CompactPositions:
    """Positions of points by blocks; arrays as of ``ResidentPoints`` where the name is the same.

    high, low : (n,) uint32: bits 0–9, 10–19 and 20–29 are the high and the low halves of the bins of x, y and z.
        ``kernels.FILTERED`` is set in ``high`` where x is NaN: the point is not drawn.
    lower : (b, 3) float64, world units: lower corner of each block's box, relative to the block's origin.
    step : (b, 3) float64, world units: size of a bin; 0 along an axis on which all points of the block are one.

    A point stands for the middle of its bin.
    Error: at most half a step an axis, 512 steps with the high bits alone.
    """

    high: np.ndarray
    low: np.ndarray
    lower: np.ndarray
    step: np.ndarray


def compact_positions(points: ResidentPoints, threads: int) -> CompactPositions:
    """The points' positions in fixed point. They must be finite, but for the NaN of points that are filtered out.

    Cost: O(n), two reads of the positions, block by block on ``threads`` threads; 8 bytes a point, nothing else.
    """
    high, low = np.empty(len(points), np.uint32), np.empty(len(points), np.uint32)
    first = np.append(points.block_first_point, len(points)).astype(np.int64)
    lower, step = np.zeros((len(first) - 1, 3)), np.zeros((len(first) - 1, 3))
    x, y, z = (np.ascontiguousarray(column).view() for column in (points.x, points.y, points.z))
    for column in (x, y, z):  # mapped and fresh arrays are one type to the compiler
        column.flags.writeable = False
    counter = np.zeros(1, np.int64)
    with ThreadPoolExecutor(threads) as executor:
        for _ in executor.map(lambda _: _encode(x, y, z, first, high, low, lower, step, counter), range(threads)):
            pass
    return CompactPositions(high, low, lower, step)


@njit(nogil=True, cache=True)
def _encode(x, y, z, first, high, low, lower, step, counter):
    """Encode blocks until none is left; ``reference.fixed_point_bins`` is the readable twin."""
    b = fetch_add(counter, 1)
    while b < len(first) - 1:
        begin, end = first[b], first[b + 1]
        if begin < end:
            lower[b, 0], step[b, 0] = _grid(x, x, begin, end)
            lower[b, 1], step[b, 1] = _grid(y, x, begin, end)
            lower[b, 2], step[b, 2] = _grid(z, x, begin, end)
        for i in range(begin, end):
            if np.isnan(x[i]):
                high[i], low[i] = FILTERED, 0
                continue
            bx = _bin(x[i], lower[b, 0], step[b, 0])
            by = _bin(y[i], lower[b, 1], step[b, 1])
            bz = _bin(z[i], lower[b, 2], step[b, 2])
            high[i] = (bx >> 10) | (by >> 10) << 10 | (bz >> 10) << 20
            low[i] = (bx & 1023) | (by & 1023) << 10 | (bz & 1023) << 20
        b = fetch_add(counter, 1)


@njit(nogil=True, cache=True)
def _grid(column, x, begin, end):
    """Least value and size of a bin, of the points whose x is a number; zeros if there is none."""
    least, most = np.float32(np.inf), np.float32(-np.inf)
    for i in range(begin, end):
        if not np.isnan(x[i]):
            least, most = min(least, column[i]), max(most, column[i])
    if least > most:
        return 0.0, 0.0
    return np.float64(least), (np.float64(most) - np.float64(least)) / 2.0**BITS


@njit(nogil=True, cache=True)
def _bin(value, lower, step):
    """Number of the bin; the upper face belongs to the last one, and an axis without extent is all bin 0."""
    return min(np.int64((np.float64(value) - lower) / step), 2**BITS - 1) if step > 0 else 0
