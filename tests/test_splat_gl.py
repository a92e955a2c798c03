"""Splats of OpenGL against the float64 reference, on whatever EGL device is there.

Stated tolerance: coverage differs on at most 0.1 % of the pixels, colours by 0.2 of 255 steps on average and by more
than one step on at most 0.1 % of the covered pixels, depths by 1e-4 of themselves on at most 0.1 %.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splatpipe.nodes.raster import CellFeatures, ResidentPoints, SplatSettings, gl_resident, gl_splat
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.nodes.raster.gl_splat import GlSplatRasterizer
from splatpipe.nodes.raster.splat import CpuSplatRasterizer
from splatpipe.nodes.raster.splat_reference import splat_frame
from splatpipe.shared.camera import Camera, look_at, perspective_camera
from splatpipe.shared.errors import InputError, MessageError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from splatpipe.shared.octree import FLAT
from splatpipe.shared.points import NO_NORMAL, pack_normals, pack_radii

AVAILABLE, REASON = gl_available()
pytestmark = [pytest.mark.gl, pytest.mark.skipif(not AVAILABLE, reason=REASON)]

WIDTH, HEIGHT = 120, 80
N_POINTS = 1500
ALL = np.array([(0, N_POINTS, 1)], RENDER_POINT)
SOME = np.array([(1100, 300, 7), (3, 1, 1), (10, 0, 1), (0, 700, 3), (1498, 2, 1)], RENDER_POINT)


def camera(eye=(0.3, -3.0, 0.5), target=(0.0, 0.0, 0.0), width=WIDTH, height=HEIGHT, near=0.01) -> Camera:
    pose = look_at(np.array(eye), np.array(target), np.array([0.0, 0.0, 1.0]))
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.8, width=width, height=height, near=near)


def resident(world: np.ndarray, normal: np.ndarray, radius: np.ndarray, seed: int = 1) -> ResidentPoints:
    """Points in five blocks, one of them empty; every tenth has no normal."""
    rng, n = np.random.default_rng(seed), len(world)
    first = np.array([0, 1, n // 3, n // 3, n // 2])
    origin = rng.uniform(-2, 2, (len(first), 3))
    x, y, z = np.ascontiguousarray((world - np.repeat(origin, np.diff(first, append=n), axis=0)).T, np.float32)
    words = pack_normals(normal)
    words[::10] = NO_NORMAL
    colour = rng.integers(0, 2**32, n, np.uint32)
    return ResidentPoints(
        x, y, z, colour, first, origin, normal=words, radius=pack_radii(radius, 4.0), root_edge=4.0
    )  # fmt: skip


@pytest.fixture(scope="module")
def points() -> ResidentPoints:
    """A unit sphere with noisy normals; radii from a fraction of a pixel to several, and zero."""
    rng = np.random.default_rng(2)
    world = rng.normal(size=(N_POINTS, 3))
    world /= np.linalg.norm(world, axis=1)[:, None]
    radius = 0.1 * rng.uniform(0.02, 1.5, N_POINTS)
    radius[::7] = 0.0
    return resident(world, world + 0.1 * rng.normal(size=world.shape), radius)


def channels(frame: np.ndarray) -> np.ndarray:
    return frame.astype(np.uint32).view(np.uint8).reshape(*frame.shape, 4)[..., :3].astype(int)


def depths(frame: np.ndarray) -> np.ndarray:
    return (frame >> np.uint64(32)).astype(np.uint32).view(np.float32)


def assert_close(found: np.ndarray, expected: np.ndarray) -> None:
    """The stated tolerance."""
    covered, expected_covered = found != FRAMEBUFFER_EMPTY, expected != FRAMEBUFFER_EMPTY
    assert (covered != expected_covered).sum() <= 0.001 * found.size
    both = covered & expected_covered
    assert both.any()
    steps = np.abs(channels(found)[both] - channels(expected)[both])
    assert steps.mean() <= 0.2
    assert (steps.max(axis=1) > 1).mean() <= 0.001
    assert (np.abs(depths(found)[both] / depths(expected)[both] - 1) > 1e-4).mean() <= 0.001


def draw(points: ResidentPoints, camera: Camera, entries: np.ndarray, settings: SplatSettings) -> np.ndarray:
    with GlSplatRasterizer(points, camera.width, camera.height, settings) as rasterizer:
        return rasterizer.draw(camera, entries).copy()


@pytest.mark.parametrize(
    "settings",
    [
        SplatSettings(),
        SplatSettings(depth_offset=0.0),
        SplatSettings(depth_offset=1e300),
        SplatSettings(lighting=False),
        SplatSettings(radius_scale=4.0),
        SplatSettings(radius_scale=1e-300),
        SplatSettings(radius_scale=1e300),
    ],
    ids=["default", "no offset", "huge offset", "unlit", "large", "no radius", "huge radius"],
)
def test_settings(points, settings):
    few = np.array([(0, 60, 1)], RENDER_POINT) if settings.radius_scale > 1e9 else ALL
    assert_close(draw(points, camera(), few, settings), splat_frame(points, camera(), few, settings))


@pytest.mark.parametrize(
    "view",
    [
        camera((0.2, 0.1, 0.3), (1.0, 0.0, 0.0)),
        camera((0.0, -1.02, 0.0)),
        camera((0.0, -1.02, 0.0), near=0.1),
        camera((0.0, -1.0, 3.0), (0.0, -1.0, 0.0)),
        camera(width=1, height=1),
        camera((0.0, -400.0, 0.0)),
    ],
    ids=["inside", "touching", "cut by near", "tangent", "one pixel", "far"],
)
def test_views(points, view):
    assert_close(draw(points, view, ALL, SplatSettings()), splat_frame(points, view, ALL, SplatSettings()))


def test_grazing_splats():
    """A floor seen at eye level: normals at right angles to the rays, up to rounding."""
    rng = np.random.default_rng(3)
    world = rng.uniform(-1, 1, (N_POINTS, 3)) * [1.0, 1.0, 1e-4]
    floor = resident(world, np.tile([0.0, 0.0, 1.0], (N_POINTS, 1)), np.full(N_POINTS, 0.05))
    view = camera((0.0, -3.0, 0.001), (0.0, 0.0, 0.001))
    assert_close(draw(floor, view, ALL, SplatSettings()), splat_frame(floor, view, ALL, SplatSettings()))


def test_points_without_a_place_are_not_drawn(points):
    x = points.x.copy()
    x[::3], x[1::9], x[4::9] = np.nan, np.inf, 3e38
    odd = replace(points, x=x)
    assert_close(draw(odd, camera(), ALL, SplatSettings()), splat_frame(odd, camera(), ALL, SplatSettings()))


def with_quads(points: ResidentPoints) -> ResidentPoints:
    """Every third cell is flat: a rectangle in front of some of the sphere, one of them through the near plane."""
    rng = np.random.default_rng(4)
    first = np.arange(5, N_POINTS, 50)
    n = len(first)
    axes = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0][:, :2] * rng.uniform(0.02, 0.3, (n, 2, 1))
    axes[0] *= 20
    axes[3, 1] = 0.0
    center = rng.uniform(-1, 1, (n, 3)) - [0.0, 0.5, 0.0]
    features = CellFeatures(
        first, np.full(n, 40), np.where(np.arange(n) % 3, 3, FLAT).astype(np.uint8), center, axes.astype(np.float32)
    )
    return replace(points, features=features)


@pytest.mark.parametrize("entries", [ALL, SOME, SOME[1:2]], ids=["all", "some", "no flat cell"])
def test_flat_cells_are_quads_in_the_visibility_pass(points, entries):
    scene, settings = with_quads(points), SplatSettings(features=True)
    found = draw(scene, camera(), entries, settings)
    assert_close(found, splat_frame(scene, camera(), entries, settings))
    if entries is ALL:
        assert (found != draw(scene, camera(), entries, SplatSettings())).any()


@pytest.mark.parametrize("entries", [ALL, SOME], ids=["all", "some"])
def test_pictures_are_those_of_cpu(points, entries):
    scene, settings = with_quads(points), SplatSettings(features=True)
    with CpuSplatRasterizer(scene, WIDTH, HEIGHT, settings, 2) as cpu:
        assert_close(draw(scene, camera(), entries, settings), cpu.draw(camera(), entries))


def test_features_without_a_flat_cell_change_nothing(points):
    scene = with_quads(points)
    none = replace(scene, features=replace(scene.features, feature=np.full_like(scene.features.feature, 2)))
    expected = draw(points, camera(), ALL, SplatSettings())
    np.testing.assert_array_equal(draw(none, camera(), ALL, SplatSettings(features=True)), expected)


def test_chunks_and_batches_do_not_show(points, monkeypatch):
    scene, settings = with_quads(points), SplatSettings(features=True)
    expected = draw(scene, camera(), ALL, settings)
    monkeypatch.setattr(gl_resident, "storage_limit", lambda _: 2000)
    monkeypatch.setattr(gl_splat, "_BATCH_SPLATS", 37)
    np.testing.assert_array_equal(draw(scene, camera(), ALL, settings), expected)


def test_frames_follow_each_other_without_a_trace(points):
    with GlSplatRasterizer(points, WIDTH, HEIGHT) as rasterizer:
        expected = rasterizer.draw(camera(), ALL).copy()
        assert (rasterizer.draw(camera(), ALL[:0]) == FRAMEBUFFER_EMPTY).all()
        assert (rasterizer.draw(camera((0.2, 0.1, 0.3)), SOME) != expected).any()
        np.testing.assert_array_equal(rasterizer.draw(camera(), ALL), expected)
        assert rasterizer.resident_bytes == 20 * N_POINTS + -(-N_POINTS // 4) * 4


def test_a_scene_far_from_the_origin_gives_the_same_bits(points):
    shift = np.array([6_400_000.0, -6_400_000.0, 6_400_000.0])  # sums with multiples of 2⁻²⁰ are exact
    near = replace(points, block_origin=np.round(points.block_origin * 2**20) / 2**20)
    far = replace(near, block_origin=near.block_origin + shift)
    eye = np.array([0.25, -3.0, 0.5])
    expected = draw(near, camera(eye), ALL, SplatSettings())
    np.testing.assert_array_equal(draw(far, camera(eye + shift, shift), ALL, SplatSettings()), expected)


def test_what_a_scene_lacks_is_named(points):
    with pytest.raises(InputError, match="without normals or radii"):
        GlSplatRasterizer(replace(points, radius=None), WIDTH, HEIGHT)
    with pytest.raises(InputError, match="without features"):
        GlSplatRasterizer(points, WIDTH, HEIGHT, SplatSettings(features=True))


def test_bad_messages_are_refused(points):
    with GlSplatRasterizer(points, WIDTH, HEIGHT) as rasterizer:
        with pytest.raises(MessageError, match="entry 0: found offset"):
            rasterizer.draw(camera(), np.array([(0, N_POINTS + 1, 1)], RENDER_POINT))
        with pytest.raises(MessageError, match=f"viewport: found 7×{HEIGHT}"):
            rasterizer.draw(camera(width=7), ALL)
