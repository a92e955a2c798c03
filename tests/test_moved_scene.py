"""A scene 6.4e6 m from the origin on each axis, with millimetre detail, draws like one at the origin."""

import numpy as np
import pytest
from build_sources import ArraySource
from splatpipe.nodes.culling import CullingNode
from splatpipe.nodes.raster import ResidentPoints, pixel_from_blocks
from splatpipe.nodes.raster.cpu import CpuRasterizer
from splatpipe.nodes.sampling import SamplingNode
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY
from splatpipe.shared.points import PointBatch
from splatpipe.shared.store import Scene
from splatpipe.shared.synth import CityScan

FAR = 6.4e6
EYES = [(-40.0, -50.0, 95.0), (100.0, 60.0, 3.0), (112.0, 95.0, 30.0)]


def city(grid: float) -> PointBatch:
    """80 000 points of the synthetic city on a grid finer than a millimetre."""
    (batch,) = CityScan(n_points=80_000).batches(80_000, attributes=("rgb",))
    return PointBatch(np.rint(batch.positions / grid) * grid, batch.attributes)


def moved(batch: PointBatch, by: float) -> PointBatch:
    return PointBatch(batch.positions + by, batch.attributes)


def camera(eye, by, width=480, height=270):
    eye, target = np.array(eye) + by, np.array([112.0, 112.0, 8.0]) + by
    pose = look_at(eye, target, np.array([0.0, 0.0, 1.0]))
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.9, width=width, height=height, near=0.05)


def frames(batch: PointBatch, path, by: float, order: str, threshold: float) -> list[np.ndarray]:
    build_scene(
        [ArraySource(batch.positions, batch.attributes)],
        path,
        settings=BuildSettings(point_order=order, points_per_cell=500),
    )
    scene = Scene.open(path)
    octree = scene.octree()
    points = ResidentPoints(*scene.positions(), scene.attribute("rgb"), *scene.blocks())
    culling, sampling = CullingNode(octree, backface=False), SamplingNode(octree, pixel_threshold=threshold)
    drawn = []
    with CpuRasterizer(points, 480, 270) as rasterizer:
        for eye in EYES:
            view = camera(eye, by)
            drawn.append(rasterizer.draw(view, sampling.process(view, culling.process(view)).entries).copy())
    return drawn


@pytest.mark.parametrize("order", ["layered", "depth-first"])
@pytest.mark.parametrize("threshold", [0, 12])
def test_the_picture_is_the_same_to_the_bit_where_the_move_is_exact(tmp_path, order, threshold):
    here = city(grid=2.0**-11)  # half a millimetre; sums with 6.4e6 are exact
    there = moved(here, FAR)
    assert np.array_equal(there.positions - FAR, here.positions)
    pairs = zip(
        frames(here, tmp_path / "here", 0, order, threshold),
        frames(there, tmp_path / "there", FAR, order, threshold),
        strict=True,
    )
    for a, b in pairs:
        assert np.array_equal(a, b)
        assert (a != FRAMEBUFFER_EMPTY).mean() > 0.01, "the picture shows something"


def test_no_point_moves_by_more_than_a_hundredth_of_a_pixel_against_float64(tmp_path):
    """Every stored point at 1920×1080, from outside and from among the points; a move that is not exact."""
    by = FAR + 1 / 3
    batch = moved(city(grid=1e-3), by)
    build_scene(
        [ArraySource(batch.positions, batch.attributes)], tmp_path / "s", settings=BuildSettings(points_per_cell=500)
    )
    scene = Scene.open(tmp_path / "s")
    columns = [np.asarray(c) for c in scene.positions()]
    first, origin = scene.blocks()
    block = np.searchsorted(first, np.arange(scene.info.n_stored), side="right") - 1
    world = np.column_stack([c.astype(np.float64) for c in columns]) + origin[block]
    grid = np.rint((world - by) * 1000).astype(np.int64)  # the millimetre that each stored point came from
    input_grid = np.rint((batch.positions - by) * 1000).astype(np.int64)
    assert np.array_equal(np.unique(grid, axis=0), np.unique(input_grid, axis=0)), "no millimetre is lost"
    given = grid / 1000 + by
    for eye in EYES:
        view = camera(eye, by, 1920, 1080)
        rows = pixel_from_blocks(view, origin)[block]
        x, y, w = (
            rows[:, i, 0] * columns[0] + rows[:, i, 1] * columns[1] + rows[:, i, 2] * columns[2] + rows[:, i, 3]
            for i in range(3)
        )
        m = view.pixel_from_world
        exact = (given - view.eye) @ m[:, :3].T
        seen = exact[:, 2] > view.near
        u, v = exact[seen, 0] / exact[seen, 2], exact[seen, 1] / exact[seen, 2]
        inside = (u > 0) & (u < 1920) & (v > 0) & (v < 1080)
        moved_px = np.hypot((x[seen] / w[seen] - u)[inside], (y[seen] / w[seen] - v)[inside])
        assert inside.sum() > 1000
        print(f"eye {eye}: {inside.sum()} points, moved at most {moved_px.max():.2g} px")
        assert moved_px.max() <= 0.01
