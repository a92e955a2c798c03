"""Flatness of a cell: smallest eigenvalue over the sum of eigenvalues of its points' covariance."""

from __future__ import annotations

import numpy as np

from ..build.flatness import add_moments, central_moments, flatness, merge_children
from ..build.morton import keys_of, root_cube, spread_bits
from ..build.parallel import Workers
from .case import cases, expect, fifty_digits

_EPS = 2.0**-52


def _rotations(n: int) -> np.ndarray:
    """(n, 3, 3) float64 random rotations."""
    return np.linalg.qr(np.random.default_rng(7).normal(size=(n, 3, 3)))[0]


def _central(matrix: np.ndarray) -> np.ndarray:
    """(10,) central moments with this (3, 3) matrix of second moments."""
    return np.array([1.0, 0.0, 0.0, 0.0, *matrix[np.triu_indices(3)]])


def _exact_flatness(central: np.ndarray) -> float:
    """λ0 / Σλ of (10,) float64 central moments, to 50 digits."""
    mp = fifty_digits()
    xx, xy, xz, yy, yz, zz = (mp.mpf(float(v)) for v in central[4:])
    eigenvalues = mp.eigsy(mp.matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), eigvals_only=True)
    return float(min(eigenvalues) / (xx + yy + zz))


@cases(
    "eigen/condition",
    bounds={10.0**k: 8 * _EPS for k in (0, 2, 4, 8, 12, 16)},
    unit="of Σλ",
)
def condition(number: float) -> float:
    """Smallest eigenvalue over their sum, of 40 rotated covariances of this condition number, against 50 digits of the
    same float64 matrices. Rounding a matrix already moves λ0 by an ulp of the largest eigenvalue, so no smaller bound
    can hold: at 1e16 the verdict is "flat", and none of its digits.
    """
    scales = np.array([1.0, number**-0.5, 1 / number])
    worst = 0.0
    for rotation in _rotations(40):
        matrix = rotation * scales @ rotation.T
        central = _central((matrix + matrix.T) / 2)
        worst = max(worst, abs(flatness(central) - max(0.0, _exact_flatness(central))))
    return worst


@cases(
    "eigen/scale",
    bounds={1e-200: 8 * _EPS, 1e-20: 8 * _EPS, 1e20: 8 * _EPS, 1e200: 8 * _EPS},
    unit="of Σλ",
)
def scale(factor: float) -> float:
    """Smallest eigenvalue over their sum, of 40 covariances times this, against times 1."""
    worst = 0.0
    for rotation in _rotations(40):
        matrix = rotation * np.array([1.0, 0.1, 1e-3]) @ rotation.T
        central = _central((matrix + matrix.T) / 2)
        worst = max(worst, abs(flatness(central * factor) - flatness(central)))
    return worst


def _corner_grid(spread: int, n: int) -> np.ndarray:
    """(n, 3) int64 key coordinates in the far corner of a cell of level 6, ``spread`` steps wide."""
    return (1 << 15) - 1 - np.random.default_rng(3).integers(0, spread, (n, 3))


def _moments(grid: np.ndarray) -> np.ndarray:
    """(10,) float64 central moments, by the program, of points that lie in one cell of level 6."""
    keys = np.array(
        [spread_bits(int(x)) | spread_bits(int(y)) << 1 | spread_bits(int(z)) << 2 for x, y, z in grid], np.int64
    )
    moments, central = np.zeros(10, np.int64), np.empty(10)
    add_moments(keys, np.arange(len(keys)), 0, len(keys), 6, moments)
    central_moments(moments, central)
    return central


def _exact_moments(grid: np.ndarray) -> tuple[int, list[int]]:
    """n, and n times the six central second moments of integer points, in Python's integers."""
    n = len(grid)
    s = [int(v) for v in grid.sum(axis=0)]
    pairs = [(a, b) for a in range(3) for b in range(a, 3)]
    return n, [n * int((grid[:, a] * grid[:, b]).sum()) - s[a] * s[b] for a, b in pairs]


@cases(
    "eigen/far corner of a cell",
    bounds={2: 1e-14, 8: 1e-14, 1000: 1e-14},
    unit="relative",
)
def far_corner(spread: int) -> float:
    """Central moments of 20 000 points within this many key steps, 32 767 steps from the cell's corner, against
    integers.
    """
    grid = _corner_grid(spread, 20_000)
    n, exact = _exact_moments(grid)
    largest = max(abs(v) for v in exact) / n
    return max(abs(float(found) - v / n) / largest for found, v in zip(_moments(grid)[4:], exact, strict=True))


@cases(
    "eigen/merged octants",
    bounds={2: 1e-12, 100: 1e-14},
    unit="of Σλ",
)
def merged_octants(spread: int) -> float:
    """Smallest eigenvalue over their sum, of eight octants merged about a common mean, nearly flat and each this many
    steps wide around their common corner, 32 768 steps from their cell's, against 50 digits.
    """
    half = 1 << 15
    rng = np.random.default_rng(5)
    children, points = np.empty((8, 10)), []
    for octant in range(8):
        upper = np.array([octant >> axis & 1 for axis in range(3)])
        inside = rng.integers(0, spread, (500, 3))
        inside[:, 2] = 0  # nearly flat: two layers
        own = np.where(upper, inside, half - 1 - inside)
        children[octant] = _moments(own)
        points.append(own + upper * half)
    merged = np.empty(10)
    merge_children(children, float(half), merged)
    n, exact = _exact_moments(np.concatenate(points))
    reference = np.array([n, 0, 0, 0, *(v / n for v in exact)], float)
    return abs(flatness(merged) - _exact_flatness(reference))


@cases(
    "eigen/far from the origin",
    bounds={6.4e6: 0.0, 1e9: 0.0},
    unit="of Σλ",
)
def far_from_the_origin(by: float) -> float:
    """Flatness of a thin slab moved by this many metres, against not moved (the move is exact)."""
    slab = np.random.default_rng(9).integers(0, 1 << 16, (20_000, 3)) * 2.0**-10 * [1.0, 1.0, 2.0**-8]
    slab = np.round(slab * 2.0**16) / 2.0**16
    expect(np.array_equal(slab + by - by, slab), "the move is exact")

    def flat(positions: np.ndarray) -> float:
        with Workers(1) as workers:
            keys = keys_of(positions, *root_cube(positions.min(axis=0), positions.max(axis=0)), workers)
        moments, central, parts = np.zeros((8, 10), np.int64), np.empty((8, 10)), np.empty(10)
        for octant in range(8):
            mine = np.flatnonzero(keys >> 60 == octant)
            add_moments(keys >> 15, mine, 0, len(mine), 6, moments[octant])
            central_moments(moments[octant], central[octant])
        merge_children(central, float(1 << 15), parts)
        return flatness(parts)

    return abs(flat(slab + by) - flat(slab))
