"""Rasterizers: points resident once; per frame (camera, render-points) → packed framebuffer.

``cpu`` is compiled with numba and needs nothing else; ``gl`` and ``gl-points`` need moderngl and an EGL device.
``reference`` is the short float64 NumPy twin that the others are held against.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...shared.camera import Camera
from ...shared.errors import InputError, MessageError

MAX_SIDE_PX = 1 << 15
"""Largest side of a point's square, and of the viewport of ``cpu``: pixel indices stay within int32."""


@dataclass(frozen=True)
class ResidentPoints:
    """The render rank's half of a scene: points relative to the origin of their block, no octree.

    x, y, z : (n,) float32, relative to the block's origin, world units. May be memory-mapped.
    colour : (n,) uint32 colour words.
    block_first_point : (b,) int64, ascending, the first is 0: block i holds points
        block_first_point[i] … block_first_point[i + 1] − 1 (the last one: to the end).
    block_origin : (b, 3) float64, world frame.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    colour: np.ndarray
    block_first_point: np.ndarray
    block_origin: np.ndarray

    def __len__(self) -> int:
        return len(self.x)


@dataclass(frozen=True)
class PointSize:
    """Side of the square a point covers, in pixels.

    pixels : fixed side ≥ 1; used alone when ``world`` is 0.
    world : side in world units, > 0 for attenuation with distance: side = clamp(world · focal_px / depth, pixels,
        maximum), rounded to the nearest integer.
    maximum : largest side in pixels when attenuated; ``pixels`` if that is larger.

    A point at (u, v) covers the columns floor(u − (side − 1) / 2) … + side − 1, and rows likewise: the pixels whose
    centres lie within half a side of it. The part inside the image is drawn, at the depth of the point.
    Raises InputError for a side out of 1…``MAX_SIDE_PX`` or a ``world`` that is negative or not finite.
    """

    pixels: int = 1
    world: float = 0.0
    maximum: int = 64

    def __post_init__(self) -> None:
        if not (1 <= self.pixels <= MAX_SIDE_PX and 1 <= self.maximum <= MAX_SIDE_PX):
            raise InputError(
                f"point size: found {self.pixels} px, at most {self.maximum} px, expected 1…{MAX_SIDE_PX} px"
            )
        if not 0 <= self.world < math.inf:
            raise InputError(f"point size: found {self.world} world units, expected a finite number ≥ 0")


class Rasterizer(Protocol):
    """What every rasterizer offers; an owner is a context manager."""

    name: str
    device: str

    def draw(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(height, width) uint64 framebuffer words, row 0 on top; valid until the next call.

        entries : (m,) RENDER_POINT.  Raises MessageError for an entry beyond the point-array or with stride 0.
        """
        ...

    def close(self) -> None:
        """Release threads and device memory."""
        ...


def pixel_from_blocks(camera: Camera, block_origin: np.ndarray) -> np.ndarray:
    """(b, 3, 4) float32: rows X, Y, W over block-relative positions; multiplied in float64, then rounded once.

    The camera's eye is subtracted from the block origin before anything is rotated, so a scene far from the world's
    origin loses nothing.
    """
    m = camera.pixel_from_world
    out = np.empty((len(block_origin), 3, 4))
    out[:, :, :3] = m[:, :3]
    out[:, :, 3] = (block_origin - camera.eye) @ m[:, :3].T
    return out.astype(np.float32)


def check_viewport(camera: Camera, width: int, height: int) -> None:
    """Raise MessageError for a camera of another viewport than the rasterizer was made for."""
    if (camera.width, camera.height) != (width, height):
        raise MessageError(f"camera viewport: found {camera.width}×{camera.height}, expected {width}×{height}")
