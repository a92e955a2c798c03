"""Depths of a frame, and normals from the depths around a pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numba import njit

from ...shared.camera import Camera
from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.windows import Window
from .rows import Rows

LONGEST_RUN_PX = 64
"""Pixels of the same depth, to one side, that are taken for one point's."""


@dataclass(frozen=True)
class Rays:
    """Where depth 1 is, in camera space (x right, y up, looking along −z), for each pixel of a picture.

    The pixel in row r and column c sees (x[c] · level[r], y[r], z[c] · level[r]); all float64.
    """

    x: np.ndarray
    z: np.ndarray
    y: np.ndarray
    level: np.ndarray

    @classmethod
    def of_camera(cls, camera: Camera, supersampling: int) -> Rays:
        """Of a picture with a ``supersampling``-th of the camera's width and height; depth along the view axis."""
        fx, fy, cx, cy = camera.pinhole_px
        columns = (np.arange(camera.width // supersampling) + 0.5) * supersampling
        rows = (np.arange(camera.height // supersampling) + 0.5) * supersampling
        return cls((columns - cx) / fx, np.full(len(columns), -1.0), (cy - rows) / fy, np.ones(len(rows)))

    def within(self, window: Window) -> Rays:
        """Those of a window of the picture."""
        x0, y0, x1, y1 = window
        return Rays(self.x[x0:x1], self.z[x0:x1], self.y[y0:y1], self.level[y0:y1])

    @classmethod
    def of_panorama(cls, width: int, height: int) -> Rays:
        """Of an equirectangular picture; depth is the distance from the eye."""
        longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * math.pi
        latitude = (0.5 - (np.arange(height) + 0.5) / height) * math.pi
        return cls(np.sin(longitude), -np.cos(longitude), np.sin(latitude), np.cos(latitude))


def depths(words: np.ndarray, supersampling: int) -> np.ndarray:
    """(h, w) float32 nearest depths of each s × s of (h · s, w · s) uint64 words, s = ``supersampling``; 0: none."""
    s = supersampling
    nearest = words if s == 1 else reduce(np.minimum, [words[y::s, x::s] for y in range(s) for x in range(s)])
    depth = (nearest >> np.uint64(32)).astype(np.uint32).view(np.float32)
    depth[nearest == FRAMEBUFFER_EMPTY] = 0.0
    return depth


def normals(depth: np.ndarray, rays: Rays, rows: Rows) -> np.ndarray:
    """(h, w, 4) uint8: (n + 1) / 2 of the normal in camera space, and alpha 255; zeros where nothing is.

    depth : (h, w) float32, 0 for none.
    Neighbouring pixels of equal depth are one point's; its place is their middle. Along each axis the tangent leads to
    the point beside it with the smaller step in depth, so that an edge is not smoothed over. The normal is their cross
    product, towards the eye. A point without a neighbour on some axis is taken to go on at its depth.
    Cost: one pass, in proportion to the size of points.
    """
    out = np.zeros((*depth.shape, 4), np.uint8)
    rows.run(len(depth), _normal_rows, depth, rays.x, rays.z, rays.y, rays.level, out)
    return out


@njit(nogil=True, cache=True)
def _normal_rows(depth, x, z, y, level, out, first, end):
    for row in range(first, end):
        for column in range(depth.shape[1]):
            if depth[row, column] == 0.0:
                continue
            ax, ay, az = _tangent(depth, x, z, y, level, row, column, 0, 1)
            bx, by, bz = _tangent(depth, x, z, y, level, row, column, 1, 0)
            nx, ny, nz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length == 0.0:
                continue
            towards = nx * x[column] * level[row] + ny * y[row] + nz * z[column] * level[row]
            if towards > 0.0:
                length = -length
            out[row, column, 0] = np.int64((nx / length + 1.0) * 127.5 + 0.5)
            out[row, column, 1] = np.int64((ny / length + 1.0) * 127.5 + 0.5)
            out[row, column, 2] = np.int64((nz / length + 1.0) * 127.5 + 0.5)
            out[row, column, 3] = 255


@njit(nogil=True, cache=True)
def _tangent(depth, x, z, y, level, row, column, down, right):
    """(x, y, z) from the point of a pixel towards that beside it, to the right or down."""
    here = np.float64(depth[row, column])
    before = _run(depth, row, column, -down, -right)
    after = _run(depth, row, column, down, right)
    best, step, place = np.inf, 0.0, 0.0
    for way in (1, -1):
        to_edge = (after if way == 1 else before) + 1
        r, c = row + way * to_edge * down, column + way * to_edge * right
        if 0 <= r < depth.shape[0] and 0 <= c < depth.shape[1] and depth[r, c] > 0.0:
            there = np.float64(depth[r, c])
            if abs(there - here) < best:
                best = abs(there - here)
                step = there
                place = way * (to_edge + 0.5 * _run(depth, r, c, way * down, way * right))
    middle = 0.5 * (after - before)
    if best == np.inf:  # between two pixels of the line, at the depth of this one
        last = len(y) - 1 if down else len(x) - 1
        middle = -1.0 if row * down + column * right == last else 0.0
        place = middle + (1.0 if last > 0 else 0.0)
        step = here
    px, py, pz = _seen(x, z, y, level, row + middle * down, column + middle * right)
    qx, qy, qz = _seen(x, z, y, level, row + place * down, column + place * right)
    sign = 1.0 if place > middle else -1.0
    return sign * (qx * step - px * here), sign * (qy * step - py * here), sign * (qz * step - pz * here)


@njit(nogil=True, cache=True)
def _run(depth, row, column, down, right):
    """Pixels beyond this one, in a direction, that have the same depth."""
    here = depth[row, column]
    n = 0
    while n < LONGEST_RUN_PX:
        r, c = row + (n + 1) * down, column + (n + 1) * right
        if not (0 <= r < depth.shape[0] and 0 <= c < depth.shape[1]) or depth[r, c] != here:
            break
        n += 1
    return n


@njit(nogil=True, cache=True)
def _seen(x, z, y, level, row, column):
    """Where depth 1 is at a place between pixels."""
    r, c = np.int64(row), np.int64(column)
    down, right = row - r, column - c
    r1, c1 = min(r + 1, len(y) - 1), min(c + 1, len(x) - 1)
    flat = level[r] + (level[r1] - level[r]) * down
    return (
        (x[c] + (x[c1] - x[c]) * right) * flat,
        y[r] + (y[r1] - y[r]) * down,
        (z[c] + (z[c1] - z[c]) * right) * flat,
    )
