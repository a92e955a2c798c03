"""Short NumPy twins of the kernels, in float64; slow, and what the kernels are held against."""

from __future__ import annotations

from itertools import groupby

import numpy as np

from ...shared.messages import FRAMEBUFFER_EMPTY
from .colour import to_linear, to_stored
from .edl import POTREE_SCALE, neighbours
from .surface import Rays

_FAR = np.finfo(np.float64).max


def reference_shades(words: np.ndarray, strength: float, radius_px: float, *, wrap: bool) -> np.ndarray:
    """(h, w) float64 shades of eye-dome lighting, as ``edl`` defines them."""
    depth = (words >> np.uint64(32)).astype(np.uint32).view(np.float32).astype(np.float64)
    depth[words == FRAMEBUFFER_EMPTY] = _FAR
    offsets = neighbours(radius_px)
    reach = int(np.abs(offsets).max())
    around = np.pad(depth, reach, constant_values=_FAR)
    if wrap:
        around[reach:-reach] = np.pad(depth, ((0, 0), (reach, reach)), mode="wrap")
    response = np.zeros_like(depth)
    for down, right in offsets + reach:
        near = around[down : down + depth.shape[0], right : right + depth.shape[1]]
        response += np.log2(depth / np.minimum(near, depth)) / len(offsets)
    response[words == FRAMEBUFFER_EMPTY] = 0.0
    return np.exp(-POTREE_SCALE * strength * response)


def reference_colours(
    words: np.ndarray, shades: np.ndarray, background: np.ndarray, supersampling: int, bits: int
) -> np.ndarray:
    """(h, w, 4) integers of ``colour.colours``, before they are rounded: float64."""
    s = supersampling
    empty = words == FRAMEBUFFER_EMPTY
    rgba = np.stack([(words >> np.uint64(8 * k) & np.uint64(255)) / 255 for k in range(4)], axis=-1)
    rgba[..., :3] *= shades[..., None]
    rgba[empty] = background / 255
    alpha = rgba[..., 3:]
    light = to_linear(rgba[..., :3]) if s > 1 else rgba[..., :3]
    blocks = np.concatenate([light * alpha, alpha], axis=-1)
    height, width = words.shape[0] // s, words.shape[1] // s
    mean = blocks.reshape(height, s, width, s, 4).mean(axis=(1, 3))
    mean[..., :3] /= np.where(mean[..., 3:] > 0, mean[..., 3:], 1.0)
    if s > 1:
        mean[..., :3] = to_stored(mean[..., :3])
    return mean * (2**bits - 1)


def reference_normals(depth: np.ndarray, rays: Rays) -> np.ndarray:
    """(h, w, 3) float64 unit normals of ``surface.normals``, NaN where nothing is; runs of any length."""
    height, width = depth.shape
    index = np.arange(width), np.arange(height)

    def point(row: float, column: float, d: float) -> np.ndarray:
        level = np.interp(row, index[1], rays.level)
        x, z = np.interp(column, index[0], rays.x), np.interp(column, index[0], rays.z)
        return d * np.array([x * level, np.interp(row, index[1], rays.y), z * level])

    along_rows, along_columns = np.full((2, height, width, 3), np.nan)
    for row in range(height):
        along_rows[row] = _tangents(depth[row], lambda at, d, row=row: point(row, at, d))
    for column in range(width):
        along_columns[:, column] = _tangents(depth[:, column], lambda at, d, column=column: point(at, column, d))
    normal = np.cross(along_columns, along_rows)
    seen = np.array([[point(row, column, 1.0) for column in range(width)] for row in range(height)])
    normal *= -np.sign((normal * seen).sum(axis=-1, keepdims=True))
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _tangents(line: np.ndarray, point) -> np.ndarray:
    """(n, 3) tangents along a line of pixels, in its direction; NaN where there is none."""
    runs, start = [], 0
    for d, pixels in groupby(line.tolist()):
        n = len(list(pixels))
        runs.append((start, start + n, d))
        start += n
    places = [point((first + end - 1) / 2, d) for first, end, d in runs]
    out = np.full((len(line), 3), np.nan)
    for i, (first, end, d) in enumerate(runs):
        beside = [j for j in (i + 1, i - 1) if 0 <= j < len(runs) and runs[j][2] > 0]
        if d > 0 and beside:
            j = min(beside, key=lambda j: abs(runs[j][2] - d))
            out[first:end] = (places[j] - places[i]) * (j - i)
        elif d > 0:
            for at in range(first, end):
                start = min(at, len(line) - 2)
                out[at] = point(start + 1, d) - point(start, d)
    return out
