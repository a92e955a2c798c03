"""What the points of a cell look like, by the eigenvalues of their covariance (thesis 4.3.1), and quads for flat cells.

λ0 ≤ λ1 ≤ λ2 are the eigenvalues over their sum. The first line that holds decides:

======  ===================================================================================================
corner  λ0 ≈ λ1 ≈ λ2 within ``CORNER_TOLERANCE``; so are points that fill space
edge    λ0 ≈ λ1 and λ2 ≈ λ0 + λ1 within ``EDGE_TOLERANCE``
flat    λ0 ≈ 0, at most ``FLAT_TOLERANCE``, λ1 is not, and a quad may stand for the splats of the cell
none    anything else: curved, on a line, fewer than ``MIN_POINTS`` or more than ``MAX_POINTS`` points
======  ===================================================================================================

A right-angled edge through the middle of a cell has (0.08, 0.31, 0.61), a cube's corner (0.17, 0.42, 0.42).

A quad hides what is behind it, so it is held against the splats that it stands for, not against the cell's extent: each
point lies within ``FLAT_DEVIATION`` of its own splat radius of the quad's plane, and no point of the quad is farther
than ``QUAD_REACH`` splat radii from a point of the cell, measured in the plane.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

from ..octree import CORNER, EDGE, FLAT, cell_centers
from ..points import radius_table
from .eigen import sorted_eigen
from .parallel import Workers

FLAT_TOLERANCE = 0.1
"""Generous: cells of few points are thick for their width, and the rule for quads is the stricter one."""
CORNER_TOLERANCE = 0.34
"""Between the corner of a cube, whose λ2 − λ0 is a quarter, and a right-angled edge, where it is at least 0.43."""
EDGE_TOLERANCE = 0.28
"""Enough for a right-angled edge; more would take in planes that are one and a half times as long as wide."""
FLAT_DEVIATION = 1.0
"""What the default depth offset lets splats lie behind the quad and still be drawn."""
QUAD_REACH = 3.0
"""Beyond its splats a quad hides what is behind; where it hides every splat of a pixel, rasterizers leave it out."""
QUAD_MARGIN = 0.75
"""A quad reaches this many mean splat radii beyond the outermost points, so that it overlaps the quads beside it."""
MIN_POINTS = 4
MAX_POINTS = 1 << 16
"""Bounds the memory of a thread; larger are only cells near the root in depth-first order, and flat leaves."""
_TURNS = 16
"""Rectangles tried, over a right angle."""
_SAMPLES = 4
"""A splat radius in steps of the grid that quads are tested on."""


def cell_features(
    cells: dict[str, np.ndarray],
    origin: np.ndarray,
    edge: float,
    block_first_point: np.ndarray,
    block_origin: np.ndarray,
    column: Callable[[str], np.ndarray],
    workers: Workers,
) -> dict[str, np.ndarray]:
    """``cell_feature`` and ``cell_quad`` (``octree.Octree``) of all cells, from the points of their own ranges.

    cells : the arrays of the octree.  column : x, y, z and attr_radius as stored, by name.
    Cost: O(stored points), once a level in depth-first order.
    """
    n = len(cells["cell_level"])
    feature, quad = np.zeros(n, np.uint8), np.zeros((n, 3, 3), np.float32)
    centers = cell_centers(origin, edge, cells["cell_level"], cells["cell_code"])
    points = column("x"), column("y"), column("z"), column("attr_radius"), radius_table(edge)
    ranges = cells["cell_first_point"], cells["cell_n_points"]
    blocks = block_first_point, block_origin
    order = np.argsort(ranges[0], kind="stable")
    workers.map(
        _classify,
        [
            (order[a:b], *ranges, centers, *blocks, *points, feature, quad)
            for a, b in workers.ranges(n, pieces=8 * workers.n_threads)
        ],
    )
    return {"cell_feature": feature, "cell_quad": quad}


@njit(nogil=True, cache=True)
def _classify(
    which, first_point, n_points, centers, block_first, block_origin, x, y, z, radius, radii, feature, quad
):  # fmt: skip
    most = 0
    for cell in which:
        if n_points[cell] <= MAX_POINTS:
            most = max(most, n_points[cell])
    points, reach = np.empty((most, 3)), np.empty(most)
    for cell in which:
        n, first = n_points[cell], first_point[cell]
        if n < MIN_POINTS or n > MAX_POINTS:
            continue
        block = np.searchsorted(block_first, first, side="right") - 1
        for i in range(n):
            j = first + i
            while block + 1 < len(block_first) and block_first[block + 1] <= j:
                block += 1
            points[i, 0] = block_origin[block, 0] - centers[cell, 0] + x[j]
            points[i, 1] = block_origin[block, 1] - centers[cell, 1] + y[j]
            points[i, 2] = block_origin[block, 2] - centers[cell, 2] + z[j]
            reach[i] = radii[radius[j]]
        feature[cell] = classify(points[:n], reach[:n], quad[cell])


@njit(nogil=True, cache=True)
def classify(points, reach, quad):
    """Code of ``octree.FEATURES`` of (n, 3) float64 points with splat radii (n,) ``reach``.

    Fills (3, 3) ``quad`` if it is ``FLAT``: centre, in the frame of the points, and two half axes.
    """
    n = len(points)
    mean, values, vectors = np.zeros(3), np.empty(3), np.empty((3, 3))
    covariance = np.zeros((3, 3))
    for i in range(n):
        for axis in range(3):
            mean[axis] += points[i, axis] / n
    largest = 0.0
    for i in range(n):
        for axis in range(3):
            largest = max(largest, abs(points[i, axis] - mean[axis]))
    if largest == 0.0:
        return 0
    for i in range(n):
        for a in range(3):
            for b in range(3):
                covariance[a, b] += (points[i, a] - mean[a]) / largest * ((points[i, b] - mean[b]) / largest)
    sorted_eigen(covariance, values, vectors)
    values /= values.sum()
    if values[2] - values[0] <= CORNER_TOLERANCE:
        return CORNER
    if values[1] - values[0] <= EDGE_TOLERANCE and abs(values[2] - values[0] - values[1]) <= EDGE_TOLERANCE:
        return EDGE
    if values[0] <= FLAT_TOLERANCE < values[1] and _quad(points, reach, mean, vectors, quad):
        return FLAT
    return 0


@njit(nogil=True, cache=True)
def _quad(points, reach, mean, vectors, quad):
    """Fill (3, 3) ``quad``, a rectangle around the points; False if it must not stand for their splats.

    points : (n, 3), reach : (n,) radii, mean : (3,), vectors : (3, 3) eigenvectors of ascending eigenvalues.
    """
    n = len(points)
    off = np.zeros(n)
    for i in range(n):
        for axis in range(3):
            off[i] += (points[i, axis] - mean[axis]) * vectors[axis, 0]
    height = (off.min() + off.max()) / 2
    radius = reach.mean()
    if not radius > 0.0:
        return False
    u, v = np.empty(n), np.empty(n)
    for i in range(n):
        if abs(off[i] - height) > FLAT_DEVIATION * reach[i]:
            return False
        u[i] = v[i] = 0.0
        for axis in range(3):
            u[i] += (points[i, axis] - mean[axis]) * vectors[axis, 2]
            v[i] += (points[i, axis] - mean[axis]) * vectors[axis, 1]
    best_area, best = np.inf, 0.0
    for turn in range(_TURNS):
        angle = np.pi / 2 * turn / _TURNS
        c, s = np.cos(angle), np.sin(angle)
        u0 = v0 = np.inf
        u1 = v1 = -np.inf
        for i in range(n):
            p, q = c * u[i] + s * v[i], c * v[i] - s * u[i]
            u0, u1, v0, v1 = min(u0, p), max(u1, p), min(v0, q), max(v1, q)
        if (u1 - u0) * (v1 - v0) < best_area:
            best_area, best = (u1 - u0) * (v1 - v0), angle
    c, s = np.cos(best), np.sin(best)
    u0 = v0 = np.inf
    u1 = v1 = -np.inf
    for i in range(n):
        u[i], v[i] = c * u[i] + s * v[i], c * v[i] - s * u[i]
        u0, u1, v0, v1 = min(u0, u[i]), max(u1, u[i]), min(v0, v[i]), max(v1, v[i])
    margin = QUAD_MARGIN * radius
    u0, u1, v0, v1 = u0 - margin, u1 + margin, v0 - margin, v1 + margin
    if not _covered(u, v, reach, radius, u0, u1, v0, v1):
        return False
    for axis in range(3):
        along = c * vectors[axis, 2] + s * vectors[axis, 1]
        across = c * vectors[axis, 1] - s * vectors[axis, 2]
        quad[0, axis] = mean[axis] + height * vectors[axis, 0] + (u0 + u1) / 2 * along + (v0 + v1) / 2 * across
        quad[1, axis], quad[2, axis] = (u1 - u0) / 2 * along, (v1 - v0) / 2 * across
    return True


@njit(nogil=True, cache=True)
def _covered(u, v, reach, radius, u0, u1, v0, v1):
    """Whether discs of ``QUAD_REACH`` times the radii ``reach`` around (u, v) cover the rectangle.

    Tested on a grid with steps of a quarter of the mean radius; discs are made smaller by half a step's diagonal, so
    what passes is covered between the grid's points too. A grid too large
    for the discs to cover is not tested, so the cost is about linear in n.
    """
    step = radius / _SAMPLES
    steps_u, steps_v = (u1 - u0) / step + 2, (v1 - v0) / step + 2
    if steps_u * steps_v > np.pi * (2 * QUAD_REACH * _SAMPLES) ** 2 * len(u):  # four times what all discs hold
        return False
    nu, nv = int(steps_u), int(steps_v)
    step_u, step_v = (u1 - u0) / (nu - 1), (v1 - v0) / (nv - 1)
    slack = np.sqrt(step_u**2 + step_v**2) / 2
    seen = np.zeros((nu, nv), np.bool_)
    n_seen = 0
    for i in range(len(u)):
        r = QUAD_REACH * reach[i] - slack
        if r <= 0.0:
            continue
        begin, end = max(0, int(np.ceil((u[i] - r - u0) / step_u))), min(nu - 1, int((u[i] + r - u0) / step_u))
        for a in range(begin, end + 1):
            half = np.sqrt(max(r * r - (u0 + a * step_u - u[i]) ** 2, 0.0))
            low, high = max(0, int(np.ceil((v[i] - half - v0) / step_v))), min(nv - 1, int((v[i] + half - v0) / step_v))
            for b in range(low, high + 1):
                if not seen[a, b]:
                    seen[a, b] = True
                    n_seen += 1
    return n_seen == nu * nv
