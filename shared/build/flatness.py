"""Flatness of a region by eigenvalue analysis (thesis 4.2, 4.3.1): λ0 / (λ0 + λ1 + λ2) of its points' covariance.

Moments are exact integer sums of key coordinates relative to the cell's own corner, so they depend neither on the
order of the points nor on how they were split into runs; cells above the bucket level merge the moments of their
children about the common mean (Chan, Golub, LeVeque 1983), so nothing cancels however far the scene is from zero.
The floor of the method is the key grid: a cell of level l is seen in steps of 2**(l - 21) of its edge.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .eigen import eigen_symmetric
from .morton import compact_bits

N_MOMENTS = 10
"""Count, three sums, six sums of products (xx, xy, xz, yy, yz, zz)."""


@njit(nogil=True, cache=True)
def add_moments(keys, ids, start, stop, level, moments):
    """Add to (10,) int64 ``moments`` the points ``keys[ids[start:stop]]`` of one cell of ``level`` ≥ 6."""
    mask = (1 << (21 - level)) - 1
    for j in range(start, stop):
        key = keys[ids[j]]
        x, y, z = compact_bits(key) & mask, compact_bits(key >> 1) & mask, compact_bits(key >> 2) & mask
        moments[0] += 1
        moments[1] += x
        moments[2] += y
        moments[3] += z
        moments[4] += x * x
        moments[5] += x * y
        moments[6] += x * z
        moments[7] += y * y
        moments[8] += y * z
        moments[9] += z * z


@njit(nogil=True, cache=True)
def central_moments(moments, central):
    """(10,) float64 count, mean, central second moments of exact (10,) int64 ``moments``.

    Sums are moved to the key step next to the mean in integers (wrapping where a part does not fit: the whole does), so
    that what is left to subtract in float64 is at most half a step a point.
    """
    n = max(moments[0], 1)
    central[0] = moments[0]
    step, rest = np.empty(3, np.int64), np.empty(3)
    for axis in range(3):
        central[1 + axis] = moments[1 + axis] / n
        step[axis] = (2 * moments[1 + axis] + n) // (2 * n)
        rest[axis] = moments[1 + axis] - step[axis] * n
    p = 4
    for a in range(3):
        for b in range(a, 3):
            moved = moments[p] - step[a] * moments[1 + b] - step[b] * moments[1 + a] + n * step[a] * step[b]
            central[p] = moved - rest[a] * rest[b] / n
            p += 1


@njit(nogil=True, cache=True)
def merge_children(children, half, parent):
    """(10,) central moments of a cell from the (8, 10) ones of its octants, whose edge is ``half`` key steps."""
    parent[:] = 0.0
    n = children[:, 0].sum()
    parent[0] = n
    if n == 0:
        return
    mean = np.empty((8, 3))
    for o in range(8):
        for axis in range(3):
            mean[o, axis] = children[o, 1 + axis] + half * ((o >> axis) & 1)
            parent[1 + axis] += mean[o, axis] * (children[o, 0] / n)
    for o in range(8):
        p = 4
        for a in range(3):
            for b in range(a, 3):
                shift = (mean[o, a] - parent[1 + a]) * (mean[o, b] - parent[1 + b])
                parent[p] += children[o, p] + children[o, 0] * shift
                p += 1


@njit(nogil=True, cache=True)
def flatness(central):
    """Smallest eigenvalue over the sum of eigenvalues of (10,) central moments, in [0, 1/3].

    0 for coincident points: a point is as flat as can be.
    """
    a = np.empty((3, 3))
    p = 4
    for i in range(3):
        for j in range(i, 3):
            a[i, j] = central[p]
            a[j, i] = central[p]
            p += 1
    trace = a[0, 0] + a[1, 1] + a[2, 2]
    if not trace > 0.0:
        return 0.0
    eigen_symmetric(a, np.empty((3, 3)))
    return max(0.0, min(a[0, 0], a[1, 1], a[2, 2]) / trace)


@njit(nogil=True, cache=True)
def bucket_moments(keys, ids, first, start, stop, level, moments):
    """Add the moments of the buckets ``[start, stop)``, bucket b being ``ids[first[b]:first[b + 1]]``."""
    for bucket in range(start, stop):
        add_moments(keys, ids, first[bucket], first[bucket + 1], level, moments[bucket])


@njit(nogil=True, cache=True)
def moments_pyramid_step(central, half):
    """((n / 8, 10) central moments one level up, (n,) flatness) of (n, 10) central moments of edge ``half`` steps."""
    n = len(central)
    flat = np.empty(n)
    parents = np.empty((n // 8, 10))
    for i in range(n):
        flat[i] = flatness(central[i])
    for i in range(n // 8):
        merge_children(central[8 * i : 8 * i + 8], half, parents[i])
    return parents, flat


@njit(nogil=True, cache=True)
def central_of(moments):
    """(n, 10) float64 central moments of (n, 10) exact int64 moments."""
    out = np.empty(moments.shape)
    for i in range(len(moments)):
        central_moments(moments[i], out[i])
    return out
