"""Eigenvalues and eigenvectors of symmetric 3×3 matrices, for kernels."""

from __future__ import annotations

import numpy as np
from numba import njit

_SWEEPS = 12
_NEGLIGIBLE = 2.0**-54
"""An element off the diagonal is zero if it is below this share of the geometric mean of the two on it."""


@njit(nogil=True, cache=True)
def eigen_symmetric(a, vectors):
    """Diagonalise (3, 3) float64 ``a`` in place; columns of (3, 3) ``vectors`` become the unit eigenvectors.

    Cyclic Jacobi, with the stopping rule that keeps small eigenvalues of positive matrices accurate relative to
    themselves where the matrix allows it (Demmel and Veselić 1992). Eigenvalues are not sorted.
    """
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        rotated = False
        for i in range(2):
            for j in range(i + 1, 3):
                if abs(a[i, j]) <= _NEGLIGIBLE * np.sqrt(abs(a[i, i])) * np.sqrt(abs(a[j, j])):
                    continue
                rotated = True
                theta = (a[j, j] - a[i, i]) / (2.0 * a[i, j])
                t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    u, v = a[k, i], a[k, j]
                    a[k, i], a[k, j] = c * u - s * v, s * u + c * v
                for k in range(3):
                    u, v = a[i, k], a[j, k]
                    a[i, k], a[j, k] = c * u - s * v, s * u + c * v
                a[i, j] = a[j, i] = 0.0
                for k in range(3):
                    u, v = vectors[k, i], vectors[k, j]
                    vectors[k, i], vectors[k, j] = c * u - s * v, s * u + c * v
        if not rotated:
            return


@njit(nogil=True, cache=True)
def sorted_eigen(a, values, vectors):
    """Diagonalise (3, 3) ``a`` in place: (3,) ``values`` ascending, ≥ 0, and the columns of ``vectors`` likewise.

    For covariances: rounding may leave a smallest eigenvalue below zero.
    """
    eigen_symmetric(a, vectors)
    for i in range(3):
        values[i] = max(a[i, i], 0.0)
    for i in range(2):
        for j in range(2 - i):
            if values[j] > values[j + 1]:
                values[j], values[j + 1] = values[j + 1], values[j]
                for k in range(3):
                    vectors[k, j], vectors[k, j + 1] = vectors[k, j + 1], vectors[k, j]
