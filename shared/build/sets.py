"""Sets of points that cells own, and the order inside them: leaves, and inner cells with samples of their children.

Layered: points stand in *stratified* order (``set_order``): any prefix is spread evenly over the cell. An inner cell
merges the first points of its children, which are in the order of its curve already, so only leaves are sorted.

How many points cover a cell depends on how much surface is inside, its *area*: the share of the cells of a grid in a
leaf that hold points, in faces of the leaf's cube, and the sum over the children for an inner cell.

Leaves with more points than a cell may hold (coincident points, flat cells, the deepest level), which may be larger
than memory, and depth-first leaves, which are thinned by stride, stand in random order instead.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from ..octree import MAX_LEVEL
from ..set_order import next_reversed, permutation, place, strata, stratify
from .parallel import Workers

if TYPE_CHECKING:
    from .subtree import LinkedCells

_RADIX_BITS = 9
_SORTED_LEVELS = 6
"""Levels below a leaf down to which its points are sorted, in two passes of ``_RADIX_BITS``: 64 × 64 on a face."""
_NONE = np.uint32(0xFFFFFFFF)
_AREA_LEVELS = 3
"""Levels below a leaf of the finest grid that its area is measured with."""
_POINTS_PER_PLACE = 4
"""Fewer points for each place of a grid that holds any do not tell which others the surface goes through."""
RANDOM_AREA = 3.0
"""Area of a leaf in random order: ln N times as many points cover it (thesis 4.3.2), a few times what strata take."""


@njit(nogil=True, cache=True)
def _sort_along_curve(keys, ids, begin, n, level, scratch):
    """Sort the n ids from ``begin`` on by key in place, stably, as far as ``_SORTED_LEVELS`` below ``level``.

    scratch : (≥ n,) uint32.
    """
    radix, digits = 1 << _RADIX_BITS, (1 << _RADIX_BITS) - 1
    shift = max(0, 3 * (MAX_LEVEL - level - _SORTED_LEVELS))
    low, high = np.zeros(radix + 1, np.int64), np.zeros(radix + 1, np.int64)
    for j in range(begin, begin + n):
        key = keys[ids[j]] >> shift
        low[(key & digits) + 1] += 1
        high[(key >> _RADIX_BITS & digits) + 1] += 1
    for d in range(radix):
        low[d + 1] += low[d]
        high[d + 1] += high[d]
    for j in range(begin, begin + n):
        d = keys[ids[j]] >> shift & digits
        scratch[low[d]] = ids[j]
        low[d] += 1
    for j in range(n):
        d = keys[scratch[j]] >> shift + _RADIX_BITS & digits
        ids[begin + high[d]] = scratch[j]
        high[d] += 1


@njit(nogil=True, cache=True)
def shuffle_leaves(which, level, code, start, count, first_point, ids, stored):
    """Write each leaf's ``ids[start:start + count]`` to ``stored[first_point:]`` in the leaf's random order."""
    p = np.empty(6, np.uint64)
    for k in range(len(which)):
        cell = which[k]
        n = count[cell]
        permutation(level[cell], code[cell], n, p)
        for i in range(n):
            stored[first_point[cell] + place(i, n, p)] = ids[start[cell] + i]


@njit(nogil=True, cache=True)
def stratify_leaves(which, level, code, start, count, first_point, capacity, keys, ids, stored, area):
    """Write each leaf's ``ids[start:start + count]`` to ``stored[first_point:]`` in stratified order, and its ``area``.

    Sorts the ids in place. Leaves of more than ``capacity`` points are put in random order.
    """
    scratch = np.empty(capacity, np.uint32)
    for k in range(len(which)):
        cell = which[k]
        if count[cell] > capacity:
            shuffle_leaves(which[k : k + 1], level, code, start, count, first_point, ids, stored)
            area[cell] = RANDOM_AREA
        else:
            _sort_along_curve(keys, ids, start[cell], count[cell], level[cell], scratch)
            stratify(level[cell], code[cell], ids, start[cell], count[cell], stored, first_point[cell])
            area[cell] = _area(keys, ids, start[cell], count[cell], level[cell])


@njit(nogil=True, cache=True)
def _area(keys, ids, begin, n, level):
    """Surface in a leaf, in faces of its cube, whose n ids stand along the curve: places of a grid that hold points.

    The grid is the finest that the points suffice for, at most 8 × 8 × 8.
    """
    for below in range(_AREA_LEVELS, 0, -1):
        shift = max(0, 3 * (MAX_LEVEL - level - below))
        places, last = 0, np.int64(-1)
        for j in range(begin, begin + n):
            place_of = keys[ids[j]] >> shift
            places += place_of != last
            last = place_of
        if n >= _POINTS_PER_PLACE * places:
            break
    return places / 4.0**below


@njit(nogil=True, cache=True)
def sample_children(which, level, code, first_child, n_children, first_point, n_points, capacity, stored):
    """Fill the set of each given inner cell from prefixes of its children's sets.

    A child is represented in proportion to the size of its own set, at most ``capacity`` (largest remainder, the
    lower octant first among equals); ``n_points[cell]`` says how many the cell takes in all.
    """
    quota = np.empty(8, np.int64)
    remainder = np.empty(8, np.int64)
    by_rank = np.full(capacity, _NONE, np.uint32)
    merged = np.empty(capacity, np.uint32)
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
        n_merged = 0
        for c in range(child, child + n_children[cell]):
            taken = stored[first_point[c] : first_point[c] + quota[c - child]]
            if n_points[c] > capacity:  # random order
                merged[n_merged : n_merged + len(taken)] = taken
            else:
                _into_curve_order(level[c], code[c], n_points[c], taken, by_rank, merged[n_merged:])
            n_merged += len(taken)
        stratify(level[cell], code[cell], merged, 0, n, stored, first_point[cell])


@njit(nogil=True, cache=True)
def _into_curve_order(level, code, n, taken, by_rank, merged):
    """Write ``taken``, the first of a cell's n stratified points, to the head of ``merged`` in the order of the curve.

    by_rank : (≥ n,) uint32, all ``_NONE``, and left so.
    """
    top, mask = strata(level, code, n)
    i, done = 0, 0
    while done < len(taken):
        if i ^ mask < n:
            by_rank[i ^ mask] = taken[done]
            done += 1
        i = next_reversed(i, top)
    done = 0
    for rank in range(n):
        if by_rank[rank] != _NONE:
            merged[done] = by_rank[rank]
            by_rank[rank] = _NONE
            done += 1


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


def merge_areas(level: np.ndarray, parent: np.ndarray, area: np.ndarray) -> np.ndarray:
    """(n,) float64 areas of all cells, breadth-first, from those of the leaves; ``area`` is 0 for inner cells."""
    area = area.copy()
    for at in range(int(level.max(initial=0)), 0, -1):
        cells = slice(*np.searchsorted(level, [at, at + 1]))
        area += np.bincount(parent[cells], area[cells] / 4, len(area))
    return area


def sample_inner(tree: LinkedCells, capacity: int, stored: np.ndarray, workers: Workers) -> None:
    """Fill the sets of every inner cell, deepest level first; those of the leaves are there."""
    inner = np.flatnonzero(tree.first_child >= 0)
    for at in np.unique(tree.level[inner])[::-1]:
        cells = inner[tree.level[inner] == at]
        links = (tree.level, tree.code, tree.first_child, tree.n_children, tree.first_point, tree.n_points)
        pieces = workers.ranges(len(cells), pieces=4 * workers.n_threads)
        workers.map(sample_children, [(cells[a:b], *links, capacity, stored) for a, b in pieces])
