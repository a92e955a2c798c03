"""One partition: the subtree of the points that fit into memory, its point order and its normal cones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .cones import leaf_cones
from .parallel import Workers
from .partition import Cells, Subdivision, subtree_cells
from .sets import sample_inner, set_sizes, shuffle_leaves, stratify_leaves


@dataclass
class LinkedCells:
    """Cells in breadth-first order with their links and point ranges; the fields of ``octree.Octree``, and ``start``.

    start : (n,) int64, where the cell's points begin in the ids that it was made from.
    area : (n,) float64 or None, of leaves in layered order, see ``sets``; 0 for inner cells.
    normal_sum : (n, 3) float64 or None, cone : (n, 4) float64 or None; set for leaves only, see ``cones``.
    """

    level: np.ndarray
    code: np.ndarray
    parent: np.ndarray
    first_child: np.ndarray
    n_children: np.ndarray
    count: np.ndarray
    start: np.ndarray
    first_point: np.ndarray
    n_points: np.ndarray
    area: np.ndarray | None = None
    normal_sum: np.ndarray | None = None
    cone: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.level)


def link(cells: Cells) -> tuple[LinkedCells, np.ndarray]:
    """(linked cells, order): breadth-first, ascending code in each level; ``order`` says where each cell came from.

    The first cell is the only one without a parent. Point ranges are left zero.
    """
    order = np.lexsort((cells.code, cells.level))
    cells = cells.take(order)
    n = len(cells)
    parent = np.full(n, -1, np.int32)
    cuts = np.searchsorted(cells.level, np.arange(int(cells.level[0]), int(cells.level[-1]) + 2))
    for above, here, below in zip(cuts[:-2], cuts[1:-1], cuts[2:], strict=True):
        parent[here:below] = above + np.searchsorted(cells.code[above:here], cells.code[here:below] >> 3)
    n_children = np.bincount(parent[1:], minlength=n).astype(np.uint8)
    first_child = np.where(n_children > 0, 1 + np.cumsum(n_children) - n_children, -1).astype(np.int32)
    empty = np.zeros(n, np.int64)
    return (
        LinkedCells(
            cells.level, cells.code, parent, first_child, n_children, cells.count, cells.start, empty, empty.copy()
        ),
        order,
    )


@dataclass
class Subtree:
    """A partition's cells and the order its points are stored in.

    stored : (m,) uint32, the index of each stored point among the partition's points; ``cells.first_point`` counts
        from the partition's first stored point.
    owners : indices of the cells that own points, in the order of their ranges.
    """

    cells: LinkedCells
    stored: np.ndarray
    owners: np.ndarray


def build_subtree(
    keys: np.ndarray,
    normals: np.ndarray | None,
    level: int,
    code: int,
    rule: Subdivision,
    point_order: str,
    workers: Workers,
) -> Subtree:
    """The subtree below (level, code) of points that all lie in that cell.

    keys : (n,) int64, 0 < n < 2**32.  normals : (n,) uint32 words or None.
    Cost: O(n); memory 8 bytes a point and 4 a stored point.
    """
    found, ids = subtree_cells(keys, level, code, rule, workers)
    cells, _ = link(found)
    leaves = np.flatnonzero(cells.first_child < 0)
    if point_order == "layered":
        cells.n_points = set_sizes(
            cells.level - cells.level[0], cells.first_child, cells.n_children, cells.count, rule.points_per_cell
        )
        cells.first_point = np.cumsum(cells.n_points) - cells.n_points
        stored = np.empty(int(cells.n_points.sum()), np.uint32)
        owners = np.arange(len(cells))
    else:
        cells.n_points, cells.first_point = cells.count.copy(), cells.start.copy()
        stored = np.empty(len(keys), np.uint32)
        owners = leaves[np.argsort(cells.first_point[leaves])]
    ends = np.cumsum(cells.count[leaves])
    cuts = np.searchsorted(ends, [b for _, b in workers.ranges(int(ends[-1]), pieces=8 * workers.n_threads)][:-1])
    leaf_parts = np.split(leaves, cuts)
    links = (cells.level, cells.code, cells.start, cells.count, cells.first_point)
    if point_order == "layered":
        capacity, cells.area = rule.points_per_cell, np.zeros(len(cells))
        workers.map(stratify_leaves, [(part, *links, capacity, keys, ids, stored, cells.area) for part in leaf_parts])
        sample_inner(cells, capacity, stored, workers)
    else:
        workers.map(shuffle_leaves, [(part, *links, ids, stored) for part in leaf_parts])
    if normals is not None:
        cells.normal_sum, cells.cone = leaf_cones(cells, normals, stored, workers)
    return Subtree(cells, stored, owners)
