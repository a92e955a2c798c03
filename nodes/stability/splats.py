"""Splats at the extremes: degenerate normals and radii, grazing planes, any ε, the smallest and largest images."""

from __future__ import annotations

import numpy as np

from ...shared.build.settings import available_memory_bytes
from ...shared.camera import Camera
from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.points import NO_NORMAL, pack_normals
from ...shared.stability.case import OutOfReach, case, cases, expect
from ..raster import ResidentPoints, SplatSettings
from ..raster.splat import CpuSplatRasterizer
from ..raster.splat_reference import splat_frame
from .chain import camera_at, every_point

_SHARE = 0.002
"""float32 moves the border of a splat, or of ε, over the centre of a pixel now and then."""

_EDGE = 4.0


def _cloud(n: int, code: int, *, normals: str = "sphere") -> ResidentPoints:
    """Points of the unit sphere whose splats have one radius, 4 · 2**(−code / 8)."""
    rng = np.random.default_rng(5)
    at = rng.normal(size=(n, 3))
    at /= np.linalg.norm(at, axis=1, keepdims=True)
    word = {
        "sphere": pack_normals(at),
        "grazing": pack_normals(np.cross(at - [0.0, -4.0, 0.0], [0.3, 0.1, 1.0])),  # the eye lies in every plane
        "none": np.full(n, NO_NORMAL),
        "random": rng.integers(0, 2**32, n, np.uint32),
    }[normals]
    x, y, z = np.ascontiguousarray(at.T, np.float32)
    return ResidentPoints(
        x,
        y,
        z,
        rng.integers(0, 2**32, n, np.uint32),
        np.zeros(1, np.int64),
        np.zeros((1, 3)),
        normal=word,
        radius=np.full(n, code, np.uint8),
        root_edge=_EDGE,
    )


def _camera(width: int = 160, height: int = 120, near: float = 1e-3) -> Camera:
    return camera_at(np.array([0.0, -4.0, 0.0]), np.zeros(3), width=width, height=height, near=near)


def _draw(points: ResidentPoints, camera: Camera, settings: SplatSettings) -> np.ndarray:
    with CpuSplatRasterizer(points, camera.width, camera.height, settings) as rasterizer:
        return rasterizer.draw(camera, every_point(points)).copy()


def _differing(points: ResidentPoints, camera: Camera, settings: SplatSettings = SplatSettings()) -> float:  # noqa: B008
    """Share of pixels whose coverage, or a channel by more than one step, is not that of the float64 reference."""
    found, expected = _draw(points, camera, settings), splat_frame(points, camera, every_point(points), settings)
    expect((expected != FRAMEBUFFER_EMPTY).any(), "the picture shows something")
    covered = (found != FRAMEBUFFER_EMPTY) == (expected != FRAMEBUFFER_EMPTY)
    a, b = (words.astype(np.uint32).view(np.uint8).astype(np.int16) for words in (found, expected))
    near = np.abs(a - b).reshape(*found.shape, 4).max(axis=2) <= 1
    return float((~(covered & near)).mean())


@cases("splats/normals", bounds=dict.fromkeys(("none", "grazing", "random"), _SHARE), unit="of pixels")
def degenerate_normals(kind: str) -> float:
    """Pixels that differ from float64 where no point has a normal, where the eye lies in the plane of every splat, and
    where normals are any 32 bits.
    """
    return _differing(_cloud(2000, 40, normals=kind), _camera())


@cases("splats/radius code", bounds=dict.fromkeys((0, 16, 32, 255), _SHARE), unit="of pixels")
def radii(code: int) -> float:
    """Pixels that differ from float64, with radii from the edge of the scene down to a billionth of it, the code of
    zero.
    """
    return _differing(_cloud(60 if code < 32 else 2000, code), _camera())


@cases("splats/epsilon", bounds=dict.fromkeys((0.0, 1e30), _SHARE), unit="of pixels")
def depth_offset(epsilon: float) -> float:
    """Pixels that differ from float64 where only the nearest fragment counts, and where all do."""
    return _differing(_cloud(2000, 40), _camera(), SplatSettings(depth_offset=epsilon))


@case("splats/one pixel", bound=0.0, unit="of pixels")
def one_pixel() -> float:
    """The same in a viewport of one pixel."""
    return _differing(_cloud(500, 40), _camera(1, 1))


@case("splats/w towards 0", bound=0.005, unit="of pixels")
def towards_zero() -> float:
    """Pixels that differ from float64 with the eye on the surface and the near plane at 1e-20: splats that reach past
    the eye, and centres at depths towards 0.
    """
    points = _cloud(300, 24)
    eye = np.array([points.x[7], points.y[7], points.z[7]], np.float64)
    camera = camera_at(eye, np.zeros(3), width=160, height=120, near=1e-20)
    return _differing(points, camera)


@case("splats/4 million on one pixel", bound=3.0, unit="colour steps")
def coincident() -> float:
    """How far the colour of 4 million coincident splats, half of them 100 and half 200, is from 150: what float32 sums
    lose.
    """
    n = 4_000_000
    zeros = np.zeros(n, np.float32)
    points = ResidentPoints(
        zeros,
        zeros,
        zeros,
        np.tile(np.array([0xFF646464, 0xFFC8C8C8], np.uint32), n // 2),
        np.zeros(1, np.int64),
        np.zeros((1, 3)),
        normal=np.broadcast_to(NO_NORMAL, n),
        radius=np.broadcast_to(np.uint8(255), n),
        root_edge=_EDGE,
    )
    words = _draw(points, _camera(), SplatSettings())
    drawn = words[words != FRAMEBUFFER_EMPTY]
    expect(len(drawn) > 0, "something is drawn")
    return float(np.abs((drawn & np.uint64(255)).astype(np.int64) - 150).max())


@case("splats/viewport 16384²", bound=0.0, unit="of pixels")
def largest_viewport() -> float:
    """Share of the middle 256² pixels of a 16384² frame, splats of 256 px, that differ from the same pixels alone."""
    side, part = 16384, 256
    needed = 3 * 8 * side**2
    if available_memory_bytes() < needed:
        raise OutOfReach(f"needs {needed / 2**30:.0f} GiB of memory")
    points, whole = _cloud(2000, 44), _camera(side, side)
    begin = (side - part) // 2
    middle = _draw(points, whole, SplatSettings())[begin : begin + part, begin : begin + part]
    clip = whole.clip_from_world.copy()
    clip[:2] *= side / part
    cut = Camera(0, clip, whole.eye, part, part, whole.near)
    covered = middle != FRAMEBUFFER_EMPTY
    expect(covered.any(), "the middle shows something")
    return float((covered != (_draw(points, cut, SplatSettings()) != FRAMEBUFFER_EMPTY)).mean())
