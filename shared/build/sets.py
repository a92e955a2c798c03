"""Sets of points that cells own: leaves in a deterministic random order, inner cells with samples of their children.

The order inside a set is a permutation seeded by the cell's level and code and evaluated point by point, so any
prefix of a set is a fair sample of it, consecutive points do not fall on one pixel, and a set larger than memory is
ordered without ever being held.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from .parallel import Workers

if TYPE_CHECKING:
    from .subtree import LinkedCells

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
def shuffle_leaves(which, level, code, start, count, first_point, ids, stored):
    """Write each leaf's ``ids[start:start + count]`` to ``stored[first_point:]`` in the leaf's own order."""
    p = np.empty(6, np.uint64)
    for k in range(len(which)):
        cell = which[k]
        n = count[cell]
        permutation(level[cell], code[cell], n, p)
        for i in range(n):
            stored[first_point[cell] + place(i, n, p)] = ids[start[cell] + i]


@njit(nogil=True, cache=True)
def sample_children(which, level, code, first_child, n_children, first_point, n_points, capacity, stored):
    """Fill the set of each given inner cell from prefixes of its children's sets.

    A child is represented in proportion to the size of its own set, at most ``capacity`` (largest remainder, the
    lower octant first among equals); ``n_points[cell]`` says how many the cell takes in all.
    """
    p = np.empty(6, np.uint64)
    quota = np.empty(8, np.int64)
    remainder = np.empty(8, np.int64)
    for k in range(len(which)):
        cell = which[k]
        n, child = n_points[cell], first_child[cell]
        available = 0
        for c in range(n_children[cell]):
            available += min(n_points[child + c], capacity)
        left = n
        for c in range(n_children[cell]):
            share = n * min(n_points[child + c], capacity)
            quota[c] = share // available
            remainder[c] = share % available
            left -= quota[c]
        while left > 0:
            best = 0
            for c in range(1, n_children[cell]):
                if remainder[c] > remainder[best]:
                    best = c
            quota[best] += 1
            remainder[best] = -1
            left -= 1
        permutation(level[cell], code[cell], n, p)
        i = 0
        for c in range(n_children[cell]):
            source = first_point[child + c]
            for j in range(quota[c]):
                stored[first_point[cell] + place(i, n, p)] = stored[source + j]
                i += 1


def set_sizes(level, first_child, n_children, count, capacity: int) -> np.ndarray:
    """(n,) int64: points each cell owns in layered order; ``count`` for a leaf, at most ``capacity`` for an inner one.

    Cells stand breadth-first. Cost: O(cells).
    """
    sizes = np.where(first_child < 0, count, 0).astype(np.int64)
    parent = np.repeat(np.arange(len(level)), n_children)  # children of cell after cell are contiguous, from cell 1 on
    for at in range(int(level.max(initial=0)), 0, -1):
        cells = slice(*np.searchsorted(level, [at, at + 1]))
        above = parent[cells.start - 1 : cells.stop - 1]
        available = np.bincount(above, np.minimum(sizes[cells], capacity), len(level))[: cells.start].astype(np.int64)
        inner = np.flatnonzero(available)
        sizes[inner] = np.minimum(available[inner], capacity)
    return sizes


def sample_inner(tree: LinkedCells, capacity: int, stored: np.ndarray, workers: Workers) -> None:
    """Fill the sets of every inner cell, deepest level first; those of the leaves are there."""
    inner = np.flatnonzero(tree.first_child >= 0)
    for at in np.unique(tree.level[inner])[::-1]:
        cells = inner[tree.level[inner] == at]
        links = (tree.level, tree.code, tree.first_child, tree.n_children, tree.first_point, tree.n_points)
        pieces = workers.ranges(len(cells), pieces=4 * workers.n_threads)
        workers.map(sample_children, [(cells[a:b], *links, capacity, stored) for a, b in pieces])
