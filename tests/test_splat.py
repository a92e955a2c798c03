"""Splats on the CPU: against the float64 reference, for any number of threads, and what quads stand for."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from rich.console import Console
from splatpipe.cluster.bench.splats import bench_splats, print_splats
from splatpipe.cluster.job import Job
from splatpipe.nodes.raster import CellFeatures, PointSize, ResidentPoints, SplatSettings
from splatpipe.nodes.raster.choose import make_rasterizer
from splatpipe.nodes.raster.splat import CpuSplatRasterizer
from splatpipe.nodes.raster.splat_geometry import LIGHT, EyeFrame, drawn_cells
from splatpipe.nodes.raster.splat_reference import splat_frame
from splatpipe.nodes.raster.splat_tiles import WEIGHT
from splatpipe.nodes.sampling import SamplingNode
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.camera import Camera, look_at, perspective_camera
from splatpipe.shared.config import RunConfig
from splatpipe.shared.errors import ConfigError, DeviceError, InputError, MessageError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT, VisibilityBits
from splatpipe.shared.octree import CORNER, FLAT
from splatpipe.shared.octree import EDGE as EDGE_CELL
from splatpipe.shared.points import NO_NORMAL, pack_normals, pack_radii, pack_rgb
from splatpipe.shared.store import Scene

from .build_sources import ArraySource

EDGE = 4.0


def resident(
    positions: np.ndarray,
    normals: np.ndarray,
    radii: np.ndarray,
    rgb: np.ndarray,
) -> ResidentPoints:
    """Points in two blocks."""
    n = len(positions)
    origins = np.array([[0.5, 0.0, -0.25], [-0.5, 0.25, 0.0]])
    first = np.array([0, n // 2])
    block = (np.arange(n) >= n // 2).astype(int) if n > 1 else np.ones(n, int)
    local = (positions - origins[block]).astype(np.float32)
    return ResidentPoints(
        *np.ascontiguousarray(local.T),
        pack_rgb(*np.asarray(rgb, np.uint8).T),
        first,
        origins,
        normal=pack_normals(normals),
        radius=pack_radii(radii, EDGE),
        root_edge=EDGE,
    )


def sphere(n: int, radius: float, seed: int = 0) -> ResidentPoints:
    """Points on the unit sphere with their normals."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return resident(d, d, np.full(n, radius), rng.integers(0, 256, (n, 3)))


def camera(width: int, height: int, eye: tuple[float, float, float] = (0.3, -3.0, 0.8), near: float = 0.01) -> Camera:
    pose = look_at(np.array(eye), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.9, width=width, height=height, near=near)


def all_of(points: ResidentPoints) -> np.ndarray:
    return np.array([(0, len(points), 1)], RENDER_POINT)


def draw(
    points: ResidentPoints, view: Camera, entries: np.ndarray, how: SplatSettings, threads: int | None = 2
) -> np.ndarray:
    with CpuSplatRasterizer(points, view.width, view.height, how, threads) as rasterizer:
        return rasterizer.draw(view, entries).copy()


def colours(words: np.ndarray) -> np.ndarray:
    return (words & np.uint64(0xFFFF_FFFF)).astype(np.uint32).view(np.uint8).reshape(*words.shape, 4).astype(int)


def depths(words: np.ndarray) -> np.ndarray:
    return (words >> np.uint64(32)).astype(np.uint32).view(np.float32)


def expect_same_picture(fast: np.ndarray, slow: np.ndarray, allowed: float = 0.001) -> None:
    """Coverage, colours and depths agree but for a share of pixels (at least two) at the border of a splat or of ε."""
    covered, expected = fast != FRAMEBUFFER_EMPTY, slow != FRAMEBUFFER_EMPTY
    limit = max(2, allowed * fast.size)
    assert (covered != expected).sum() <= limit
    both = covered & expected
    if both.any():
        difference = np.abs(colours(fast) - colours(slow))[both].max(axis=1)
        assert (difference > 1).sum() <= limit
        assert (np.abs(depths(fast) / depths(slow) - 1)[both] > 1e-5).sum() <= limit


@st.composite
def clouds(draw_: st.DrawFn) -> tuple[ResidentPoints, np.ndarray]:
    """Up to 60 splats of all sizes, some without normals, and entries that draw some of them in any order."""
    rng = np.random.default_rng(draw_(st.integers(0, 2**32 - 1)))
    n = draw_(st.integers(1, 60))
    normals = rng.normal(size=(n, 3))
    normals[rng.random(n) < 0.2] = 0
    positions = rng.uniform(-1, 1, (n, 3)) * draw_(st.sampled_from([1.0, 0.1, 3.0]))
    points = resident(positions, normals, 10.0 ** rng.uniform(-4, 0, n), rng.integers(0, 256, (n, 3)))
    first = rng.integers(0, n, 3)
    rows = [(f, rng.integers(1, n - f + 1), s) for f, s in zip(first, rng.integers(1, 4, 3), strict=True)]
    return points, np.array(rows, RENDER_POINT)


@settings(max_examples=40, deadline=None)
@given(
    clouds(),
    st.tuples(st.integers(1, 150), st.integers(1, 100)),
    st.builds(
        SplatSettings,
        radius_scale=st.sampled_from([1.0, 0.3, 5.0]),
        depth_offset=st.sampled_from([0.0, 1.0, 100.0]),
        lighting=st.booleans(),
    ),
)
def test_any_splats_are_drawn_as_the_reference_does(cloud, size, how):
    points, entries = cloud
    view = camera(*size)
    expect_same_picture(draw(points, view, entries, how), splat_frame(points, view, entries, how), allowed=0.005)


@pytest.mark.parametrize("radius", [0.2, 0.05, 0.001])
def test_a_surface_is_drawn_as_the_reference_does(radius):
    points, view = sphere(4000, radius), camera(200, 150)
    fast, slow = (f(points, view, all_of(points), SplatSettings()) for f in (draw, splat_frame))
    assert (slow != FRAMEBUFFER_EMPTY).mean() > 0.1
    expect_same_picture(fast, slow)
    both = (fast != FRAMEBUFFER_EMPTY) & (slow != FRAMEBUFFER_EMPTY)
    assert np.abs(colours(fast) - colours(slow))[both].mean() < 0.01


def test_far_from_the_origin_is_as_near_to_it():
    points = sphere(2000, 0.1)
    far = np.array([4e6, -3e6, 5e5])
    moved = replace(points, block_origin=points.block_origin + far)
    view, pose = camera(120, 90), look_at(np.array([0.3, -3.0, 0.8]) + far, far, np.array([0.0, 0.0, 1.0]))
    there = perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.9, width=120, height=90, near=0.01)
    expect_same_picture(
        draw(moved, there, all_of(points), SplatSettings()), draw(points, view, all_of(points), SplatSettings())
    )


@pytest.mark.parametrize("threads", [1, 3, 7])
@pytest.mark.parametrize("features", [False, True])
def test_any_number_of_threads_gives_the_same_bits(threads, features):
    points = replace(sphere(30_000, 0.03), features=wall(64).features) if features else sphere(30_000, 0.03)
    view, how = camera(333, 222), SplatSettings(features=features)
    entries = np.array([(0, 20_000, 1), (25_000, 5_000, 3), (100, 4_000, 1)], RENDER_POINT)
    expected = draw(points, view, entries, how, threads=2)
    np.testing.assert_array_equal(draw(points, view, entries, how, threads), expected)


def test_a_frame_does_not_depend_on_those_before():
    points, how = sphere(5000, 0.05), SplatSettings()
    views = [camera(130, 70), camera(130, 70, (0.1, -0.9, 0.1)), camera(130, 70)]
    with CpuSplatRasterizer(points, 130, 70, how) as rasterizer:
        for view in views:
            frame = rasterizer.draw(view, all_of(points))
            np.testing.assert_array_equal(frame, draw(points, view, all_of(points), how))
        assert (rasterizer.draw(views[0], np.empty(0, RENDER_POINT)) == FRAMEBUFFER_EMPTY).all()


def test_splats_close_the_gaps_between_points():
    points, view = sphere(3000, 0.12), camera(160, 120)
    with make_rasterizer("cpu", points, 160, 120, PointSize(), 1) as plain:
        holes = (plain.draw(view, all_of(points)) == FRAMEBUFFER_EMPTY).copy()
    row, column = np.mgrid[:120, :160]
    inside = np.hypot(row - 60, column - 80) < 35
    assert holes[inside].mean() > 0.3
    assert (draw(points, view, all_of(points), SplatSettings()) != FRAMEBUFFER_EMPTY)[inside].all()


def test_light_is_that_of_the_appendix():
    """One splat that faces the eye on the view axis: ambient and diffuse light, and a highlight, by hand."""
    view = camera(9, 9)
    rotation = EyeFrame.of(view).rotation
    for towards, colour in (([0.0, 0.0, -1.0], (200, 100, 0)), (LIGHT * [1, 1, -1], (10, 20, 30)), (None, (1, 2, 3))):
        normal = np.zeros(3) if towards is None else np.array(towards) @ rotation
        points = resident(np.zeros((1, 3)), normal[None], np.array([0.5]), np.array([colour]))
        n = np.array([0.0, 0.0, -1.0]) if towards is None else np.array(towards) * -np.sign(towards[2])
        half = LIGHT - np.array([0, 0, 1])
        diffuse = max(n @ LIGHT, 0) + 0.2
        highlight = 255 * max(n @ half / np.linalg.norm(half), 0) ** 32
        expected = np.array(colour) if towards is None else np.clip(np.array(colour) * diffuse + highlight, 0, 255)
        found = colours(draw(points, view, all_of(points), SplatSettings()))[4, 4, :3]
        np.testing.assert_allclose(found, expected, atol=1)
        unlit = colours(draw(points, view, all_of(points), SplatSettings(lighting=False)))[4, 4, :3]
        np.testing.assert_array_equal(unlit, colour)


def test_weights_are_a_gaussian():
    rho_2 = np.linspace(0, 1, 10_001)
    assert np.abs(np.polynomial.Polynomial(WEIGHT)(rho_2) * np.exp(2 * rho_2) - 1).max() < 1.1e-4


def wall(n_cells: int, depth: float = 0.0) -> ResidentPoints:
    """A wall of n_cells square cells of 16 points, each a flat cell with a quad that covers it, facing the camera."""
    side = round(n_cells**0.5)
    rng = np.random.default_rng(1)
    step = 1 / side
    corner = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2) / side - 0.5).repeat(16, 0)
    place = corner + rng.uniform(0, step, corner.shape)
    positions = np.column_stack([place[:, 0], np.full(len(place), depth), place[:, 1]])
    centre = corner[::16] + step / 2
    cells = CellFeatures(
        np.arange(n_cells) * 16,
        np.full(n_cells, 16),
        np.full(n_cells, FLAT, np.uint8),
        np.column_stack([centre[:, 0], np.full(n_cells, depth), centre[:, 1]]),
        np.tile(np.array([[step / 2, 0, 0], [0, 0, step / 2]], np.float32), (n_cells, 1, 1)),
    )
    rgb = rng.integers(0, 256, (len(place), 3))
    points = resident(positions, np.tile([0.0, -1.0, 0.0], (len(place), 1)), np.full(len(place), 0.1), rgb)
    return replace(points, features=cells)


@pytest.mark.parametrize("eye", [(0.3, -2.0, 0.8), (0.1, -0.2, 0.0), (0.45, -0.02, 0.1), (0.2, 1.5, 0.1)])
def test_quads_are_drawn_as_the_reference_does(eye):
    """From the front, close up with quads behind the near plane, grazing, and from behind."""
    points, how = wall(64), SplatSettings(features=True)
    view = camera(140, 110, eye, near=0.05)
    entries = np.array([(0, 500, 1), (640, 100, 2)], RENDER_POINT)
    expect_same_picture(draw(points, view, entries, how), splat_frame(points, view, entries, how), allowed=0.003)


def test_one_quad_stands_for_the_points_of_a_flat_cell():
    points, view = wall(64), camera(140, 110)
    entries = np.array([(0, 512, 1), (512, 40, 1), (600, 8, 1)], RENDER_POINT)
    with CpuSplatRasterizer(points, 140, 110, SplatSettings(features=True)) as rasterizer:
        drawn = rasterizer.draw(view, entries).copy()
        counts = rasterizer.counts
    assert (counts.visibility_splats, counts.quads, counts.colour_splats) == (0, 32 + 3 + 1, 560)
    without = draw(points, view, entries, SplatSettings())
    expect_same_picture(drawn, without, allowed=0.01)

    cells = points.features
    assert cells is not None
    corners = replace(points, features=replace(cells, feature=np.full(64, CORNER, np.uint8)))
    np.testing.assert_array_equal(draw(corners, view, entries, SplatSettings(features=True)), without)


def test_a_quad_hides_what_is_behind_it():
    front, back = wall(16), wall(16, depth=0.9)
    n = len(front)
    both = resident(
        np.concatenate([_world(front), _world(back)]),
        np.tile([0.0, -1.0, 0.0], (2 * n, 1)),
        np.full(2 * n, 0.1),
        np.concatenate([np.tile([255, 0, 0], (n, 1)), np.tile([0, 255, 0], (n, 1))]),
    )
    both = replace(both, features=front.features)
    drawn = draw(both, camera(140, 110, (0, -3, 0)), all_of(both), SplatSettings(features=True, lighting=False))
    assert (colours(drawn)[45:65, 60:80, :3] == [255, 0, 0]).all()


def _world(points: ResidentPoints) -> np.ndarray:
    block = np.searchsorted(points.block_first_point, np.arange(len(points)), side="right") - 1
    return np.column_stack([points.x, points.y, points.z]) + points.block_origin[block]


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_drawn_cells_are_those_that_share_a_point(data):
    sizes = data.draw(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 4)), max_size=12))
    first, end, n = [], [], 0
    for gap, size in sizes:
        first, end, n = [*first, n + gap], [*end, n + gap + size], n + gap + size
    cells = CellFeatures(
        np.array(first, np.int64),
        np.subtract(end, first).astype(np.int64),
        np.full(len(first), FLAT, np.uint8),
        np.zeros((len(first), 3)),
        np.zeros((len(first), 2, 3), np.float32),
    )
    ranges = data.draw(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 6)), max_size=6))
    expected = [any(a < e and f < a + m and m for a, m in ranges) for f, e in zip(first, end, strict=True)]
    entries = np.array([(a, m, 1) for a, m in ranges], RENDER_POINT)
    assert drawn_cells(cells, entries).tolist() == expected


def test_a_depth_offset_beyond_float32_is_the_largest_there_is():
    points, huge = sphere(50, 0.1), SplatSettings(depth_offset=1e300)
    with np.errstate(over="raise"), CpuSplatRasterizer(points, 20, 20, huge) as rasterizer:
        found = rasterizer.draw(camera(20, 20), all_of(points)).copy()
    with CpuSplatRasterizer(points, 20, 20, SplatSettings(depth_offset=1e30)) as rasterizer:
        assert np.array_equal(found, rasterizer.draw(camera(20, 20), all_of(points)))


def test_what_splats_need_is_asked_for():
    points = sphere(10, 0.1)
    with pytest.raises(InputError, match="splats: found points without normals or radii"):
        CpuSplatRasterizer(replace(points, normal=None), 10, 10, SplatSettings())
    with pytest.raises(InputError, match=r"splats\.features: found cells without features"):
        CpuSplatRasterizer(points, 10, 10, SplatSettings(features=True))
    with pytest.raises(InputError, match="viewport: found 0×10"):
        CpuSplatRasterizer(points, 0, 10, SplatSettings())
    with pytest.raises(InputError, match="threads: found 0"):
        CpuSplatRasterizer(points, 10, 10, SplatSettings(), threads=0)
    with CpuSplatRasterizer(points, 10, 10, SplatSettings()) as rasterizer:
        with pytest.raises(MessageError, match="camera viewport: found 11×10"):
            rasterizer.draw(camera(11, 10), all_of(points))
        with pytest.raises(MessageError, match="found offset 5, range 6"):
            rasterizer.draw(camera(10, 10), np.array([(5, 6, 1)], RENDER_POINT))
    with pytest.raises(ConfigError, match="gl-points"):
        make_rasterizer("gl-points", points, 10, 10, PointSize(), None, splats=SplatSettings())


def test_points_without_normals_face_the_eye():
    points = replace(sphere(500, 0.2), normal=np.full(500, NO_NORMAL))
    view = camera(100, 80)
    fast, slow = (f(points, view, all_of(points), SplatSettings()) for f in (draw, splat_frame))
    expect_same_picture(fast, slow)


def test_bench_counts_what_the_visibility_pass_saves(tmp_path):
    rng = np.random.default_rng(3)
    positions = np.column_stack([rng.uniform(-1, 1, (4000, 2)), np.zeros(4000)])
    settings_ = BuildSettings(features=True, points_per_cell=40)
    build_scene([ArraySource(positions)], tmp_path / "plane.scene", settings=settings_)
    results = bench_splats([tmp_path / "plane.scene"], size=96, views=2, repeats=1, pictures=tmp_path / "pictures")
    row = results["rows"][0]
    assert row["points"] == 4000
    assert row["reduction"] > 0.7
    assert row["psnr_db"] > 25
    assert row["holes_px"]["splats"] < 0.05 * row["holes_px"]["points"]
    with Image.open(tmp_path / "pictures" / "plane.png") as picture:
        assert picture.size == (4 * 96, 96)
    console = Console(record=True, width=200, file=io.StringIO())
    print_splats(results, console)
    assert f"{row['reduction']:.2%}" in console.export_text()


def test_lit_splats_are_not_shaded_twice(tmp_path):
    positions = np.random.default_rng(3).normal(size=(300, 3))
    build_scene([ArraySource(positions)], tmp_path / "s.scene", settings=BuildSettings(splats=True))
    for lighting, mode in ((True, "constant"), (False, "normal")):
        config = {"scene": {"path": str(tmp_path / "s.scene")}, "splats": {"lighting": lighting}}
        job = Job(RunConfig.model_validate(config | {"render": {"style": "splats"}}))
        assert job.colouring.mode == mode


def test_the_bench_says_which_package_it_misses_before_it_draws(tmp_path, monkeypatch):
    monkeypatch.setattr("splatpipe.shared.metrics.find_spec", lambda name: None)
    with pytest.raises(DeviceError, match=r"install splatpipe\[error\]"):
        bench_splats([tmp_path / "none.scene"])


def test_edges_and_corners_are_sampled_more_densely(tmp_path):
    rng = np.random.default_rng(4)
    cube = rng.uniform(0, 1, (20_000, 3))
    cube[np.arange(len(cube)), rng.integers(0, 3, len(cube))] = rng.integers(0, 2, len(cube))
    build_scene([ArraySource(cube)], tmp_path / "c.scene", settings=BuildSettings(features=True, points_per_cell=400))
    scene = Scene.open(tmp_path / "c.scene")
    view = camera(60, 60, (2.0, -3.0, 2.5))
    tree = scene.octree(features=True)
    order = np.argsort(tree.first_point)
    of_cell = []
    for octree in (scene.octree(), tree):
        bits = VisibilityBits.pack(0, np.ones(len(octree), bool))
        chosen = SamplingNode(octree, pixel_threshold=16, points_per_pixel=1).process(view, bits)
        drawn = np.zeros(scene.info.n_stored, np.int64)
        for first, n, _ in chosen.entries.tolist():
            drawn[first : first + n] = 1
        of_cell.append(np.add.reduceat(drawn, tree.first_point[order]))
    sharp = np.isin(tree.feature, (EDGE_CELL, CORNER))[order]
    less, more = of_cell
    both = (less > 0) & (more > 0)
    np.testing.assert_array_equal(more[both & ~sharp], less[both & ~sharp])
    assert more[both & sharp].sum() > 1.5 * less[both & sharp].sum() > 0
    assert more.sum() > less.sum()
