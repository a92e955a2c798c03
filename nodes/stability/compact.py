"""Positions in fixed point: clouds of any extent, degenerate clouds, an eye inside a block, the smallest image."""

from __future__ import annotations

import numpy as np

from ...shared.camera import Camera
from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.stability.case import case, cases, expect
from ..raster import ResidentPoints
from ..raster.blocks import HIGH_BITS_ERROR_PX
from ..raster.compact import compact_positions
from ..raster.cpu import CpuRasterizer
from ..raster.reference import point_indices, project_compact, reference_frame
from .chain import built, camera_at, city, every_point, in_one_block, project_given
from .clouds import CLOUDS, cameras_of

_EYE, _TARGET = np.array([100.0, 62.0, 3.0]), np.array([112.0, 112.0, 8.0])


def _differing(points: ResidentPoints, camera: Camera) -> int:
    """Pixels of a frame of all points in fixed point that are not as the NumPy twin draws them."""
    with CpuRasterizer(points, camera.width, camera.height, threads=2, compact=True) as rasterizer:
        found = rasterizer.draw(camera, every_point(points))
        twin = project_compact(compact_positions(points, 1))
        return int((found != reference_frame(points, camera, every_point(points), projection=twin)).sum())


@cases(
    "compact/metres",
    bounds=dict.fromkeys((1e-30, 1e-9, 1e-3, 1e3, 1e9, 1e12, 1e30), 2**0.5 * HIGH_BITS_ERROR_PX + 0.01),
    unit="px",
)
def metres(extent: float) -> float:
    """Image position of every drawn point of a city of this extent, in fixed point, against float64; 1920×1080
    (bound: what leaving out the low bits may cost on each axis, and what float32 positions cost).
    """
    factor = extent / 200.0
    with built(city() * factor) as chain:
        camera = camera_at(_EYE * factor, _TARGET * factor, near=0.05 * factor)
        index = point_indices(chain.chosen(camera).entries)
        u, v, _ = project_compact(compact_positions(chain.points, 2))(chain.points, camera, index)
        exact_u, exact_v, seen = project_given(camera, chain.given[chain.source[index]])
        expect(seen.sum() > 1000, "points are in the image")
        return float(np.hypot(u[seen] - exact_u[seen], v[seen] - exact_v[seen]).max())


@cases("compact/cloud", bounds=dict.fromkeys(CLOUDS, 0.0), unit="pixels")
def cloud(name: str) -> float:
    """Pixels that differ from the NumPy twin for degenerate clouds: coincident, collinear, flat, …"""
    positions = CLOUDS[name]()
    with built(positions, points_per_cell=4096) as chain:
        return sum(_differing(chain.points, camera) for camera in cameras_of(positions))


@case("compact/eye inside a block", bound=0.0, unit="pixels")
def inside() -> float:
    """Pixels that differ from the NumPy twin with the eye among a block's points and a near plane of 1e-6 of its edge:
    depths of both signs and around 0.
    """
    points = in_one_block(np.random.default_rng(5).uniform(-1, 1, (200_000, 3)))
    camera = camera_at(np.array([0.01, 0.02, 0.03]), np.array([0.3, 0.8, 0.1]), width=480, height=270, near=2e-6)
    return _differing(points, camera)


@cases("compact/viewport", bounds={"1×1": 0.0, "1×4096": 0.0, "4096×1": 0.0}, unit="pixels")
def viewport(name: str) -> float:
    """Pixels that differ from the NumPy twin in the smallest images."""
    width, height = map(int, name.split("×"))
    points = in_one_block(np.random.default_rng(6).uniform(-1, 1, (100_000, 3)))
    camera = camera_at(np.array([3.0, 2.0, 1.0]), np.zeros(3), width=width, height=height)
    with CpuRasterizer(points, width, height, compact=True) as rasterizer:
        expect((rasterizer.draw(camera, every_point(points)) != FRAMEBUFFER_EMPTY).any(), "points are drawn")
    return _differing(points, camera)
