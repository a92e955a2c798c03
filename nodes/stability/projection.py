"""Where a point falls: pixels against float64, under far translations and wide and narrow views."""

from __future__ import annotations

import numpy as np

from ...shared.camera import Camera
from ...shared.stability.case import cases, expect
from ..culling import CullingNode
from .chain import Chain, built, camera_at, city, project_given

_EYES = np.array([(-40.0, -50.0, 95.0), (100.0, 62.0, 3.0), (112.0, 95.0, 30.0)])
_TARGET = np.array([112.0, 112.0, 8.0])
_TRANSLATIONS = {0.0: 0.01, 1.0: 0.01, 1e3: 0.01, 6.4e6: 0.01, 1e9: 0.01}


def _worst_px(chain: Chain, cameras: list[Camera]) -> float:
    moved = [chain.moved_px(camera) for camera in cameras]
    expect(min(map(len, moved)) > 100, "points are in the image")
    return max(float(m.max()) for m in moved)


@cases(
    "projection/translation",
    bounds=_TRANSLATIONS,
    unit="px",
)
def translation(by: float) -> float:
    """Image position of every drawn point of a city moved by this many metres on each axis (not exact in binary):
    read, built, stored, culled, sampled, projected in float32, against float64 of the points as given; 1920×1080.
    """
    by = by + by / 3e7
    with built(city() + by) as chain:
        return _worst_px(chain, [camera_at(eye + by, _TARGET + by) for eye in _EYES])


@cases(
    "projection/picture moved by",
    bounds={6.4e6: 0.01, 1e9: 0.01 + 1158 * 2 * 2.0**-23 / 0.25},
    unit="px",
)
def picture(by: float) -> float:
    """Image position of every drawn point against the same point of the scene at the origin: what rounding the
    *input* to float64 at that distance adds (bound: 0.01 px, and focal length × 2 float64 steps / depth of the
    nearest point). The near plane lies at 0.25 m: with float64 steps of 1.2e-7 m at 1e9 m, what is nearer moves
    further.
    """
    here = city()
    worst = 0.0
    with built(here + by) as chain:
        for eye in _EYES:
            camera = camera_at(eye + by, _TARGET + by, near=0.25)
            u, v, seen = project_given(camera, chain.given)
            exact_u, exact_v, also = project_given(camera_at(eye, _TARGET, near=0.25), here)
            both = seen & also
            expect(both.sum() > 100, "points are in the image")
            input_px = np.hypot(u - exact_u, v - exact_v)[both].max()
            worst = max(worst, float(input_px + chain.moved_px(camera).max()))
    return worst


def _wide_bound_px(degrees: float) -> float:
    """Pixels that 1e-6 rad (17 float32 steps of a direction) cover in the corner of a 1920×1080 image; 0.01 at least.

    Near the corner of a very wide image a pixel is a tiny angle: focal length · sec² of the angle off the axis.
    """
    if degrees <= 120:
        return 0.01
    half = np.tan(np.radians(degrees / 2))
    return max(0.01, float(1e-6 * 540 / half * (1 + (half * half) * (1 + (16 / 9) ** 2))))


@cases(
    "projection/field of view",
    bounds={degrees: _wide_bound_px(degrees) for degrees in (1.0, 10.0, 60.0, 120.0, 170.0, 179.0)},
    unit="px",
)
def field_of_view(degrees: float) -> float:
    """Image position of every drawn point at this vertical field of view in degrees, against float64; 1920×1080
    (bound: 0.01 px, or 1e-6 rad at the image's corner if that is more). Narrow views look from so far that 60 m fill
    the image.
    """
    with built(city()) as chain:
        back = max(1.0, 0.3 / np.tan(np.radians(degrees / 2)))
        return _worst_px(
            chain, [camera_at(_TARGET + (eye - _TARGET) * back, _TARGET, fov_deg=degrees) for eye in _EYES]
        )


@cases(
    "culling/field of view",
    bounds={0.01: 0.0, 1.0: 0.0, 60.0: 0.0, 179.0: 0.0, 179.99: 0.0},
    unit="points",
)
def culling(degrees: float) -> float:
    """Points in the image (float64) whose cell is culled, at this vertical field of view in degrees."""
    lost = 0
    with built(city(), points_per_cell=50) as chain:
        owner = _owners(chain)
        for eye in _EYES:
            camera = camera_at(eye, _TARGET, fov_deg=degrees)
            visible = CullingNode(chain.octree, backface=False, margin_px=0.0).process(camera).unpack().astype(bool)
            seen = project_given(camera, chain.given[chain.source])[2]
            lost += int((seen & ~visible[owner]).sum())
    return lost


def _owners(chain: Chain) -> np.ndarray:
    """(n_stored,) the cell that owns each stored point, in layered order."""
    order = np.argsort(chain.octree.first_point, kind="stable")
    return np.repeat(order, chain.octree.n_points[order])
