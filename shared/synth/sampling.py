"""Points on primitives: how many each gets, and where they lie."""

from __future__ import annotations

import numpy as np

from .primitives import MATERIALS, Shape, areas

_PLASTIC = 1.32471795724474602596  # the root of x³ = x + 1
_STEPS = (1 / _PLASTIC, 1 / _PLASTIC**2, (5**0.5 - 1) / 2)


def allot(primitives: np.ndarray, n_points: int) -> np.ndarray:
    """(n_primitives + 1,) int64: first point of each primitive, then n_points; by area × the material's weight.

    Rounding the running sum keeps the total exact; equal primitives get equal counts to within one point.
    """
    weight = np.array([MATERIALS[m].weight for m in MATERIALS])[primitives["material"]]
    share = np.cumsum(areas(primitives) * weight)
    first = np.floor(share / share[-1] * n_points).astype(np.int64)
    first[-1] = n_points
    return np.concatenate([[0], first])


class Surfaces:
    """Primitives by columns, to be sampled.

    primitives : (k,) PRIMITIVE.  Arrays of vectors are by component, (3, n): passes over them run at memory speed.
    """

    def __init__(self, primitives: np.ndarray) -> None:
        self._shape = primitives["shape"]
        self._taper = primitives["taper"]
        self._axes = {name: np.ascontiguousarray(primitives[name].T) for name in ("origin", "u", "v", "w")}
        # Equal parts start alike, unlike ones do not, so a façade's thin strips are not all hit at their middles.
        self._phase = np.abs(primitives["u"]).sum(axis=1) * 7.31 + np.abs(primitives["v"]).sum(axis=1) * 3.77

    def points(self, which: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Point number ``index[i]`` of primitive ``which[i]``: positions, unit normals and patch coordinates.

        which : (n,) int64.  index : (n,) int64, from 0 in each primitive.
        Returns (3, n) float64 positions in metres, (3, n) float64 normals, (2, n) float64 in [0, 1) (where on the
        patch).

        The points of a primitive are an additive recurrence: any prefix covers it evenly, and equal primitives get
        equal points. Source: Roberts 2018, "The unreasonable effectiveness of quasirandom sequences" (R2).
        """
        shape = self._shape[which]
        u_axis, v_axis, w_axis = (self._axes[name].take(which, axis=1) for name in "uvw")
        phase = self._phase[which]
        s, t, r = (_fraction(phase + index * step) for step in _STEPS)

        a, b, c = s.copy(), t.copy(), np.zeros(len(s))
        na, nb, nc = np.zeros(len(s)), np.zeros(len(s)), np.ones(len(s))

        i = np.flatnonzero((shape == Shape.TRIANGLE) & (s + t > 1))
        a[i], b[i] = 1 - s[i], 1 - t[i]

        i = np.flatnonzero(shape == Shape.DISC)
        radius, angle = np.sqrt(t[i]), 2 * np.pi * s[i]
        a[i], b[i] = radius * np.cos(angle), radius * np.sin(angle)

        i = np.flatnonzero(shape == Shape.FRUSTUM)
        angle, k = 2 * np.pi * s[i], self._taper[which[i]]
        along = t[i] * (1 + k) / (1 + np.sqrt(1 + t[i] * (k * k - 1)))  # equal area: the wider end gets more
        radius, na[i], nb[i] = 1 + (k - 1) * along, np.cos(angle), np.sin(angle)
        a[i], b[i], c[i] = radius * na[i], radius * nb[i], along
        nc[i] = (1 - k) * _square(u_axis[:, i]) / _square(w_axis[:, i])

        i = np.flatnonzero(shape >= Shape.ELLIPSOID)
        angle, c[i] = 2 * np.pi * s[i], 1 - 2 * t[i]
        ring = np.sqrt(1 - c[i] ** 2)
        a[i], b[i] = ring * np.cos(angle), ring * np.sin(angle)
        for n, x, axis in ((na, a, u_axis), (nb, b, v_axis), (nc, c, w_axis)):
            n[i] = x[i] / _square(axis[:, i])

        i = np.flatnonzero(shape == Shape.FOLIAGE)
        clump = 0.86 + 0.14 * np.sin(11 * a[i] + 5 * c[i]) * np.sin(9 * b[i] - 6 * c[i])
        depth = clump * (1 - 0.42 * r[i] ** 3)
        a[i], b[i], c[i] = a[i] * depth, b[i] * depth, c[i] * depth

        positions = self._axes["origin"].take(which, axis=1) + a * u_axis + b * v_axis + c * w_axis
        normals = na * u_axis + nb * v_axis + nc * w_axis
        normals /= np.sqrt(_square(normals))
        return positions, normals, np.stack([s, t])


def _fraction(x: np.ndarray) -> np.ndarray:
    return x - np.floor(x)


def _square(vectors: np.ndarray) -> np.ndarray:
    """(n,) squared lengths of (3, n) vectors."""
    return vectors[0] ** 2 + vectors[1] ** 2 + vectors[2] ** 2
