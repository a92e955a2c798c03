"""The compiled CPU rasterizer against its NumPy twins."""

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.nodes.raster import PointSize, ResidentPoints, pixel_from_blocks
from splatpipe.nodes.raster.cpu import CpuRasterizer
from splatpipe.nodes.raster.reference import point_indices, project, project_float32, reference_frame
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.errors import InputError, MessageError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT

SIZES = [
    PointSize(),
    PointSize(2),
    PointSize(3),
    PointSize(1, world=0.02, maximum=9),
    PointSize(2, world=0.05, maximum=6),
]


def cloud(n, blocks=7, seed=0, offset=(0.0, 0.0, 0.0)):
    """Points in a unit cube around ``offset``, in blocks of uneven length; a point's colour is its number."""
    rng = np.random.default_rng(seed)
    first = np.unique(np.r_[0, rng.integers(0, n + 1, blocks - 1)]) if n else np.zeros(1, np.int64)
    world = rng.uniform(-1, 1, (n, 3))
    origin = rng.uniform(-1, 1, (len(first), 3))
    block = np.searchsorted(first, np.arange(n), side="right") - 1
    x, y, z = (world - origin[block]).astype(np.float32).T
    return ResidentPoints(
        *map(np.ascontiguousarray, (x, y, z)), np.arange(n, dtype=np.uint32), first, origin + np.asarray(offset)
    )


def camera(width, height, eye=(1.5, -2.5, 1.2), target=(0.0, 0.0, 0.0), near=0.1, frame=0):
    pose = look_at(np.array(eye), np.array(target), np.array([0.0, 0.0, 1.0]))
    return perspective_camera(frame=frame, world_from_camera=pose, fov_y_rad=0.9, width=width, height=height, near=near)


def render_points(*entries):
    return np.array(list(entries), RENDER_POINT)


def draw(points, view, entries, size=SIZES[0], threads=1):
    with CpuRasterizer(points, view.width, view.height, size, threads) as rasterizer:
        return rasterizer.draw(view, entries).copy()


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("threads", [1, 2, 3, 5])
def test_equals_the_float32_twin_word_by_word(size, threads):
    points, view = cloud(40_000), camera(211, 97)
    entries = render_points((0, 40_000, 1))
    expected = reference_frame(points, view, entries, size, project_float32)
    assert (expected != FRAMEBUFFER_EMPTY).sum() > 2000
    np.testing.assert_array_equal(draw(points, view, entries, size, threads), expected)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    entries=st.lists(
        st.tuples(st.integers(0, 4999), st.integers(0, 5000), st.integers(1, 700)), min_size=0, max_size=6
    ),
    size=st.sampled_from(SIZES),
    threads=st.sampled_from([1, 2, 3]),
)
def test_any_entries_equal_the_twin(entries, size, threads):
    """Odd offsets, lengths and strides, over block borders, overlapping, empty."""
    points, view = cloud(5000, blocks=9), camera(61, 53)
    entries = render_points(*((o, min(r, 5000 - o), s) for o, r, s in entries))
    expected = reference_frame(points, view, entries, size, project_float32)
    np.testing.assert_array_equal(draw(points, view, entries, size, threads), expected)


@pytest.mark.parametrize("side", [4, 5, 6, 63, 64, 65, 150])
def test_squares_over_several_runs_are_merged_whole(side):
    """Two frames, so that a run that one of them drew to and did not mark would be seen."""
    points, view = cloud(300), camera(400, 90)
    with CpuRasterizer(points, 400, 90, PointSize(side), threads=2) as rasterizer:
        for entries in (render_points((0, 300, 1)), render_points((3, 200, 50))):
            expected = reference_frame(points, view, entries, PointSize(side), project_float32)
            np.testing.assert_array_equal(rasterizer.draw(view, entries), expected)


def test_a_point_is_rounded_alike_wherever_it_stands():
    """Vector body and remainder: each point alone gives the words that all of them give together."""
    points, view = cloud(301, blocks=1), camera(64, 64)
    together = draw(points, view, render_points((0, 301, 1)))
    with CpuRasterizer(points, 64, 64, threads=1) as rasterizer:
        alone = np.full((64, 64), FRAMEBUFFER_EMPTY)
        for i in range(301):
            np.minimum(alone, rasterizer.draw(view, render_points((i, 1, 1))), out=alone)
    np.testing.assert_array_equal(alone, together)


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_differs_from_float64_only_at_pixel_borders(size):
    points, view = cloud(60_000), camera(400, 300)
    entries = render_points((0, 60_000, 1))
    found = draw(points, view, entries, size)
    expected = reference_frame(points, view, entries, size)
    colour, expected_colour = found.astype(np.uint32), expected.astype(np.uint32)
    differing = colour != expected_colour
    assert differing.sum() <= 0.005 * (expected != FRAMEBUFFER_EMPTY).sum()

    u, v, w = project(points, view, np.arange(60_000))
    side = np.clip(size.world * view.focal_px / w, size.pixels, max(size.pixels, size.maximum))
    corner = np.stack([u, v]) - (np.floor(side + 0.5) - 1) / 2
    to_border = np.abs(corner - np.rint(corner)).min(axis=0)
    to_next_side = np.abs(side - np.floor(side) - 0.5)
    rounded = (to_border < 0.01) | (to_next_side < 0.01)  # the colour of a point is its number
    involved = np.stack([colour[differing], expected_colour[differing]])
    explained = (rounded[np.minimum(involved, 59_999)] & (involved != 0xFFFF_FFFF)).any(axis=0)
    assert explained.all()

    same = ~differing & (expected != FRAMEBUFFER_EMPTY)
    depth, expected_depth = ((f[same] >> np.uint64(32)).astype(np.uint32).view(np.float32) for f in (found, expected))
    np.testing.assert_allclose(depth, expected_depth, rtol=2e-6)


@pytest.mark.parametrize("offset", [0.0, 6.4e6, -6.4e6])
def test_far_from_the_world_origin_no_point_moves(offset):
    points = cloud(20_000, offset=(offset,) * 3)
    view = camera(1920, 1080, eye=np.array([1.5, -2.5, 1.2]) + offset, target=np.full(3, offset))
    index = np.arange(20_000)
    u, v, _ = project_float32(points, view, index)
    exact_u, exact_v, w = project(points, view, index)
    assert np.hypot(u - exact_u, v - exact_v)[w > 0.1].max() < 0.01


def test_moved_scene_is_the_same_picture():
    """Block origins and eye on a grid that survives the move exactly: every word is the same."""
    step = 6.4e6
    points, eye = cloud(20_000), np.array([1.5, -2.5, 1.25])
    points.block_origin[:] = np.round(points.block_origin * 1024) / 1024
    still = camera(300, 200, eye)
    moved = camera(300, 200, eye + step, np.full(3, step))
    entries = render_points((0, 20_000, 1))
    frame = draw(points, still, entries)
    points.block_origin[:] += step
    np.testing.assert_array_equal(draw(points, moved, entries), frame)


def test_frames_do_not_leak_into_each_other():
    """Framebuffers are reused, and as many of them as the frame is worth."""
    points, view = cloud(40_000), camera(80, 60)
    with CpuRasterizer(points, 80, 60, threads=3) as rasterizer:
        for entries in (
            render_points((0, 40_000, 1)),
            render_points((5, 3, 1)),
            render_points(),
            render_points((100, 39_000, 1)),
            render_points((0, 40_000, 777)),
        ):
            expected = reference_frame(points, view, entries, projection=project_float32)
            np.testing.assert_array_equal(rasterizer.draw(view, entries), expected)


def test_a_failed_frame_does_not_leak_into_the_next(monkeypatch):
    from splatpipe.nodes.raster import kernels

    points, view = cloud(40_000), camera(80, 60)
    few = render_points((5, 3, 1))
    with CpuRasterizer(points, 80, 60, threads=2) as rasterizer:
        with monkeypatch.context() as patch:
            patch.setattr(kernels, "merge", None)
            with pytest.raises(TypeError):
                rasterizer.draw(view, render_points((0, 40_000, 1)))
        expected = reference_frame(points, view, few, projection=project_float32)
        np.testing.assert_array_equal(rasterizer.draw(view, few), expected)


@pytest.mark.parametrize("size", [PointSize(), PointSize(5), PointSize(1, world=1.0, maximum=8)], ids=str)
def test_points_that_have_no_pixel(size):
    """Behind the camera, at w = 0, nearer than near, beyond float32."""
    eye = np.array([0.0, 0.0, 0.0])
    view = camera(32, 32, eye, (0.0, 1.0, 0.0), near=0.5)
    y = np.array([-1.0, 0.0, 0.4, 0.0, 3e38, 3e38, -3e38], np.float32)
    x = np.array([0.0, 0.0, 0.0, 1.0, 3e38, -3e38, 0.0], np.float32)
    z = np.array([0.0, 0.0, 0.0, 0.0, 3e38, 3e38, 3e38], np.float32)
    points = ResidentPoints(x, y, z, np.zeros(7, np.uint32), np.zeros(1, np.int64), np.array([[0.0, 0.0, 0.0]]))
    with np.errstate(over="ignore"):
        frame = draw(points, view, render_points((0, 4, 1)), size)
        assert (frame == FRAMEBUFFER_EMPTY).all()
        expected = reference_frame(points, view, render_points((0, 7, 1)), size, project_float32)
        np.testing.assert_array_equal(draw(points, view, render_points((0, 7, 1)), size), expected)


@pytest.mark.parametrize(
    ("size", "columns"), [(1, [4]), (2, [4, 5]), (3, [3, 4, 5]), (4, [3, 4, 5, 6]), (7, [1, 2, 3, 4, 5, 6, 7])]
)
def test_square_is_centred(size, columns):
    """A point at u = 4.6 covers the pixels whose centres lie within half a side of it."""
    view = camera(9, 9, (0.0, -1.0, 0.0))
    side_px = 1 / view.focal_px  # world units a pixel covers at depth 1
    x, z = np.float32([0.1 * side_px]), np.float32([-0.1 * side_px])
    points = ResidentPoints(
        x, np.zeros(1, np.float32), z, np.zeros(1, np.uint32), np.zeros(1, np.int64), np.zeros((1, 3))
    )
    frame = draw(points, view, render_points((0, 1, 1)), PointSize(size))
    rows, found = np.nonzero(frame != FRAMEBUFFER_EMPTY)
    assert sorted(set(found)) == columns
    assert sorted(set(rows)) == columns
    assert len(found) == size**2


def test_square_partly_outside_is_drawn_where_it_is_seen():
    view = camera(8, 8, (0.0, -1.0, 0.0))
    pixel = 1 / view.focal_px
    x = np.float32([-5.0 * pixel])  # u = −1
    points = ResidentPoints(
        x, np.zeros(1, np.float32), np.zeros(1, np.float32), np.zeros(1, np.uint32), np.zeros(1, np.int64),
        np.zeros((1, 3)),
    )  # fmt: skip
    assert (draw(points, view, render_points((0, 1, 1))) == FRAMEBUFFER_EMPTY).all()
    rows, columns = np.nonzero(draw(points, view, render_points((0, 1, 1)), PointSize(5)) != FRAMEBUFFER_EMPTY)
    assert set(columns) == {0, 1}
    assert len(rows) == 10


def test_attenuated_side_halves_with_twice_the_depth():
    view = camera(200, 200, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    world = 16 / view.focal_px
    covered = []
    for depth in (1.0, 2.0, 4.0, 64.0, 0.2):
        one = np.zeros(1, np.float32)
        points = ResidentPoints(
            one, np.float32([depth]), one, np.zeros(1, np.uint32), np.zeros(1, np.int64), np.zeros((1, 3))
        )
        frame = draw(points, view, render_points((0, 1, 1)), PointSize(2, world, maximum=20))
        covered.append(int((frame != FRAMEBUFFER_EMPTY).sum()))
    assert covered == [16**2, 8**2, 4**2, 2**2, 20**2]


def test_nothing_to_draw():
    empty = ResidentPoints(
        *[np.empty(0, np.float32)] * 3, np.empty(0, np.uint32), np.zeros(1, np.int64), np.zeros((1, 3))
    )
    assert (draw(empty, camera(5, 3), render_points()) == FRAMEBUFFER_EMPTY).all()
    assert (draw(cloud(10), camera(5, 3), render_points((3, 0, 1))) == FRAMEBUFFER_EMPTY).all()


def test_one_pixel_viewport_keeps_the_nearest_point():
    points, view = cloud(5000), camera(1, 1)
    entries = render_points((0, 5000, 1))
    frame = draw(points, view, entries, threads=2)
    u, v, w = project(points, view, np.arange(5000))
    inside = (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
    assert frame.astype(np.uint32)[0, 0] == np.flatnonzero(inside)[w[inside].argmin()]


def test_equal_depths_are_broken_by_the_smaller_colour_word():
    one = np.zeros(3, np.float32)
    points = ResidentPoints(one, one, one, np.uint32([9, 4, 7]), np.zeros(1, np.int64), np.zeros((1, 3)))
    assert draw(points, camera(1, 1), render_points((0, 3, 1))).astype(np.uint32)[0, 0] == 4


def test_memory_mapped_read_only_points(tmp_path):
    points, view, entries = cloud(3000), camera(40, 30), render_points((0, 3000, 1))
    columns = []
    for name in ("x", "y", "z", "colour"):
        np.save(tmp_path / f"{name}.npy", getattr(points, name))
        columns.append(np.load(tmp_path / f"{name}.npy", mmap_mode="r"))
    mapped = ResidentPoints(*columns, points.block_first_point, points.block_origin)
    received = np.frombuffer(entries.tobytes(), RENDER_POINT)
    np.testing.assert_array_equal(draw(mapped, view, received), draw(points, view, entries))


@pytest.mark.parametrize(
    "entry", [(0, 10, 0), (0, 11, 1), (11, 0, 1), (10, 1, 1), (2**64 - 1, 1, 1), (2**63, 2**32 - 1, 1)]
)
def test_malformed_entries_are_refused(entry):
    with pytest.raises(MessageError, match="render-points entry 1: found offset"):
        draw(cloud(10), camera(4, 4), render_points((0, 10, 1), entry))


def test_wrong_viewport_and_sizes_are_refused():
    points = cloud(10)
    with (
        CpuRasterizer(points, 4, 5, threads=1) as rasterizer,
        pytest.raises(MessageError, match="camera viewport: found 5×4, expected 4×5"),
    ):
        rasterizer.draw(camera(5, 4), render_points())
    with pytest.raises(InputError, match="viewport: found 0×3"):
        CpuRasterizer(points, 0, 3)
    with pytest.raises(InputError, match="threads: found 0"):
        CpuRasterizer(points, 3, 3, threads=0)


@pytest.mark.parametrize("size", [(0,), (1, 0.0, 0), (1, -1.0), (1, np.nan), (1, np.inf), (40_000,)])
def test_impossible_point_sizes_are_refused(size):
    with pytest.raises(InputError, match="point size: found"):
        PointSize(*size)


def test_indices_of_entries():
    entries = render_points((4, 0, 1), (2, 7, 3), (0, 2, 1), (9, 1, 100))
    assert point_indices(entries).tolist() == [2, 5, 8, 0, 1, 9]


def test_rows_are_rounded_once():
    points, view = cloud(10), camera(640, 480)
    m = view.pixel_from_world
    expected = np.concatenate(
        [np.broadcast_to(m[:, :3], (len(points.block_origin), 3, 3)),
         (points.block_origin @ m[:, :3].T + m[:, 3])[:, :, None]], axis=2
    )  # fmt: skip
    np.testing.assert_allclose(pixel_from_blocks(view, points.block_origin), expected, rtol=1e-6, atol=1e-4)


def run_python(code, **environment):
    return subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **environment}, capture_output=True, text=True, check=True
    ).stdout


def test_kernels_are_compiled_once_also_by_processes_that_start_together(tmp_path):
    code = (
        "import numpy as np\n"
        "from splatpipe.nodes.raster import ResidentPoints, kernels\n"
        "from splatpipe.nodes.raster.cpu import CpuRasterizer, kernels_cached\n"
        "from splatpipe.shared.camera import Camera\n"
        "from splatpipe.shared.messages import RENDER_POINT\n"
        "one = np.ones(1, np.float32)\n"
        "points = ResidentPoints(one, one, one, np.ones(1, np.uint32), np.zeros(1, np.int64), np.zeros((1, 3)))\n"
        "before = kernels_cached()\n"
        "with CpuRasterizer(points, 1, 1) as rasterizer:\n"
        "    rasterizer.draw(Camera(0, np.eye(4), np.zeros(3), 1, 1, 0.1), np.empty(0, RENDER_POINT))\n"
        "print(before, kernels_cached(), sum(kernels.draw.stats.cache_hits.values()))"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    def start():
        return subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True)

    for process in [start(), start()]:
        out, _ = process.communicate(timeout=100)
        assert process.returncode == 0
        assert out.split()[1] == "True"
    assert start().communicate(timeout=100)[0].split() == ["True", "True", "1"]


def test_drawing_nothing_compiles_all_that_drawing_needs():
    from splatpipe.nodes.raster import kernels, pieces

    def variants():
        return [list(kernel.signatures) for kernel in (kernels.draw, kernels.merge, pieces._split)]

    draw(cloud(5000), camera(61, 53), render_points())
    before = variants()
    for size in SIZES:
        for threads in (1, 2):
            draw(cloud(5000), camera(61, 53), render_points((0, 5000, 1), (1, 4000, 7)), size, threads)
    assert variants() == before
