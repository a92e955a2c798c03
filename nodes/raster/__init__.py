"""Rasterizers: points resident once; per frame (camera, render-points) → packed framebuffer.

``cpu`` is compiled with numba and needs nothing else; ``gl`` and ``gl-points`` need moderngl and an EGL device.
``reference`` is the short float64 NumPy twin that the others are held against.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, Self

import numpy as np

from ...shared.camera import Camera
from ...shared.errors import InputError, MessageError

if TYPE_CHECKING:
    from .group_raster import ResidentGroups
    from .pools import PoolCells

MAX_SIDE_PX = 1 << 15
"""Largest side of a point's square, and of the viewport of ``cpu``: pixel indices stay within int32."""


@dataclass(frozen=True)
class CellFeatures:
    """What the points of a cell look like (thesis 4.3.1), of every cell that owns points, in stored order.

    first_point, n_points : (c,) int64, the cell's own range in the point-array; ascending, without overlap.
    feature : (c,) uint8, code of ``octree.FEATURES``.
    quad_center : (c, 3) float64, world frame.  quad_axes : (c, 2, 3) float32, half axes, world units; of flat cells.
    """

    first_point: np.ndarray
    n_points: np.ndarray
    feature: np.ndarray
    quad_center: np.ndarray
    quad_axes: np.ndarray


@dataclass(frozen=True)
class ResidentPoints:
    """The render rank's half of a scene: points relative to the origin of their block, no octree.

    x, y, z : (n,) float32, relative to the block's origin, world units. May be memory-mapped. A point whose x is NaN
        is not drawn (``point_filter``), in whatever form a rasterizer holds it.
    colour : (n,) uint32 colour words.
    block_first_point : (b,) int64, ascending, the first is 0: block i holds points
        block_first_point[i] … block_first_point[i + 1] − 1 (the last one: to the end).
    block_origin : (b, 3) float64, world frame.

    What only some settings need is None elsewhere:
    normal : (n,) uint32 octahedral words (``points.pack_normals``): splats.
    radius : (n,) uint8 codes (``points.pack_radii`` with ``root_edge``): splats.
    root_edge : edge of the scene's root cube, world units.
    block_spacing : (b,) float32, side of squares that leave no gap between the points of each block, world units:
        adaptive point size. Blocks are single cells then.
    features : what cells look like: feature-driven splats.
    pools : cells in pooled form, in stored order; their ``world_side`` is their spacing as of ``block_spacing``, else
        0. No point may be filtered out then.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    colour: np.ndarray
    block_first_point: np.ndarray
    block_origin: np.ndarray
    normal: np.ndarray | None = None
    radius: np.ndarray | None = None
    root_edge: float = 1.0
    block_spacing: np.ndarray | None = None
    features: CellFeatures | None = None
    pools: PoolCells | None = None

    def __len__(self) -> int:
        return len(self.x)


@dataclass(frozen=True)
class PointSize:
    """Side of the square a point covers, in pixels.

    pixels : fixed side ≥ 1; used alone when ``world`` is 0.
    world : side in world units, > 0 for attenuation with distance: side = clamp(world · focal_px / depth, pixels,
        maximum), rounded to the nearest integer.
    maximum : largest side in pixels when attenuated or adaptive; ``pixels`` if that is larger.
    adaptive : side grows with the spacing of the points of a cell: side = clamp(max(world, block_spacing) · focal_px /
        depth, pixels, maximum), rounded. Needs ``ResidentPoints.block_spacing``.

    A point at (u, v) covers the columns floor(u − (side − 1) / 2) … + side − 1, and rows likewise: the pixels whose
    centres lie within half a side of it. The part inside the image is drawn, at the depth of the point.
    Raises InputError for a side out of 1…``MAX_SIDE_PX`` or a ``world`` that is negative or not finite.
    """

    pixels: int = 1
    world: float = 0.0
    maximum: int = 64
    adaptive: bool = False

    def __post_init__(self) -> None:
        if not (1 <= self.pixels <= MAX_SIDE_PX and 1 <= self.maximum <= MAX_SIDE_PX):
            raise InputError(
                f"point size: found {self.pixels} px, at most {self.maximum} px, expected 1…{MAX_SIDE_PX} px"
            )
        if not 0 <= self.world < math.inf:
            raise InputError(f"point size: found {self.world} world units, expected a finite number ≥ 0")


@dataclass(frozen=True)
class SplatSettings:
    """How splats are drawn (thesis 4.4.3).

    radius_scale : factor on the stored radii, > 0.
    depth_offset : ε of the visibility pass, in splat radii, ≥ 0: fragments up to this much behind the nearest surface
        are blended with it.
    features : feature-driven: one quad for a flat cell in the visibility pass (thesis 4.4.3).
    lighting : Appendix C: ambient, diffuse and specular light where there are normals.
    Raises InputError for a value out of range or not finite.
    """

    radius_scale: float = 1.0
    depth_offset: float = 1.0
    features: bool = False
    lighting: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.radius_scale < math.inf:
            raise InputError(f"splats: found radius_scale {self.radius_scale}, expected a finite number > 0")
        if not 0 <= self.depth_offset < math.inf:
            raise InputError(f"splats: found depth_offset {self.depth_offset}, expected a finite number ≥ 0")


class Rasterizer(Protocol):
    """What every rasterizer offers; an owner is a context manager."""

    name: str
    device: str

    def draw(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(height, width) uint64 framebuffer words, row 0 on top; valid until the next call.

        entries : (m,) RENDER_POINT.  Raises MessageError for an entry beyond the point-array, and for pooled points
        (stride 0) that are not there, or that it does not draw.
        """
        ...

    def close(self) -> None:
        """Release threads and device memory."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


def pixel_from_blocks(camera: Camera, block_origin: np.ndarray) -> np.ndarray:
    """(b, 3, 4) float32: rows X, Y, W over block-relative positions; multiplied in float64, then rounded once.

    The camera's eye is subtracted from the block origin before anything is rotated, so a scene far from the world's
    origin loses nothing.
    """
    m = camera.pixel_from_world
    out = np.empty((len(block_origin), 3, 4))
    out[:, :, :3] = m[:, :3]
    x, y, z = (block_origin - camera.eye).T[:, :, None]
    out[:, :, 3] = x * m[:, 0] + y * m[:, 1] + z * m[:, 2]  # in this order in the compiled kernels, too
    return out.astype(np.float32)


def world_sides(points: ResidentPoints | ResidentGroups, size: PointSize) -> np.ndarray:
    """(b,) float64: side of a point's square in each block, world units; 0: the smallest.

    Raises InputError if sizes are adaptive and nobody knows the spacing of the points.
    """
    if not size.adaptive:
        return np.full(len(points.block_origin), size.world)
    if points.block_spacing is None:
        raise InputError("point size: found no spacing of the points of each block, expected it for adaptive sizes")
    return np.maximum(points.block_spacing.astype(np.float64), size.world)


def check_viewport(camera: Camera, width: int, height: int) -> None:
    """Raise MessageError for a camera of another viewport than the rasterizer was made for."""
    if (camera.width, camera.height) != (width, height):
        raise MessageError(f"camera viewport: found {camera.width}×{camera.height}, expected {width}×{height}")
