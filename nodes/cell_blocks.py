"""Blocks that are single cells, and how far apart the points of each lie: for what goes by cell on the render rank."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..shared.octree import Octree
from ..shared.store import Scene
from .raster import CellFeatures

NEIGHBOUR = 6
"""Which nearest neighbour tells the spacing. On a square grid it is one of the four across the diagonal, √2 steps away:
the side with which squares close the grid however it is turned. At random on a surface it is as far (√(6/π) steps)."""

HEAD_POINTS = 128
"""How many points of a cell are looked at; whichever order a set is stored in, its head is a fair sample."""

SAMPLES = 16
"""How many of them are asked for their neighbours; the median counts."""


def cell_blocks(scene: Scene, octree: Octree) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((b,) int64 first point, (b, 3) float64 origin, (b,) int32 cell) of the cells that own points, in stored order.

    A cell's origin is that of the block it is stored in, so no coordinate changes. Of a share of a scene: its cells.
    """
    owners = octree.owners
    owners = owners[(octree.first_point[owners] >= 0) & (octree.first_point[owners] < scene.info.n_stored)]
    first_point = octree.first_point[owners]
    first, origin = scene.blocks()
    return first_point, origin[np.searchsorted(first, first_point, side="right") - 1], owners.astype(np.int32)


def cell_features(octree: Octree) -> CellFeatures:
    """What the cells that own points look like, in stored order, of an octree loaded with features."""
    assert octree.feature is not None
    assert octree.quad is not None
    owners = octree.owners
    quad = octree.quad[owners]
    return CellFeatures(
        first_point=octree.first_point[owners],
        n_points=octree.n_points[owners],
        feature=octree.feature[owners],
        quad_center=octree.centers[owners] + quad[:, 0],
        quad_axes=np.ascontiguousarray(quad[:, 1:]),
    )


def cell_spacing(scene: Scene, octree: Octree, cells: np.ndarray) -> np.ndarray:
    """(b,) float32: side of the squares that close the surface on which the points of each cell lie, world units.

    The distance to the ``NEIGHBOUR``-th nearest in a sample of the cell's own set, scaled by √(sampled / own) as on a
    surface. Too few points for that (outliers, and cells that a surface only grazes) are taken to lie as densely as
    the parent's on a surface that crosses its cube. It is the spacing of the whole set, also where only its head is
    drawn: a cell of N pixels is cut only if that head covers them (``nodes.sampling``).
    (The edge over the root of the number of points, which needs no point, is wrong by the share of the cube's face that
    the surface covers: outliers become as large as their cell.)

    Cost: about 15 µs a cell, however many points it has.
    """
    return spacing_of_heads(octree, cells, *scene.positions(), octree.first_point[cells])


def spacing_of_heads(
    octree: Octree, cells: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray, first_point: np.ndarray
) -> np.ndarray:
    """``cell_spacing`` where the head of each cell's set begins at (b,) int64 ``first_point`` of float32 columns."""
    spacing = np.empty(len(cells), np.float32)
    n_points = octree.n_points[cells]
    _neighbour_distance(x, y, z, first_point, n_points, spacing)
    few = np.isnan(spacing)
    parent = np.maximum(octree.parent[cells[few]], 0)
    share = np.minimum(4 * octree.n_below[cells[few]] / octree.n_below[parent], 1)  # of its face, four to a parent's
    spacing[few] = 2 * octree.half_edges[cells[few]] * np.sqrt(share / n_points[few])
    return spacing


@njit(nogil=True, cache=True)
def _neighbour_distance(x, y, z, first_point, n_points, spacing):
    """Fill ``spacing``; NaN for a cell of at most ``NEIGHBOUR`` points."""
    nearest = np.empty(NEIGHBOUR)
    found = np.empty(SAMPLES)
    for cell in range(len(first_point)):
        first = first_point[cell]
        n = min(n_points[cell], HEAD_POINTS)
        if n <= NEIGHBOUR:
            spacing[cell] = np.nan
            continue
        n_found = min(n, SAMPLES)
        for sample in range(n_found):
            i = first + sample
            nearest[:] = np.inf
            for j in range(first, first + n):
                dx, dy, dz = x[j] - x[i], y[j] - y[i], z[j] - z[i]
                distance_2 = dx * dx + dy * dy + dz * dz
                if j != i and distance_2 < nearest[-1]:
                    place = NEIGHBOUR - 1
                    while place > 0 and nearest[place - 1] > distance_2:
                        nearest[place] = nearest[place - 1]
                        place -= 1
                    nearest[place] = distance_2
            found[sample] = nearest[-1]
        spacing[cell] = np.sqrt(np.median(found[:n_found]) * n / n_points[cell])
