"""Scenes whose positions are coded cell by cell: the same points as a float32 scene's, rounded, whatever damage is told."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
import zlib
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from splatpipe.cluster.launch import mpi_available
from splatpipe.nodes.raster.cpu import CpuRasterizer
from splatpipe.nodes.render import Wanted, load_points
from splatpipe.shared.build import BuildSettings, build_scene, builder
from splatpipe.shared.build.settings import MemoryPlan
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.codecs.grid import from_grid, to_grid
from splatpipe.shared.codecs.linear_groups import LinearGroupCodec
from splatpipe.shared.codecs.positions import position_codec
from splatpipe.shared.colour import Colouring
from splatpipe.shared.errors import CodecError, InputError, StoreError
from splatpipe.shared.messages import RENDER_POINT
from splatpipe.shared.rebuild import rebuild_in_order
from splatpipe.shared.scene_info import POINT_ORDERS, POSITIONS
from splatpipe.shared.store import Scene

from .build_sources import ArraySource, cells_of, columns_for

CODECS = POSITIONS[1:]
BITS, EPSILON = 7, 0.004
LOWER, UPPER = np.array([6.4e5, -2.0, 30.0]), np.array([6.4e5 + 4.0, 2.0, 31.0])
OPTIONS = {"one": {}, "many": {"points_per_cell": 150}, "duplicates": {"points_per_cell": 60, "max_depth": 4}}
SPLATPIPE = [sys.executable, "-m", "splatpipe.cluster"]
needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
each_codec = pytest.mark.parametrize("codec", CODECS)
each_order = pytest.mark.parametrize("order", POINT_ORDERS)
each_cloud = pytest.mark.parametrize("cloud", OPTIONS)


def points_of(cloud):
    """A wavy sheet; of duplicates, 80 places of it, one of which holds more points than a cell may."""
    rng = np.random.default_rng(5)
    u, v = rng.random((2, {"one": 900, "many": 3000, "duplicates": 1500}[cloud]))
    unit = np.column_stack([u, v, 0.5 + 0.4 * np.sin(6 * u) * np.cos(5 * v)])
    unit[:2] = [[0, 0, 0], [1, 1, 1]]
    if cloud == "duplicates":
        unit = unit[rng.integers(0, 80, len(unit))]
        unit[-200:] = unit[0]
    return LOWER + unit * (UPPER - LOWER)


def source(cloud):
    points = points_of(cloud)
    columns = columns_for(len(points), ("rgb", "intensity"))
    columns["intensity"] = (np.arange(len(points)) * 7 % 65536).astype(columns["intensity"].dtype)
    return ArraySource(points, columns)


def options(cloud, order, codec, **more):
    return BuildSettings(
        point_order=order,
        positions=codec,
        position_bits=BITS,
        group_epsilon=EPSILON,
        overwrite=True,
        **OPTIONS[cloud] | more,
    )


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """(cloud, order, codec) → scene, each built once."""
    folder, built = tmp_path_factory.mktemp("coded"), {}

    def scene(cloud, order, codec):
        if (cloud, order, codec) not in built:
            path = folder / f"{cloud}-{order}-{codec}"
            build_scene([source(cloud)], path, settings=options(cloud, order, codec))
            built[cloud, order, codec] = Scene.open(path)
        return built[cloud, order, codec]

    return scene


@dataclass
class CellPoints:
    """A cell's own points: relative to their block; which of the input; the lower corner of the cube there; a bin."""

    relative: np.ndarray
    number: np.ndarray
    lower: np.ndarray
    step: float
    edge: float


def cells_by_key(scene):
    """(level, code) → the points that the cell owns."""
    octree, (first, origin) = scene.octree(), scene.blocks()
    columns, rgb = scene.positions(), scene.attribute("rgb")
    found = {}
    for cell in octree.owners:
        own = slice(octree.first_point[cell], octree.first_point[cell] + octree.n_points[cell])
        block = np.searchsorted(first, own.start, side="right") - 1
        edge = 2 * octree.half_edges[cell]
        found[int(octree.level[cell]), int(octree.code[cell])] = CellPoints(
            np.column_stack([column[own] for column in columns]),
            np.asarray(rgb[own]),
            octree.centers[cell] - edge / 2 - origin[block],
            float(np.ldexp(edge, -BITS)),
            float(edge),
        )
    return found


@each_cloud
@each_order
@each_codec
def test_points_are_those_of_float32_rounded_with_their_attributes(scenes, cloud, order, codec):
    coded, plain = scenes(cloud, order, codec), scenes(cloud, order, "float32")
    coded.verify()
    assert not set("xyz") & set(coded.info.arrays)
    assert (coded.info.positions, coded.info.position_bits) == (codec, BITS)
    there, expected = cells_by_key(coded), cells_by_key(plain)
    assert there.keys() == expected.keys()
    assert (len(there) > 1) == (cloud != "one")
    epsilon = EPSILON * float((UPPER - LOWER).max())
    for key, cell in expected.items():
        found = there[key]
        a, b = np.argsort(found.number), np.argsort(cell.number)
        assert np.array_equal(found.number[a], cell.number[b]), "the same points, each once"
        bins = to_grid(found.relative.astype(np.float64), cell.lower, cell.edge, BITS)
        middle = from_grid(bins, cell.lower, cell.edge, BITS).astype(np.float32)
        assert np.array_equal(middle, found.relative), "at the middle of bins"
        wanted = to_grid(cell.relative.astype(np.float64), cell.lower, cell.edge, BITS)
        off = np.linalg.norm(bins[a].astype(np.int64) - wanted[b], axis=1)
        if codec == "groups":
            assert off.max() <= LinearGroupCodec(epsilon / cell.step).error_bound
        else:
            assert off.max() == 0
    intensity, rgb = coded.attribute("intensity"), coded.attribute("rgb")
    assert np.array_equal(intensity, rgb * 7 % 65536)


@each_cloud
@each_codec
def test_layered_sets_stand_in_stratified_order(scenes, cloud, codec):
    """Of every prefix of a set, the i-th along the curve lies near the i-th of as many strata."""
    assert all(map(is_stratified, cells_by_key(scenes(cloud, "layered", codec)).values()))
    assert not all(map(is_stratified, cells_by_key(scenes("many", "depth-first", codec)).values()))


def is_stratified(cell):
    bins = to_grid(cell.relative.astype(np.float64), cell.lower, cell.edge, BITS).astype(np.int64)
    bit = np.arange(BITS)
    keys = sum((bins[:, axis, None] >> bit & 1) @ (1 << 3 * bit + axis) for axis in range(3))
    along, n = np.sort(keys), len(keys)
    for stratum in 2 ** np.arange(1, int(np.ceil(np.log2(n))) + 1):
        whole = n // stratum
        first, at = np.sort(keys[: -(-n // stratum)])[:whole], np.arange(whole) * stratum
        before, behind = along[np.maximum(at - stratum, 0)], along[np.minimum(at + 2 * stratum, n) - 1]
        if not ((before <= first) & (first <= behind)).all():
            return False
    return True


@each_codec
def test_depth_first_leaves_stand_in_random_order(scenes, codec):
    cell = cells_by_key(scenes("one", "depth-first", codec))[0, 0]
    jumps = np.linalg.norm(np.diff(cell.relative, axis=0), axis=1)
    random = np.random.default_rng(0).permutation(cell.relative)
    assert np.median(jumps) == pytest.approx(np.median(np.linalg.norm(np.diff(random, axis=0), axis=1)), rel=0.1)


def frame(points, scene, threads=1):
    """Words of a picture of the points of all leaves."""
    octree = scene.octree()
    leaves = octree.is_leaf
    entries = np.zeros(leaves.sum(), RENDER_POINT)
    entries["offset"], entries["range"], entries["stride"] = octree.first_point[leaves], octree.n_points[leaves], 1
    middle = (LOWER + UPPER) / 2
    camera = perspective_camera(
        frame=0,
        world_from_camera=look_at(middle + np.array([1, -4, 3]), middle, np.array([0, 0, 1])),
        fov_y_rad=1.0,
        width=120,
        height=90,
        near=0.01,
    )
    with CpuRasterizer(points, 120, 90, threads=threads) as rasterizer:
        return rasterizer.draw(camera, entries).copy()


@pytest.mark.parametrize("cloud", ["many", "duplicates"])
@each_order
@pytest.mark.parametrize("codec", ["ci", "eci", "occupancy"])
def test_a_picture_is_that_of_float32_points_at_the_same_places(scenes, cloud, order, codec):
    coded, plain = scenes(cloud, order, codec), scenes(cloud, order, "float32")
    points = load_points(plain, Colouring.choose(plain, "rgb"), verify=True)
    octree = plain.octree()
    columns = [np.array(column) for column in (points.x, points.y, points.z)]
    cells = cells_by_key(plain)
    for cell in octree.owners:
        own = slice(octree.first_point[cell], octree.first_point[cell] + octree.n_points[cell])
        held = cells[int(octree.level[cell]), int(octree.code[cell])]
        bins = to_grid(held.relative.astype(np.float64), held.lower, held.edge, BITS)
        for column, rounded in zip(columns, from_grid(bins, held.lower, held.edge, BITS).T, strict=True):
            column[own] = rounded
    expected = frame(replace(points, **dict(zip("xyz", columns, strict=True))), plain)
    drawn = load_points(coded, Colouring.choose(coded, "rgb"), verify=True)
    assert np.array_equal(frame(drawn, coded), expected)
    assert np.array_equal(frame(drawn, coded, threads=3), expected)


@each_order
@each_codec
def test_scene_does_not_depend_on_threads_or_memory(tmp_path, monkeypatch, order, codec):
    wanted = source("many")
    made = []
    for capacity, threads in ((10_000, 1), (10_000, 3), (1000, 2)):
        monkeypatch.setattr(builder, "plan_memory", lambda *_, n=capacity: MemoryPlan(n, 900))
        out = tmp_path / f"{capacity}-{threads}"
        report = build_scene([wanted], out, settings=options("many", order, codec, threads=threads))
        scene = Scene.open(out)
        scene.verify()
        assert {f.name for f in out.iterdir()} == {"scene.json"} | {f"{name}.npy" for name in scene.info.arrays}
        made.append((cells_of(out), scene.info.arrays))
    assert report.n_partitions > 1
    assert made[0][1] == made[1][1]
    assert made[0][0] == made[2][0]


def test_a_cell_larger_than_memory_is_refused_before_it_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(builder, "plan_memory", lambda *_: MemoryPlan(1000, 500))
    cloud = ArraySource(np.repeat([[0.0, 0, 0], [1.0, 1, 1]], 1500, axis=0))
    with pytest.raises(InputError, match=r"positions = 'eci': a cell of 1500 points does not fit into memory"):
        build_scene([cloud], tmp_path / "s", settings=options("duplicates", "layered", "eci"))
    assert not list(tmp_path.iterdir())


@each_order
def test_splats_and_features_follow_their_points(tmp_path, order):
    """What is made of neighbours is made before positions are rounded, and goes where its point goes."""
    made = {}
    for codec in ("float32", "occupancy"):
        settings = options("many", order, codec, features=True, pools=True)
        build_scene([source("many")], tmp_path / codec, settings=settings)
        scene = made[codec] = Scene.open(tmp_path / codec)
        scene.verify()
    coded, plain = made["occupancy"], made["float32"]
    for cell in plain.octree().owners[:: 1 if order == "layered" else 2]:
        a, b = (self_range(scene, cell) for scene in (coded, plain))
        order_a, order_b = (np.argsort(scene.attribute("rgb")[own]) for scene, own in ((coded, a), (plain, b)))
        for name in ("normal", "radius"):
            assert np.array_equal(coded.attribute(name)[a][order_a], plain.attribute(name)[b][order_b])
    same = coded.octree(features=True).feature == plain.octree(features=True).feature
    assert same.mean() > 0.9, "cells look alike on a grid of 128 bins"
    assert coded.octree(pools=True).pool_points is not None
    load_points(coded, Colouring.choose(coded, "normal"), Wanted(splats=True, features=True, cells=True), verify=True)


def self_range(scene, cell):
    octree = scene.octree()
    return slice(octree.first_point[cell], octree.first_point[cell] + octree.n_points[cell])


@each_order
def test_a_coded_scene_is_built_again_in_the_other_order(scenes, tmp_path, order):
    coded = scenes("many", order, "eci")
    other = POINT_ORDERS[order == "layered"]
    again = rebuild_in_order(coded, other, tmp_path / "again", lambda *_: None)
    again.verify()
    assert (again.info.positions, again.info.point_order) == ("float32", other)

    def leaf_points(scene):
        octree, (first, origin) = scene.octree(), scene.blocks()
        world = np.empty((scene.info.n_points, 3))
        for cell in np.flatnonzero(octree.is_leaf):
            own = self_range(scene, cell)
            block = np.searchsorted(first, own.start, side="right") - 1
            number = scene.attribute("rgb")[own]
            world[number] = np.column_stack([column[own] for column in scene.positions()]) + origin[block]
        return world

    assert np.allclose(leaf_points(again), leaf_points(coded), rtol=0, atol=1e-6)


# --- reading ----------------------------------------------------------------------------------------------------


def test_positions_are_decoded_once_while_in_use(scenes):
    scene = scenes("many", "layered", "ci")
    x, _, z = scene.positions()
    assert not x.flags.writeable
    assert np.shares_memory(z, scene.positions()[2])
    held = z.copy()
    del x, z, _
    gc.collect()
    assert scene._decoded() is None
    assert np.array_equal(scene.positions()[2], held)


@settings(max_examples=40, deadline=None)
@given(ends=st.tuples(st.integers(0, 6000), st.integers(0, 6000)), codec=st.sampled_from(POSITIONS))
def test_any_range_of_points_is_that_of_all(scenes, ends, codec):
    scene = scenes("many", "layered", codec)
    start, stop = sorted(min(end, scene.info.n_stored) for end in ends)
    assert np.array_equal(scene.position_reader()(start, stop), np.stack(scene.positions())[:, start:stop])


def test_float32_scenes_have_no_codes(scenes):
    with pytest.raises(StoreError, match="positions are float32, expected coded ones"):
        scenes("one", "layered", "float32").coded_positions()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"positions": "zip"}, r"positions = 'zip', expected one of float32, ci, eci, occupancy, groups"),
        ({"position_bits": 0}, r"position_bits = 0, expected 1 … 21 for ci"),
        ({"position_bits": 22}, r"position_bits = 22, expected 1 … 21 for ci"),
        ({"positions": "groups", "position_bits": 17}, r"position_bits = 17, expected 1 … 16 for groups"),
        ({"group_epsilon": float("nan")}, r"group_epsilon = nan, expected a number in \[0, 1\]"),
        ({"group_detail": -0.1}, r"group_detail = -0.1, expected a number in \[0, 1\]"),
    ],
)
def test_what_a_codec_cannot_take_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        BuildSettings(**{"positions": "ci", **changes})


def test_unknown_codecs_are_refused():
    with pytest.raises(CodecError, match="codec of positions: found 'zip', expected ci, eci"):
        position_codec("zip")


def test_progress_shows_the_stage(tmp_path):
    seen = []
    build_scene(
        [source("many")], tmp_path / "s", settings=options("many", "layered", "ci"), progress=lambda *a: seen.append(a)
    )
    steps = [(done, total) for stage, done, total in seen if stage == "positions"]
    assert steps[-1][0] == steps[-1][1] == Scene.open(tmp_path / "s").info.n_stored


# --- damage -----------------------------------------------------------------------------------------------------


@pytest.fixture
def copied(scenes, tmp_path):
    """(order, codec) → a copy of a scene, to damage."""

    def copy(order, codec):
        path = tmp_path / "copy.scene"
        path.mkdir()
        for file in scenes("many", order, codec).path.iterdir():
            (path / file.name).write_bytes(file.read_bytes())
        return path

    return copy


def rewrite(path, name, array, **changes):
    """Replace an array and what ``scene.json`` promises of it."""
    np.save(path / f"{name}.npy", array)
    content = json.loads((path / "scene.json").read_text())
    content["arrays"][name] |= {
        "crc32": zlib.crc32(np.ascontiguousarray(array).data),
        "shape": list(array.shape),
        "bytes": array.nbytes,
    }
    (path / "scene.json").write_text(json.dumps(content | changes))


def damage_of(scene):
    """What ``verify`` says."""
    try:
        scene.verify()
    except StoreError as error:
        return str(error)
    return ""


@each_order
@each_codec
def test_damaged_codes_are_told_and_nothing_else_happens(copied, order, codec):
    path = copied(order, codec)
    codes = np.load(path / "position_codes.npy")
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(30):
        damaged = codes.copy()
        damaged[rng.integers(len(codes), size=rng.integers(1, 4))] ^= rng.integers(1, 256, dtype=np.uint8)
        np.save(path / "position_codes.npy", damaged)
        rewrite(path, "position_codes", damaged)
        scene = Scene.open(path)
        said = damage_of(scene)
        assert "position_codes.npy: cell " in said if said else np.isfinite(np.stack(scene.positions())).all()
        refused += said != ""
    assert refused or codec == "occupancy", "entropy coded: damage mostly gives other points"


def test_a_flipped_bit_is_found_by_its_checksum(copied):
    path = copied("layered", "occupancy")
    file = path / "position_codes.npy"
    data = bytearray(file.read_bytes())
    data[-7] ^= 4
    file.write_bytes(data)
    scene = Scene.open(path)
    with pytest.raises(StoreError, match=r"position_codes\.npy: checksum"):
        scene.verify()
    with pytest.raises(StoreError, match=r"position_codes\.npy: checksum"):
        load_points(scene, Colouring.choose(scene, "rgb"), verify=True)
    done = subprocess.run([*SPLATPIPE, "verify", str(path)], capture_output=True, text=True, timeout=100)
    assert done.returncode == 2
    assert "position_codes.npy: checksum" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_truncated_codes_are_refused_at_once(copied):
    path = copied("layered", "ci")
    file = path / "position_codes.npy"
    file.write_bytes(file.read_bytes()[:-3])
    with pytest.raises(StoreError, match=r"position_codes\.npy: found \d+ bytes, expected \d+"):
        Scene.open(path)


def test_byte_counts_that_do_not_add_up_are_refused(copied):
    path = copied("depth-first", "eci")
    n_bytes = np.load(path / "cell_position_bytes.npy")
    octree = Scene.open(path).octree()
    leaf, inner = np.flatnonzero(octree.is_leaf)[[0, 3]], np.flatnonzero(~octree.is_leaf)[0]

    def refused(**changes):
        damaged = n_bytes.copy()
        for cell, value in changes.items():
            damaged[int(cell[1:])] = value
        rewrite(path, "cell_position_bytes", damaged)
        with pytest.raises(StoreError) as error:
            Scene.open(path).positions()
        return str(error.value)

    total = int(n_bytes.sum())
    assert f"their sum is {total + 1}, expected {total}" in refused(**{f"c{leaf[0]}": n_bytes[leaf[0]] + 1})
    assert "no code for a cell that owns points" in refused(**{f"c{leaf[0]}": 0})
    assert "a cell that owns no points" in refused(**{f"c{inner}": 1})
    moved = {f"c{leaf[0]}": n_bytes[leaf[0]] - 1, f"c{leaf[1]}": n_bytes[leaf[1]] + 1}
    assert f"position_codes.npy: cell {leaf[0]}: " in refused(**moved)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"position_bits": 0}, "position_bits = 0 of groups, expected 1 … 16"),
        ({"position_bits": 17}, "position_bits = 17 of groups, expected 1 … 16"),
        ({"position_bytes": 0}, "position_bytes = 0 of groups, expected a whole number > 0"),
        ({"positions": "float32"}, "position_bits = 7 of float32, expected 0"),
        ({"positions": "zip"}, "positions = zip, expected one of float32, ci"),
    ],
)
def test_what_scene_json_says_of_positions_is_checked(copied, changes, message):
    path = copied("layered", "groups")
    content = json.loads((path / "scene.json").read_text())
    (path / "scene.json").write_text(json.dumps(content | changes))
    with pytest.raises(StoreError, match=message):
        Scene.open(path)


def test_codes_of_more_points_than_the_cell_has_are_refused(copied):
    path = copied("depth-first", "ci")
    scene = Scene.open(path)
    coded = scene.coded_positions()
    n = coded.cells.n_points(0)
    more = position_codec("ci").encode(np.zeros((10**9 // 8**6, 3), np.uint32), BITS).data
    codes = np.concatenate([more, coded.codes[coded.first_byte[1] :]])
    n_bytes = np.load(path / "cell_position_bytes.npy")
    n_bytes[coded.cells.cell[0]] = len(more)
    rewrite(path, "cell_position_bytes", n_bytes)
    rewrite(path, "position_codes", codes, position_bytes=len(codes))
    with pytest.raises(StoreError, match=rf"cell {coded.cells.cell[0]}: .*more than {n} points"):
        Scene.open(path).positions()


def test_more_points_than_memory_holds_are_refused(tmp_path):
    """No attribute's file bounds their number, and what repeats takes hardly a byte."""
    path = tmp_path / "s"
    build_scene([ArraySource(np.ones((50, 3)))], path, settings=BuildSettings(positions="eci"))
    many = 1 << 45
    for name in ("cell_n_points", "cell_n_below"):
        rewrite(path, name, np.array([many]), n_points=many, n_stored=many)
    with pytest.raises(StoreError, match=rf"position_codes\.npy: found {many} points, expected as many as fit"):
        Scene.open(path).positions()


# --- from the command line --------------------------------------------------------------------------------------


def pictures(folder):
    return np.stack([np.asarray(Image.open(path)) for path in sorted(folder.glob("frame_*.png"))])


def call(*arguments):
    return subprocess.run([*SPLATPIPE, *map(str, arguments)], capture_output=True, text=True, timeout=100)


@needs_mpi
@pytest.mark.mpi
def test_three_ranks_draw_a_coded_scene_as_one_does(scenes, tmp_path):
    config = tmp_path / "run.toml"
    scene = scenes("many", "layered", "occupancy").path
    config.write_text(
        f'[scene]\npath = "{scene}"\n[camera]\nwidth = 120\nheight = 90\n[output]\nframes = 2\n'
        '[render]\nrasterizer = "cpu"\ncolour = "elevation"\npoint_size_adaptive = true\n[sampling]\npixel_threshold = 8\n'
    )
    ways = {"single": (), "pipelined": (), "messages": ("--set", "scene.delivery=messages")}
    for way, sets in ways.items():
        topology = "single" if way == "single" else "pipelined"
        out = f"output.directory={tmp_path / way}"
        done = call("run", config, "--set", f"pipeline.topology={topology}", "--set", out, *sets)
        assert done.returncode == 0, done.stderr
    one = pictures(tmp_path / "single")
    assert np.array_equal(one, pictures(tmp_path / "pipelined"))
    assert np.array_equal(one, pictures(tmp_path / "messages"))
    assert len(np.unique(one[0].reshape(-1, 3), axis=0)) > 20, "the picture shows something"


def test_build_and_info(tmp_path):
    points = tmp_path / "points.npy"
    np.save(points, points_of("many"))
    scene = tmp_path / "s"
    flags = ("--positions", "occupancy", "--position-bits", 10, "--points-per-cell", 500)
    assert call("build", points, "-o", scene, *flags).returncode == 0
    Scene.open(scene).verify()
    done = call("info", scene, "--json", tmp_path / "info.json")
    assert done.returncode == 0
    said = json.loads((tmp_path / "info.json").read_text())
    octree, info = Scene.open(scene).octree(), Scene.open(scene).info
    assert (said["positions"], said["position_bits"]) == ("occupancy", 10)
    assert said["position_bytes_per_point"] == pytest.approx(info.position_bytes / info.n_stored, abs=1e-3)
    halves = octree.half_edges[octree.is_leaf] / 2**10
    assert said["position_error_coarsest_leaf"] == pytest.approx(halves.max(), rel=1e-2)
    assert said["position_error_finest_leaf"] == pytest.approx(halves.min(), rel=1e-2)
    assert "position error coarsest leaf" in done.stdout
