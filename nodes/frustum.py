"""The frustum of a camera, or of a window of its picture, and the cubes of cells that are held against it."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..shared.camera import Camera
from ..shared.octree import MAX_LEVEL, Octree
from ..shared.windows import Window

N_PLANES = 5


def padded_half_edges(octree: Octree) -> np.ndarray:
    """(MAX_LEVEL + 1,) float64 half edge of the cubes of each level, grown to hold what rounding moves out of them.

    Stored float32 positions may lie outside their cell by a rounding of the root edge, centres and world coordinates by
    one of the largest coordinate; and the rasterizer rounds depth.
    """
    half = np.ldexp(octree.edge, -np.arange(MAX_LEVEL + 1) - 1)
    largest = np.abs(octree.origin).max() + octree.edge
    return half * (1 + 2.0**-20) + octree.edge * 2.0**-22 + 4 * np.spacing(largest)


def frustum_planes(camera: Camera, margin_px: float, window: Window | None = None) -> np.ndarray:
    """(5, 4) float64 half-spaces ``row[:3] · (p − eye) ≥ row[3]``: left, right, top, bottom, near.

    window : of the picture that is seen through; None: all of it.
    There is no far plane. Relative to the eye, so that a scene far from the world's origin loses nothing.
    """
    x, y, w = camera.pixel_from_world[:, :3]
    x0, y0, x1, y1 = window or (0, 0, camera.width, camera.height)
    planes = np.zeros((N_PLANES, 4))
    planes[0, :3] = x + (margin_px - x0) * w
    planes[1, :3] = (x1 + margin_px) * w - x
    planes[2, :3] = y + (margin_px - y0) * w
    planes[3, :3] = (y1 + margin_px) * w - y
    planes[4, :3], planes[4, 3] = w, camera.near
    return planes


@njit(nogil=True, cache=True)
def cubes_within(centers, half_edge, cells, eye, planes, within):
    """Fill (k,) bool ``within``: the cube of each of (k,) cells is not wholly outside one of (5, 4) half-spaces.

    centers : (n, 3) float64.  half_edge : (n,) float64.
    """
    reach = np.abs(planes[:, :3]).sum(axis=1)
    for i, cell in enumerate(cells):
        within[i] = True
        for plane in range(N_PLANES):
            distance = -planes[plane, 3]
            for axis in range(3):
                distance += planes[plane, axis] * (centers[cell, axis] - eye[axis])
            if distance < -half_edge[cell] * reach[plane]:
                within[i] = False
                break
