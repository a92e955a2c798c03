"""Near and far: order of depths, the near plane, points at and behind the eye, cameras inside cells."""

from __future__ import annotations

import numpy as np

from ...shared.camera import Camera
from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.stability.case import case, cases, expect
from ..raster import ResidentPoints
from ..raster.reference import project_float32, reference_frame
from .chain import STEPS, Chain, built, camera_at, city, draw_all, every_point, in_one_block

_WIDTH, _HEIGHT = 480, 270


def _along_x(near: float) -> Camera:
    """At the origin, looking along x: depth is x itself, to the bit."""
    return camera_at(np.zeros(3), np.array([1.0, 0.0, 0.0]), width=_WIDTH, height=_HEIGHT, near=near)


def pairs_one_step_apart() -> tuple[ResidentPoints, Camera, int]:
    """100 000 pairs of points one float32 step apart, at depths from 1e-3 to 1e7, each pair in a pixel of its own, the
    farther point first and last; the camera; the number of pairs. The nearer one has colour 1.
    """
    n = 100_000
    depth = np.geomspace(1e-3, 1e7, n).astype(np.float32)
    pixel = np.arange(n)
    column, row = pixel % _WIDTH + 0.5, pixel // _WIDTH + 0.5
    camera = _along_x(near=1e-4)
    sideways = (column - _WIDTH / 2) / camera.focal_px, (row - _HEIGHT / 2) / camera.focal_px
    farther = np.nextafter(depth, np.float32(np.inf))
    layers = [np.column_stack([d, -sideways[0] * d, -sideways[1] * d]) for d in (farther, depth, farther)]
    return in_one_block(np.concatenate(layers), np.repeat([2, 1, 2], n)), camera, n


def not_the_nearer(frame: np.ndarray, n: int) -> int:
    """Pixels of those pairs that show the farther point."""
    words = frame.ravel()
    expect((words[:n] != FRAMEBUFFER_EMPTY).all() and (words[n:] == FRAMEBUFFER_EMPTY).all(), "one pixel a pair")
    return int((words[:n] & np.uint64(0xFFFFFFFF) != 1).sum())


@case("depth/one float32 step apart", bound=0.0, unit="pixels")
def one_step() -> float:
    """Pixels that do not show the nearer of two points one float32 step apart, at 100 000 depths from 1e-3 to 1e7, each
    in a pixel of its own, the farther one drawn first and last.
    """
    points, camera, n = pairs_one_step_apart()
    return not_the_nearer(draw_all(points, camera), n)


@case("depth/1e-3 to 1e7 m", bound=0.0, unit="pairs")
def near_and_far() -> float:
    """Neighbours in exact depth, 1e-3 … 1e7 m from an eye in the middle of the scene, whose float32 depths are in the
    wrong order though they differ by more than 4 float32 steps of depth and of position within their block.
    """
    positions, eye = _shells()
    with built(positions) as chain:
        depth, exact, step = chain.depths(_in_the_middle(eye))
    order = np.argsort(exact)
    depth, exact, step = depth[order], exact[order], step[order]
    expect(exact[0] < 2e-3 and exact[-1] > 5e6, "depths from near to far")
    apart = np.diff(exact) > 4 * np.maximum(step[1:], step[:-1])
    expect(apart.mean() > 0.3, "many pairs can be told apart")
    return int((apart & (np.diff(depth) <= 0)).sum())


@case("depth/error from 1e-3 to 1e7 m", bound=4.0, unit="float32 steps")
def depth_error() -> float:
    """Largest error of a float32 depth, 1e-3 … 1e7 m from the eye, in float32 steps of the depth and of the way from
    the eye to the point's block and on to the point.
    """
    positions, eye = _shells()
    with built(positions) as chain:
        depth, exact, step = chain.depths(_in_the_middle(eye))
        return float((np.abs(depth - exact) / step).max())


def _in_the_middle(eye: np.ndarray) -> Camera:
    return camera_at(eye, eye + np.array([1.0, 0.3, 0.2]), near=1e-3)


def _shells() -> tuple[np.ndarray, np.ndarray]:
    """40 000 points at 1e-3 … 1e7 m in all directions from an eye that is no round number; the eye."""
    rng = np.random.default_rng(31)
    direction = rng.normal(size=(40_000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    eye = np.array([1 / 3, 2 / 7, 5 / 11])
    return eye + direction * np.geomspace(1e-3, 1e7, len(direction))[:, None], eye


@case("depth/near plane", bound=0.0, unit="points")
def near_plane() -> float:
    """Points kept in front of the near plane, or lost on and behind it, one float32 step apart at 5 near planes."""
    wrong = 0
    for near in (1e-30, 1e-3, 1.0, 1000.0, 1e30):
        at = np.float32(near)
        for depth, kept in ((np.nextafter(at, np.float32(0)), 0), (at, 1), (np.nextafter(at, np.float32(np.inf)), 1)):
            frame = draw_all(in_one_block(np.array([[depth, 0.0, 0.0]])), _along_x(float(at)))
            wrong += abs(int((frame != FRAMEBUFFER_EMPTY).sum()) - kept)
    return wrong


@case("depth/w towards 0", bound=0.0, unit="pixels")
def towards_zero() -> float:
    """Pixels that differ from the NumPy twin, or hold a depth before the near plane or not finite, for points at w from
    −1e10 over ±denormals, ±0 to 1e10, infinities and not-a-numbers among them; near plane 1e-38.
    """
    rng = np.random.default_rng(37)
    depth = np.concatenate([np.geomspace(1e-45, 1e10, 20_000), -np.geomspace(1e-45, 1e10, 20_000), [0.0, -0.0] * 50])
    sideways = rng.normal(size=(len(depth), 2)) * 10.0 ** rng.uniform(-45, 10, (len(depth), 1))
    xyz = np.column_stack([depth, sideways])
    near_the_axis = rng.random(len(xyz)) < 0.5
    xyz[near_the_axis, 1:] = depth[near_the_axis, None] * rng.uniform(-0.5, 0.5, (int(near_the_axis.sum()), 2))
    xyz[::1000] = np.inf
    xyz[1::1000, 0] = np.nan
    points, camera = in_one_block(xyz), _along_x(near=1e-38)
    frame = draw_all(points, camera)
    with np.errstate(all="ignore"):
        wrong = int((frame != reference_frame(points, camera, every_point(points), projection=project_float32)).sum())
    drawn = (frame[frame != FRAMEBUFFER_EMPTY] >> np.uint64(32)).astype(np.uint32).view(np.float32)
    expect(len(drawn) > 1000, "points are in the image")
    return wrong + int((~np.isfinite(drawn) | (drawn < np.float32(1e-38))).sum())


@case("camera/on a point", bound=STEPS, unit="float32 steps")
def on_a_point() -> float:
    """Image position of every drawn point, against float64, with the eye exactly on 20 of the points of a city (near
    plane at 5 cm), and no pixel that differs from brute force; 1920×1080.
    """
    worst = 0.0
    with built(city()) as chain:
        for eye in chain.given[:: len(chain.given) // 20]:
            camera = camera_at(eye, eye + np.array([1.0, 0.7, 0.1]))
            worst = max(worst, float(chain.moved_steps(camera).max(initial=0.0)))
            small = camera_at(eye, eye + np.array([1.0, 0.7, 0.1]), width=_WIDTH, height=_HEIGHT)
            expect(chain.differing_pixels(small) == 0, "no pixel differs from brute force")
    return worst


_CELLS = (100, 500, 4096, 30_000)


def _close_views(chain: Chain, distance: float, near: float) -> list[Camera]:
    """50 cameras at this distance from points, each looking at its point."""
    rng = np.random.default_rng(41)
    away = rng.normal(size=(50, 3))
    points = chain.given[rng.integers(len(chain.given), size=50)]
    eyes = points - distance * away / np.linalg.norm(away, axis=1, keepdims=True)
    return [camera_at(eye, point, near=near) for eye, point in zip(eyes, points, strict=True)]


@cases("camera/inside a cell of", bounds=dict.fromkeys(_CELLS, STEPS), unit="float32 steps")
def inside_a_cell(points_per_cell: int) -> float:
    """Image position of every drawn point, against float64, from 50 eyes inside cells of at most this many points,
    6 cm from a point; 1920×1080. With 30 000 the whole city is one cell of 200 m.
    """
    with built(city(), points_per_cell=points_per_cell) as chain:
        return max(float(chain.moved_steps(camera).max()) for camera in _close_views(chain, 0.06, 0.05))


@cases("camera/a spacing from a point", bounds=dict.fromkeys(_CELLS, 0.05), unit="px")
def a_spacing_away(points_per_cell: int) -> float:
    """The same in pixels, from as far as the points of the city are apart: 1.15 m, near plane too (0.01 px as a rule; a
    twentieth from within, since a block is as wide as some hundred spacings and has 2⁻²⁴ of that).
    """
    with built(city(), points_per_cell=points_per_cell) as chain:
        return max(float(chain.moved_px(camera).max()) for camera in _close_views(chain, 1.2, 1.15))


@cases("camera/6 cm from a point", bounds=dict.fromkeys(_CELLS, 1.0), unit="px")
def six_centimetres_away(points_per_cell: int) -> float:
    """The same from 6 cm, a twentieth of the spacing: what float32 offsets are good for (bound: one pixel)."""
    with built(city(), points_per_cell=points_per_cell) as chain:
        return max(float(chain.moved_px(camera).max()) for camera in _close_views(chain, 0.06, 0.05))


@cases("camera/away by", bounds=dict.fromkeys((1e3, 1e6, 1e9, 1e12), 0.01), unit="px")
def away(distance: float) -> float:
    """Image position of every drawn point of a city seen from this many metres away through a telephoto lens that it
    fills, against float64; 1920×1080.
    """
    target = np.array([100.0, 100.0, 30.0])
    eye = target + distance * np.array([0.6, -0.64, 0.48])
    with built(city()) as chain:
        camera = camera_at(eye, target, fov_deg=float(np.degrees(2 * np.arctan(150 / distance))))
        moved = chain.moved_px(camera)
        expect(len(moved) > 1000, "points are in the image")
        return float(moved.max())
