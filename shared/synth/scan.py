"""The scan: batches of points of a city, as a reader would yield them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..points import PointBatch, concatenate, pack_normals, pack_rgb
from ..readers.source import Source, SourceInfo
from .city import city, is_draped
from .light import Light
from .primitives import MATERIALS, Material, boxes
from .sampling import Surfaces, allot
from .terrain import HIGHEST_M, LOWEST_M, PITCH_M, STREET_M, height

CHUNK_POINTS = 1 << 15
"""Points made at a time. Random numbers are drawn per chunk, so the chunk and not the batch decides every point."""

RANGE_NOISE_M = 0.005
_NOISE_LIMIT = 4.0  # standard deviations
_LIGHT_POINTS_PER_M2 = 20
DEFAULT_POINTS = 2_000_000
DEFAULT_EXTENT_M = 225.0
MOST_BLOCKS = 12

_CLASS = np.array([MATERIALS[m].classification for m in Material], np.uint8)
_REFLECTANCE = np.array([MATERIALS[m].reflectance for m in Material], np.float32)


class CityScan(Source):
    """A synthetic scan of a city, deterministic in ``seed``, n_points and extent; batching changes nothing.

    n_points : > 0; points are spread over the surfaces evenly, whatever their number.
    extent_m : side of the city, rounded to whole blocks of 72 m plus one street. The default suits two million points.
    offset : (3,) metres, world position of the city's lower corner.
    Raises InputError for values out of range.
    Cost: time linear in n_points; memory of one batch, a few chunks and about 4 MB a block of the city.
    """

    part_points = CHUNK_POINTS
    ATTRIBUTES = ("rgb", "normal", "intensity", "classification", "return_number")

    def __init__(
        self,
        n_points: int = DEFAULT_POINTS,
        seed: int = 1,
        extent_m: float = DEFAULT_EXTENT_M,
        offset: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        if n_points < 1:
            raise InputError(f"synth: n_points = {n_points}, expected a number > 0")
        if seed < 0:
            raise InputError(f"synth: seed = {seed}, expected a number ≥ 0")
        largest_m = MOST_BLOCKS * PITCH_M + STREET_M
        if not 0 < extent_m <= largest_m:
            raise InputError(f"synth: extent_m = {extent_m}, expected a number in (0, {largest_m:g}]")
        self._offset = np.asarray(offset, np.float64)
        if self._offset.shape != (3,) or not np.isfinite(self._offset).all():
            raise InputError(f"synth: offset = {offset}, expected three finite numbers")
        n_blocks = max(1, round((extent_m - STREET_M) / PITCH_M))
        edge_m = n_blocks * PITCH_M + STREET_M
        self.seed, self.n_points = seed, n_points
        self._primitives = city(seed, n_blocks)
        self._surfaces = Surfaces(self._primitives)
        self._draped = is_draped(self._primitives)
        self._material = self._primitives["material"].copy()
        self._colour = np.ascontiguousarray(self._primitives["colour"].T, np.float32)
        self._first = allot(self._primitives, n_points)
        self._light = Light(self._survey(edge_m), edge_m, seed)
        lower, upper = self._bounds()
        self.info = SourceInfo(
            path=Path("synthetic city"),
            format="synth",
            n_points=n_points,
            lower=lower,
            upper=upper,
            attributes=self.ATTRIBUTES,
            crs=None,
        )

    def _read(self, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        return self._read_part(0, self.n_points, max_points, attributes)

    def _read_part(self, first: int, last: int, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        pending: list[PointBatch] = []
        missing = max_points
        for chunk in self._chunks(first, last, attributes):
            while len(chunk) >= missing:
                yield concatenate([*pending, chunk.select(slice(0, missing))])
                chunk = chunk.select(slice(missing, None))
                pending, missing = [], max_points
            if len(chunk):
                pending.append(chunk)
                missing -= len(chunk)
        if pending:
            yield concatenate(pending)

    def _chunks(self, first: int, last: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        """The chunks in order, cut to the points ``first`` … ``last`` − 1, a few of them made ahead by threads."""
        n_threads = len(os.sched_getaffinity(0))
        ahead: deque[Future[PointBatch]] = deque()

        def part(start: int) -> PointBatch:
            return self._chunk(start, attributes).select(slice(max(first - start, 0), last - start))

        with ThreadPoolExecutor(n_threads, "synth") as pool:
            for start in range(first // CHUNK_POINTS * CHUNK_POINTS, last, CHUNK_POINTS):
                ahead.append(pool.submit(part, start))
                if len(ahead) > 2 * n_threads:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()

    def _chunk(self, start: int, attributes: tuple[str, ...]) -> PointBatch:
        """The points of one chunk."""
        rng = np.random.default_rng([self.seed, start // CHUNK_POINTS])
        n = min(CHUNK_POINTS, self.n_points - start)
        which, positions, normals, patch = self._surface(self._first, start, start + n)
        material = self._material[which]
        noise = rng.standard_normal((3, n), np.float32).clip(-_NOISE_LIMIT, _NOISE_LIMIT)
        draws = rng.random((2, n), np.float32)
        leaves = np.flatnonzero(material == Material.LEAVES)
        normals = normals.astype(np.float32)
        ruffled = normals[:, leaves] + 0.5 * rng.standard_normal((3, len(leaves)), np.float32)
        normals[:, leaves] = ruffled / np.sqrt((ruffled**2).sum(axis=0))
        columns: dict[str, np.ndarray] = {}
        if "rgb" in attributes:
            base = self._colour.take(which, axis=1)
            base[:, _is_frame(material, patch)] = np.array([MATERIALS[Material.TRIM].colour]).T
            columns["rgb"] = pack_rgb(*self._light.colour(rng, positions.astype(np.float32), normals, material, base))
        if "normal" in attributes:
            columns["normal"] = pack_normals(normals.T)
        if "intensity" in attributes:
            incidence = 0.55 + 0.45 * np.abs(normals[2])
            columns["intensity"] = np.rint(_REFLECTANCE[material] * incidence * (0.85 + 0.15 * draws[0]) * 65535)
        if "classification" in attributes:
            columns["classification"] = _CLASS[material]
        if "return_number" in attributes:
            returns = np.ones(n, np.uint8)
            returns[leaves] += (3 * draws[1, leaves] ** 2).astype(np.uint8)
            columns["return_number"] = returns
        world = np.empty((n, 3))
        for axis in range(3):
            world[:, axis] = positions[axis] + RANGE_NOISE_M * noise[axis] + self._offset[axis]
        return PointBatch(world, columns)

    def _surface(
        self, first: np.ndarray, start: int, stop: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points start … stop − 1 without noise: primitive, position on the terrain, normal and patch coordinates."""
        low = int(np.searchsorted(first, start, side="right")) - 1
        high = int(np.searchsorted(first, stop, side="left"))
        inside = np.diff(np.clip(first[low : high + 1], start, stop))
        which = np.repeat(np.arange(low, high), inside)
        positions, normals, patch = self._surfaces.points(which, np.arange(start, stop) - first[which])
        x, y, z = positions
        ground = height(x, y)
        # Walls end at the ground; only the pond lies below it.
        standing = np.where(self._material[which] == Material.WATER, z, np.maximum(z, ground))
        positions[2] = np.where(self._draped[which], z + ground, standing)
        return which, positions, normals, patch

    def _survey(self, edge_m: float) -> Iterator[np.ndarray]:
        """A coarse sample of positions for the light, independent of n_points."""
        n = int(edge_m**2 * _LIGHT_POINTS_PER_M2)
        first = allot(self._primitives, n)
        for start in range(0, n, CHUNK_POINTS):
            yield self._surface(first, start, min(start + CHUNK_POINTS, n))[1]

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of a box that holds every point: the primitives' boxes, the terrain's span and the noise."""
        low, high = boxes(self._primitives)
        lower, upper = low.min(axis=0), high.max(axis=0)
        lower[2] = min(lower[2], (low[self._draped, 2] + LOWEST_M).min())
        upper[2] = max(upper[2], (high[self._draped, 2] + HIGHEST_M).max())
        margin = RANGE_NOISE_M * _NOISE_LIMIT + 1e-3
        return lower - margin + self._offset, upper + margin + self._offset


def _is_frame(material: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """(n,) bool: points on the frame and the mullion of a pane."""
    s, t = np.abs(patch - 0.5)
    return (material == Material.GLASS) & ((s > 0.44) | (t > 0.45) | (s < 0.035))
