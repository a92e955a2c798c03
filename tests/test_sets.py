"""The order inside sets: any prefix is spread over its cell; and how much surface a cell holds."""

from __future__ import annotations

import json

import numpy as np
import pytest
from splatpipe.shared.build import BuildSettings, build_scene, builder
from splatpipe.shared.build.sets import RANDOM_AREA
from splatpipe.shared.build.settings import MemoryPlan
from splatpipe.shared.store import Scene

from .build_sources import ArraySource


@pytest.fixture
def build(tmp_path):
    """Positions → scene."""

    def built(positions, **options):
        settings = BuildSettings(overwrite=True, **options)
        build_scene([ArraySource(positions)], tmp_path / "s", settings=settings)
        return Scene.open(tmp_path / "s")

    return built


def square(n, seed=0):
    """(n, 3) points on a unit square in the plane z = 0."""
    return np.random.default_rng(seed).uniform(size=(n, 3)) * [1.0, 1.0, 0.0]


def set_of(scene, cell):
    """World positions of a cell's own points, in their order."""
    octree, (first, origin) = scene.octree(), scene.blocks()
    own = np.arange(octree.first_point[cell], octree.first_point[cell] + octree.n_points[cell])
    block = np.searchsorted(first, own, side="right") - 1
    return np.column_stack([column[own] for column in scene.positions()]) + origin[block]


def empty_squares(points, n_squares):
    """Share of the squares of a grid over the unit square that hold no point."""
    side = int(n_squares**0.5)
    column, row = (points[:, :2] * side).astype(int).clip(0, side - 1).T
    return 1 - len(np.unique(column * side + row)) / side**2


@pytest.mark.parametrize("points_per_cell", [4000, 1000], ids=["leaf", "inner cell"])
@pytest.mark.parametrize("n", [130, 300, 700])
def test_a_prefix_covers_a_surface_better_than_random_points_do(build, points_per_cell, n):
    """Two points a square leave 13.5 % of the squares empty where they are random, and half of that in strata."""
    empty = []
    for seed in range(8):
        root_set = set_of(build(square(4000, seed), points_per_cell=points_per_cell), 0)
        empty.append(empty_squares(root_set[:n], n / 2))
    assert np.mean(empty) < 0.09


def test_consecutive_points_lie_far_apart(build):
    points = set_of(build(square(4000), points_per_cell=4000), 0)
    assert np.median(np.linalg.norm(np.diff(points, axis=0), axis=1)) > 0.3


def test_which_points_come_first_prefers_no_side(build):
    """The first points of many cells, seen from their cells' centres, are at the centres on average."""
    scene = build(square(100_000), points_per_cell=64)
    octree = scene.octree()
    full = np.flatnonzero(octree.is_leaf & (octree.n_points > 20))
    offsets = [(set_of(scene, cell)[0] - octree.centers[cell]) / octree.half_edges[cell] for cell in full[:400]]
    assert np.abs(np.mean(offsets, axis=0)[:2]).max() < 4 / np.sqrt(3 * 400)


@pytest.mark.parametrize("sheets", [1, 2, 3])
def test_area_counts_the_sheets_of_a_cell(build, sheets):
    points = square(30_000)
    points[:, 2] = np.random.default_rng(1).integers(sheets, size=len(points)) / 3 + 0.02
    points[0] = [0, 0, 0]
    points[1] = [1, 1, 1]
    for points_per_cell in (30_000, 2000):
        octree = build(points, points_per_cell=points_per_cell).octree()
        assert octree.area is not None
        assert octree.area[0] == pytest.approx(sheets, rel=0.1)


def test_area_of_few_points_is_not_their_number(build):
    """30 points of a square do not fall on each of its 64 places, and still need all of the square's pixels."""
    octree = build(square(30), points_per_cell=100).octree()
    assert octree.area is not None
    assert octree.area[0] == pytest.approx(1, rel=0.1)


def test_too_large_leaves_are_in_random_order_and_say_so(build):
    octree = build(np.ones((500, 3)), points_per_cell=100, max_depth=2).octree()
    assert octree.area is not None
    assert octree.area[octree.is_leaf] == RANDOM_AREA


def test_areas_do_not_depend_on_memory(tmp_path, build, monkeypatch):
    points = np.random.default_rng(2).normal(size=(60_000, 3)) * [1, 1, 0.05]
    points[:9000] = points[0]
    whole = build(points, points_per_cell=200, max_depth=9).info.arrays["cell_area"]
    monkeypatch.setattr(builder, "plan_memory", lambda *_, **__: MemoryPlan(5000, 900))
    assert build(points, points_per_cell=200, max_depth=9).info.arrays["cell_area"] == whole


def test_depth_first_scenes_have_no_areas(build):
    scene = build(square(500), points_per_cell=100, point_order="depth-first")
    assert "cell_area" not in scene.info.arrays
    assert scene.octree().area is None


def test_scenes_of_format_1_have_no_areas(build):
    scene = build(square(500), points_per_cell=100)
    content = json.loads((scene.path / "scene.json").read_text())
    content["format_version"] = 1
    del content["arrays"]["cell_area"]
    (scene.path / "scene.json").write_text(json.dumps(content))
    assert Scene.open(scene.path).octree().area is None
