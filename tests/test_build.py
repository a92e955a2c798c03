"""The build in memory: equal to its twin, sound as an octree, deterministic, and exact far from the origin."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.errors import InputError
from splatpipe.shared.octree import cell_coordinates
from splatpipe.shared.points import NO_NORMAL, pack_normals, unpack_normals
from splatpipe.shared.store import Scene

from .build_sources import ArraySource, cells_of, columns_for
from .reference_octree import reference_build

KINDS = ("uniform", "clustered", "coincident", "collinear", "planar")


@st.composite
def clouds(draw):
    kind, n = draw(st.sampled_from(KINDS)), draw(st.sampled_from([1, 2, 3, 17, 90, 400]))
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    scale, offset = draw(st.sampled_from([1e-6, 1.0, 1e5])), draw(st.sampled_from([0.0, -3.5, 6.4e6]))
    points = {
        "uniform": lambda: rng.uniform(-1, 1, (n, 3)),
        "clustered": lambda: rng.normal(0, 1e-4, (n, 3)) + rng.integers(0, 2, (n, 3)),
        "coincident": lambda: np.ones((n, 3)) * rng.integers(0, 2, (n, 1)),
        "collinear": lambda: rng.uniform(-1, 1, (n, 1)) * [1.0, 2.0, -0.5],
        "planar": lambda: rng.uniform(-1, 1, (n, 3)) * [1.0, 1.0, 0.0],
    }[kind]()
    return points * scale + offset


def build(path, positions, columns=None, **options):
    options = {"overwrite": True, "points_per_cell": 8} | options
    return build_scene([ArraySource(positions, columns)], path, settings=BuildSettings(**options))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("build")


@settings(max_examples=60, deadline=None, derandomize=True)
@given(clouds(), st.sampled_from([3, 8, 50]), st.sampled_from([21, 4, 0]), st.sampled_from([0.0, 0.01]))
def test_equals_the_reference(folder, positions, points_per_cell, max_depth, flatness):
    columns = columns_for(len(positions), ("gps_time",))
    options = {"points_per_cell": points_per_cell, "max_depth": max_depth, "flatness": flatness}
    build(folder / "twin", positions, columns, **options)
    expected = reference_build(positions, **options)
    found = {
        key: (n_below, np.frombuffer(attributes["gps_time"]).astype(int).tolist(), n_children)
        for key, (n_below, n_children, _, _, attributes) in cells_of(folder / "twin").items()
    }
    assert found == {key: (n, own, len(children)) for key, (n, own, children) in expected.items()}


@settings(max_examples=40, deadline=None, derandomize=True)
@given(clouds(), st.sampled_from(["layered", "depth-first"]))
def test_octree_is_sound(folder, positions, point_order):
    columns = columns_for(len(positions), ("gps_time", "rgb"))
    report = build(folder / "sound", positions, columns, point_order=point_order)
    scene = Scene.open(folder / "sound")
    scene.verify()
    octree = scene.octree()
    number = np.asarray(scene.attribute("gps_time")).astype(int)
    assert report.n_points == len(positions) == scene.info.n_points
    assert sorted(np.concatenate([number[_range(octree, leaf)] for leaf in np.flatnonzero(octree.is_leaf)])) == list(
        range(len(positions))
    )
    assert (np.asarray(scene.attribute("rgb")) == columns["rgb"][number]).all()
    for cell in range(len(octree)):
        inside = np.abs(positions[number[_range(octree, cell)]] - octree.centers[cell])
        rounding = 8 * np.spacing(np.abs(positions).max())
        assert (inside <= octree.half_edges[cell] * (1 + 1e-9) + rounding).all()
        if octree.is_leaf[cell]:
            assert octree.n_below[cell] <= 8 or octree.level[cell] == 21
        elif point_order == "layered":
            own = number[_range(octree, cell)]
            assert len(set(own)) == len(own) == min(8, octree.n_below[cell])


def _range(octree, cell):
    return slice(int(octree.first_point[cell]), int(octree.first_point[cell] + octree.n_points[cell]))


def _world(scene):
    first, origin = scene.blocks()
    block = np.searchsorted(first, np.arange(scene.info.n_stored), side="right") - 1
    return origin[block] + np.column_stack(scene.positions()).astype(np.float64)


@pytest.mark.parametrize("points_per_cell", [16, 300, 4096])
@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
def test_positions_are_near_and_blocks_large_enough(tmp_path, point_order, points_per_cell):
    rng = np.random.default_rng(3)
    positions = rng.uniform(0, 300, (60_000, 3)) * [1, 1, 0.01] + 6.4e6
    build(
        tmp_path / "s",
        positions,
        columns_for(60_000, ("gps_time",)),
        point_order=point_order,
        points_per_cell=points_per_cell,
    )
    scene = Scene.open(tmp_path / "s")
    number = np.asarray(scene.attribute("gps_time")).astype(int)
    first, _ = scene.blocks()
    assert np.abs(_world(scene) - positions[number]).max() <= scene.info.edge * 2.0**-25 + 2e-9
    assert np.diff(np.r_[first, scene.info.n_stored]).mean() > 500


@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
def test_exact_translation_changes_nothing(tmp_path, point_order):
    rng = np.random.default_rng(5)
    positions = np.round(rng.uniform(0, 200, (20_000, 3)) * 1024) / 1024
    for name, offset in (("here", 0.0), ("far", 6.4e6)):
        build(tmp_path / name, positions + offset, point_order=point_order, points_per_cell=64)
    here, far = Scene.open(tmp_path / "here"), Scene.open(tmp_path / "far")
    assert (here.octree().code == far.octree().code).all()
    assert (here.octree().first_point == far.octree().first_point).all()
    for a, b in zip(here.positions(), far.positions(), strict=True):
        assert (a.view(np.uint32) == b.view(np.uint32)).all()


def test_threads_and_batches_do_not_change_a_bit(tmp_path):
    rng = np.random.default_rng(6)
    positions, columns = rng.normal(size=(30_000, 3)), columns_for(30_000, ("rgb", "intensity"))
    columns["normal"] = pack_normals(rng.normal(size=(30_000, 3)))
    for threads in (1, 2, 5):
        build(tmp_path / str(threads), positions, columns, threads=threads, points_per_cell=100)
    one = Scene.open(tmp_path / "1").info.arrays
    assert one == Scene.open(tmp_path / "2").info.arrays == Scene.open(tmp_path / "5").info.arrays


def test_prefix_of_a_set_is_a_fair_sample(tmp_path):
    """A tenth of a leaf's points, taken from its begin, falls on its quarters like a random sample would."""
    positions = np.column_stack([np.linspace(0, 1, 4000), np.zeros(4000), np.zeros(4000)])
    chi = []
    for n in range(300, 4000, 100):  # other sizes, other permutations
        build(tmp_path / "s", positions[:n], points_per_cell=5000)
        x = _world(Scene.open(tmp_path / "s"))[: n // 10, 0] / positions[n - 1, 0]
        counts = np.bincount((x * 4).astype(int).clip(0, 3), minlength=4)
        chi.append(((counts - n / 40) ** 2 / (n / 40)).sum())
    assert np.mean(chi) < 4.5  # 3 degrees of freedom: mean 3, standard error 0.4


def test_cones_hold_every_normal_below(tmp_path):
    rng = np.random.default_rng(8)
    directions = rng.normal(size=(5000, 3))
    words = pack_normals(directions)
    words[directions[:, 2] < -2.5] = NO_NORMAL
    build(
        tmp_path / "s", directions / np.linalg.norm(directions, axis=1)[:, None], {"normal": words}, points_per_cell=40
    )
    scene = Scene.open(tmp_path / "s")
    octree, stored = scene.octree(), np.asarray(scene.attribute("normal"))
    assert octree.cone is not None
    assert np.allclose(np.linalg.norm(octree.cone[:, :3].astype(float), axis=1), 1, atol=1e-6)
    normals = unpack_normals(stored).astype(np.float64)
    narrow = 0
    for leaf in np.flatnonzero(octree.is_leaf):
        own = slice(*(_range(octree, leaf).start, _range(octree, leaf).stop))
        cell = leaf
        while cell >= 0:
            axis, cosine = octree.cone[cell, :3].astype(float), float(octree.cone[cell, 3])
            if (stored[own] == NO_NORMAL).any():
                assert cosine == -1
            assert (normals[own] @ axis >= cosine).all()
            narrow += cosine > 0.9
            cell = octree.parent[cell]
    assert narrow > 20


def test_flat_region_stays_a_leaf(tmp_path):
    rng = np.random.default_rng(9)
    flat = rng.uniform(0, 1, (5000, 3)) * [1, 1, 1e-3]
    build(tmp_path / "s", flat, flatness=1e-3)
    assert len(Scene.open(tmp_path / "s").octree()) == 1
    build(tmp_path / "s", flat, flatness=1e-9)
    assert len(Scene.open(tmp_path / "s").octree()) > 600


def test_millions_of_coincident_points(tmp_path):
    n = 2_000_000
    report = build(tmp_path / "s", np.broadcast_to([6.4e6, 1.0, -2.0], (n, 3)), points_per_cell=4096)
    scene = Scene.open(tmp_path / "s")
    octree = scene.octree()
    assert report.n_cells == 22
    assert octree.n_below.tolist() == [n] * 22
    assert (cell_coordinates(octree.code) == 0).all()


def test_not_finite_points_are_dropped_or_refused(tmp_path):
    positions = np.random.default_rng(1).uniform(0, 1, (100, 3))
    positions[[3, 50, 99], [0, 1, 2]] = np.nan, np.inf, -np.inf
    report = build(tmp_path / "s", positions)
    assert (report.n_points, report.n_dropped) == (97, 3)
    with pytest.raises(InputError, match=r"cloud\.npy: found 3 points that are not finite"):
        build(tmp_path / "t", positions, strict=True)
    with pytest.raises(InputError, match="no finite point"):
        build(tmp_path / "t", positions * np.nan)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s"]


def test_extremes(tmp_path):
    for positions in (
        [[1e29, 0, 0], [-1e29, 5, 5]],
        [[5e-324, 0, 0], [0, 0, 0]],
        [[1e16, 1e16, 1e16]],
        np.zeros((9, 3)),
    ):
        build(tmp_path / "s", np.array(positions, float), points_per_cell=1)
        Scene.open(tmp_path / "s").octree()
    for far, found in ((1.7e308, "inf"), (1e300, r"2e\+300"), (1e30, r"2e\+30")):  # float32 offsets would overflow
        with pytest.raises(InputError, match=f"extent of {found}, expected at most"):
            build(tmp_path / "t", np.array([[far, 0, 0], [-far, 0, 0]]))


def test_several_sources_keep_what_all_have(tmp_path):
    rng = np.random.default_rng(2)
    a = ArraySource(rng.normal(size=(50, 3)), columns_for(50, ("rgb", "intensity")), name="a.las", crs="WKT")
    b = ArraySource(
        rng.normal(size=(70, 3)), columns_for(70, ("rgb", "gps_time")), name="b.ply", n_points=None, bounds=None
    )
    report = build_scene([a, b], tmp_path / "s")
    info = Scene.open(tmp_path / "s").info
    assert report.dropped_attributes == ("intensity", "gps_time")
    assert info.attributes == ("rgb",)
    assert [(s.name, s.n_points) for s in info.sources] == [("a.las", 50), ("b.ply", 70)]
    assert info.crs == "WKT"
    with pytest.raises(InputError, match="normal is in none of the inputs"):
        build_scene([a, b], tmp_path / "t", settings=BuildSettings(attributes=("normal",)))


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"point_order": "random"}, "point_order"),
        ({"points_per_cell": 0}, "points_per_cell"),
        ({"max_depth": 22}, "max_depth"),
        ({"flatness": 0.5}, "flatness"),
        ({"memory_bytes": -1}, "memory_bytes"),
        ({"up": "w"}, "up"),
        ({"attributes": ("colour",)}, "attributes"),
        ({"threads": 0}, "threads"),
    ],
)
def test_settings_out_of_range(options, key):
    with pytest.raises(InputError, match=f"build: {key} = "):
        BuildSettings(**options)
