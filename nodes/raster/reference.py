"""The reference rasterizer: short, NumPy, one array operation a step.

``project`` goes through world coordinates in float64. ``project_float32`` rounds as the fast rasterizers do, so that
frames drawn with it equal theirs word by word; ``project_compact`` does so for positions in fixed point.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ...shared.camera import Camera
from ...shared.messages import FRAMEBUFFER_EMPTY
from . import PointSize, ResidentPoints, pixel_from_blocks
from .blocks import FULL, HIGH, HIGH_BITS_ERROR_PX

if TYPE_CHECKING:
    from .compact import CompactPositions

Projection = Callable[[ResidentPoints, Camera, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""(points, camera, (n,) point indices) → (n,) image positions u, v in pixels and depths w."""


_BATCH_POINTS = 1 << 20


def point_indices(entries: np.ndarray) -> np.ndarray:
    """(n,) int64: the points that (m,) RENDER_POINT entries draw, in their order."""
    runs = [np.arange(first, first + length, stride) for first, length, stride in entries.tolist()]
    return np.concatenate([np.empty(0, np.int64), *runs])


def project(points: ResidentPoints, camera: Camera, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u, v, w in float64. Points with w = 0 have no finite u, v."""
    block = np.searchsorted(points.block_first_point, index, side="right") - 1
    relative = np.column_stack([c[index] for c in (points.x, points.y, points.z)])
    world = points.block_origin[block] + relative.astype(np.float64)
    m = camera.pixel_from_world
    u, v, w = (world @ m[:, :3].T + m[:, 3]).T
    with np.errstate(all="ignore"):
        return u / w, v / w, w


def project_float32(
    points: ResidentPoints, camera: Camera, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u, v, w in float32, each operation rounded as in the compiled kernels."""
    block = np.searchsorted(points.block_first_point, index, side="right") - 1
    rows = pixel_from_blocks(camera, points.block_origin)[block]
    return _project_rows(rows, points.x[index], points.y[index], points.z[index])


def fixed_point_bins(points: ResidentPoints, bits: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions as bins of their block's bounding box, 2**bits an axis. Every block holds points; those whose x is NaN
    do not count, and have bin 0.

    Returns (n, 3) int64 bins, (b, 3) float64 lower corners relative to the block's origin, (b, 3) float64 bin sizes.
    """
    relative = np.column_stack([points.x, points.y, points.z]).astype(np.float64)
    filtered = np.isnan(points.x)
    relative[filtered] = np.nan
    lower = np.nan_to_num(np.fmin.reduceat(relative, points.block_first_point))
    step = (np.nan_to_num(np.fmax.reduceat(relative, points.block_first_point)) - lower) / 2**bits
    block = np.searchsorted(points.block_first_point, np.arange(len(points)), side="right") - 1
    unit = np.where(step > 0, step, 1)
    bins = np.floor(np.where(filtered[:, None], 0, relative - lower[block]) / unit[block]).astype(np.int64)
    return np.minimum(bins, 2**bits - 1), lower, step


def unpack_bins(high: np.ndarray, low: np.ndarray) -> np.ndarray:
    """(n, 3) int64 bins of 20 bits from their two words of three times 10 bits; see ``compact``."""
    shift = np.array([0, 10, 20])
    halves = [(word.astype(np.int64)[:, None] >> shift) & 1023 for word in (high, low)]
    return halves[0] << 10 | halves[1]


def compact_rows(block_origin: np.ndarray, compact: CompactPositions, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(b, 3, 4) float32 rows X, Y, W over bins and (b,) precision, HIGH or FULL, of blocks in the image."""
    x, y, w = m = camera.pixel_from_world[:, :3]
    lower, step = block_origin - camera.eye + compact.lower, compact.step
    middle, half = lower + 2**19 * step, 2**19 * step
    reach = half @ np.abs(w)
    nearest = np.maximum(middle @ w - reach - 2.0**-20 * (np.abs(middle) @ np.abs(w) + reach), camera.near)
    px_at_one = [
        np.abs(row - size / 2 * w) + size / 2 * np.abs(w) for row, size in ((x, camera.width), (y, camera.height))
    ]
    moved_px = 512 * step @ np.transpose(px_at_one) / nearest[:, None]
    precision = np.where((moved_px <= HIGH_BITS_ERROR_PX).all(axis=1), HIGH, FULL)

    size = step * np.where(precision == HIGH, 1024.0, 1.0)[:, None]
    corner = lower + 0.5 * size
    rows = np.empty((len(step), 3, 4))
    rows[:, :, :3] = m * size[:, None, :]
    rows[:, :, 3] = corner[:, :1] * m[:, 0] + corner[:, 1:2] * m[:, 1] + corner[:, 2:] * m[:, 2]
    with np.errstate(over="ignore"):
        return rows.astype(np.float32), precision


def project_compact(compact: CompactPositions) -> Projection:
    """The projection of positions in fixed point, each operation rounded as in the compiled kernels."""

    def project(points: ResidentPoints, camera: Camera, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        block = np.searchsorted(points.block_first_point, index, side="right") - 1
        rows, precision = compact_rows(points.block_origin, compact, camera)
        bins = unpack_bins(compact.high[index], compact.low[index])
        bins = np.where(precision[block, None] == HIGH, bins >> 10, bins)
        return _project_rows(rows[block], *bins.astype(np.float32).T)

    return project


def _project_rows(m: np.ndarray, *position: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u, v, w of (n, 3, 4) float32 rows and n positions, in float32."""
    x, y, z = position
    with np.errstate(all="ignore"):
        u, v, w = (m[:, i, 0] * x + m[:, i, 1] * y + m[:, i, 2] * z + m[:, i, 3] for i in range(3))
        return u / w, v / w, w


def squares(
    points: ResidentPoints, camera: Camera, index: np.ndarray, size: PointSize, projection: Projection = project
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The squares of those of the (n,) points that reach into the image.

    Returns (m,) int64 first row, first column and side in pixels, (m,) depth, (m,) index of the point.
    """
    u, v, w = projection(points, camera, index)
    number = w.dtype.type
    with np.errstate(all="ignore"):
        side = np.full_like(w, size.pixels)
        if size.world or size.adaptive:
            world = np.float64(size.world)
            if size.adaptive:
                block = np.searchsorted(points.block_first_point, index, side="right") - 1
                world = np.maximum(np.asarray(points.block_spacing, np.float64), world)[block]
            at_one = (world * camera.focal_px).astype(number)
            side = np.clip(at_one / w, size.pixels, max(size.pixels, size.maximum))
            side = np.floor(side + number(0.5))
        first_column, first_row = (np.floor(p - number(0.5) * (side - number(1))) for p in (u, v))
        visible = (w >= number(camera.near)) & (w <= np.finfo(np.float32).max)
        visible &= (first_column < camera.width) & (first_column > -side)
        visible &= (first_row < camera.height) & (first_row > -side)
    first_row, first_column, side = (a[visible].astype(np.int64) for a in (first_row, first_column, side))
    return first_row, first_column, side, w[visible], index[visible]


def covered_pixels(points: ResidentPoints, camera: Camera, entries: np.ndarray, size: PointSize) -> int:
    """Pixels that the points of (m,) RENDER_POINT entries cover, hidden ones included: D_FP of thesis Table 3-1."""
    total = 0
    index = point_indices(entries)
    for begin in range(0, len(index), _BATCH_POINTS):
        row, column, side, _, _ = squares(points, camera, index[begin : begin + _BATCH_POINTS], size)
        rows = np.minimum(row + side, camera.height) - np.maximum(row, 0)
        columns = np.minimum(column + side, camera.width) - np.maximum(column, 0)
        total += int((rows * columns).sum())
    return total


def reference_frame(
    points: ResidentPoints,
    camera: Camera,
    entries: np.ndarray,
    size: PointSize = PointSize(),  # noqa: B008 (frozen)
    projection: Projection = project,
) -> np.ndarray:
    """(height, width) uint64 framebuffer words. Arguments as in ``Rasterizer``; entries are not checked."""
    first_row, first_column, side, w, index = squares(points, camera, point_indices(entries), size, projection)
    depth_bits = w.astype(np.float32).view(np.uint32).astype(np.uint64)
    word = depth_bits << np.uint64(32) | points.colour[index]

    frame = np.full((camera.height, camera.width), FRAMEBUFFER_EMPTY)
    for dy, dx in np.ndindex(side.max(initial=0), side.max(initial=0)):
        row, column = first_row + dy, first_column + dx
        covered = (dy < side) & (dx < side)
        covered &= (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
        np.minimum.at(frame, (row[covered], column[covered]), word[covered])
    return frame
