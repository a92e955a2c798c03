"""Inputs larger than memory: the same scene as in memory, whatever the memory, and bounded."""

from __future__ import annotations

import shutil
import subprocess
import sys

import numpy as np
import pytest
from splatpipe.shared.build import BuildSettings, build_scene, builder, runs
from splatpipe.shared.build.holes import punch_hole
from splatpipe.shared.build.settings import MemoryPlan, resident_bytes
from splatpipe.shared.errors import InputError
from splatpipe.shared.points import pack_normals
from splatpipe.shared.readers import open_source
from splatpipe.shared.store import Scene

from .build_sources import ArraySource, cells_of, columns_for


def clouds(kind, n, rng):
    match kind:
        case "uniform":
            return rng.uniform(-50, 50, (n, 3))
        case "surface":
            p = rng.normal(size=(n, 3))
            return p / np.linalg.norm(p, axis=1)[:, None]
        case "clustered":  # a cluster far below the bucket level, and an outlier
            p = rng.normal(0, 1e-4, (n, 3))
            p[0] = 1000.0
            return p
        case "coincident":
            p = np.full((n, 3), 3.25)
            p[: n // 10] = rng.uniform(0, 8, (n // 10, 3))
            return p
        case "flat":
            return rng.uniform(0, 100, (n, 3)) * [1, 1, 1e-7]
    raise ValueError(kind)


def build(tmp, source, plan, monkeypatch, **options):
    monkeypatch.setattr(builder, "plan_memory", lambda *_: plan)
    out = tmp / f"scene-{plan.capacity}"
    report = build_scene([source], out, settings=BuildSettings(overwrite=True, **options))
    scene = Scene.open(out)
    scene.verify()
    assert {f.name for f in out.iterdir()} == {"scene.json"} | {f"{name}.npy" for name in scene.info.arrays}
    return report, cells_of(out)


@pytest.mark.parametrize("kind", ["uniform", "surface", "clustered", "coincident", "flat"])
@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
@pytest.mark.parametrize("flatness", [0.0, 1e-3])
def test_scene_does_not_depend_on_memory(tmp_path, monkeypatch, kind, point_order, flatness):
    rng = np.random.default_rng(7)
    positions = clouds(kind, 7000, rng)
    columns = columns_for(len(positions), ("rgb", "gps_time")) | {
        "normal": pack_normals(rng.normal(size=(7000, 3)) + 2)
    }
    source = ArraySource(positions, columns)
    options = {"point_order": point_order, "flatness": flatness, "points_per_cell": 32}
    report, whole = build(tmp_path, source, MemoryPlan(10_000, 900), monkeypatch, **options)
    assert report.n_partitions == 1
    assert report.spilled_bytes == 0
    for capacity, chunk in ((5000, 1 << 17), (2100, 1 << 17), (2100, 300)):
        monkeypatch.setattr(runs, "_CHUNK", chunk)
        report, parts = build(tmp_path, source, MemoryPlan(capacity, 500), monkeypatch, **options)
        assert report.spilled_bytes > 0
        assert parts == whole


@pytest.mark.data
@pytest.mark.parametrize(
    "file", ["formats/lion_takanawa.copc.laz", "models/stanford-bunny_35947.ply", "formats/fusa.laz"]
)
def test_real_scans_do_not_depend_on_memory(tmp_path, monkeypatch, data_dir, file):
    source = open_source(data_dir / file)
    _, whole = build(tmp_path, source, MemoryPlan(1 << 20, 1 << 18), monkeypatch)
    report, parts = build(tmp_path, source, MemoryPlan(10_000, 4096), monkeypatch)
    assert report.n_partitions > 3
    assert parts == whole


class CountingSource(ArraySource):
    """Says how often it was read, and with which attributes."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.passes = []

    def _read(self, max_points, attributes):
        self.passes.append(attributes)
        return super()._read(max_points, attributes)


@pytest.mark.parametrize(
    ("bounds", "passes"),
    [
        ("true", [("rgb",)]),
        (None, [("rgb",), ()]),  # a second pass, over the positions, when the memory is full
        (([-1.0] * 3, [0.5] * 3), [("rgb",), ("rgb",)]),  # points outside: once more with the bounds found
        (([-1e9] * 3, [1e9] * 3), [("rgb",), ("rgb",)]),  # far too wide
    ],
)
def test_input_is_read_once_unless_its_bounds_are_missing_or_wrong(tmp_path, monkeypatch, bounds, passes):
    positions = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
    if bounds not in ("true", None):
        bounds = tuple(np.array(b) for b in bounds)
    source = CountingSource(positions, columns_for(5000), bounds=bounds)
    _, whole = build(tmp_path, source, MemoryPlan(10_000, 900), monkeypatch, points_per_cell=50)
    assert source.passes == [("rgb",)]
    source.passes.clear()
    report, parts = build(tmp_path, source, MemoryPlan(2100, 900), monkeypatch, points_per_cell=50)
    assert source.passes == passes
    assert report.n_partitions > 1
    assert parts == whole


@pytest.mark.parametrize("n_points", [None, 3000])
def test_count_of_the_header_is_not_needed(tmp_path, monkeypatch, n_points):
    positions = np.random.default_rng(0).uniform(-1, 1, (3000, 3))
    source = ArraySource(positions, n_points=n_points)
    report, _ = build(tmp_path, source, MemoryPlan(1 << 20, 900), monkeypatch)
    assert (report.n_points, report.n_partitions) == (3000, 1)


def test_header_that_promises_a_trillion_points_allocates_nothing_for_them(tmp_path):
    source = ArraySource(np.zeros((10, 3)), n_points=10**12)
    with pytest.raises(InputError, match="found 10 points, expected the 1000000000000"):
        build_scene([source], tmp_path / "s", settings=BuildSettings(memory_bytes=resident_bytes() + (1 << 30)))
    assert not list(tmp_path.iterdir())


def test_too_little_memory_says_how_much_is_needed(tmp_path):
    with pytest.raises(InputError, match=r"memory_bytes = 1000000, expected at least \d+"):
        build_scene([ArraySource(np.zeros((10, 3)))], tmp_path / "s", settings=BuildSettings(memory_bytes=1_000_000))


_MEASURED = """
import sys
from pathlib import Path
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.readers import open_source
settings = BuildSettings(memory_bytes=int(sys.argv[3]))
report = build_scene([open_source(Path(sys.argv[1]))], sys.argv[2], settings=settings)
print(report.n_partitions, report.peak_bytes)
"""


def test_memory_is_bounded(tmp_path):
    """4 million points, of which a quarter fits: peak resident memory below the limit and a quarter."""
    rng = np.random.default_rng(1)
    np.save(tmp_path / "cloud.npy", rng.uniform(0, 1, (4_000_000, 3)) * [100, 100, 1])
    memory = 330 << 20
    command = [sys.executable, "-c", _MEASURED, str(tmp_path / "cloud.npy"), str(tmp_path / "s"), str(memory)]
    subprocess.run(command, check=True, capture_output=True)  # compiling takes memory of its own, once
    shutil.rmtree(tmp_path / "s")
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    n_partitions, peak = map(int, printed.split())
    assert n_partitions > 2
    assert peak < memory * 1.25
    Scene.open(tmp_path / "s").verify()


def test_runs_give_back_their_disk_space_as_partitions_are_taken(tmp_path, monkeypatch):
    """As far as the file system can: what is left of the runs shrinks from partition to partition."""
    probe = tmp_path / "probe"
    probe.write_bytes(bytes(1 << 20))
    punch_hole(probe, 4096, 1 << 19)
    assert probe.read_bytes() == bytes(1 << 20)
    if probe.stat().st_blocks * 512 >= 1 << 20:
        pytest.skip("a file system without holes")
    held = []

    def add_from_runs(self, runs, partition, n_total):
        held.append(sum(file.stat().st_blocks * 512 for file in (self.writer.partial / "runs").iterdir()))
        add(self, runs, partition, n_total)

    add = builder.Build.add_from_runs
    monkeypatch.setattr(builder.Build, "add_from_runs", add_from_runs)
    positions = np.random.default_rng(3).uniform(0, 100, (120_000, 3))
    source = ArraySource(positions, columns_for(len(positions)))
    report, _ = build(tmp_path, source, MemoryPlan(30_000, 30_000), monkeypatch)
    assert report.n_partitions > len(held) > 4, "one more for the cells above"
    assert held == sorted(held, reverse=True)
    points_left = held[-1] - held[0] + 28 * len(positions)
    assert points_left < 0.5 * 28 * len(positions), "the files keep their tables of buckets"
