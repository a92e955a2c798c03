"""Parts of a sequential octree: some of its cells with all their ancestors, as an octree of its own.

A part decides of each of its cells what the whole would: visibility and cut depend on a cell and its ancestors alone.
Subtrees are dealt to ranks in Morton order, so that a rank's are one range of them (thesis 5.3.1, Figure 5-3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .octree import Octree

_BY_CELL = ("level", "code", "first_point", "n_points", "n_below", "cone", "area", "feature", "quad")


def part_of(octree: Octree, keep: np.ndarray) -> Octree:
    """The cells of a mask, (n,) bool, as an octree; with a cell it holds its ancestors, and the root always.

    Point ranges stay those of the whole. A cell that has lost all its children is still no leaf. Pooled forms, which
    are numbered over the whole, are left out.  Cost: some passes over the cells.
    """
    kept = np.flatnonzero(keep)
    before = np.cumsum(keep) - keep  # kept cells in front of each cell
    first_child = octree.first_child[kept].astype(np.int64)
    inner = first_child >= 0
    begin = np.where(inner, first_child, 0)
    ends = np.append(before, len(kept))
    n_children = np.where(inner, ends[begin + octree.n_children[kept]] - ends[begin], 0)
    parent = octree.parent[kept].astype(np.int64)
    columns = {name: getattr(octree, name) for name in _BY_CELL}
    return replace(
        octree,
        **{name: None if column is None else column[kept] for name, column in columns.items()},
        parent=np.where(parent >= 0, before[np.maximum(parent, 0)], -1).astype(np.int32),
        first_child=np.where(inner, ends[begin], -1).astype(np.int32),
        n_children=n_children.astype(np.uint8),
        pool_points=None,
        pool_bytes=None,
        pool_bits=0,
    )


def cells_of_range(octree: Octree, first: int, stop: int) -> np.ndarray:
    """(n,) bool: the cells that own points in ``first`` … ``stop`` − 1 of the point-array, and their ancestors."""
    owners = octree.owners
    begin = octree.first_point[owners]
    keep = np.zeros(len(octree), bool)
    keep[owners[(begin < stop) & (begin + octree.n_points[owners] > first)]] = True
    keep[0] = True
    return _with_ancestors(octree, keep)


def _with_ancestors(octree: Octree, keep: np.ndarray) -> np.ndarray:
    borders = np.searchsorted(octree.level, np.arange(int(octree.level[-1]) + 2))
    for level in range(len(borders) - 2, 0, -1):
        cells = slice(borders[level], borders[level + 1])
        keep[octree.parent[cells][keep[cells]]] = True
    return keep


@dataclass(frozen=True)
class Subtrees:
    """Disjoint subtrees of an octree that hold all its leaves, in Morton order.

    label : (n,) int64, the subtree of each cell; of a cell above them, its first one.
    above : (n,) bool, the cells above them.
    cells : (s,) int64, number of cells of each.
    """

    octree: Octree
    label: np.ndarray
    above: np.ndarray
    cells: np.ndarray

    @classmethod
    def of(cls, octree: Octree, at_least: int) -> Subtrees:
        """At least so many, if the octree has them: roots are the cells of one level, and the leaves above it.

        Cost: some passes over the cells.
        """
        level = octree.level
        leaves = np.bincount(level[octree.is_leaf], minlength=int(level[-1]) + 1)
        roots = np.bincount(level, minlength=len(leaves)) + np.cumsum(leaves) - leaves
        enough = np.flatnonzero(roots >= at_least)
        at = int(enough[0]) if len(enough) else int(roots.argmax())
        is_root = (level == at) | (octree.is_leaf & (level < at))
        borders = np.searchsorted(level, np.arange(int(level[-1]) + 2))
        shift = (np.uint64(3) * (np.uint64(at) - np.minimum(level, np.uint8(at)).astype(np.uint64))).astype(np.uint64)
        root_cells = np.flatnonzero(is_root)
        in_order = root_cells[np.argsort(octree.code[root_cells] << shift[root_cells], kind="stable")]
        label = np.full(len(octree), -1, np.int64)
        label[in_order] = np.arange(len(in_order))
        for below in range(at + 1, len(borders) - 1):
            cells = slice(borders[below], borders[below + 1])
            label[cells] = label[octree.parent[cells]]
        above = label < 0
        for up in range(at - 1, -1, -1):
            cells = np.arange(borders[up], borders[up + 1])
            cells = cells[above[cells]]
            label[cells] = label[octree.first_child[cells]]  # children stand in Morton order
        return cls(octree, label, above, np.bincount(label[~above], minlength=len(in_order)))

    def __len__(self) -> int:
        return len(self.cells)

    def part(self, first: int, stop: int) -> tuple[np.ndarray, Octree, np.ndarray]:
        """Of the subtrees ``first`` … ``stop`` − 1: (cells, octree, own).

        cells : (p,) int64, ascending, the part's cells: those of the subtrees and all above them.
        own : (p,) bool, those that this part and no other range of subtrees answers for.
        """
        mine, keep = self._masks(first, stop)
        cells = np.flatnonzero(keep)
        return cells, part_of(self.octree, keep), mine[cells]

    def cells_of(self, first: int, stop: int) -> np.ndarray:
        """The cells of a part alone. Cost: two passes over the cells."""
        return np.flatnonzero(self._masks(first, stop)[1])

    def _masks(self, first: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        """(n,) bool each: the cells of a part's subtrees; and all above them too."""
        mine = (self.label >= first) & (self.label < stop)
        keep = _with_ancestors(self.octree, mine.copy())
        keep[0] = True
        return mine, keep


def balanced_borders(weights: np.ndarray, n: int) -> np.ndarray:
    """(n + 1,) int64: borders of n ranges of (s,) weights ≥ 0, their sums as even as whole weights allow."""
    ends = np.append(0.0, np.cumsum(np.asarray(weights, np.float64)))
    wanted = ends[-1] * np.arange(n + 1) / n
    after = np.minimum(np.searchsorted(ends, wanted), len(ends) - 1)
    before = np.maximum(after - 1, 0)
    borders = np.where(wanted - ends[before] < ends[after] - wanted, before, after)
    borders[0], borders[-1] = 0, len(weights)
    return np.maximum.accumulate(borders)
