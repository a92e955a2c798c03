"""Boxes of objects → sequential octree.

Every box lies in the cube of the cell that owns its object: the deepest cell that holds it whole, or an ancestor that
has few enough. So objects across the border of large cells belong to large cells, and a cell's objects are drawn with
those of the cells above it (``octree.Octree.point_order`` "additive").
"""

from __future__ import annotations

import numpy as np

from ..build.morton import morton_keys, root_cube
from ..build.partition import Cells
from ..build.subtree import link
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
    code = np.empty(len(low), np.int64)
    morton_keys(low.astype(np.float64), np.zeros(3), 1.0, 0, len(low), code)
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


def _linked(level: np.ndarray, code: np.ndarray, origin: np.ndarray, edge: float) -> Octree:
    """The octree of objects that stand by level and code."""
    codes = [np.empty(0, np.int64)] * (int(level[-1]) + 2)
    for at in range(int(level[-1]), -1, -1):
        codes[at] = np.unique(np.concatenate([code[level == at], codes[at + 1] >> 3]))
    codes.pop()
    levels = np.repeat(np.arange(len(codes)), [len(c) for c in codes]).astype(np.uint8)
    own = np.concatenate(
        [np.bincount(np.searchsorted(c, code[level == at]), minlength=len(c)) for at, c in enumerate(codes)]
    )
    none = np.zeros(len(levels), np.int64)
    cells, _ = link(Cells(levels, np.concatenate(codes), none, own, none.astype(bool)))  # in this order already
    below = own.copy()
    for at in range(len(codes) - 1, 0, -1):
        here = np.flatnonzero(levels == at)
        np.add.at(below, cells.parent[here], below[here])
    return Octree(
        origin=origin,
        edge=edge,
        level=cells.level,
        code=cells.code.astype(np.uint64),
        parent=cells.parent,
        first_child=cells.first_child,
        n_children=cells.n_children,
        first_point=np.cumsum(own) - own,
        n_points=own,
        n_below=below,
        cone=None,
        point_order="additive",
    )
