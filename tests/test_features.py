"""Flat, edge and corner cells: what they are on solids, and what a quad may hide."""

from __future__ import annotations

import json
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree
from splatpipe.cluster.job import Job
from splatpipe.cluster.scenes import info_command
from splatpipe.nodes.render import Wanted, load_points
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.build.features import (
    CORNER_TOLERANCE,
    EDGE_TOLERANCE,
    FLAT_DEVIATION,
    FLAT_TOLERANCE,
    MIN_POINTS,
    QUAD_MARGIN,
    QUAD_REACH,
    classify,
)
from splatpipe.shared.colour import Colouring
from splatpipe.shared.config import parse_config
from splatpipe.shared.errors import ConfigError, StoreError
from splatpipe.shared.octree import CORNER, EDGE, FLAT
from splatpipe.shared.points import radius_table
from splatpipe.shared.store import Scene

from .build_sources import ArraySource, columns_for

NONE = 0


def classes(points, radius):
    quad = np.zeros((3, 3), np.float32)
    return classify(np.ascontiguousarray(points, np.float64), np.full(len(points), radius), quad), quad


def reference_class(points):
    """The eigenvalue rules alone (thesis 4.3.1)."""
    values = np.linalg.eigvalsh(np.cov(points.T, bias=True))
    if not values.sum() > 0:
        return NONE
    a, b, c = values / values.sum()
    if c - a <= CORNER_TOLERANCE:
        return CORNER
    if b - a <= EDGE_TOLERANCE and abs(c - a - b) <= EDGE_TOLERANCE:
        return EDGE
    return FLAT if a <= FLAT_TOLERANCE < b else NONE


def faces(n, axes, rng):
    """Uniform on that many faces of the unit cube that meet in its corner at 0."""
    points = rng.uniform(0, 1, (axes, n, 3))
    for axis in range(axes):
        points[axis, :, axis] = 0
    return points.reshape(-1, 3)


def turned(points, rng):
    return points @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T + rng.normal(size=3)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.integers(MIN_POINTS, 200))
def test_classes_equal_their_twin(seed, n):
    rng = np.random.default_rng(seed)
    points = turned(rng.normal(size=(n, 3)) * rng.choice([1.0, 0.5, 0.1, 1e-3, 0.0], 3), rng)
    found, quad = classes(points, 1e9)  # splats so large that any quad will do
    assert found == reference_class(points)
    assert quad.any() == (found == FLAT)


@pytest.mark.parametrize("n", [64, 200])
def test_edges_corners_and_faces_of_a_cube(n):
    rng = np.random.default_rng(1)
    for axes, expected in ((1, FLAT), (2, EDGE), (3, CORNER)):
        found = [classes(turned(faces(n, axes, rng), rng), 1e9)[0] for _ in range(100)]
        assert found.count(expected) >= 95


def test_what_is_no_feature():
    rng = np.random.default_rng(2)
    line = rng.uniform(0, 1, (50, 1)) * [1.0, 2.0, 3.0]
    coincident = np.full((50, 3), 0.3)
    assert [classes(points, 0.5)[0] for points in (line, coincident)] == [NONE, NONE]


# --- quads --------------------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.sampled_from([8, 30, 300]), st.sampled_from([0.0, 0.3, 0.6]))
def test_a_quad_holds_the_points_and_reaches_no_farther_than_their_splats(seed, n, thickness):
    rng = np.random.default_rng(seed)
    radius = 1.8 / np.sqrt(n)
    flat = rng.uniform(0, 1, (n, 3)) * [1, 1, thickness * radius]
    found, quad = classes(turned(flat, rng), radius)
    if found != FLAT:
        return
    rng = np.random.default_rng(seed)
    rng.uniform(0, 1, (n, 3))
    points = turned(flat, rng)
    center, half = quad[0].astype(float), quad[1:].astype(float)
    assert abs(half[0] @ half[1]) < 1e-5
    length = np.linalg.norm(half, axis=1)
    inside = (points - center) @ (half / length[:, None]).T
    margin = length - np.abs(inside).max(axis=0)
    assert np.allclose(margin, QUAD_MARGIN * radius, atol=1e-5)
    normal = np.cross(*(half / length[:, None]))
    assert (np.abs((points - center) @ normal) <= FLAT_DEVIATION * radius + 1e-5).all()
    corners = rng.uniform(-1, 1, (2000, 2)) * length
    assert np.max(KDTree(inside).query(corners)[0]) <= QUAD_REACH * radius + 1e-5


def test_no_quad_over_a_hole_or_a_bent_surface():
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    assert classes(grid, 1.5)[0] == FLAT
    for gone in (np.hypot(*(grid[:, :2] - 10).T) < 6, grid[:, :2].min(axis=1) > 12, grid[:, :2].sum(axis=1) > 20):
        assert classes(grid[~gone], 1.5)[0] == NONE
    bent = grid.copy()
    bent[:, 2] = (grid[:, 0] - 10) ** 2 / 100  # half a unit about its mean plane
    assert [classes(bent, radius)[0] for radius in (1.5, 0.45)] == [FLAT, NONE]


def test_no_quad_if_one_splat_is_too_small_for_it():
    points = np.stack(np.meshgrid(np.arange(10), np.arange(10), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    points[0, 2] = 0.2
    reach, quad = np.full(100, 1.5), np.zeros((3, 3), np.float32)
    assert classify(points, reach, quad) == FLAT
    reach[0] = 0.075
    assert classify(points, reach, quad) == NONE


# --- in a scene -------------------------------------------------------------------------------------------------------


def cube_surface(n, rng):
    points = rng.uniform(0, 1, (n, 3))
    points[np.arange(n), rng.integers(0, 3, n)] = rng.integers(0, 2, n)
    return points


def build(path, positions, **options):
    options = {"overwrite": True, "points_per_cell": 32, "features": True} | options
    build_scene([ArraySource(positions, columns_for(len(positions)))], path, settings=BuildSettings(**options))
    scene = Scene.open(path)
    scene.verify()
    return scene


@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
def test_cells_of_a_cube(tmp_path, point_order):
    """Turned, so that its faces are not those of cells."""
    rng = np.random.default_rng(4)
    unit = cube_surface(40_000, rng)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    scene = build(tmp_path / "s", unit @ turn.T, point_order=point_order)
    octree = scene.octree(features=True)
    assert octree.feature is not None
    assert octree.quad is not None
    flat, edge, corner = ((octree.feature == code) & (octree.n_points >= 10) for code in (FLAT, EDGE, CORNER))
    assert octree.n_points[flat & octree.is_leaf].sum() > 0.5 * 40_000
    middle = octree.centers @ turn
    nearness = np.sort(np.minimum(np.abs(middle), np.abs(middle - 1)), axis=1) / (2 * octree.half_edges[:, None])
    assert (nearness[edge, 1] < 1).mean() > 0.9  # two faces within reach
    assert corner.any()
    assert (nearness[corner, 2] < 1).mean() >= 0.5
    assert (nearness[flat, 1] > 0.2).mean() > 0.95
    assert (octree.quad[octree.feature != FLAT] == 0).all()
    normal = np.cross(octree.quad[flat, 1], octree.quad[flat, 2]).astype(float)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    far_from_edges = nearness[flat, 1] > 1.5
    assert np.degrees(np.arccos(np.abs(normal @ turn).max(axis=1).clip(0, 1)))[far_from_edges].max() < 0.01


def test_quads_and_discs_leave_no_hole(tmp_path):
    """Any ray from outside to the middle of a sphere passes a quad of a leaf, or the disc of a point in no flat leaf."""
    rng = np.random.default_rng(5)
    outward = rng.normal(size=(20_000, 3))
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    scene = build(tmp_path / "s", outward, points_per_cell=16)
    points = load_points(scene, Colouring.choose(scene, "#ffffff"), Wanted(splats=True, features=True), verify=True)
    features = points.features
    assert features is not None
    octree = scene.octree()
    owners = np.argsort(octree.first_point, kind="stable")
    leaf = octree.is_leaf[owners]
    flat = leaf & (features.feature == FLAT)
    assert features.n_points[flat].sum() > 0.4 * 20_000
    rays = rng.normal(size=(20_000, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    center, axes = features.quad_center[flat], features.quad_axes[flat].astype(float)
    normal = np.cross(axes[:, 0], axes[:, 1])
    _, near = KDTree(center).query(rays, k=12)
    t = (center * normal).sum(axis=1)[near] / (rays[:, None] * normal[near]).sum(axis=2)
    offset = rays[:, None] * t[..., None] - center[near]
    reach = np.abs(np.einsum("ijk,ijlk->ijl", offset, axes[near])) <= (axes[near] ** 2).sum(axis=3)
    covered = reach.all(axis=2).any(axis=1)
    rough = np.flatnonzero(leaf & ~(features.feature == FLAT))
    own = np.concatenate(
        [np.arange(features.first_point[c], features.first_point[c] + features.n_points[c]) for c in rough]
    )
    block = np.searchsorted(points.block_first_point, own, side="right") - 1
    world = np.column_stack([points.x[own], points.y[own], points.z[own]]) + points.block_origin[block]
    assert points.radius is not None
    distance, near = map(np.asarray, KDTree(world).query(rays, k=20))
    covered |= (distance <= radius_table(points.root_edge)[points.radius[own]][near]).any(axis=1)
    assert (~covered).mean() < 3e-4


def test_exact_translation_changes_nothing(tmp_path):
    positions = np.round(cube_surface(5000, np.random.default_rng(6)) * 1024) / 1024
    here, far = (
        build(tmp_path / name, positions + by).octree(features=True) for name, by in (("a", 0.0), ("b", 2.0**23))
    )
    assert here.feature is not None
    assert (here.feature == FLAT).any()
    assert np.array_equal(here.feature, far.feature)
    assert np.array_equal(here.quad, far.quad)


# --- the store and the render rank ------------------------------------------------------------------------------------


@pytest.fixture
def scene(tmp_path):
    return build(tmp_path / "s.scene", cube_surface(5000, np.random.default_rng(7)) + 6.4e6)


def test_only_what_is_asked_for_is_loaded(scene, tmp_path):
    assert scene.octree().feature is None
    assert scene.octree().quad is None
    colouring = Colouring.choose(scene, "rgb")
    bare = load_points(scene, colouring, verify=True)
    assert (bare.normal, bare.radius, bare.features) == (None, None, None)
    points = load_points(scene, colouring, Wanted(splats=True, features=True), verify=True)
    assert points.radius is not None
    assert points.normal is not None
    assert np.array_equal(points.radius, scene.attribute("radius"))
    assert np.array_equal(points.normal, scene.attribute("normal"))
    features, octree = points.features, scene.octree(features=True)
    assert features is not None
    assert octree.feature is not None
    assert np.array_equal(features.first_point, np.cumsum(features.n_points) - features.n_points)
    assert features.n_points.sum() == len(points)
    assert sorted(features.feature) == sorted(octree.feature)
    flat = features.feature == FLAT
    assert (features.quad_center[flat] > 6.4e6 - 0.1).all()
    assert features.quad_center.dtype == np.float64


def test_what_a_scene_was_built_without_is_said(tmp_path):
    scene = build(tmp_path / "s", cube_surface(500, np.random.default_rng(8)), features=False)
    colouring = Colouring.choose(scene, "rgb")
    with pytest.raises(StoreError, match="build it with --splats"):
        load_points(scene, colouring, Wanted(splats=True), verify=False)
    with pytest.raises(StoreError, match="build it with --features"):
        load_points(scene, colouring, Wanted(features=True), verify=False)


def test_a_run_that_cannot_be_drawn_is_refused_before_it_starts(tmp_path):
    build(tmp_path / "s", cube_surface(500, np.random.default_rng(8)), splats=True, features=False)
    splats = {"scene": {"path": str(tmp_path / "s")}, "render": {"style": "splats"}}
    assert Job(parse_config(splats)).splats
    with pytest.raises(StoreError, match="build it with --features"):
        Job(parse_config(splats | {"splats": {"features": True}}))
    with pytest.raises(ConfigError, match="'gl-points' draws no splats"):
        Job(parse_config(splats | {"render": {"style": "splats", "rasterizer": "gl-points"}}))


@pytest.mark.parametrize("array", ["attr_normal", "attr_radius", "cell_feature", "cell_quad"])
def test_a_damaged_array_is_named(scene, array):
    file = scene.path / f"{array}.npy"
    damaged = bytearray(file.read_bytes())
    damaged[-1] ^= 1
    file.write_bytes(damaged)
    with pytest.raises(StoreError, match=rf"{array}\.npy: checksum"):
        load_points(scene, Colouring.choose(scene, "rgb"), Wanted(splats=True, features=True), verify=True)


@pytest.mark.parametrize(("array", "value", "message"), [("feature", 4, "above 3"), ("quad", np.nan, "not finite")])
def test_a_faulty_writer_is_found(scene, array, value, message):
    file = scene.path / f"cell_{array}.npy"
    values = np.load(file)
    values[5] = value
    np.save(file, values)
    info = json.loads((scene.path / "scene.json").read_text())
    info["arrays"][f"cell_{array}"]["crc32"] = zlib.crc32(values.tobytes())
    (scene.path / "scene.json").write_text(json.dumps(info))
    with pytest.raises(StoreError, match=rf"cell_{array}\.npy: entry 5: {message}"):
        Scene.open(scene.path).octree(features=True)


def test_info_says_what_is_there(scene, tmp_path, capsys):
    info_command(scene.path, tmp_path / "i.json")
    assert "flat" in capsys.readouterr().out
    content = json.loads((tmp_path / "i.json").read_text())
    assert content["splats"] is True
    assert sum(int(text.split()[0].replace(",", "")) for text in content["features"]) == scene.info.n_cells
