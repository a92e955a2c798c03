"""Blocks of the point-array and the frustum that they are held against, as the compiled kernels take them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...shared.camera import Camera

BITS = 20
"""Bits an axis of positions in fixed point, half of them in each word."""

FLOAT32, HIGH, FULL, OUTSIDE = 0, 1, 2, 3
"""How the positions of a block are read: three float32, 10 bits an axis, 20 bits an axis; or not at all."""

HIGH_BITS_ERROR_PX = 1 / 16
"""A point moves by less than this along each image axis where its low bits are not read; on a surface the mean is a
quarter of it. Drawing a point as a whole pixel moves it by up to 1/2; but where points are about as dense as pixels,
1/8 already shows as other holes than before (``RESULTS.md``), and 1/32 would read the low bits of most cells."""


class Blocks(NamedTuple):
    """Blocks of the point-array.

    origin : (b, 3) float64, world frame.  world_side : (b,) float64, side of a point's square, world units.
    lower, step : (b, 3) float64 as of ``compact.CompactPositions``; (0, 3) if positions are float32.
    """

    origin: np.ndarray
    world_side: np.ndarray
    lower: np.ndarray
    step: np.ndarray


class Frustum(NamedTuple):
    """What blocks are held against in a frame; float64.

    eye : (3,) world frame.  rows : (3, 3): X, Y and W over positions relative to the eye.  near, focal_px : as of the
    camera.
    planes : (5, 3) over positions relative to the eye: depth, and four that are ≥ 0 within the image and its margin.
    high_bits_error_px : ``HIGH_BITS_ERROR_PX``.
    px_at_one : (2, 3), at most so many pixels a point at depth 1 in the image moves for each world unit it is moved.
    """

    eye: np.ndarray
    rows: np.ndarray
    near: float
    focal_px: float
    planes: np.ndarray
    high_bits_error_px: float
    px_at_one: np.ndarray


def frustum(camera: Camera, margin_px: float) -> Frustum:
    """The frustum of a camera; points up to ``margin_px`` from the image count as inside."""
    rows = np.ascontiguousarray(camera.pixel_from_world[:, :3], np.float64)
    x, y, w = rows
    half_width, half_height = camera.width / 2, camera.height / 2
    planes = [w, x, 2 * half_width * w - x, y, 2 * half_height * w - y]
    planes = np.array(planes) + np.outer([0, 1, 1, 1, 1], margin_px * w)
    # u − width / 2 = X' / w, so that |du| = |dX' − (u − width / 2) dw| / w
    px_at_one = np.abs([x - half_width * w, y - half_height * w]) + np.outer([half_width, half_height], np.abs(w))
    eye = np.array(camera.eye, np.float64)
    return Frustum(eye, rows, float(camera.near), float(camera.focal_px), planes, HIGH_BITS_ERROR_PX, px_at_one)
