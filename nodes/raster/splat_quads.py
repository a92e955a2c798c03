"""Compiled kernel of the ``cpu`` splat rasterizer: flat cells → quads on the screen (thesis 4.4.3).

1 / depth of a plane is affine in the pixel, and so are the coordinates in the rectangle over the depth. Everything is
float64, for the centre of a quad may lie anywhere, behind the eye too.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .atomic import fetch_add

QUAD = np.dtype([(name, "<f8") for name in ("z0", "zx", "zy", "a0", "ax", "ay", "b0", "bx", "by")])
"""At the pixel centre (x, y) the plane has the inverse depth z = z0 + zx · x + zy · y; the rectangle covers it if
|a0 + ax · x + ay · y| ≤ z and likewise for b."""


@njit(nogil=True, cache=True, error_model="numpy")
def project_quads(center, axes, drawn, chunks, eye, rotation, pinhole, view, out, totals, counter):
    """Project chunks of quads until none is left.

    center : (f, 3) float64, world.  axes : (f, 2, 3) float32, half axes.  drawn : (f,) bool.
    chunks : (c + 1, 2) int64; the second column is the first quad of each chunk and its first place in ``out``.
    eye : (3,) float64, world.  rotation : (3, 3) float64, eye from world directions.
    pinhole : focal x, y, centre x, y in pixels.  view : near, width, height.
    out : (f,) QUAD and (f,) BOUNDS.  totals : (c, 2) int64, the first column: quads written.
    counter : (1,) int64, shared by the threads of a frame, 0 at its start.
    """
    quads, bounds = out
    p, a, b = np.empty(3), np.empty(3), np.empty(3)
    chunk = fetch_add(counter, 1)
    while chunk < len(totals):
        place = chunks[chunk, 1]
        for i in range(chunks[chunk, 1], chunks[chunk + 1, 1]):
            if not drawn[i]:
                continue
            for k in range(3):
                r0, r1, r2 = rotation[k, 0], rotation[k, 1], rotation[k, 2]
                p[k] = r0 * (center[i, 0] - eye[0]) + r1 * (center[i, 1] - eye[1]) + r2 * (center[i, 2] - eye[2])
                a[k] = r0 * axes[i, 0, 0] + r1 * axes[i, 0, 1] + r2 * axes[i, 0, 2]
                b[k] = r0 * axes[i, 1, 0] + r1 * axes[i, 1, 1] + r2 * axes[i, 1, 2]
            left, right, top, bottom = _corners(p, a, b, pinhole, view)
            if left < right and top < bottom:
                s = bounds[place]
                s.left, s.right, s.top, s.bottom = left, right, top, bottom
                _plane(p, a, b, pinhole, quads[place])
                place += 1
        totals[chunk, 0] = place - chunks[chunk, 1]
        chunk = fetch_add(counter, 1)


@njit(nogil=True, cache=True, error_model="numpy")
def _corners(p, a, b, pinhole, view):
    """Columns left … right − 1 and rows top … bottom − 1 between the corners; the image if one is nearer than near."""
    fx, fy, cx, cy = pinhole
    near, width, height = view
    left, right, top, bottom = width, 0.0, height, 0.0
    behind = 0
    for corner in range(4):
        sa, sb = (1.0 if corner & 1 else -1.0), (1.0 if corner & 2 else -1.0)
        x, y, w = p[0] + sa * a[0] + sb * b[0], p[1] + sa * a[1] + sb * b[1], p[2] + sa * a[2] + sb * b[2]
        behind += w < near
        u, v = fx * x / w + cx, fy * y / w + cy
        left, right = min(left, u), max(right, u)
        top, bottom = min(top, v), max(bottom, v)
    if behind == 4:
        return 0, 0, 0, 0
    if behind:
        return 0, np.int64(width), 0, np.int64(height)
    left, right = np.ceil(max(left - 0.5, 0.0)), np.floor(min(right + 0.5, width))
    top, bottom = np.ceil(max(top - 0.5, 0.0)), np.floor(min(bottom + 0.5, height))
    return np.int64(left), np.int64(max(right, left)), np.int64(top), np.int64(max(bottom, top))


@njit(nogil=True, cache=True, error_model="numpy")
def _plane(p, a, b, pinhole, quad):
    """Fill a QUAD."""
    fx, fy, cx, cy = pinhole
    nx, ny, nw = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    inverse = 1.0 / (nx * p[0] + ny * p[1] + nw * p[2])
    quad.zx, quad.zy = nx / fx * inverse, ny / fy * inverse
    quad.z0 = (nw - nx * cx / fx - ny * cy / fy) * inverse
    quad.a0, quad.ax, quad.ay = _axis(p, a, pinhole, quad)
    quad.b0, quad.bx, quad.by = _axis(p, b, pinhole, quad)


@njit(nogil=True, cache=True, error_model="numpy")
def _axis(p, a, pinhole, quad):
    """Coefficients of the coordinate along a half axis, over the depth."""
    fx, fy, cx, cy = pinhole
    scale = 1.0 / (a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    along = (p[0] * a[0] + p[1] * a[1] + p[2] * a[2]) * scale
    ax, ay = a[0] / fx * scale, a[1] / fy * scale
    constant = a[2] * scale - ax * cx - ay * cy
    return constant - along * quad.z0, ax - along * quad.zx, ay - along * quad.zy
