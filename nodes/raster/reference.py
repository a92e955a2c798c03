"""The reference rasterizer: short, NumPy, one array operation a step.

``project`` goes through world coordinates in float64. ``project_float32`` rounds as the fast rasterizers do, so that
frames drawn with it equal theirs word by word.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...shared.camera import Camera
from ...shared.messages import FRAMEBUFFER_EMPTY
from . import PointSize, ResidentPoints, pixel_from_blocks

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
    m = pixel_from_blocks(camera, points.block_origin)[block]
    x, y, z = points.x[index], points.y[index], points.z[index]
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
        if size.world:
            side = np.clip(number(size.world * camera.focal_px) / w, size.pixels, max(size.pixels, size.maximum))
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
