"""The OpenGL rasterizers against the reference and the ``cpu`` rasterizer, on whatever EGL device is there."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from splatpipe.nodes.raster import PointSize, ResidentPoints, gl, gl_context, gl_resident
from splatpipe.nodes.raster.cpu import CpuRasterizer
from splatpipe.nodes.raster.gl import GlComputeRasterizer, GlPointsRasterizer
from splatpipe.nodes.raster.gl_context import gl_available, is_software
from splatpipe.nodes.raster.reference import project, reference_frame
from splatpipe.shared.camera import Camera, look_at, perspective_camera
from splatpipe.shared.errors import DeviceError, InputError, MessageError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT

AVAILABLE, REASON = gl_available()

WIDTH, HEIGHT = 160, 100
N_POINTS = 40_000
SIZES = [
    PointSize(),
    PointSize(3),
    PointSize(4),
    PointSize(1, world=0.05, maximum=9),
    PointSize(1, adaptive=True),
    PointSize(2, world=0.03, maximum=9, adaptive=True),
]
SPACING = np.array([0.1, 0.01, 0.05, 0.02, 0.0, 0.04, 0.2], np.float32)
BOTH = pytest.mark.parametrize("rasterizer", [GlComputeRasterizer, GlPointsRasterizer])
BORDER_PX = 0.001
"""A point nearer than this to a pixel border may be rounded to either side."""


def camera(eye=(0.3, -3.0, 0.5), target=(0.0, 0.0, 0.0)) -> Camera:
    pose = look_at(np.array(eye), np.array(target), np.array([0.0, 0.0, 1.0]))
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.8, width=WIDTH, height=HEIGHT, near=0.01)


@pytest.fixture(scope="module")
def points() -> ResidentPoints:
    """A unit sphere in 7 blocks, one of them empty, whose borders are no multiple of anything."""
    rng = np.random.default_rng(1)
    world = rng.normal(size=(N_POINTS, 3))
    world /= np.linalg.norm(world, axis=1)[:, None]
    first = np.array([0, 1, 5003, 5003, 17_777, 30_011, 39_999])
    origin = rng.uniform(-2, 2, (len(first), 3))
    x, y, z = np.ascontiguousarray((world - np.repeat(origin, np.diff(first, append=N_POINTS), axis=0)).T, np.float32)
    colour = rng.integers(0, 2**32, N_POINTS, np.uint32)
    return ResidentPoints(x, y, z, colour, first, origin, block_spacing=SPACING)


ALL = np.array([(0, N_POINTS, 1)], RENDER_POINT)
SOME = np.array(
    [(30_000, 9_000, 7), (3, 1, 1), (10, 0, 1), (0, 20_000, 3), (4_000, 2_000, 5_000), (39_998, 2, 1)], RENDER_POINT
)


def depths(frame: np.ndarray) -> np.ndarray:
    """float32, NaN where nothing was drawn."""
    return (frame >> np.uint64(32)).astype(np.uint32).view(np.float32)


def pixels_near_borders(points: ResidentPoints, size: PointSize) -> np.ndarray:
    """(HEIGHT, WIDTH) bool: pixels that some square may or may not cover, by its position or its size."""
    u, v, w = project(points, camera(), np.arange(len(points)))
    world = np.full(len(SPACING), size.world)
    world = np.maximum(world, SPACING) if size.adaptive else world
    world = np.repeat(world, np.diff(points.block_first_point, append=N_POINTS))
    side = np.clip(world * camera().focal_px / w, size.pixels, max(size.pixels, size.maximum))
    whole = np.floor(side + 0.5)
    corner = np.stack([u, v]) - 0.5 * (whole - 1)
    near = (np.abs(corner - np.rint(corner)) < BORDER_PX).any(axis=0) | (
        np.abs(side + 0.5 - np.rint(side + 0.5)) < 1e-4
    )
    mask = np.zeros((HEIGHT, WIDTH), bool)
    for i in np.flatnonzero(near):
        (x, y), s = np.floor(corner[:, i]).astype(int), int(whole[i]) + 2
        mask[max(y - 1, 0) : max(y - 1 + s, 0), max(x - 1, 0) : max(x - 1 + s, 0)] = True
    return mask


@pytest.mark.gl
@pytest.mark.skipif(not AVAILABLE, reason=REASON)
class TestOnDevice:
    @pytest.mark.parametrize("size", SIZES)
    @pytest.mark.parametrize("entries", [ALL, SOME], ids=["all", "some"])
    def test_compute_frames_equal_those_of_cpu_but_for_rounding(self, points, size, entries):
        with (
            GlComputeRasterizer(points, WIDTH, HEIGHT, size) as ours,
            CpuRasterizer(points, WIDTH, HEIGHT, size) as cpu,
        ):
            differing = (ours.draw(camera(), entries) != cpu.draw(camera(), entries)).sum()
        # llvmpipe rounds every operation as the CPU does; a GPU's division may be off by some units in the last place
        assert differing <= (0 if is_software(ours.device) else 0.002 * WIDTH * HEIGHT)

    @pytest.mark.parametrize("size", SIZES)
    def test_compute_frames_differ_from_float64_only_where_a_point_touches_a_border(self, points, size):
        with GlComputeRasterizer(points, WIDTH, HEIGHT, size) as ours:
            depth = depths(ours.draw(camera(), ALL))
        expected = depths(reference_frame(points, camera(), ALL, size))
        moved = ~np.isclose(depth, expected, rtol=1e-6, atol=0, equal_nan=True)
        assert not (moved & ~pixels_near_borders(points, size)).any()
        assert moved.sum() <= 0.002 * WIDTH * HEIGHT

    @pytest.mark.parametrize("size", SIZES)
    @pytest.mark.parametrize("entries", [ALL, SOME], ids=["all", "some"])
    def test_gl_points_differ_only_where_depths_are_within_the_depth_test(self, points, size, entries):
        with GlComputeRasterizer(points, WIDTH, HEIGHT, size) as compute:
            best = compute.draw(camera(), entries).copy()
        with GlPointsRasterizer(points, WIDTH, HEIGHT, size) as baseline:
            frame = baseline.draw(camera(), entries)
        np.testing.assert_array_equal(frame == FRAMEBUFFER_EMPTY, best == FRAMEBUFFER_EMPTY)
        np.testing.assert_allclose(depths(frame), depths(best), rtol=4e-6)
        assert (frame != best).sum() <= 0.01 * WIDTH * HEIGHT

    def test_chunks_and_batches_do_not_show(self, points, monkeypatch):
        for rasterizer in (GlComputeRasterizer, GlPointsRasterizer):
            with rasterizer(points, WIDTH, HEIGHT) as whole:
                expected = whole.draw(camera(), SOME).copy()
            with monkeypatch.context() as patch:
                patch.setattr(gl_resident, "storage_limit", lambda _: WIDTH * HEIGHT * 8)
                patch.setattr(gl, "_BATCH_PIECES", 10)
                patch.setattr(gl, "_PIECE_POINTS", 100)
                with rasterizer(points, WIDTH, HEIGHT) as split:
                    np.testing.assert_array_equal(split.draw(camera(), SOME), expected)

    def test_two_passes_equal_one_pass_of_64_bit_atomics(self, points):
        with GlComputeRasterizer(points, WIDTH, HEIGHT) as whatever_the_driver_has:
            expected = whatever_the_driver_has.draw(camera(), ALL).copy()
        with GlComputeRasterizer(points, WIDTH, HEIGHT, two_passes=True) as two_passes:
            assert two_passes.passes == 2
            np.testing.assert_array_equal(two_passes.draw(camera(), ALL), expected)

    @BOTH
    def test_more_pieces_than_one_dispatch_dimension_holds(self, points, rasterizer):
        single = np.zeros(70_000, RENDER_POINT)
        single["offset"] = np.arange(70_000) % N_POINTS
        single["range"] = single["stride"] = 1
        with rasterizer(points, WIDTH, HEIGHT) as ours:
            expected = ours.draw(camera(), ALL).copy()
            np.testing.assert_array_equal(ours.draw(camera(), single), expected)

    def test_equal_depths_go_to_the_least_colour(self):
        colour = np.random.default_rng(2).permutation(np.arange(5, 5005, dtype=np.uint32))
        same = np.zeros(5000, np.float32)
        pile = ResidentPoints(same, same, same, colour, np.zeros(1, np.int64), np.zeros((1, 3)))
        with GlComputeRasterizer(pile, WIDTH, HEIGHT) as ours:
            frame = ours.draw(camera(), np.array([(0, 5000, 1)], RENDER_POINT))
        drawn = frame[frame != FRAMEBUFFER_EMPTY]
        assert (drawn & np.uint64(0xFFFF_FFFF)).tolist() == [5]

    @BOTH
    def test_row_0_is_on_top(self, rasterizer):
        one = ResidentPoints(
            np.zeros(1, np.float32), np.zeros(1, np.float32), np.ones(1, np.float32),
            np.array([7], np.uint32), np.zeros(1, np.int64), np.zeros((1, 3)),
        )  # fmt: skip
        with rasterizer(one, WIDTH, HEIGHT) as ours:
            frame = ours.draw(camera(), np.array([(0, 1, 1)], RENDER_POINT))
        drawn = np.flatnonzero((frame != FRAMEBUFFER_EMPTY).any(axis=1))
        assert len(drawn) == 1
        assert drawn[0] < HEIGHT / 4

    @BOTH
    def test_points_without_a_place_are_not_drawn(self, rasterizer):
        odd = np.array([np.nan, np.inf, -np.inf, 3e38, -3e38], np.float32)
        x, y, z = np.ascontiguousarray(np.stack(np.meshgrid(odd, odd, odd)).reshape(3, -1))
        cloud = ResidentPoints(x, y, z, np.zeros(len(x), np.uint32), np.zeros(1, np.int64), np.zeros((1, 3)))
        entries = np.array([(0, len(x), 1)], RENDER_POINT)
        with CpuRasterizer(cloud, WIDTH, HEIGHT) as cpu, rasterizer(cloud, WIDTH, HEIGHT) as ours:
            expected = cpu.draw(camera(), entries) != FRAMEBUFFER_EMPTY
            np.testing.assert_array_equal(ours.draw(camera(), entries) != FRAMEBUFFER_EMPTY, expected)

    @BOTH
    def test_a_scene_far_from_the_origin_gives_the_same_bits(self, points, rasterizer):
        shift = np.array([6_400_000.0, -6_400_000.0, 6_400_000.0])  # sums with multiples of 2⁻²⁰ are exact
        near = replace(points, block_origin=np.round(points.block_origin * 2**20) / 2**20)
        far = replace(near, block_origin=near.block_origin + shift)
        eye = np.array([0.25, -3.0, 0.5])
        with rasterizer(near, WIDTH, HEIGHT) as here, rasterizer(far, WIDTH, HEIGHT) as there:
            expected = here.draw(camera(eye), ALL)
            np.testing.assert_array_equal(there.draw(camera(eye + shift, shift), ALL), expected)

    @BOTH
    def test_two_rasterizers_take_turns_and_close_in_any_order(self, points, rasterizer):
        first, second = rasterizer(points, WIDTH, HEIGHT), GlComputeRasterizer(points, WIDTH, HEIGHT)
        with second:
            expected = first.draw(camera(), ALL).copy()
            assert (second.draw(camera(), SOME) != FRAMEBUFFER_EMPTY).any()
            np.testing.assert_array_equal(first.draw(camera(), ALL), expected)
            first.close()
            first.close()
            assert (second.draw(camera(), SOME) != FRAMEBUFFER_EMPTY).any()

    @BOTH
    def test_nothing_to_draw_is_an_empty_frame(self, points, rasterizer):
        nothing = np.empty(0, np.float32)
        empty = ResidentPoints(
            nothing, nothing, nothing, np.empty(0, np.uint32), np.zeros(1, np.int64), np.zeros((1, 3))
        )
        for cloud in (points, empty):
            with rasterizer(cloud, WIDTH, HEIGHT) as ours:
                assert (ours.draw(camera(), ALL[:0]) == FRAMEBUFFER_EMPTY).all()

    @BOTH
    def test_bad_messages_are_refused(self, points, rasterizer):
        with rasterizer(points, WIDTH, HEIGHT) as ours:
            for bad in [(0, N_POINTS + 1, 1), (0, 5, 0), (2**63, 1, 1)]:
                with pytest.raises(MessageError, match="entry 0: found offset"):
                    ours.draw(camera(), np.array([bad], RENDER_POINT))
            with pytest.raises(MessageError, match="viewport: found 7×100"):
                ours.draw(replace(camera(), width=7), ALL)

    @BOTH
    def test_adaptive_sizes_need_spacings(self, points, rasterizer):
        with pytest.raises(InputError, match="found no spacing of the points of each block"):
            rasterizer(replace(points, block_spacing=None), WIDTH, HEIGHT, PointSize(adaptive=True))

    @BOTH
    def test_a_bad_viewport_is_refused(self, points, rasterizer):
        for width in (0, 10**6):
            with pytest.raises(InputError, match=f"viewport: found {width}×{HEIGHT}"):
                rasterizer(points, width, HEIGHT)

    @BOTH
    def test_points_take_16_bytes_each(self, points, rasterizer):
        with rasterizer(points, WIDTH, HEIGHT) as ours:
            assert ours.resident_bytes == 16 * N_POINTS

    def test_a_frame_above_the_storage_limit_is_refused(self, points, monkeypatch):
        monkeypatch.setattr(gl_resident, "storage_limit", lambda _: 1 << 24)
        with pytest.raises(DeviceError, match="found 33554432 bytes of framebuffer, expected at most 16777216"):
            GlComputeRasterizer(points, 2048, 2048)

    def test_a_point_size_above_the_drivers_is_refused(self, points):
        with pytest.raises(DeviceError, match="found point size 30000 px"):
            GlPointsRasterizer(points, WIDTH, HEIGHT, PointSize(30_000))

    @BOTH
    def test_the_environment_chooses_the_device(self, points, rasterizer, monkeypatch):
        with pytest.raises(DeviceError, match="EGL device 99: requested"):
            rasterizer(points, WIDTH, HEIGHT, device_index=99)
        monkeypatch.setenv("GLCONTEXT_DEVICE_INDEX", "98")
        with pytest.raises(DeviceError, match="EGL device 98: requested"):
            rasterizer(points, WIDTH, HEIGHT, device_index=0)

    def test_an_opengl_error_is_raised(self, points):
        with GlComputeRasterizer(points, WIDTH, HEIGHT) as ours:
            ours._most_groups = 10**6  # what the driver refuses without a word
            single = np.zeros(70_000, RENDER_POINT)
            single["range"] = single["stride"] = 1
            with pytest.raises(DeviceError, match="GL_INVALID_VALUE while drawing"):
                ours.draw(camera(), single)
            assert (ours.draw(camera(), ALL) != FRAMEBUFFER_EMPTY).any()


@pytest.fixture
def fresh_probe():
    gl_available.cache_clear()
    yield
    gl_available.cache_clear()


@pytest.mark.usefixtures("fresh_probe")
class TestAvailability:
    def test_names_the_missing_package(self, monkeypatch):
        monkeypatch.setattr(gl_context, "_LIBRARY", "libNoSuchEGL.so.1")
        available, reason = gl_available()
        assert not available
        assert "libNoSuchEGL.so.1 is missing" in reason
        assert "apt install libegl1 libgl1-mesa-dri" in reason

    def test_names_the_missing_extra(self, monkeypatch):
        monkeypatch.setattr(gl_context, "find_spec", lambda _: None)
        available, reason = gl_available()
        assert not available
        assert "pip install 'splatpipe[gl]'" in reason

    def test_survives_a_driver_that_crashes(self, monkeypatch):
        crash = [sys.executable, "-c", "import os; os.abort()"]
        run = subprocess.run
        monkeypatch.setattr(gl_context, "_check_installed", lambda: None)
        monkeypatch.setattr(gl_context.subprocess, "run", lambda _, **options: run(crash, **options))
        assert gl_available() == (False, "OpenGL: the driver crashed (signal 6)")

    def test_is_false_without_a_device(self, monkeypatch):
        monkeypatch.setenv("GLCONTEXT_DEVICE_INDEX", "99")
        available, reason = gl_available()
        assert not available
        assert "\n" not in reason
        assert reason.startswith("OpenGL: ")

    def test_knows_software_drivers(self):
        assert is_software("llvmpipe (LLVM 15.0.6, 256 bits)")
        assert not is_software("NVIDIA H100 80GB HBM3/PCIe/SSE2")
