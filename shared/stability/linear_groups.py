"""Linear groups at the extremes: any ε, ends that nearly coincide, matrices that stretch or flatten."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np

from ..codecs.linear_groups import LinearGroupCodec, LinearGroups, read, write
from .case import cases, expect

_LAST = 2**21 - 1


def _sheet(n: int, edge: int) -> np.ndarray:
    """(n, 3) grid points of a wavy sheet."""
    u, v = np.random.default_rng(71).uniform(0, 1, (2, n))
    return (np.column_stack([u, v, 0.5 + 0.3 * np.sin(5 * u) * np.cos(4 * v)]) * edge).astype(np.int64)


def _line(n: int) -> np.ndarray:
    """(n, 3) grid points on the diagonal of the grid, at dyadic distances."""
    return np.repeat(np.arange(n)[:, None] * (2**21 // 256), 3, axis=1)


_CORNER = np.array([_LAST, _LAST, _LAST])
_ENDS = {
    "no ε, on a line": (_line(200), 0.0),
    "no ε, all in one place": (np.tile(_CORNER, (200, 1)), 0.0),
    "ε of 1e-300": (_line(200), 1e-300),
    "ε of half a step": (_sheet(2000, 40), 0.5),
    "ε just below the distance of neighbours": (np.indices((9, 9, 9)).reshape(3, -1).T * 2**16, 2.0**16 - 2.0**-8),
    "ends a step apart, and one across the grid": (np.vstack([_CORNER - _sheet(60, 2), [[0, 0, 0]]]), 1.0),
    "ends a step apart, points across the grid": (
        np.vstack([_line(60), _line(60) + np.eye(3, dtype=np.int64)[2]]),
        2.0,
    ),
    "ε of the object": (_sheet(500, _LAST), float(_LAST)),
    "ε of 1e300": (_sheet(500, _LAST), 1e300),
}


@cases("linear groups/ends", bounds=dict.fromkeys(_ENDS, 0.0), unit="points")
def ends(name: str) -> float:
    """Points that lie farther than ε from where they are drawn, in rationals, after a round trip through bytes."""
    points, epsilon = _ENDS[name]
    groups, order = LinearGroupCodec(epsilon, part_points=64).group(points, 21)
    groups = read(write(groups), 21, len(points))
    expect(len(groups.parameter) > 0, "some points are grouped")
    limit = Fraction(epsilon) ** 2
    away = [
        sum((a - int(b)) ** 2 for a, b in zip(place, point, strict=True)) > limit
        for place, point in zip(_places(groups), points[order], strict=True)
    ]
    return sum(away)


def _places(groups: LinearGroups) -> list[list[Fraction]]:
    """Where each point is drawn, in coded order."""
    kept = [[Fraction(int(x)) for x in point] for point in groups.kept]
    inner = []
    for (v1, v2), (first, stop) in zip(groups.ends, pairwise(groups.first_inner), strict=True):
        for t in groups.parameter[first:stop]:
            inner.append([a + Fraction(int(t), 256) * (b - a) for a, b in zip(kept[v1], kept[v2], strict=True)])
    return kept + inner


def _rotation(seed: int) -> np.ndarray:
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


_MATRICES = {
    "a billion times as long as wide": _rotation(1) * [1e9, 1.0, 1.0] @ _rotation(2),
    "1e12 … 1e-12": _rotation(3) * [1e12, 1.0, 1e-12] @ _rotation(4),
    "nearly singular": np.ones((3, 3)) + 1e-15 * np.eye(3),
    "singular": np.outer([1.0, 2.0, 3.0], [3.0, -1.0, 2.0]),
    "1e-150": 1e-150 * _rotation(5),
    "1e150": 1e150 * _rotation(6),
}


@cases("linear groups/matrix", bounds=dict.fromkeys(_MATRICES, 1 + 1e-9), unit="ε ‖A‖")
def matrix(name: str) -> float:
    """Distance of points whose ends went through a matrix, and that were interpolated, from the points that went
    through it in rationals, over ε and the matrix's largest stretch.
    """
    linear, epsilon = _MATRICES[name], 8.0
    points = _sheet(600, 1023)
    groups, order = LinearGroupCodec(epsilon, part_points=64).group(points, 10)
    expect(len(groups.parameter) > 150, "many points are grouped")
    scale = float(np.linalg.norm(linear, 2))
    found = groups.transformed(np.column_stack([linear, np.zeros(3)]))
    rows = [[Fraction(float(entry)) for entry in row] for row in linear]
    worst = Fraction(0)
    for place, point in zip(found, points[order], strict=True):
        exact = [sum(a * int(b) for a, b in zip(row, point, strict=True)) for row in rows]
        worst = max(
            worst, sum(((Fraction(float(a)) - b) / Fraction(scale)) ** 2 for a, b in zip(place, exact, strict=True))
        )
    return float(worst) ** 0.5 / epsilon
