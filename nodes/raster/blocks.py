"""Compiled: what a frame needs of a block, worked out by the thread that draws it, in float64 and rounded once.

It costs about 0.1 µs a piece, so no pass over the blocks stands before a frame and nothing is kept between frames.
``pixel_from_blocks`` and ``reference.compact_rows`` are the readable twins: the same steps in the same order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ...shared.camera import Camera

BITS = 20
"""Bits an axis of positions in fixed point, half of them in each word."""

FLOAT32, HIGH, FULL, OUTSIDE = 0, 1, 2, 3
"""How the positions of a block are read: three float32, 10 bits an axis, 20 bits an axis; or not at all."""

HIGH_BITS_ERROR_PX = 1 / 8
"""A point moves by less than this along each image axis where its low bits are not read: a quarter of what drawing it
as a whole pixel moves it by. That is the bound; on a surface the mean is a quarter of it (``RESULTS.md``)."""

_ROUNDING = 2.0**-20
"""Relative to the sum of the terms' sizes, more than what float32 rounds in a row of a matrix times a position."""


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
    px_at_one : (2, 3), at most so many pixels a point at depth 1 in the image moves for each world unit it is moved.
    """

    eye: np.ndarray
    rows: np.ndarray
    near: float
    focal_px: float
    planes: np.ndarray
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
    return Frustum(eye, rows, float(camera.near), float(camera.focal_px), planes, px_at_one)


@njit(nogil=True, cache=True, error_model="numpy")
def block_rows(blocks, s, frustum, out):
    """Fill ``out`` (3, 4) float32: rows X, Y, W over the positions of block ``s``; return how those are read.

    The eye is subtracted first, so a scene far from the world's origin loses nothing.
    """
    m = frustum.rows
    x, y, z = (
        blocks.origin[s, 0] - frustum.eye[0],
        blocks.origin[s, 1] - frustum.eye[1],
        blocks.origin[s, 2] - frustum.eye[2],
    )
    if len(blocks.step) == 0:
        for i in range(3):
            out[i, 0], out[i, 1], out[i, 2] = m[i, 0], m[i, 1], m[i, 2]
            out[i, 3] = x * m[i, 0] + y * m[i, 1] + z * m[i, 2]
        return FLOAT32

    x, y, z = x + blocks.lower[s, 0], y + blocks.lower[s, 1], z + blocks.lower[s, 2]
    a, b, c = blocks.step[s, 0], blocks.step[s, 1], blocks.step[s, 2]
    nearest, precision = _nearest(x, y, z, a, b, c, frustum), HIGH
    if nearest < 0:
        return OUTSIDE
    for i in range(2):
        p = frustum.px_at_one[i]
        if not 2.0 ** (BITS // 2 - 1) * (p[0] * a + p[1] * b + p[2] * c) <= HIGH_BITS_ERROR_PX * nearest:
            precision = FULL
    if precision == HIGH:
        a, b, c = a * 2.0 ** (BITS // 2), b * 2.0 ** (BITS // 2), c * 2.0 ** (BITS // 2)
    x, y, z = x + 0.5 * a, y + 0.5 * b, z + 0.5 * c
    for i in range(3):
        out[i, 0], out[i, 1], out[i, 2] = m[i, 0] * a, m[i, 1] * b, m[i, 2] * c
        out[i, 3] = x * m[i, 0] + y * m[i, 1] + z * m[i, 2]
    return precision


@njit(nogil=True, cache=True, error_model="numpy")
def _nearest(x, y, z, a, b, c, frustum):
    """Depth of the nearest point that a box can have in the image; −1 if it can have none there, rounding considered.

    x, y, z : lower corner relative to the eye.  a, b, c : size of a bin.
    """
    a, b, c = a * 2.0 ** (BITS - 1), b * 2.0 ** (BITS - 1), c * 2.0 ** (BITS - 1)
    x, y, z = x + a, y + b, z + c  # middle of the box, and half its size
    nearest = 0.0
    for i in range(5):
        p = frustum.planes[i]
        middle = p[0] * x + p[1] * y + p[2] * z
        reach = abs(p[0]) * a + abs(p[1]) * b + abs(p[2]) * c
        slack = _ROUNDING * (abs(p[0] * x) + abs(p[1] * y) + abs(p[2] * z) + reach)
        if middle + reach + slack < (frustum.near if i == 0 else 0.0):
            return -1.0
        if i == 0:
            nearest = max(middle - reach - slack, frustum.near)
    return nearest
