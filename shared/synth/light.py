"""Colour of a point: its material in the sun, in the shade of what stands about, and under the part of the sky it sees.

The light is computed once from a height map of the city, and looked up per point.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from .primitives import MATERIALS, Material

SUN = np.array([-0.52, -0.62, 0.80]) / np.linalg.norm([-0.52, -0.62, 0.80])
"""Unit vector towards the sun, in the south-west."""

_SUNLIGHT = np.array([0.84, 0.76, 0.63], np.float32)
_SKYLIGHT = np.array([0.44, 0.49, 0.58], np.float32)
_BOUNCE = np.array([0.12, 0.11, 0.10], np.float32)
_SMALLEST_CELL_M = 0.4
_MOST_CELLS = 2048
_SKY_RADIUS_M = 7.0
_CANYON_M = 14.0
_TEXTURE = 256


class Light:
    """Shadows and openness of the sky over a city.

    survey : chunks of (3, n) float64 positions, together dense enough to hit every cell of 0.4 m.
    edge_m : the city's side, from 0.
    Cost: memory of a few maps of at most 2048² cells.
    """

    def __init__(self, survey: Iterable[np.ndarray], edge_m: float, seed: int) -> None:
        self.cell_m = max(_SMALLEST_CELL_M, edge_m / _MOST_CELLS)
        self._n = int(np.ceil(edge_m / self.cell_m))
        top = np.full(self._n * self._n, -1.0, np.float32)
        for x, y, z in survey:
            np.maximum.at(top, self._cells(x, y), z.astype(np.float32))
        top = top.reshape(self._n, self._n)
        self._shadow = _shadow_tops(top, self.cell_m).ravel()
        self._skyline = _blurred(top, max(1, round(_SKY_RADIUS_M / self.cell_m))).ravel()
        self._texture = _noise_texture(np.random.default_rng([seed, 1])).ravel()

    def _cells(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(n,) int32: cell of the map under each place, row by row."""
        i, j = ((v / self.cell_m).clip(0, self._n - 1).astype(np.int32) for v in (x, y))
        return j * self._n + i

    def colour(
        self,
        rng: np.random.Generator,
        positions: np.ndarray,
        normals: np.ndarray,
        material: np.ndarray,
        base: np.ndarray,
    ) -> np.ndarray:
        """(3, n) uint8 RGB of points with (3, n) base colours in [0, 1]; ``rng`` gives the grain.

        positions, normals : (3, n) float32, city frame.  material : (n,) uint8.
        """
        x, y, z = positions
        # A step off the surface keeps a wall from standing in its own shadow; the dither softens the map's edges.
        dither = (rng.random((2, len(z)), np.float32) - 0.5) * np.float32(1.5 * self.cell_m)
        step = np.float32(1.3 * self.cell_m)
        cell = self._cells(x + step * normals[0] + dither[0], y + step * normals[1] + dither[1])
        lit = ((z + step * normals[2] + 0.25 - self._shadow[cell]) * 2).clip(0, 1)
        toward = SUN.astype(np.float32)
        facing = toward[0] * normals[0] + toward[1] * normals[1] + toward[2] * normals[2]
        facing = (facing + _TRANSLUCENCY[material] * (1 - facing)).clip(0)
        below = ((self._skyline[cell] - z) / _CANYON_M).clip(0, 1)
        sun = lit * facing
        sky = (0.62 + 0.38 * normals[2]) * (1 - 0.62 * below)
        bounce = 1 - 0.5 * below
        grain = rng.standard_normal(len(z), np.float32)
        variation = 255 * (1 + _PATCHES[material] * self._patches(positions) + _GRAIN[material] * grain)
        out = np.empty((3, len(z)), np.uint8)
        for channel, value in enumerate(base):
            light = _SUNLIGHT[channel] * sun + _SKYLIGHT[channel] * sky + _BOUNCE[channel] * bounce
            out[channel] = (value * light * variation).clip(0, 255)
        return out

    def _patches(self, positions: np.ndarray) -> np.ndarray:
        """Smooth noise in [−1, 1] over about a metre, the same for any batch."""
        x, y, z = positions
        i = ((x + np.float32(0.37) * z) * 3).astype(np.int32) & (_TEXTURE - 1)
        j = ((y + np.float32(0.73) * z) * 3).astype(np.int32) & (_TEXTURE - 1)
        return self._texture[j * _TEXTURE + i]


_TRANSLUCENCY = np.array([0.45 if m == Material.LEAVES else 0.0 for m in Material], np.float32)
_GRAIN = np.array([MATERIALS[m].grain for m in Material], np.float32)
_PATCHES = np.array([MATERIALS[m].patches for m in Material], np.float32)


def _shadow_tops(top: np.ndarray, cell_m: float) -> np.ndarray:
    """(n, n) float32: the height below which a point is in shadow of the height map ``top``."""
    n = len(top)
    horizontal = float(np.hypot(SUN[0], SUN[1]))
    reach_m = float(np.ptp(top)) * horizontal / SUN[2]
    out = np.full_like(top, -np.inf)
    for distance in np.arange(2 * cell_m, min(reach_m, n * cell_m), cell_m):
        dx, dy = (round(SUN[k] / horizontal * distance / cell_m) for k in (0, 1))
        there = top[max(dy, 0) : n + min(dy, 0), max(dx, 0) : n + min(dx, 0)]
        here = out[max(-dy, 0) : n + min(-dy, 0), max(-dx, 0) : n + min(-dx, 0)]
        np.maximum(here, there - np.float32(distance * SUN[2] / horizontal), out=here)
    return out


def _blurred(image: np.ndarray, radius: int) -> np.ndarray:
    """Mean over (2 radius + 1)² cells, edges repeated."""
    for axis in (0, 1):
        padded = np.pad(image, [(radius + 1, radius) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        total = np.cumsum(padded, axis=axis, dtype=np.float64)
        width = 2 * radius + 1
        image = (
            np.take(total, range(width, total.shape[axis]), axis)
            - np.take(total, range(total.shape[axis] - width), axis)
        ) / width
    return image.astype(np.float32)


def _noise_texture(rng: np.random.Generator) -> np.ndarray:
    """(256, 256) float32 tileable smooth noise with a span of ±1."""
    frequency = np.fft.fftfreq(_TEXTURE) * _TEXTURE
    radius = np.hypot(*np.meshgrid(frequency, frequency))
    spectrum = np.fft.fft2(rng.standard_normal((_TEXTURE, _TEXTURE))) * np.exp(-((radius / 40) ** 2)) / (1 + radius / 8)
    noise = np.fft.ifft2(spectrum).real
    return (noise / np.abs(noise).max()).astype(np.float32)
