"""Vertex–transformation tables and their pools, written to be read: sections 4.1 and 4.2 of the paper, in NumPy.

Source: Kim, Lee, Varshney, "Vertex Transformation Streams". ``pools`` states the readings taken.
"""

from __future__ import annotations

import numpy as np


def translation_counts(points: np.ndarray) -> dict[tuple[int, int, int], int]:
    """How many of (n, 3) distinct points each translation takes to another one: all pairs, one by one."""
    pairs = (points[None].astype(np.int64) - points[:, None]).reshape(-1, 3)
    translations, counts = np.unique(pairs, axis=0, return_counts=True)
    return {(x, y, z): n for (x, y, z), n in zip(translations.tolist(), counts.tolist(), strict=True)}


def table(vertices: np.ndarray, translations: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(m, n) bool: whether translation i takes vertex j to one of the points."""
    there = set(map(tuple, points.tolist()))
    sums = translations[:, None].astype(np.int64) + vertices[None].astype(np.int64)
    return np.array([[tuple(p) in there for p in row] for row in sums.tolist()]).reshape(sums.shape[:2])


def next_pool(points: np.ndarray, translations: np.ndarray, left: np.ndarray, width: int) -> tuple[np.ndarray, ...]:
    """The next pool of at most ``width`` translations, of which no point is covered that is not left.

    left : (n,) bool.  Returns rows (k,) of the translations, vertices (v,) among the points and bits (k, v) bool.
    """
    ones = table(points, translations, points[left])
    rows = np.flatnonzero(ones[:, ones.sum(axis=0).argmax()])[:width]
    ones = ones[rows]
    uncovered = set(map(tuple, points[left].tolist()))
    vertices, bits = [], []
    for j in np.argsort(-ones.sum(axis=0), kind="stable"):
        targets = list(map(tuple, (points[j].astype(np.int64) + translations[rows]).tolist()))
        new = [target in uncovered for target in targets]
        if sum(new) > 0.25 * len(rows):
            vertices.append(j)
            bits.append(new)
            uncovered -= set(targets)
    return rows, np.array(vertices), np.array(bits).T


def pool_points(vertices: np.ndarray, translations: np.ndarray, bits: np.ndarray) -> np.ndarray:
    """The points of a pool in its order, from (v, 3) vertices, (m, 3) translations and the (m, v) table of bits."""
    sums = vertices[:, None].astype(np.int64) + translations[None].astype(np.int64)
    return sums[bits.T.astype(bool)]
