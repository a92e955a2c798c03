"""The scene store: whatever is wrong with a directory is found and named, and no half scene ever looks whole."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.errors import InputError, StoreError
from splatpipe.shared.points import pack_normals
from splatpipe.shared.store import Scene

from .build_sources import ArraySource, columns_for


def source(n=20_000, seed=0):
    rng = np.random.default_rng(seed)
    columns = columns_for(n, ("rgb", "intensity")) | {"normal": pack_normals(rng.normal(size=(n, 3)))}
    return ArraySource(rng.uniform(0, 100, (n, 3)) * [1, 1, 0.1], columns, crs="LOCAL")


@pytest.fixture(scope="module", params=["layered", "depth-first"])
def built(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / f"{request.param}.scene"
    build_scene([source()], path, settings=BuildSettings(points_per_cell=200, point_order=request.param, up="z"))
    return path


@pytest.fixture
def scene(built, tmp_path):
    """A copy to damage."""
    copy = tmp_path / "copy.scene"
    copy.mkdir()
    for file in built.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    return copy


def edit_json(scene, **changes):
    file = scene / "scene.json"
    content = json.loads(file.read_text()) | changes
    file.write_text(json.dumps({key: value for key, value in content.items() if value != "removed"}))


def test_what_was_built_is_read(built):
    scene = Scene.open(built)
    scene.verify()
    info = scene.info
    assert (info.n_points, info.up, info.crs) == (20_000, "z", "LOCAL")
    assert info.attributes == ("rgb", "normal", "intensity")
    assert info.n_cells == len(scene.octree())
    assert [len(column) for column in scene.positions()] == [info.n_stored] * 3
    assert isinstance(scene.positions()[0], np.memmap)
    assert not isinstance(scene.attribute("rgb", mmap=False), np.memmap)
    with pytest.raises(StoreError, match="attribute gps_time not found, expected one of rgb, normal, intensity"):
        scene.attribute("gps_time")


def test_verify_reports_progress(built):
    seen = []
    Scene.open(built).verify(lambda stage, done, total: seen.append((stage, done, total)))
    assert {stage for stage, _, _ in seen} == {"check", "points"}
    assert all(done <= total for _, done, total in seen)


def arrays_of(scene):
    return sorted(file.stem for file in Path(scene).glob("*.npy"))


def test_every_damaged_byte_of_an_array_is_found(scene):
    rng = random.Random(1)
    for name in arrays_of(scene):
        file = scene / f"{name}.npy"
        whole = file.read_bytes()
        damaged = bytearray(whole)
        damaged[rng.randrange(128, len(whole))] ^= 1 << rng.randrange(8)
        file.write_bytes(damaged)
        with pytest.raises(StoreError, match=rf"{name}\.npy: checksum"):
            Scene.open(scene).verify()
        with pytest.raises(StoreError, match=rf"{name}\.npy: checksum"):
            Scene.open(scene).check([name])
        if name.startswith("cell_"):
            with pytest.raises(StoreError, match=rf"{name}\.npy: checksum"):
                Scene.open(scene).octree()
        file.write_bytes(whole)
    Scene.open(scene).verify()


def test_headers_as_numpy_writes_them_are_not_parsed(built, monkeypatch):
    """That takes ``ast.parse``, which may fail in two threads at once in Python before 3.11.8."""
    monkeypatch.setattr(np.lib.format, "read_array_header_1_0", lambda _: pytest.fail("a header was parsed"))
    monkeypatch.setattr("ast.parse", lambda *_, **__: pytest.fail("a header was parsed"))
    scene = Scene.open(built)
    scene.verify()
    for mmap in (True, False):
        assert [len(column) for column in scene.positions(mmap)] == [scene.info.n_stored] * 3


def test_headers_written_otherwise_are_read(scene):
    file = scene / "x.npy"
    whole, expected = file.read_bytes(), Scene.open(scene).positions(mmap=False)[0]
    length = int.from_bytes(whole[8:10], "little")
    header, data = whole[10 : 10 + length], whole[10 + length :]
    longer = header.replace(b"{'descr'", b"{ 'descr'").rstrip() + b" " * 77 + b"\n"
    file.write_bytes(whole[:8] + len(longer).to_bytes(2, "little") + longer + data)
    other = Scene.open(scene)
    other.verify()
    for mmap in (True, False):
        assert np.array_equal(other.positions(mmap)[0], expected)


@pytest.mark.parametrize("damage", ["short", "long", "gone", "empty", "header", "pickle"])
def test_arrays_of_the_wrong_size_are_refused_at_once(scene, damage):
    file = scene / "x.npy"
    whole = file.read_bytes()
    match damage:
        case "short":
            file.write_bytes(whole[:-1])
        case "long":
            file.write_bytes(whole + b"\0")
        case "gone":
            file.unlink()
        case "empty":
            file.write_bytes(b"")
        case "header":
            file.write_bytes(whole.replace(b"'<f4'", b"'<i4'", 1))
        case "pickle":
            np.save(file, np.array([{}], object), allow_pickle=True)
    with pytest.raises(StoreError, match=r"x\.npy: "):
        Scene.open(scene)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": 4}, r"format_version = 4, this splatpipe reads up to 3: upgrade splatpipe"),
        ({"format_version": "1"}, "format_version = '1', expected a whole number"),
        ({"edge": -1.0}, "edge = -1.0, expected a number > 0"),
        ({"edge": "removed"}, "edge not found"),
        ({"origin": [1, 2]}, r"origin = \[1, 2\], expected three finite numbers"),
        ({"lower": [0, 0, 10**400]}, "lower = .*, expected three finite numbers"),
        ({"n_cells": 10**15}, "array cell_level: found"),
        ({"n_stored": True}, "n_stored = True"),
        ({"attributes": ["rgb", "colour"]}, "attributes = "),
        ({"attributes": ["rgb"]}, "arrays: attr_intensity is unknown"),
        ({"point_order": "random"}, "point_order = random, expected one of layered, depth-first"),
        ({"arrays": {"x": {}}}, "arrays = "),
        ({"sources": [{}]}, "sources = "),
    ],
)
def test_wrong_scene_file(scene, changes, message):
    edit_json(scene, **changes)
    with pytest.raises(StoreError, match=rf"scene\.json: {message}"):
        Scene.open(scene)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"a":' * 100_000, "\xff\xfe", "[1e999]"])
def test_scene_file_that_is_no_json_object(scene, text):
    (scene / "scene.json").write_text(text, encoding="latin-1")
    with pytest.raises(StoreError, match=r"scene\.json: "):
        Scene.open(scene)


def test_scene_of_version_1_opens(tmp_path):
    """A scene of three points in one cell, as the first version wrote it."""
    arrays = {
        "cell_level": np.zeros(1, "u1"),
        "cell_code": np.zeros(1, "<u8"),
        "cell_parent": np.full(1, -1, "<i4"),
        "cell_first_child": np.full(1, -1, "<i4"),
        "cell_n_children": np.zeros(1, "u1"),
        "cell_first_point": np.zeros(1, "<i8"),
        "cell_n_points": np.full(1, 3, "<i8"),
        "cell_n_below": np.full(1, 3, "<i8"),
        "x": np.array([-0.5, 0.0, 0.5], "<f4"),
        "y": np.zeros(3, "<f4"),
        "z": np.zeros(3, "<f4"),
        "attr_rgb": np.full(3, 0xFF808080, "<u4"),
        "block_first_point": np.zeros(1, "<i8"),
        "block_origin": np.array([[0.5, 0.5, 0.5]]),
    }
    for name, array in arrays.items():
        np.save(tmp_path / f"{name}.npy", array)
    content = {
        "point_order": "layered",
        "origin": [0.0, 0.0, 0.0],
        "edge": 1.0,
        "lower": [0.0, 0.5, 0.5],
        "upper": [1.0, 0.5, 0.5],
        "n_points": 3,
        "n_stored": 3,
        "n_cells": 1,
        "n_blocks": 1,
        "n_dropped": 0,
        "attributes": ["rgb"],
        "block_levels": 0,
        "up": "z",
        "crs": None,
        "sources": [{"name": "cloud.npy", "n_points": 3}],
        "build": {},
        "arrays": {
            name: {
                "dtype": array.dtype.str,
                "shape": list(array.shape),
                "bytes": array.nbytes,
                "crc32": zlib.crc32(array.tobytes()),
            }
            for name, array in arrays.items()
        },
        "format_version": 1,
    }
    (tmp_path / "scene.json").write_text(json.dumps(content))
    scene = Scene.open(tmp_path)
    scene.verify()
    assert (scene.info.features, scene.info.splats) == (False, False)
    assert scene.octree().n_points.tolist() == [3]
    edit_json(tmp_path, format_version=2)
    with pytest.raises(StoreError, match=r"scene\.json: features not found"):
        Scene.open(tmp_path)


def test_not_a_scene(tmp_path):
    for path in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(StoreError, match="not a scene"):
            Scene.open(path)


@pytest.mark.parametrize(
    "array", ["parent", "first_child", "n_children", "code", "level", "first_point", "n_points", "n_below"]
)
def test_links_that_do_not_hold_together_are_named(scene, array):
    """With checksums made to fit: what a faulty writer would leave."""
    file = scene / f"cell_{array}.npy"
    values = np.load(file)
    rng = np.random.default_rng(3)
    for _ in range(20):
        damaged = values.copy()
        cell = rng.integers(1, len(values))
        damaged[cell] += np.asarray(rng.choice([1, 2, 7]), values.dtype)
        np.save(file, damaged)
        info = json.loads((scene / "scene.json").read_text())
        info["arrays"][f"cell_{array}"]["crc32"] = zlib.crc32(damaged.tobytes())
        (scene / "scene.json").write_text(json.dumps(info))
        with pytest.raises(StoreError, match=r"cell_\w+\.npy: entry \d+: "):
            Scene.open(scene).octree()


def test_a_point_outside_its_cell_is_found(scene):
    x = np.load(scene / "x.npy")
    x[777] += 60
    np.save(scene / "x.npy", x)
    info = json.loads((scene / "scene.json").read_text())
    info["arrays"]["x"]["crc32"] = zlib.crc32(x.tobytes())
    (scene / "scene.json").write_text(json.dumps(info))
    with pytest.raises(StoreError, match=r"x\.npy: point 777 lies outside the cube of cell"):
        Scene.open(scene).verify()


def test_an_existing_scene_is_only_replaced_when_asked(tmp_path):
    out = tmp_path / "s"
    build_scene([source(100)], out)
    with pytest.raises(InputError, match="the scene exists"):
        build_scene([source(200)], out)
    assert Scene.open(out).info.n_points == 100
    build_scene([source(200)], out, settings=BuildSettings(overwrite=True))
    assert Scene.open(out).info.n_points == 200
    bad = source(300)
    bad.positions[:] = np.nan
    with pytest.raises(InputError):
        build_scene([bad], out, settings=BuildSettings(overwrite=True))
    assert Scene.open(out).info.n_points == 200
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


def test_what_is_not_a_scene_is_never_replaced(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("years")
    (tmp_path / "file").write_text("years")
    for name in ("folder", "file"):
        with pytest.raises(InputError, match="exists and is not a scene"):
            build_scene([source(100)], tmp_path / name, settings=BuildSettings(overwrite=True))
    assert (tmp_path / "folder" / "thesis.txt").read_text() == (tmp_path / "file").read_text() == "years"


def test_scene_set_aside_by_a_killed_replacement_comes_back(tmp_path):
    out = tmp_path / "s"
    build_scene([source(100)], out)
    out.rename(tmp_path / ".s.replaced")
    with pytest.raises(InputError, match="the scene exists"):
        build_scene([source(10)], out)
    assert Scene.open(out).info.n_points == 100
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


_CHILD = """
import resource, sys
import numpy as np
sys.path.insert(0, {root!r})
from tests.test_store import source
from splatpipe.shared.build import BuildSettings, build_scene, builder
from splatpipe.shared.build.settings import MemoryPlan
capacity, limit = int(sys.argv[2]), int(sys.argv[3])
builder.plan_memory = lambda *_: MemoryPlan(capacity, 20_000)
points = source(200_000)
if limit:
    import signal
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
print("ready", flush=True)
try:
    build_scene([points], sys.argv[1], settings=BuildSettings(points_per_cell=200, overwrite=True))
except Exception as error:
    print(type(error).__name__, error)
"""


def child(out, capacity, limit=0):
    root = str(Path(__file__).parent.parent)
    code = _CHILD.format(root=root)
    return subprocess.Popen(
        [sys.executable, "-c", code, str(out), str(capacity), str(limit)], stdout=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize("capacity", [1 << 30, 30_000])
def test_killed_build_leaves_nothing_that_looks_whole(tmp_path, capacity):
    rng = random.Random(capacity)
    out = tmp_path / "s"
    process = child(out, capacity)
    assert process.stdout is not None
    process.stdout.readline()
    started = time.perf_counter()
    process.communicate()
    whole_s = time.perf_counter() - started
    killed = 0
    for share in (0.0, *(rng.uniform(0, 1) for _ in range(5))):  # the first is killed before it can be done
        shutil.rmtree(out, ignore_errors=True)
        process = child(out, capacity)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(share * whole_s)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        if out.exists():
            Scene.open(out).verify()  # it was done before
        else:
            killed += 1
            with pytest.raises(StoreError):
                Scene.open(out)
    assert killed
    process = child(out, capacity)
    process.communicate()
    Scene.open(out).verify()
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


@pytest.mark.parametrize("capacity", [1 << 30, 30_000])
def test_full_disk_is_one_line_and_leaves_nothing(tmp_path, capacity):
    printed, _ = child(tmp_path / "s", capacity, limit=300_000).communicate()
    assert "disk full" in printed.splitlines()[1]
    assert printed.splitlines()[1].startswith("InputError")
    assert not list(tmp_path.iterdir())


def test_unwritable_output_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file is not a writable folder"):
        build_scene([source(10)], tmp_path / "file" / "s")


def test_two_builds_of_one_scene_do_not_mix(tmp_path):
    import fcntl

    (tmp_path / ".s.partial").mkdir()
    lock = os.open(tmp_path / ".s.partial", os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    with pytest.raises(InputError, match="another build of it is running"):
        build_scene([source(10)], tmp_path / "s")
    os.close(lock)
    (tmp_path / ".s.partial" / "x.npy").write_text("stale")
    build_scene([source(10)], tmp_path / "s")
    Scene.open(tmp_path / "s").verify()
