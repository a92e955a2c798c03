"""A closed, smooth surface in smooth colours: what a picture loses by leaving points out shows on it undisguised."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..points import PointBatch, pack_normals, pack_rgb
from ..readers.source import Source, SourceInfo
from ..surfaces import bumpy_sphere

_CHUNK_POINTS = 1 << 16
"""Points made at a time. Random numbers are drawn per chunk, so the chunk and not the batch decides every point."""
_BOUND = 1.15


class SphereScan(Source):
    """Points on ``surfaces.bumpy_sphere``, coloured by smooth waves over space, with outward normals.

    n_points : > 0.  The same points for the same number and seed, whatever the batches.
    Raises InputError for values out of range.
    Cost: about 0.2 µs a point; memory of one chunk.
    """

    ATTRIBUTES = ("rgb", "normal")

    def __init__(self, n_points: int, seed: int = 1) -> None:
        if n_points < 1 or seed < 0:
            raise InputError(f"synth: n_points = {n_points}, seed = {seed}, expected numbers > 0 and ≥ 0")
        self.seed = seed
        bound = np.full(3, _BOUND)
        self.info = SourceInfo(Path("synthetic sphere"), "synth", n_points, self.ATTRIBUTES, -bound, bound)

    def _read(self, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        n_points = self.info.n_points or 0
        for chunk, start in enumerate(range(0, n_points, _CHUNK_POINTS)):
            positions = bumpy_sphere(min(_CHUNK_POINTS, n_points - start), [self.seed, chunk])
            columns = {}
            if "rgb" in attributes:
                columns["rgb"] = _colours(positions)
            if "normal" in attributes:
                columns["normal"] = pack_normals(_outward(positions))
            points = PointBatch(positions, columns)
            for first in range(0, len(points), max_points):
                yield points.select(slice(first, first + max_points))


def _colours(positions: np.ndarray) -> np.ndarray:
    """(n,) colour words: each channel one wave along another direction, about 0.3 % of the range a pixel at 1080p."""
    waves = positions @ np.array([[2.0, 1.0, 0.5], [-1.0, 2.0, 1.0], [0.5, -1.0, 2.0]]) + [0.0, 2.0, 4.0]
    return pack_rgb(*np.rint(127.5 + 110 * np.sin(waves)).astype(np.uint8).T)


def _outward(positions: np.ndarray) -> np.ndarray:
    """(n, 3) normals, of any length: the gradient of |p| − r(p / |p|)."""
    length = np.linalg.norm(positions, axis=1, keepdims=True)
    direction = positions / length
    x, y, z = direction.T
    sx, sy, sz = np.sin(5 * x), np.sin(6 * y), np.sin(4 * z + 1)
    slope = 0.15 * np.column_stack(
        [5 * np.cos(5 * x) * sy * sz, 6 * sx * np.cos(6 * y) * sz, 4 * sx * sy * np.cos(4 * z + 1)]
    )
    tangential = slope - (slope * direction).sum(axis=1, keepdims=True) * direction
    return direction - tangential / length
