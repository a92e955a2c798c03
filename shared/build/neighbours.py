"""Normals and splat radii from the nearest neighbours of each point (Hoppe et al. 1992; thesis 4.4.1, option 1).

Neighbours are looked for among *distinct* positions, so that coincident points neither hide the spacing of a surface
nor cost more than one search. Searching in Morton order makes the search four times faster than in input order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import KDTree

from ..points import PointBatch, pack_normals, pack_radii
from .eigen import sorted_eigen
from .parallel import Workers

NORMAL_NEIGHBOURS = 16
"""A normal is that of the plane through a point and this many neighbours."""
RADIUS_NEIGHBOURS = 8
"""k of thesis 4.4.1: a splat reaches the farthest of this many neighbours. On an evenly random surface sample of n
points the largest empty circle has a radius of √(ln n / π) spacings, this distance is 1.6 of them on average and 2.2 at
the rim of such a circle."""
RADIUS_MARGIN = 1.1
"""Factor on that distance, so that the discs of evenly random samples leave no hole (1.07 was found to be needed)."""
RADIUS_CAP = 2.0
CAP_NEIGHBOURS = 32
"""A splat is at most ``RADIUS_CAP`` times as large as half of this many neighbours' are: that of a point that stands
apart from a surface, alone or with a few companions, would else be as large as its distance from it."""
COLLINEAR = 1e-6
"""Neighbours whose second eigenvalue is at most this share of the largest are on a line: they have no normal."""
_CHUNK = 1 << 13


@dataclass(frozen=True)
class SurfaceRule:
    """What is made of the neighbours of points.

    normals, radii : which of the two.
    origin, edge : the root cube.
    up : (3,) float64 or None: normals lie in its half space; None: they point away from ``center``, (3,) float64.

    A side is chosen point by point: right for terrain and for surfaces that bulge outwards, arbitrary for walls under
    ``up`` and wrong in hollows without. Splats do not mind, culling of back faces does.
    """

    normals: bool
    radii: bool
    origin: np.ndarray
    edge: float
    up: np.ndarray | None
    center: np.ndarray

    @property
    def n_neighbours(self) -> int:
        """Neighbours to search for, the point itself not counted."""
        return max(self.normals * NORMAL_NEIGHBOURS, self.radii * CAP_NEIGHBOURS)


def add_surface(
    points: PointBatch, keys: np.ndarray, rule: SurfaceRule, workers: Workers, share: float = 1.0
) -> PointBatch:
    """The points with columns ``normal`` and ``radius`` as the rule asks for.

    keys : (n,) int64 Morton keys of the points.
    share : of the points of the surface that these are, if they are a random part of it: on a surface, spacings shrink
        with the square root of the number of points.
    The same for any number of threads. Cost: about 2 µs a point and thread.
    """
    order, first = distinct(points.positions, keys)
    positions = points.positions[order[first]]
    positions -= rule.origin
    tree = KDTree(positions, balanced_tree=False, compact_nodes=False)
    toward = rule.center - rule.origin if rule.up is None else rule.up
    normal, radius = np.empty(len(first), np.uint32), np.empty(len(first), np.uint8)
    n, k = len(first), min(rule.n_neighbours + 1, len(first))
    reach, around = np.full(n + 1, np.nan), np.empty((n, k) if rule.radii else (0, k), np.int32)

    def search(begin: int, end: int) -> None:
        distance, neighbour = (np.reshape(a, (-1, k)) for a in tree.query(positions[begin:end], k=k))
        if rule.normals:
            normal[begin:end] = pack_normals(plane_normals(positions, neighbour, rule.up is None, toward))
        if rule.radii:
            around[begin:end] = neighbour
            reach[begin:end] = distance[:, min(k - 1, RADIUS_NEIGHBOURS)]

    def cap(begin: int, end: int) -> None:
        radii = capped_reach(reach, around[begin:end])
        radius[begin:end] = pack_radii(radii * (RADIUS_MARGIN * np.sqrt(share)), rule.edge)

    pieces = workers.ranges(n, pieces=-(-n // _CHUNK))
    workers.map(search, pieces)
    if rule.radii:
        workers.map(cap, pieces)
    count = np.diff(first, append=len(order))
    columns = dict(points.attributes)
    for name, wanted, values in (("normal", rule.normals, normal), ("radius", rule.radii, radius)):
        if wanted:
            columns[name] = np.empty(len(points), values.dtype)
            columns[name][order] = np.repeat(values, count)
    return PointBatch(points.positions, columns)


def distinct(positions: np.ndarray, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(order, first): indices of points in Morton order, coincident ones together, and where each position starts.

    positions : (n, 3) float64, finite.  order : (n,) int64.  first : (m,) int64, ascending from 0.
    """
    order = np.argsort(keys, kind="stable")
    sorted_keys = keys[order]
    same = sorted_keys[1:] == sorted_keys[:-1]
    crowded = np.flatnonzero(np.r_[False, same] | np.r_[same, False])  # in one deepest cell, not always in one place
    x, y, z = positions[order[crowded]].T
    order[crowded] = order[crowded[np.lexsort((z, y, x, sorted_keys[crowded]))]]
    moved = np.ones(len(order), bool)
    moved[1:] = ~same
    later = crowded[crowded > 0]
    moved[later] = (positions[order[later]] != positions[order[later - 1]]).any(axis=1)
    return order, np.flatnonzero(moved)


@njit(nogil=True, cache=True)
def plane_normals(positions, neighbour, outward, toward):
    """(m, 3) float64 unit normals of the planes through the neighbours of points, zero where there is no plane.

    positions : (n, 3) float64.  neighbour : (m, k) int64 rows of positions, the first is the point itself, n: none.
    outward : the side away from (3,) ``toward``, else the side it points to.
    Total least squares: the eigenvector of the smallest eigenvalue of the covariance, of offsets from the point.
    """
    m, k = neighbour.shape
    normals = np.zeros((m, 3))
    offset, mean = np.empty((k, 3)), np.empty(3)
    covariance, vectors, values = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for i in range(m):
        n, largest = 0, 0.0
        mean[:] = 0.0
        for j in range(k):
            if neighbour[i, j] == len(positions):
                break
            for axis in range(3):
                offset[j, axis] = positions[neighbour[i, j], axis] - positions[neighbour[i, 0], axis]
                mean[axis] += offset[j, axis]
                largest = max(largest, abs(offset[j, axis]))
            n += 1
        if n < 3:
            continue
        covariance[:, :] = 0.0
        for j in range(n):
            for a in range(3):
                for b in range(a, 3):
                    covariance[a, b] += (
                        (offset[j, a] - mean[a] / n) / largest * ((offset[j, b] - mean[b] / n) / largest)
                    )
        for a in range(3):
            for b in range(a):
                covariance[a, b] = covariance[b, a]
        sorted_eigen(covariance, values, vectors)
        if values[1] <= COLLINEAR * values[2]:
            continue
        facing = 0.0
        for axis in range(3):
            side = positions[neighbour[i, 0], axis] - toward[axis] if outward else toward[axis]
            facing += vectors[axis, 0] * side
        for axis in range(3):
            normals[i, axis] = vectors[axis, 0] if facing >= 0.0 else -vectors[axis, 0]
    return normals


def capped_reach(reach: np.ndarray, around: np.ndarray) -> np.ndarray:
    """(m,) float64: ``reach`` of (m,) points, at most ``RADIUS_CAP`` times its median over the points around them.

    reach : (n + 1,) float64, distance from each point to the farthest of a few neighbours; the last is NaN.
    around : (m, 1 + k) int32, the points themselves and their neighbours; n: none.
    """
    own = reach[around[:, 0]]
    if around.shape[1] == 1:
        return own
    return np.minimum(own, RADIUS_CAP * np.nanmedian(reach[around[:, 1:]], axis=1))
