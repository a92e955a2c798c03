"""Pooled cells of scenes: built, dropped by the gate, verified, and read with their colours."""

from __future__ import annotations

import json
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.cluster.cli import app
from splatpipe.nodes.pooled_cells import load_pools
from splatpipe.nodes.render import load_points
from splatpipe.shared import pooled
from splatpipe.shared.build import BuildSettings, build_scene, builder
from splatpipe.shared.build.pooled import LONGEST, suited_bits
from splatpipe.shared.build.settings import MemoryPlan, resident_bytes
from splatpipe.shared.codecs import streams
from splatpipe.shared.codecs.grid import to_grid
from splatpipe.shared.colour import Colouring
from splatpipe.shared.errors import StoreError
from splatpipe.shared.pooled import LEAST_POINTS, CellGrid, PoolCounts, keys_of, points_of, pooled_cells
from splatpipe.shared.rebuild import rebuild_in_order
from splatpipe.shared.store import Scene
from typer.testing import CliRunner

from .build_sources import ArraySource, columns_for

POOL_ARRAYS = ("cell_pool_points", "cell_pool_bytes", "pool_codes")


def sphere(n=20_000, at=0.0, seed=1):
    points = np.random.default_rng(seed).normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1)[:, None] + at


def build(path, cloud, **options):
    options = {"overwrite": True, "points_per_cell": 1024, "pools": True, "pool_bits": 4} | options
    source = ArraySource(cloud, columns_for(len(cloud)))
    build_scene([source], path, settings=BuildSettings(**options))
    return Scene.open(path)


def distinct_grid_points(scene, octree, cell):
    """The set of grid points of a cell's own range, straight from what is stored."""
    own = slice(int(octree.first_point[cell]), int(octree.first_point[cell] + octree.n_points[cell]))
    first, origin = scene.blocks()
    block = np.searchsorted(first, np.arange(own.start, own.stop), side="right") - 1
    edge = 2 * octree.half_edges[cell]
    lower = octree.centers[cell] - edge / 2
    relative = np.column_stack([column[own] for column in scene.positions()]).astype(np.float64)
    return to_grid(relative + (origin[block] - lower), np.zeros(3), edge, octree.pool_bits)


def as_set(points):
    return set(map(tuple, np.asarray(points).tolist()))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return build(tmp_path_factory.mktemp("pools") / "s.scene", sphere())


# --- building ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
@pytest.mark.parametrize("positions", ["float32", "ci", "groups"])
def test_a_pooled_form_holds_the_distinct_grid_points_of_its_cell(tmp_path, point_order, positions):
    options = {"position_bits": 10, "group_epsilon": 1e-3}
    scene = build(tmp_path / "s", sphere(8_000, 6.4e6), point_order=point_order, positions=positions, **options)
    scene.verify()
    octree, codes = scene.octree(pools=True), scene.pool_codes()
    held = pooled_cells(octree)
    assert len(held) >= 4
    for cell in held:
        points = streams.decode(codes[cell.begin : cell.end], octree.pool_bits, cell.pool_points)
        assert as_set(points) == as_set(distinct_grid_points(scene, octree, cell.cell))
        assert len(points) == cell.pool_points == len(as_set(points))


def test_the_gate_drops_what_does_not_pay(scene):
    octree = scene.octree(pools=True)
    kept = octree.pool_points > 0
    tried = octree.n_points >= LEAST_POINTS
    assert (kept & tried).sum() >= 5
    assert not (kept & ~tried).any()
    for cell in np.flatnonzero(tried):
        points = np.unique(distinct_grid_points(scene, octree, cell), axis=0)
        data = streams.encode(points, octree.pool_bits, 2, longest=LONGEST).data
        pays = streams.keeps_pools(streams.read_pools(data, octree.pool_bits, len(points)))
        assert kept[cell] == pays
        assert octree.pool_bytes[cell] == (len(data) if pays else 0)
    assert scene.info.pool_bytes == octree.pool_bytes.sum() == len(scene.pool_codes())


def test_sparse_cells_have_no_pools(tmp_path):
    scene = build(tmp_path / "s", np.random.default_rng(2).uniform(0, 1, (3000, 3)), pool_bits=6)
    scene.verify()
    counts = PoolCounts.of(scene.octree(pools=True))
    assert counts.pooled == 0 < counts.no_gain
    assert len(scene.pool_codes()) == 0
    points = load_points(scene, Colouring.choose(scene, "rgb"), verify=True)
    assert len(load_pools(scene, points).step) == 0


def arrays_of(scene):
    return {name: (scene.path / f"{name}.npy").read_bytes() for name in scene.info.arrays}


def test_the_same_bits_for_any_number_of_threads(tmp_path):
    one, many = (build(tmp_path / str(n), sphere(8000), threads=n) for n in (1, 5))
    assert arrays_of(one) == arrays_of(many)


def codes_by_cell(scene):
    octree, codes = scene.octree(pools=True), scene.pool_codes()
    return {
        (int(octree.level[cell.cell]), int(octree.code[cell.cell])): bytes(codes[cell.begin : cell.end])
        for cell in pooled_cells(octree)
    }


@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
def test_an_external_build_makes_the_same_pools(tmp_path, monkeypatch, point_order):
    positions = sphere(8000)
    whole = build(tmp_path / "whole", positions, point_order=point_order)
    monkeypatch.setattr(builder, "plan_memory", lambda *_: MemoryPlan(3000, 500))
    parts = build(tmp_path / "parts", positions, point_order=point_order)
    parts.verify()
    assert codes_by_cell(parts) == codes_by_cell(whole) != {}


def test_little_memory_means_fewer_cells_at_a_time_and_the_same_bits(tmp_path):
    plenty = build(tmp_path / "a", sphere(8000), pool_bits=6, threads=4)
    room = resident_bytes() + (350 << 20)
    little = build(tmp_path / "b", sphere(8000), pool_bits=6, threads=4, memory_bytes=room)
    assert arrays_of(plenty) == arrays_of(little)


def test_a_scene_built_anew_in_another_order_keeps_its_pools(scene, tmp_path):
    rebuilt = rebuild_in_order(scene, "depth-first", tmp_path / "new", lambda *_: None)
    rebuilt.verify()
    assert rebuilt.info.pool_bits == scene.info.pool_bits
    assert PoolCounts.of(rebuilt.octree(pools=True)).pooled > 0


def test_bits_that_suit_the_size_of_cells(tmp_path):
    assert [suited_bits(1 << n) for n in (0, 8, 12, 14, 16, 24)] == [4, 5, 6, 6, 7, 8]
    assert build(tmp_path / "s", sphere(3000), pool_bits=0).info.pool_bits == suited_bits(1024)


def test_keys_and_points_are_each_others_inverse():
    points = np.random.default_rng(3).integers(0, 64, (500, 3)).astype(np.uint32)
    np.testing.assert_array_equal(points_of(keys_of(points, 6), 6), points)
    order = np.argsort(keys_of(points, 6), kind="stable")
    np.testing.assert_array_equal(points[order], points[np.lexsort(points.T[::-1])])


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(1, 8), st.integers(1, 200), st.integers(1, 50), st.integers(0, 10_000))
def test_distinct_keys_are_found_chunk_by_chunk(bits, n, chunk, seed):
    """Also of points on the faces of the cube, and a rounding error outside of it."""
    x, y, z = np.random.default_rng(seed).choice([-0.5 - 1e-7, -0.5, 0.0, 0.1, 0.25, 0.5], (3, n)).astype(np.float32)
    grid = CellGrid(np.full(3, 0.5), 1.0, bits)
    expected = np.unique(keys_of(to_grid(np.column_stack([x, y, z]) + 0.5, np.zeros(3), 1.0, bits), bits))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pooled, "_CHUNK", chunk)
        found = grid.distinct_keys(lambda begin, end: (x[begin:end], y[begin:end], z[begin:end]), 0, n)
    np.testing.assert_array_equal(found, expected)


# --- colours ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
def test_a_pooled_point_has_the_colour_of_the_first_point_in_its_bin(tmp_path, point_order):
    positions = sphere(4000)
    colour = np.random.default_rng(4).integers(0, 200, 4000).astype(np.uint32)  # few: the palette is exact
    source = ArraySource(positions, {"rgb": colour})
    options = BuildSettings(points_per_cell=1024, pools=True, pool_bits=4, point_order=point_order)
    build_scene([source], tmp_path / "s", settings=options)
    scene = Scene.open(tmp_path / "s")
    points = load_points(scene, Colouring.choose(scene, "rgb"), verify=True)
    pools, octree, codes = load_pools(scene, points), scene.octree(pools=True), scene.pool_codes()
    held = pooled_cells(octree)
    assert len(held) == len(pools.step) >= 3
    assert pools.first_point.tolist() == [0, *np.cumsum([cell.pool_points for cell in held])]
    for i, cell in enumerate(held):
        first = {}
        for at, point in enumerate(map(tuple, distinct_grid_points(scene, octree, cell.cell).tolist())):
            first.setdefault(point, points.colour[cell.first_point + at])
        decoded = streams.decode(codes[cell.begin : cell.end], octree.pool_bits, cell.pool_points)
        found = pools.palette[i, pools.colour[pools.first_point[i] : pools.first_point[i + 1]]]
        assert found.tolist() == [first[tuple(point)] for point in decoded.tolist()]
        np.testing.assert_array_equal(pools.origin[i], octree.centers[cell.cell] - octree.half_edges[cell.cell])
        assert pools.step[i] == 2 * octree.half_edges[cell.cell] / 2**octree.pool_bits


# --- damage -----------------------------------------------------------------------------------------------------------


def change(scene, path, name, values):
    """A copy of the scene, in which an array is another one, with a checksum that fits."""
    path.mkdir()
    for file in scene.path.iterdir():
        (path / file.name).write_bytes(file.read_bytes())
    np.save(path / f"{name}.npy", values)
    info = json.loads((path / "scene.json").read_text())
    info["arrays"][name]["crc32"] = zlib.crc32(values.tobytes())
    (path / "scene.json").write_text(json.dumps(info))
    return Scene.open(path)


def test_damaged_codes_are_found_by_their_checksum(scene, tmp_path):
    damaged = change(scene, tmp_path / "s", "cell_code", np.load(scene.path / "cell_code.npy"))
    file = damaged.path / "pool_codes.npy"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    with pytest.raises(StoreError, match=r"pool_codes\.npy: checksum"):
        damaged.verify()


@pytest.mark.parametrize("seed", range(8))
def test_damaged_codes_with_a_checksum_that_fits_are_named_with_their_cell(scene, tmp_path, seed):
    rng = np.random.default_rng(seed)
    cells = pooled_cells(scene.octree(pools=True))
    cell = cells[rng.integers(len(cells))]
    codes = np.array(scene.pool_codes())
    codes[rng.integers(cell.begin, cell.end)] ^= 1 << rng.integers(8)
    damaged = change(scene, tmp_path / "s", "pool_codes", codes)
    with pytest.raises(StoreError, match=rf"pool_codes\.npy: cell {cell.cell}: "):
        damaged.verify()
    with pytest.raises(StoreError, match=rf"pool_codes\.npy: cell {cell.cell}: "):
        load_pools(damaged, load_points(damaged, Colouring.choose(damaged, "rgb"), verify=False))


@pytest.mark.parametrize(
    ("array", "by", "message"),
    [
        ("cell_pool_bytes", 1, "their sum is not"),
        ("cell_pool_points", 1, "expected|other grid points"),
        ("cell_pool_points", 1 << 20, "more than the cell owns"),
    ],
)
def test_counts_that_do_not_fit_are_refused(scene, tmp_path, array, by, message):
    values = np.load(scene.path / f"{array}.npy")
    values[np.flatnonzero(values)[0]] += np.uint32(by)
    with pytest.raises(StoreError, match=message):
        change(scene, tmp_path / "s", array, values).verify()


def test_a_scene_without_pools_says_so(tmp_path):
    scene = build(tmp_path / "s", sphere(500), pools=False)
    with pytest.raises(StoreError, match="no pooled cells: build it with --pools"):
        scene.octree(pools=True)
    with pytest.raises(StoreError, match="no pooled cells: build it with --pools"):
        scene.pool_codes()


# --- what is said -----------------------------------------------------------------------------------------------------


def run(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result.output


def test_info_says_which_cells_have_pools_and_why_the_others_have_none(scene, tmp_path):
    run("info", scene.path, "--json", tmp_path / "i.json")
    told = json.loads((tmp_path / "i.json").read_text())["pooled_cells"]
    octree = scene.octree(pools=True)
    kept, few = octree.pool_points > 0, octree.n_points < LEAST_POINTS
    assert told == [
        f"{kept.sum()} of {len(octree)} cells with points have a pooled form",
        f"too few points (below 256): {few.sum()}",
        f"saving less than 25% of three bytes a point: {(~kept & ~few).sum()}",
    ]


def test_synth_builds_pools_and_info_says_where_there_are_none(tmp_path):
    run("synth", tmp_path / "with", "--points", 20_000, "--pools")
    run("synth", tmp_path / "without", "--points", 20_000)
    assert Scene.open(tmp_path / "with").info.pool_bits == 6
    assert "without --pools" in run("info", tmp_path / "without")
    run("verify", tmp_path / "with")
