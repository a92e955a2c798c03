"""Eight small spheres, one in each octant of a cube, and one of them with nearly all points: uneven work to balance."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..points import PointBatch, pack_rgb
from ..readers.source import Source, SourceInfo
from ..surfaces import bumpy_sphere

_CHUNK_POINTS = 1 << 16
"""Points made at a time. Random numbers are drawn per chunk, so the chunk and not the batch decides every point."""
_SCALE = 0.35
_CORNERS = 0.5 * np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)], np.float64)


class HotOctant(Source):
    """Points on eight ``surfaces.bumpy_sphere`` in a cube of edge 2 about the origin, coloured by place.

    n_points : > 0.  share : of them in the octant of positive coordinates, 0 … 1; the others are even.
    The same points for the same numbers, whatever the batches.
    Raises InputError for values out of range.  Cost: about 0.2 µs a point; memory of one chunk.
    """

    def __init__(self, n_points: int, share: float = 0.9, seed: int = 1) -> None:
        if n_points < 1 or seed < 0 or not 0 <= share <= 1:
            raise InputError(
                f"synth: n_points = {n_points}, share = {share}, seed = {seed}, expected > 0, 0 … 1 and ≥ 0"
            )
        self._seed = seed
        self._shares = [share, *[(1 - share) / 7] * 7]
        bound = np.ones(3)
        self.info = SourceInfo(Path("synthetic hot octant"), "synth", n_points, ("rgb",), -bound, bound)

    def _read(self, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        n_points = self.info.n_points or 0
        for chunk, start in enumerate(range(0, n_points, _CHUNK_POINTS)):
            n = min(_CHUNK_POINTS, n_points - start)
            octant = np.random.default_rng([self._seed, chunk, 1]).choice(8, n, p=self._shares)
            positions = _SCALE * bumpy_sphere(n, [self._seed, chunk]) + _CORNERS[octant]
            columns = {}
            if "rgb" in attributes:
                columns["rgb"] = pack_rgb(*np.rint(127.5 + 120 * np.sin(9 * positions)).astype(np.uint8).T)
            points = PointBatch(positions, columns)
            for first in range(0, n, max_points):
                yield points.select(slice(first, first + max_points))
