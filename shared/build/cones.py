"""Normal cones: per cell an axis and a half angle that hold every normal below it (Shirman and Abi-Ezzi 1993)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from ..points import NO_NORMAL
from .parallel import Workers

if TYPE_CHECKING:
    from .subtree import LinkedCells

_NO_NORMAL = int(NO_NORMAL)


@njit(nogil=True, cache=True)
def _unpack(word, out):
    """Unit vector of an octahedral word; see ``points.unpack_normals``."""
    u = np.int16(word & 0xFFFF) / 32767.0
    v = np.int16((word >> 16) & 0xFFFF) / 32767.0
    w = 1.0 - abs(u) - abs(v)
    if w < 0.0:
        u, v = (1.0 - abs(v)) * (1.0 if u >= 0.0 else -1.0), (1.0 - abs(u)) * (1.0 if v >= 0.0 else -1.0)
    length = np.sqrt(u * u + v * v + w * w)
    out[0], out[1], out[2] = u / length, v / length, w / length


@njit(nogil=True, cache=True)
def add_normals(words, stored, begin, end, total):
    """Add the normals of ``words[stored[begin:end]]`` to (3,) ``total``; False if one is missing."""
    normal = np.empty(3)
    for j in range(begin, end):
        word = np.int64(words[stored[j]])
        if word == _NO_NORMAL:
            return False
        _unpack(word, normal)
        for axis in range(3):
            total[axis] += normal[axis]
    return True


@njit(nogil=True, cache=True)
def start_cone(total, cone):
    """Set (4,) ``cone`` to the axis of (3,) ``total`` with cosine 1, or to "any direction"; True for an axis."""
    length = np.sqrt(total[0] ** 2 + total[1] ** 2 + total[2] ** 2)
    cone[3] = -1.0
    if not length > 0.0:
        return False
    for axis in range(3):
        cone[axis] = total[axis] / length
    cone[3] = 1.0
    return True


@njit(nogil=True, cache=True)
def widen_cone(words, stored, begin, end, cone):
    """Lower the cosine of (4,) ``cone`` until it holds the normals of ``words[stored[begin:end]]``."""
    normal = np.empty(3)
    for j in range(begin, end):
        _unpack(np.int64(words[stored[j]]), normal)
        cone[3] = min(cone[3], normal[0] * cone[0] + normal[1] * cone[1] + normal[2] * cone[2])


@njit(nogil=True, cache=True)
def _leaf_cones(which, first_point, n_points, stored, words, total, cone):
    for k in range(len(which)):
        cell = which[k]
        begin, end = first_point[cell], first_point[cell] + n_points[cell]
        if not add_normals(words, stored, begin, end, total[cell]):
            total[cell, :] = 0.0
        if start_cone(total[cell], cone[cell]):
            widen_cone(words, stored, begin, end, cone[cell])


def leaf_cones(
    cells: LinkedCells, normals: np.ndarray, stored: np.ndarray, workers: Workers
) -> tuple[np.ndarray, np.ndarray]:
    """((n, 3) normal sums, (n, 4) axis and cosine), float64, filled for the leaves."""
    total, cone = np.zeros((len(cells), 3)), np.zeros((len(cells), 4))
    leaves = np.flatnonzero(cells.first_child < 0)
    workers.map(
        _leaf_cones,
        [
            (leaves[a:b], cells.first_point, cells.n_points, stored, normals, total, cone)
            for a, b in workers.ranges(len(leaves), pieces=8 * workers.n_threads)
        ],
    )
    return total, cone


@njit(cache=True)
def _merge(first_child, n_children, total, cone):
    for cell in range(len(first_child) - 1, -1, -1):
        if first_child[cell] < 0:
            continue
        complete = True
        for child in range(first_child[cell], first_child[cell] + n_children[cell]):
            complete = complete and cone[child, 3] > -1.0
            for axis in range(3):
                total[cell, axis] += total[child, axis]
        if not complete:
            cone[cell, 3] = -1.0
            continue
        if not start_cone(total[cell], cone[cell]):
            continue
        half_angle = 0.0
        for child in range(first_child[cell], first_child[cell] + n_children[cell]):
            between = cone[child, 0] * cone[cell, 0] + cone[child, 1] * cone[cell, 1] + cone[child, 2] * cone[cell, 2]
            angle = np.arccos(min(1.0, max(-1.0, between))) + np.arccos(min(1.0, max(-1.0, cone[child, 3])))
            half_angle = max(half_angle, angle)
        cone[cell, 3] = np.cos(half_angle) if half_angle < np.pi else -1.0


def merge_cones(first_child: np.ndarray, n_children: np.ndarray, total: np.ndarray, cone: np.ndarray) -> np.ndarray:
    """(n, 4) float32 cones of all cells from those of the leaves; total and cone are filled in place.

    The cosine is lowered by more than the rounding of axis, angle and float32, so the cone stays conservative.
    """
    _merge(first_child, n_children, total, cone)
    out = cone.astype(np.float32)
    out[:, 3] = np.maximum(cone[:, 3] - 4e-7, -1.0)
    out[out[:, 3] <= -1.0] = (0.0, 0.0, 1.0, -1.0)
    return out
