"""From the subtrees of all partitions to one sequential octree, with the cells above the partitions."""

from __future__ import annotations

import numpy as np

from ..points import PointBatch, concatenate
from ..scene_info import CELL_ARRAYS
from .cones import merge_cones
from .parallel import Workers
from .partition import Cells
from .point_array import PointArrayWriter, block_level
from .sets import merge_areas, sample_inner, set_sizes
from .subtree import LinkedCells, link

_FIELDS = ("level", "code", "count", "first_point", "n_points")
_LINKED = ("level", "code", "parent", "first_child", "n_children", "count", "start", "first_point", "n_points")
_MADE: dict[str, tuple[int, ...]] = {"area": (), "normal_sum": (3,), "cone": (4,)}
"""Fields of LinkedCells that may be None, and the shape of a cell's row: zeros stand for None."""


class Assembly:
    """Takes the subtrees in Morton order, then makes the cells above them.

    capacity : the most points an inner cell owns.
    Memory: the cells, and one set of points a partition.
    """

    def __init__(self, point_order: str, capacity: int) -> None:
        self._layered = point_order == "layered"
        self._capacity = capacity
        self._parts: list[LinkedCells] = []
        self._root_sets: list[PointBatch] = []

    @property
    def n_partitions(self) -> int:
        """Subtrees taken so far."""
        return len(self._parts)

    @property
    def n_points(self) -> int:
        """Input points in the subtrees taken so far."""
        return sum(int(p.count[0]) for p in self._parts)

    def add(self, cells: LinkedCells, root_set: PointBatch) -> None:
        """One subtree, its point ranges counted from the scene's first point, and at least the first ``capacity``
        points of its root's own set.
        """
        self._parts.append(cells)
        self._root_sets.append(root_set)

    def part(self) -> dict[str, np.ndarray]:
        """The subtrees so far as arrays, for ``take`` in another process."""
        arrays = {"n_cells": np.array([len(p) for p in self._parts], np.int64)}
        if not self._parts:
            return arrays
        for name in _LINKED:
            arrays[f"cell_{name}"] = np.concatenate([getattr(p, name) for p in self._parts])
        for name, row in _MADE.items():
            arrays[f"cell_{name}"] = np.concatenate([_or_zeros(getattr(p, name), (len(p), *row)) for p in self._parts])
        if self._layered:
            sets = concatenate([s.select(slice(0, self._capacity)) for s in self._root_sets])
            arrays["n_set"] = np.array([min(len(s), self._capacity) for s in self._root_sets], np.int64)
            arrays |= {"positions": sets.positions} | {f"attr_{a}": column for a, column in sets.attributes.items()}
        return arrays

    def take(self, part: dict[str, np.ndarray], first_point: int) -> None:
        """Go on with what ``part`` gave, whose points are stored from ``first_point`` on."""
        cuts = np.cumsum(part["n_cells"])[:-1]
        if len(part["n_cells"]):
            columns = zip(*(np.split(part[f"cell_{name}"], cuts) for name in (*_LINKED, *_MADE)), strict=True)
            parts = [LinkedCells(*cells) for cells in columns]
            for cells in parts:
                cells.first_point += first_point
            self._parts += parts
        if len(part["n_cells"]) and self._layered:
            attributes = {name[5:]: column for name, column in part.items() if name.startswith("attr_")}
            sets, end = PointBatch(part["positions"], attributes), 0
            for n in part["n_set"].tolist():
                self._root_sets.append(sets.select(slice(end, end + n)))
                end += n

    def append_top(self, array: PointArrayWriter, workers: Workers) -> None:
        """Make the cells above the partitions and append the sets they own."""
        top = self._top_cells()
        if not len(top):
            return
        if self._layered:
            self._append_top_sets(top, array, workers)
        else:
            self._span_top(top)
        self._parts.append(top)

    def _top_cells(self) -> LinkedCells:
        """The ancestors of the partitions; counts are sums, point ranges are left zero."""
        level = np.array([p.level[0] for p in self._parts], np.int64)
        code = np.array([p.code[0] for p in self._parts])
        count = np.array([p.count[0] for p in self._parts])
        found: dict[tuple[int, int], int] = {}
        for at, key, n in zip(level.tolist(), code.tolist(), count.tolist(), strict=True):
            for up in range(1, at + 1):
                ancestor = (at - up, key >> 3 * up)
                found[ancestor] = found.get(ancestor, 0) + n
        n_top = len(found)
        zeros = np.zeros(n_top, np.int64)
        cells = Cells(
            np.array([a for a, _ in found], np.uint8),
            np.array([c for _, c in found], np.int64),
            zeros,
            np.array(list(found.values()), np.int64),
            np.ones(n_top, bool),
        )
        return link(cells)[0] if n_top else _no_cells()

    def _with_roots(self, top: LinkedCells) -> tuple[LinkedCells, np.ndarray, np.ndarray]:
        """(tree, which of its cells are top cells, which are the partitions in their order)."""
        roots = [p.level[:1] for p in self._parts], [p.code[:1] for p in self._parts]
        level, code = np.concatenate([top.level, *roots[0]]), np.concatenate([top.code, *roots[1]])
        count = np.concatenate([top.count, *(p.count[:1] for p in self._parts)])
        none = np.zeros(len(level), np.int64)
        tree, order = link(Cells(level, code, none, count, none.astype(bool)))
        where = np.empty(len(order), np.int64)
        where[order] = np.arange(len(order))
        return tree, where[: len(top)], where[len(top) :]

    def _append_top_sets(self, top: LinkedCells, array: PointArrayWriter, workers: Workers) -> None:
        tree, inner, roots = self._with_roots(top)
        pool = concatenate([s.select(slice(0, self._capacity)) for s in self._root_sets])
        sizes = np.array([min(len(s), self._capacity) for s in self._root_sets])
        leaf_sizes = np.zeros(len(tree), np.int64)
        leaf_sizes[roots] = sizes
        tree.n_points = set_sizes(tree.level, tree.first_child, tree.n_children, leaf_sizes, self._capacity)
        tree.n_points[roots] = [p.n_points[0] for p in self._parts]  # what their order was made for
        tree.first_point[roots] = np.cumsum(sizes) - sizes
        owned = tree.n_points[inner]
        tree.first_point[inner] = len(pool) + np.cumsum(owned) - owned
        stored = np.empty(len(pool) + int(owned.sum()), np.uint32)
        stored[: len(pool)] = np.arange(len(pool))
        sample_inner(tree, self._capacity, stored, workers)
        top.n_points = owned
        top.first_point = array.n_stored + np.cumsum(owned) - owned
        blocks = block_level(top, "layered", self._capacity)
        array.append(pool, stored[len(pool) :], top.level, top.code, owned, top.count, blocks, workers)

    def _span_top(self, top: LinkedCells) -> None:
        tree, inner, roots = self._with_roots(top)
        tree.first_point[roots] = [p.first_point[0] for p in self._parts]
        for cell in np.flatnonzero(tree.first_child >= 0)[::-1]:
            tree.first_point[cell] = tree.first_point[tree.first_child[cell]]
        top.first_point, top.n_points = tree.first_point[inner], top.count.copy()

    def cell_arrays(self, with_cones: bool) -> dict[str, np.ndarray]:
        """The arrays of the sequential octree, as stored."""
        merged = {f: np.concatenate([getattr(p, f) for p in self._parts]) for f in _FIELDS}
        n = len(merged["level"])
        cells, order = link(
            Cells(merged["level"], merged["code"], np.zeros(n, np.int64), merged["count"], np.zeros(n, bool))
        )
        arrays = {
            "cell_level": cells.level,
            "cell_code": cells.code,
            "cell_parent": cells.parent,
            "cell_first_child": cells.first_child,
            "cell_n_children": cells.n_children,
            "cell_first_point": merged["first_point"][order],
            "cell_n_points": merged["n_points"][order],
            "cell_n_below": cells.count,
        }
        if self._layered:
            area = np.concatenate([_or_zeros(p.area, len(p)) for p in self._parts])[order]
            arrays["cell_area"] = merge_areas(cells.level, cells.parent, area)
        if with_cones:
            total = np.concatenate([_or_zeros(p.normal_sum, (len(p), 3)) for p in self._parts])[order]
            cone = np.concatenate([_or_zeros(p.cone, (len(p), 4)) for p in self._parts])[order]
            arrays["cell_cone"] = merge_cones(cells.first_child, cells.n_children, total, cone)
        return {name: array.astype(CELL_ARRAYS[name]) for name, array in arrays.items()}


def _no_cells() -> LinkedCells:
    none = np.zeros(0, np.int64)
    return LinkedCells(*([none] * 9))


def _or_zeros(array: np.ndarray | None, shape: int | tuple[int, ...]) -> np.ndarray:
    return np.zeros(shape) if array is None else array
