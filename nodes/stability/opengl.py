"""The ``gl`` rasterizer on the scenes that are hard for float32, against ``cpu``."""

from __future__ import annotations

import numpy as np

from ...shared.camera import Camera
from ...shared.stability.case import OutOfReach, case, cases, expect
from ..raster import ResidentPoints
from .chain import built, camera_at, city, draw_all, every_point, is_drawn
from .depth import not_the_nearer, pairs_one_step_apart

_SHARE = 0.002
"""A GPU's division may round a point on the border of a pixel to either side; software OpenGL differs nowhere."""


def _draw(points: ResidentPoints, camera: Camera) -> np.ndarray:
    from ..raster.gl import GlComputeRasterizer
    from ..raster.gl_context import gl_available

    available, reason = gl_available()
    if not available:
        raise OutOfReach(reason)
    with GlComputeRasterizer(points, camera.width, camera.height) as rasterizer:
        return rasterizer.draw(camera, every_point(points)).copy()


_VIEWS: dict[str, tuple[float, float, float]] = {
    "6.4e6 m away": (1.0, 6.4e6, 50.0),
    "1e9 m away": (1.0, 1e9, 50.0),
    "1e-9 m wide": (1e-9 / 200, 0.0, 50.0),
    "1e12 m wide": (1e12 / 200, 0.0, 50.0),
    "at 179 degrees": (1.0, 0.0, 179.0),
}


@cases("opengl/city", bounds=dict.fromkeys(_VIEWS, _SHARE), unit="of pixels")
def view(name: str) -> float:
    """Share of the pixels that differ between the frames of ``gl`` and ``cpu``: colour, depth or coverage."""
    factor, by, degrees = _VIEWS[name]
    with built(city() * factor + by) as chain:
        eye, target = (np.array(v) * factor + by for v in ((100.0, 62.0, 3.0), (112.0, 112.0, 8.0)))
        camera = camera_at(eye, target, fov_deg=degrees, width=480, height=270, near=0.05 * factor)
        ours, expected = _draw(chain.points, camera), draw_all(chain.points, camera)
        expect(is_drawn(expected).sum() > 100, "the picture shows something")
        return float((ours != expected).mean())


@case("opengl/one float32 step apart", bound=0.0, unit="pixels")
def one_step() -> float:
    """Pixels of ``gl`` that do not show the nearer of two points one float32 step apart, at depths from 1e-3 to 1e7."""
    points, camera, n = pairs_one_step_apart()
    return not_the_nearer(_draw(points, camera), n)
