"""Boxes of objects → sequential octree.

Every box lies in the cube of the cell that owns its object: the deepest cell that holds it whole, or an ancestor that
has few enough. So objects across the border of large cells belong to large cells, and a cell's objects are drawn with
those of the cells above it (``octree.Octree.point_order`` "additive").
"""

from __future__ import annotations

import numpy as np

from ..build.morton import root_cube, spread_bits
from ..octree import Octree

CAPACITY = 256
"""Objects of a cell above which those that fit a child go there."""

_LEVELS = 16


def box_octree(lower: np.ndarray, upper: np.ndarray, capacity: int = CAPACITY) -> tuple[Octree, np.ndarray]:
    """The octree of (n, 3) float64 boxes, world frame, n > 0, and (n,) int64: which box each in stored order is.

    The ranges of its cells count objects. Stable: boxes of one cell keep their order, and boxes in stored order stay
    in it.  Cost: O(n) for each level that is occupied.
    """
    origin, edge = root_cube(lower.min(axis=0), upper.max(axis=0))
    scale = 2.0**_LEVELS / edge
    last = (1 << _LEVELS) - 1
    low, high = (np.clip((corner - origin) * scale, 0, last).astype(np.int64) for corner in (lower, upper))
    # what rounding puts on a border is held by both its sides
    low, high = np.maximum(low - 1, 0), np.minimum(high + 1, last)
    deepest = _LEVELS - np.frexp((low ^ high).max(axis=1).astype(np.float64))[1]
    code = np.zeros(len(low), np.int64)
    for axis in range(3):
        code |= _spread(low[:, axis]) << axis
    level = np.zeros(len(low), np.int64)
    for at in range(_LEVELS):
        here = np.flatnonzero(level == at)
        _, cell, count = np.unique(code[here] >> 3 * (_LEVELS - at), return_inverse=True, return_counts=True)
        move = here[(count[cell] > capacity) & (deepest[here] > at)]
        if not len(move):
            break
        level[move] += 1
    code >>= 3 * (_LEVELS - level)
    order = np.lexsort((code, level))
    return _linked(level[order], code[order], origin, edge), order


def _spread(values: np.ndarray) -> np.ndarray:
    return np.array([spread_bits(v) for v in np.unique(values)], np.int64)[np.unique(values, return_inverse=True)[1]]


def _linked(level: np.ndarray, code: np.ndarray, origin: np.ndarray, edge: float) -> Octree:
    """The octree of objects that stand by level and code."""
    codes = [np.empty(0, np.int64)] * (int(level[-1]) + 2)
    for at in range(int(level[-1]), -1, -1):
        codes[at] = np.unique(np.concatenate([code[level == at], codes[at + 1] >> 3]))
    codes.pop()
    sizes = [len(c) for c in codes]
    start = np.cumsum([0, *sizes])
    n = int(start[-1])
    cell_level = np.repeat(np.arange(len(codes)), sizes)
    parent = np.full(n, -1, np.int32)
    own = np.zeros(n, np.int64)
    for at, here in enumerate(codes):
        cells = slice(start[at], start[at + 1])
        if at:
            parent[cells] = start[at - 1] + np.searchsorted(codes[at - 1], here >> 3)
        own[cells] = np.bincount(np.searchsorted(here, code[level == at]), minlength=len(here))
    below = own.copy()
    for cell in range(n - 1, 0, -1):
        below[parent[cell]] += below[cell]
    n_children = np.bincount(parent[1:], minlength=n).astype(np.uint8)
    return Octree(
        origin=origin,
        edge=edge,
        level=cell_level.astype(np.uint8),
        code=np.concatenate(codes).astype(np.uint64),
        parent=parent,
        first_child=np.where(n_children > 0, 1 + np.cumsum(n_children) - n_children, -1).astype(np.int32),
        n_children=n_children,
        first_point=np.cumsum(own) - own,
        n_points=own,
        n_below=below,
        cone=None,
        point_order="additive",
    )
