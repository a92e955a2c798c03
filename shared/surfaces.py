"""A closed surface of points, for measurements and tests."""

from __future__ import annotations

import numpy as np

from .build.morton import keys_of, root_cube
from .build.parallel import Workers

RUN_POINTS = 4096
"""Points of a run in ``stored`` order: a full leaf."""


def bumpy_sphere(n: int, seed: int | list[int] = 0) -> np.ndarray:
    """(n, 3) float64 points, in random order, on a closed surface around the origin, radius 0.85 … 1.15."""
    direction = np.random.default_rng(seed).standard_normal((n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    x, y, z = direction.T
    return direction * (1 + 0.15 * np.sin(5 * x) * np.sin(6 * y) * np.sin(4 * z + 1))[:, None]


def point_orders(positions: np.ndarray, seed: int = 0) -> dict[str, np.ndarray]:
    """Permutations of (n, 3) float64 positions by the name of the order they bring.

    ``morton``; ``stored``: Morton order in runs of ``RUN_POINTS``, each shuffled, as leaves of a scene are; ``random``.
    """
    rng = np.random.default_rng(seed)
    with Workers() as workers:
        keys = keys_of(positions, *root_cube(positions.min(axis=0), positions.max(axis=0)), workers)
    morton = np.argsort(keys)
    whole = len(morton) // RUN_POINTS * RUN_POINTS
    stored = morton.copy()
    stored[:whole] = rng.permuted(morton[:whole].reshape(-1, RUN_POINTS), axis=1).ravel()
    return {"morton": morton, "stored": stored, "random": rng.permutation(len(positions))}
