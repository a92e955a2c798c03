"""Normals and splat radii made of neighbours: equal to their twins, right on surfaces that are known, without holes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree
from splatpipe.shared.build import BuildSettings, build_scene, builder, neighbours
from splatpipe.shared.build.morton import keys_of, root_cube
from splatpipe.shared.build.neighbours import SurfaceRule, add_surface, distinct, plane_normals
from splatpipe.shared.build.parallel import Workers
from splatpipe.shared.build.point_array import radius_steps
from splatpipe.shared.build.settings import MemoryPlan
from splatpipe.shared.points import NO_NORMAL, PointBatch, pack_normals, radius_table, unpack_normals
from splatpipe.shared.store import Scene

from .build_sources import ArraySource, columns_for


def sphere(n, rng):
    p = rng.normal(size=(n, 3))
    p /= np.linalg.norm(p, axis=1)[:, None]
    return p, p


def torus(n, rng):
    """Uniform on a torus of radii 1 and 0.4, by rejection."""
    u, v, keep = rng.uniform(0, [2 * np.pi, 2 * np.pi, 1.4], (3 * n, 3)).T
    u, v = u[keep < 1 + 0.4 * np.cos(v)][:n], v[keep < 1 + 0.4 * np.cos(v)][:n]
    normal = np.column_stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)])
    return np.column_stack([np.cos(u), np.sin(u), 0 * u]) + 0.4 * normal, normal


def plane(n, rng):
    return rng.uniform(0, 1, (n, 3)) * [1, 1, 0], np.tile([0.0, 0.0, 1.0], (n, 1))


def surface_of(positions, threads=1, **options):
    """(normals (n, 3), radii (n,)) of points, as they are stored."""
    positions = np.ascontiguousarray(positions, np.float64)
    lower, upper = positions.min(axis=0), positions.max(axis=0)
    origin, edge = root_cube(lower, upper)
    rule = {"normals": True, "radii": True, "origin": origin, "edge": edge, "up": None, "center": (lower + upper) / 2}
    with Workers(threads) as workers:
        keys = keys_of(positions, origin, edge, workers)
        made = add_surface(PointBatch(positions), keys, SurfaceRule(**rule | options), workers).check()
    return unpack_normals(made.attributes["normal"]).astype(float), radius_table(edge)[made.attributes["radius"]]


def angle_deg(a, b):
    return np.degrees(np.arccos(np.clip(np.abs((a * b).sum(axis=1)), 0, 1)))


# --- twins ------------------------------------------------------------------------------------------------------------


def reference_normal(points):
    """Normal of the plane through points, the first of which it belongs to; zero where they are on a line."""
    values, vectors = np.linalg.eigh(np.cov((points - points[0]).T, bias=True))
    return vectors[:, 0] * (values[1] > neighbours.COLLINEAR * values[2])


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.sampled_from([1e-9, 1.0, 1e6]), st.sampled_from([1, 2, 5, 60]))
def test_normals_equal_their_twin(seed, scale, n):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3)) * rng.choice([1.0, 0.1, 1e-3], 3) * scale
    near = np.asarray(KDTree(points).query(points, k=9)[1])
    normals = plane_normals(points, near, True, np.zeros(3))
    for i in range(n):
        found = points[near[i][near[i] < n]]
        expected = reference_normal(found) if n > 2 else np.zeros(3)
        assert abs(normals[i] @ expected) == pytest.approx(expected @ expected, abs=1e-6)
        assert normals[i] @ points[i] >= 0  # away from the centre


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.lists(st.tuples(*[st.sampled_from([0.0, -0.0, 1.0, 1.0 + 2**-52, 5.0])] * 3), min_size=1, max_size=40))
def test_distinct_positions_are_those_of_unique(rows):
    positions = np.array(rows)
    origin, edge = root_cube(positions.min(axis=0), positions.max(axis=0))
    with Workers(1) as workers:
        keys = keys_of(positions, origin, edge, workers)
    order, first = distinct(positions, keys)
    assert sorted(order) == list(range(len(rows)))
    assert (np.diff(keys[order]) >= 0).all()
    found = positions[order[first]] + 0.0
    assert np.array_equal(np.unique(found, axis=0), np.unique(positions + 0.0, axis=0))
    assert len(found) == len(np.unique(positions + 0.0, axis=0))


# --- surfaces that are known ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("surface", "mean_deg", "most_deg"), [(sphere, 0.6, 3.5), (torus, 1.5, 10.0), (plane, 0, 0.004)]
)
def test_normals_of_known_surfaces(surface, mean_deg, most_deg):
    positions, normals = surface(10_000, np.random.default_rng(1))
    error = angle_deg(surface_of(positions)[0], normals)
    assert error.mean() <= max(mean_deg, 0.004)
    assert error.max() <= most_deg


def test_normals_point_outwards_or_up():
    positions, outward = sphere(5000, np.random.default_rng(2))
    assert ((surface_of(positions + 100)[0] * outward).sum(axis=1) > 0.99).all()
    assert (surface_of(positions, up=np.array([0.0, 0.0, 1.0]))[0][:, 2] >= 0).all()
    assert (surface_of(positions, up=np.array([-1.0, 0.0, 0.0]))[0][:, 0] <= 0).all()


@pytest.mark.parametrize("surface", [sphere, torus, plane])
def test_discs_leave_no_hole(surface):
    rng = np.random.default_rng(3)
    positions, _ = surface(20_000, rng)
    radii = surface_of(positions)[1]
    anywhere, _ = surface(100_000, rng)
    distance, near = map(np.asarray, KDTree(positions).query(anywhere, k=12))
    if surface is plane:
        distance = distance[np.abs(anywhere[:, :2] - 0.5).max(axis=1) < 0.49]
        near = near[np.abs(anywhere[:, :2] - 0.5).max(axis=1) < 0.49]
    assert (distance <= radii[near]).any(axis=1).all()
    assert np.mean(radii) < 2.2 * np.sqrt({sphere: 4 * np.pi, torus: 1.6 * np.pi**2, plane: 1.0}[surface] / 20_000)


# --- neighbourhoods that are none ---------------------------------------------------------------------------------------


def test_coincident_points_do_not_hide_the_spacing():
    positions, _ = sphere(3000, np.random.default_rng(4))
    normals, radii = surface_of(positions)
    again = np.repeat(np.arange(3000), np.random.default_rng(5).integers(1, 30, 3000))
    normals_again, radii_again = surface_of(positions[again])
    assert np.array_equal(normals_again, normals[again])
    assert np.array_equal(radii_again, radii[again])


def test_radii_are_the_eighth_distance_capped_by_those_around():
    """By the rule as it is written, for every point."""
    rng = np.random.default_rng(8)
    positions = np.concatenate([plane(3000, rng)[0], rng.uniform(-1, 2, (40, 3))])
    distance, near = map(np.asarray, KDTree(positions).query(positions, k=33))
    reach = distance[:, 8]
    expected = np.minimum(reach, neighbours.RADIUS_CAP * np.median(reach[near[:, 1:]], axis=1))
    radii = surface_of(positions)[1] / neighbours.RADIUS_MARGIN
    assert (expected < reach).sum() > 10
    assert (radii / expected >= 1 - 1e-6).all()
    assert (radii / expected < 1.1).all(), "codes round up by at most 9 %"


def test_an_isolated_point_gets_no_giant_splat():
    """Alone, and with up to eleven companions, a thousand spacings away."""
    positions, _ = plane(10_000, np.random.default_rng(6))
    typical = np.median(surface_of(positions)[1])
    for company in (1, 2, 3, 7, 12):
        far = np.array([0.5, 0.5, 10.0]) + np.arange(company)[:, None] * [0.005, 0, 0]
        radii = surface_of(np.concatenate([positions, far]))[1]
        assert radii[-company:].max() < 4 * typical
        assert radii[:-company].max() < 3 * typical


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_points(n):
    normals, radii = surface_of(np.eye(3)[:n])
    assert (normals[:, 0] != 0).any() == (n == 3)
    assert np.allclose(radii, 0.0 if n == 1 else 1.0, atol=1e-3)  # no splat is larger than the root cube


def test_points_on_a_line_or_in_one_place_have_no_normal():
    line = np.linspace(0, 1, 500)[:, None] * [1.0, 2.0, -0.5]
    normals, radii = surface_of(line)
    assert (normals == 0).all()
    assert radii.min() > 0.008
    normals, radii = surface_of(np.full((500, 3), 7.25))
    assert (normals == 0).all()
    assert (radii < 1e-8).all()


def test_threads_and_exact_translations_change_nothing():
    positions = np.round(sphere(9000, np.random.default_rng(7))[0] * 2**20) / 2**20
    normals, radii = surface_of(positions)
    for moved, threads in ((positions, 3), (positions + 2.0**23, 1)):
        normals_moved, radii_moved = surface_of(moved, threads)
        assert np.array_equal(normals, normals_moved)
        assert np.array_equal(radii, radii_moved)


# --- in a scene -------------------------------------------------------------------------------------------------------


def build(path, positions, columns=None, source=None, **options):
    options = {"overwrite": True, "points_per_cell": 100} | options
    build_scene([source or ArraySource(positions, columns)], path, settings=BuildSettings(**options))
    scene = Scene.open(path)
    scene.verify()
    return scene


@pytest.mark.parametrize(
    ("options", "has_normals", "stored"),
    [
        ({}, False, ("rgb",)),
        ({"normals": "estimate"}, False, ("rgb", "normal")),
        ({"splats": True}, False, ("rgb", "normal", "radius")),
        ({"features": True}, True, ("rgb", "normal", "radius")),
        ({"splats": True, "attributes": ("rgb",)}, True, ("rgb", "normal", "radius")),
        ({"normals": "estimate", "attributes": ("normal",)}, False, ("normal",)),
        ({"normals": "estimate", "attributes": ("rgb",)}, True, ("rgb", "normal")),
    ],
)
def test_what_is_stored(tmp_path, options, has_normals, stored):
    positions, outward = sphere(2000, np.random.default_rng(8))
    columns = columns_for(2000) | ({"normal": pack_normals(-outward)} if has_normals else {})
    scene = build(tmp_path / "s", positions, columns, **options)
    assert scene.info.attributes == stored
    assert scene.info.splats == ("radius" in stored)
    if "rgb" in stored and "normal" in stored:
        normals, number = unpack_normals(scene.attribute("normal")), np.asarray(scene.attribute("rgb"))
        kept = has_normals and options.get("normals") != "estimate"  # those of the file point inwards
        assert (((normals * outward[number]).sum(axis=1) < 0) == kept).all()


@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
def test_radii_of_level_of_detail_sets_grow_with_their_spacing(tmp_path, point_order):
    positions, _ = sphere(20_000, np.random.default_rng(9))
    columns = columns_for(20_000)
    scene = build(tmp_path / "s", positions, columns, splats=True, point_order=point_order)
    octree, code = scene.octree(), np.asarray(scene.attribute("radius")).astype(int)
    number = np.asarray(scene.attribute("rgb"))
    of_input = np.empty(20_000, int)
    for leaf in np.flatnonzero(octree.is_leaf):
        own = slice(octree.first_point[leaf], octree.first_point[leaf] + octree.n_points[leaf])
        of_input[number[own]] = code[own]
    assert np.array_equal(radius_table(octree.edge)[of_input], surface_of(positions)[1])
    for cell in np.flatnonzero(octree.first_child >= 0) if point_order == "layered" else []:
        own = slice(octree.first_point[cell], octree.first_point[cell] + octree.n_points[cell])
        grown = 2.0 ** ((of_input[number[own]] - code[own]) / 8)
        needed = np.sqrt(octree.n_below[cell] / octree.n_points[cell])
        assert ((grown >= needed * (1 - 1e-9)) & (grown < needed * 2**0.125)).all()


def test_radius_steps():
    assert radius_steps(np.array([100, 400, 401, 5]), np.array([100, 100, 100, 0])).tolist() == [0, 8, 9, 10]


@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
def test_builds_larger_than_memory_leave_no_hole_either(tmp_path, monkeypatch, point_order):
    """Partitions of the sphere, and a leaf of one level that does not fit."""
    rng = np.random.default_rng(10)
    positions, outward = sphere(20_000, rng)
    anywhere, _ = sphere(50_000, rng)
    inside = build(tmp_path / "s", positions, columns_for(20_000), splats=True, point_order=point_order)
    monkeypatch.setattr(builder, "plan_memory", lambda *_: MemoryPlan(3000, 900))
    for max_depth in (21, 0):
        scene = build(
            tmp_path / "t",
            positions,
            columns_for(20_000),
            splats=True,
            max_depth=max_depth,
            point_order=point_order,
        )
        leaves = np.flatnonzero(scene.octree().is_leaf)
        assert scene.octree().n_below[leaves].max() == (20_000 if max_depth == 0 else 100) or max_depth
        own = np.concatenate([np.arange(f, f + n) for f, n in zip(*_ranges(scene, leaves), strict=True)])
        number = np.asarray(scene.attribute("rgb"))[own]
        radii = np.empty(20_000)
        radii[number] = radius_table(scene.info.edge)[np.asarray(scene.attribute("radius"))[own]]
        normals = unpack_normals(np.asarray(scene.attribute("normal"))[own])
        assert np.mean(angle_deg(normals.astype(float), outward[number])) < 1.5
        distance, near = map(np.asarray, KDTree(positions).query(anywhere, k=20))
        assert (distance > radii[near]).all(axis=1).mean() < (1e-4 if max_depth else 2e-3)
        assert np.mean(radii) < 1.2 * np.mean(surface_of(positions)[1])
    assert inside.info.edge == scene.info.edge


def _ranges(scene, cells):
    octree = scene.octree()
    return octree.first_point[cells], octree.n_points[cells]


def test_cones_hold_estimated_normals_and_give_up_where_a_leaf_does_not_fit(tmp_path, monkeypatch):
    positions, _ = sphere(5000, np.random.default_rng(11))
    scene = build(tmp_path / "s", positions, normals="estimate")
    octree, normals = scene.octree(), unpack_normals(scene.attribute("normal")).astype(float)
    assert octree.cone is not None
    for cell in range(len(octree)):
        own = slice(octree.first_point[cell], octree.first_point[cell] + octree.n_points[cell])
        assert (normals[own] @ octree.cone[cell, :3].astype(float) >= octree.cone[cell, 3]).all()
    assert (octree.cone[octree.is_leaf, 3] > 0).all()
    monkeypatch.setattr(builder, "plan_memory", lambda *_: MemoryPlan(2000, 900))
    scene = build(tmp_path / "s", positions, normals="estimate", max_depth=0)
    cone = scene.octree().cone
    assert cone is not None
    assert (cone[:, 3] == -1).all()


def test_millions_of_coincident_points_have_splats_as_well(tmp_path):
    scene = build(tmp_path / "s", np.broadcast_to([6.4e6, 1.0, -2.0], (1_000_000, 3)), splats=True)
    assert (np.asarray(scene.attribute("normal")) == NO_NORMAL).all()
    assert radius_table(scene.info.edge)[np.asarray(scene.attribute("radius")).min()] < scene.info.edge * 1e-6


def test_threads_do_not_change_a_bit(tmp_path):
    positions, _ = torus(9000, np.random.default_rng(12))
    one, three = (
        build(tmp_path / str(threads), positions, features=True, threads=threads).info.arrays for threads in (1, 3)
    )
    assert one == three
