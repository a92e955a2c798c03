"""The sequential octree: cells in breadth-first order in flat arrays (thesis 4.2.2).

Geometry is kept apart from the point-array (thesis 4.2.1): a cell only knows its range there. Octant ``o`` of a
cell has bit 0 set on the upper half in x, bit 1 in y, bit 2 in z; the Morton ``code`` of a child is
``parent_code << 3 | o``. Cells of one level stand in ascending code order, so the children of a cell are contiguous.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

MAX_LEVEL = 21
"""Deepest level: 21 bits an axis fill a 63-bit Morton code."""


FEATURES = ("none", "flat", "edge", "corner")
"""Names of the codes of ``Octree.feature``; ``none``: curved, on a line, or too few points to tell."""
FLAT, EDGE, CORNER = 1, 2, 3


@dataclass(frozen=True)
class Octree:
    """Flat arrays over cells, breadth-first; the root is cell 0.

    origin : (3,) float64, world position of the root cube's lower corner.
    edge : root cube edge, world units, > 0.
    level : (n,) uint8, root 0.  code : (n,) uint64, Morton code of the cell at its level.
    parent : (n,) int32, −1 for the root.
    first_child : (n,) int32, −1 for a leaf.  n_children : (n,) uint8, 0…8.
    first_point, n_points : (n,) int64, the cell's contiguous range in the point-array.
    n_below : (n,) int64, input points inside the cell's cube.
    area : (n,) float32 or None, surface inside the cell in faces of its cube, estimated; None where sets stand in
        random order and not in stratified order (``build.sets``).
    cone : (n, 4) float32 or None: unit axis and cosine of the half angle of a cone that holds every normal below the
        cell; a cosine of −1 means "any direction".
    feature : (n,) uint8 or None: what the points of the cell's own range look like (thesis 4.3.1), a code of
        ``FEATURES``.
    quad : (n, 3, 3) float32 or None, of flat cells: centre relative to the cell's centre, and the two half axes of the
        rectangle that covers these points; world units.
    pool_points : (n,) uint32 or None, points of the pooled form of the cell's own range (``codecs.streams``), which
        is drawn whole; 0 for a cell that has none.
    pool_bytes : (n,) uint32 or None, bytes of that form.  pool_bits : bits an axis of its grid; 0 where there is none.
    point_order : ``layered`` (an inner cell owns its own level-of-detail set, of which any prefix is a
        fair sample), ``depth-first`` (points in leaves only, an inner cell's range spans its leaves) or ``additive``
        (a cell's own range is drawn with those of all cells above it: objects of a layer, ``layers.box_octree``).
    """

    origin: np.ndarray
    edge: float
    level: np.ndarray
    code: np.ndarray
    parent: np.ndarray
    first_child: np.ndarray
    n_children: np.ndarray
    first_point: np.ndarray
    n_points: np.ndarray
    n_below: np.ndarray
    cone: np.ndarray | None
    point_order: str
    area: np.ndarray | None = None
    feature: np.ndarray | None = None
    quad: np.ndarray | None = None
    pool_points: np.ndarray | None = None
    pool_bytes: np.ndarray | None = None
    pool_bits: int = 0

    def __len__(self) -> int:
        return len(self.level)

    @cached_property
    def is_leaf(self) -> np.ndarray:
        """(n,) bool."""
        return self.first_child < 0

    @cached_property
    def owners(self) -> np.ndarray:
        """(c,) int64: the cells that own points, in stored order."""
        owners = np.flatnonzero(self.is_leaf if self.point_order == "depth-first" else self.n_points)
        return owners[np.argsort(self.first_point[owners])]

    @cached_property
    def half_edges(self) -> np.ndarray:
        """(n,) float64: half the edge of each cell's cube, world units."""
        return np.ldexp(self.edge, -self.level.astype(np.int32) - 1)

    @cached_property
    def centers(self) -> np.ndarray:
        """(n, 3) float64: centre of each cell's cube, world frame."""
        return cell_centers(self.origin, self.edge, self.level, self.code)


def compact_bits(code: np.ndarray) -> np.ndarray:
    """Every third bit of (n,) uint64 Morton codes, gathered: (n,) uint64 below 2**21."""
    x = code & np.uint64(0x1249249249249249)
    x = (x ^ (x >> np.uint64(2))) & np.uint64(0x10C30C30C30C30C3)
    x = (x ^ (x >> np.uint64(4))) & np.uint64(0x100F00F00F00F00F)
    x = (x ^ (x >> np.uint64(8))) & np.uint64(0x001F0000FF0000FF)
    x = (x ^ (x >> np.uint64(16))) & np.uint64(0x001F00000000FFFF)
    return (x ^ (x >> np.uint64(32))) & np.uint64(0x1FFFFF)


def cell_coordinates(code: np.ndarray) -> np.ndarray:
    """(n, 3) int64 grid coordinates, at the code's own level, of (n,) uint64 Morton codes."""
    code = np.asarray(code, np.uint64)
    return np.column_stack([compact_bits(code >> np.uint64(axis)) for axis in range(3)]).astype(np.int64)


def cell_centers(origin: np.ndarray, edge: float, level: np.ndarray, code: np.ndarray) -> np.ndarray:
    """(n, 3) float64 world centres of cells given by level and Morton code. Exact up to one rounding an axis."""
    size = np.ldexp(edge, -np.asarray(level, np.int32))
    return np.asarray(origin, np.float64) + (cell_coordinates(code) + 0.5) * size[:, None]
