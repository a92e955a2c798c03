"""The orders in which the points of a cell's set stand: stratified, of which any prefix is a fair sample, and random.

Stratified: along the Morton curve of its cell the point of rank r comes at the place that r's bits say when read
backwards (van der Corput 1935), so the first m points of a set cut the curve into m nearly equal parts: they are spread
over the cell as evenly as its points are, and cover a surface with about half the points that a random choice takes.
Consecutive points lie half a cell apart and do not fall on one pixel.

Random: a permutation seeded by the cell's level and code and evaluated point by point.

Who builds sets (``build.sets``) and who reads coded ones (``coded_positions``) finds the same order.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S27, _S30, _S31 = np.uint64(27), np.uint64(30), np.uint64(31)
_ONE = np.uint64(1)


@njit(nogil=True, cache=True)
def _mixed(x):
    """SplitMix64's finaliser (Steele, Lea, Flood 2014)."""
    x = (x ^ (x >> _S30)) * _MIX_1
    x = (x ^ (x >> _S27)) * _MIX_2
    return x ^ (x >> _S31)


@njit(nogil=True, cache=True)
def permutation(level, code, n, p):
    """Fill (6,) uint64 ``p`` with the parameters of the permutation of [0, n) that belongs to a cell."""
    state = _mixed(np.uint64(code) + np.uint64(level + 1) * _GOLDEN)
    bits = 1
    while (1 << bits) < n:
        bits += 1
    p[0] = (np.uint64(1) << np.uint64(bits)) - _ONE
    p[1] = np.uint64((bits + 1) // 2)
    for k in range(2, 6):
        state += _GOLDEN
        p[k] = _mixed(state)
    p[2] |= _ONE
    p[3] |= _ONE
    p[4] |= _ONE


@njit(nogil=True, cache=True)
def place(i, n, p):
    """Where the i-th of n goes: odd multiplications and shifts permute [0, 2**bits); walk until below n."""
    if n == 1:
        return 0
    x = np.uint64(i)
    mask, half = p[0], p[1]
    while True:
        x = (x * p[2] + p[5]) & mask
        x ^= x >> half
        x = (x * p[3]) & mask
        x ^= x >> half
        x = (x * p[4]) & mask
        x ^= x >> half
        if x < np.uint64(n):
            return np.int64(x)


@njit(nogil=True, cache=True)
def strata(level, code, n):
    """(top, mask) of the stratified order of n points of a cell: the highest bit of a rank, and the cell's own start.

    The mask, a random word, decides which point of each stratum comes first, so that no side of a cell is preferred.
    """
    top = np.int64(1)
    while top < n:
        top <<= 1
    mask = np.int64(_mixed(np.uint64(code) + np.uint64(level + 1) * _GOLDEN) & np.uint64(top - 1))
    return top >> 1, mask


@njit(nogil=True, cache=True)
def next_reversed(i, top):
    """One more, in a number whose bits are read backwards from ``top`` on."""
    bit = top
    while i & bit:
        i ^= bit
        bit >>= 1
    return i | bit


@njit(nogil=True, cache=True)
def stratify(level, code, in_order, begin, n, stored, first):
    """Write the n ids ``in_order[begin:]``, which stand along the curve, to ``stored[first:]`` in stratified order."""
    top, mask = strata(level, code, n)
    i, done = 0, 0
    while done < n:
        if i ^ mask < n:
            stored[first + done] = in_order[begin + (i ^ mask)]
            done += 1
        i = next_reversed(i, top)


@njit(nogil=True, cache=True)
def stratified_order(level, code, along):
    """(n,) int64: the n ids ``along``, which stand along the curve of a cell, in stratified order."""
    order = np.empty(len(along), np.int64)
    stratify(level, code, along, 0, len(along), order, 0)
    return order


@njit(nogil=True, cache=True)
def random_order(level, code, n):
    """(n,) int64: the ids 0 … n − 1 in the random order of a cell."""
    p = np.empty(6, np.uint64)
    permutation(level, code, n, p)
    order = np.empty(n, np.int64)
    for i in range(n):
        order[place(i, n, p)] = i
    return order
