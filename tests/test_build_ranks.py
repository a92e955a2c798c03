"""Builds on several ranks: the scene of one process, bit for bit, whatever the number of ranks; all or nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import zlib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.cluster.build_ranks import without_ranks
from splatpipe.cluster.launch import find_mpiexec, mpi_available
from splatpipe.shared.build import BuildSettings, build_scene, builder, on_ranks
from splatpipe.shared.build import settings as build_settings
from splatpipe.shared.build.on_ranks import build_scene_on_ranks
from splatpipe.shared.build.ranks import FailedElsewhere
from splatpipe.shared.build.settings import MemoryPlan
from splatpipe.shared.build.shares import consecutive, input_share
from splatpipe.shared.crc import crc32_combine
from splatpipe.shared.errors import InputError, SplatpipeError
from splatpipe.shared.points import PointBatch, concatenate, pack_normals
from splatpipe.shared.readers import open_source
from splatpipe.shared.readers.described import DescribedSource, described
from splatpipe.shared.store import Scene
from splatpipe.shared.synth import CityScan

from .build_sources import ArraySource, cells_of, columns_for
from .reader_files import write_las
from .thread_ranks import on_threads

needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
SPLATPIPE = [sys.executable, "-m", "splatpipe.cluster"]


@pytest.fixture(autouse=True)
def process_of_its_own(monkeypatch):
    """Ranks that are threads of the tests' process do not each hold what that holds, which is much by now."""
    monkeypatch.setattr(build_settings, "resident_bytes", lambda: 200 << 20)


class PartSource(ArraySource):
    """An array that can be read in parts."""

    part_points = 1

    def _read_part(self, first, last, max_points, attributes):
        for i in range(first, last, max_points):
            part = slice(i, min(i + max_points, last))
            yield PointBatch(self.positions[part], {name: self.columns[name][part] for name in attributes})


def cloud(kind, n, seed=0):
    rng = np.random.default_rng(seed)
    match kind:
        case "uniform":
            positions = rng.uniform(-50, 50, (n, 3))
        case "surface":
            positions = rng.normal(size=(n, 3))
            positions /= np.linalg.norm(positions, axis=1)[:, None]
        case "lattice":
            positions = np.column_stack([np.arange(n) % 40, np.arange(n) // 40 % 40, np.full(n, seed)]) * 0.5
        case "coincident":
            positions = np.full((n, 3), 3.25)
            positions[: n // 10] = rng.uniform(0, 8, (n // 10, 3))
    columns = columns_for(n, ("rgb", "gps_time"), seed) | {"normal": pack_normals(rng.normal(size=(n, 3)) + 2)}
    return positions, columns


def several_sources(kind="uniform", bounds="true"):
    """Four inputs, two of which can be read in parts; one of them is a single point."""
    kinds = (PartSource, ArraySource, ArraySource, PartSource)
    sizes = (2900, 900, 1, 1700)
    return [
        source(*cloud(kind, n, seed), name=f"{seed}.npy", bounds=bounds)
        for seed, (source, n) in enumerate(zip(kinds, sizes, strict=True))
    ]


def build_together(sources, out, size, **options):
    """The report of rank 0. Raises what the first rank that failed raises."""
    told = BuildSettings(**{"overwrite": True, "threads": 2, "points_per_cell": 32} | options)
    done = on_threads(size, lambda ranks: build_scene_on_ranks(sources, out, ranks, settings=told))
    for result in done:
        if isinstance(result, Exception) and not isinstance(result, FailedElsewhere):
            raise result
    assert done[1:] == [None] * (size - 1)
    assert not [path for path in out.parent.iterdir() if path.name.startswith(".")]
    Scene.open(out).verify()
    return done[0]


def bytes_of(scene):
    """File name → bytes, but for ``scene.json``; its arrays with their checksums."""
    files = {path.name: path.read_bytes() for path in sorted(scene.glob("*.npy"))}
    assert {f"{name}.npy" for name in Scene.open(scene).info.arrays} == files.keys()
    assert {path.name for path in scene.iterdir()} == files.keys() | {"scene.json"}
    return files


@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
@pytest.mark.parametrize("kind", ["uniform", "surface", "coincident"])
def test_scene_does_not_depend_on_the_number_of_ranks(tmp_path, kind, point_order):
    sources = several_sources(kind)
    options = {"point_order": point_order, "points_per_cell": 32}
    whole = build_scene(sources, tmp_path / "one", settings=BuildSettings(**options))
    expected, files = cells_of(tmp_path / "one"), None
    for size in (1, 2, 3, 4, 7):
        report = build_together(sources, tmp_path / "together", size, **options)
        assert (report.n_points, report.n_cells, report.n_stored) == (whole.n_points, whole.n_cells, whole.n_stored)
        assert (report.n_ranks, report.n_partitions > 1, report.spilled_bytes > 0) == (size, True, True)
        assert cells_of(tmp_path / "together") == expected
        files = files or bytes_of(tmp_path / "together")
        assert bytes_of(tmp_path / "together") == files
    assert Scene.open(tmp_path / "together").info.sources == Scene.open(tmp_path / "one").info.sources


@pytest.mark.parametrize("point_order", ["layered", "depth-first"])
def test_little_memory_flat_cells_and_leaves_larger_than_memory(tmp_path, monkeypatch, point_order):
    sources = several_sources("coincident")
    options = {"point_order": point_order, "points_per_cell": 32, "flatness": 1e-3}
    build_scene(sources, tmp_path / "one", settings=BuildSettings(**options))
    monkeypatch.setattr(builder, "plan_memory", lambda *_: MemoryPlan(2100, 500))
    report = build_together(sources, tmp_path / "together", 3, **options)
    assert report.n_points > 2 * 2100
    assert cells_of(tmp_path / "together") == cells_of(tmp_path / "one")


@pytest.mark.parametrize("bounds", [None, ([-1.0] * 3, [0.5] * 3), ([-1e9] * 3, [1e9] * 3)])
def test_ranks_agree_on_the_root_cube_where_headers_are_missing_or_wrong(tmp_path, bounds):
    sources = several_sources(bounds=bounds and tuple(np.array(b) for b in bounds))
    build_scene(sources, tmp_path / "one", settings=BuildSettings(points_per_cell=32))
    build_together(sources, tmp_path / "together", 3)
    assert cells_of(tmp_path / "together") == cells_of(tmp_path / "one")


def test_fewer_points_than_ranks(tmp_path):
    source = PartSource(*cloud("uniform", 2))
    build_scene([source], tmp_path / "one", settings=BuildSettings())
    build_together([source], tmp_path / "together", 4)
    assert cells_of(tmp_path / "together") == cells_of(tmp_path / "one")


def test_dropped_points_are_counted_over_all_ranks(tmp_path):
    positions, columns = cloud("uniform", 3000)
    positions[::100] = np.nan
    sources = [PartSource(positions, columns, name="a.npy"), ArraySource(positions[:150], name="b.npy")]
    one = build_scene(sources, tmp_path / "one", settings=BuildSettings(points_per_cell=32))
    together = build_together(sources, tmp_path / "together", 3)
    assert (together.n_dropped, together.dropped_attributes) == (one.n_dropped, one.dropped_attributes)
    assert one.n_dropped == 32
    assert cells_of(tmp_path / "together") == cells_of(tmp_path / "one")


@pytest.mark.parametrize(
    "options", [{"positions": "occupancy"}, {"positions": "ci", "position_bits": 6, "point_order": "depth-first"}]
)
def test_coded_positions_and_pools_are_those_of_one_process(tmp_path, options):
    sources = several_sources("lattice")
    options = {"points_per_cell": 512, "pools": True, "pool_bits": 5} | options
    build_scene(sources, tmp_path / "one", settings=BuildSettings(**options))
    for size in (1, 3):
        build_together(sources, tmp_path / str(size), size, **options)
    assert cells_of(tmp_path / "3") == cells_of(tmp_path / "one")
    one, three = bytes_of(tmp_path / "one"), bytes_of(tmp_path / "3")
    assert np.load(tmp_path / "one" / "cell_pool_bytes.npy").any()
    for name in ("cell_pool_bytes", "cell_pool_points", "cell_position_bytes"):
        assert one[f"{name}.npy"] == three[f"{name}.npy"]
    assert three == bytes_of(tmp_path / "1")


def test_features_and_radii_are_the_same_for_any_number_of_ranks(tmp_path):
    sources = several_sources("surface")
    options = {"points_per_cell": 256, "features": True, "normals": "estimate", "attributes": ("rgb", "normal")}
    for size in (2, 3):
        build_together(sources, tmp_path / str(size), size, **options)
    assert bytes_of(tmp_path / "2") == bytes_of(tmp_path / "3")
    assert {"radius", "normal"} <= set(Scene.open(tmp_path / "2").info.attributes)


class BrokenSource(ArraySource):
    """Ends with an error after its points."""

    def __init__(self, error, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.error = error

    def _read(self, max_points, attributes):
        yield from super()._read(max_points, attributes)
        raise self.error


def test_a_rank_that_fails_fails_all_and_leaves_nothing(tmp_path):
    sources = [*several_sources(), BrokenSource(InputError("c.npy: broken"), *cloud("uniform", 4000), name="c.npy")]
    first, second, third = on_threads(3, lambda ranks: build_scene_on_ranks(sources, tmp_path / "s", ranks))
    assert isinstance(first, FailedElsewhere)
    assert {first.exit_status, second.exit_status, third.exit_status} == {2}
    assert [str(error) for error in (second, third) if type(error) is InputError] == ["c.npy: broken"]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("stage", ["read", "write"])
def test_what_should_not_happen_on_a_rank_ends_all_of_them(tmp_path, stage):
    def build(ranks):
        def progress(now, done, total):
            if now == stage and ranks.rank == 1:
                raise ZeroDivisionError("oops")

        return build_scene_on_ranks(several_sources(), tmp_path / "s", ranks, progress=progress)

    first, second = on_threads(2, build)
    assert (type(first), type(second)) == (FailedElsewhere, SplatpipeError)
    assert (first.exit_status, str(second)) == (1, "ZeroDivisionError: oops")
    assert not list(tmp_path.iterdir())


def test_folder_that_ranks_do_not_share_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(on_ranks, "_PATIENCE_S", 0.05)
    sources = several_sources()
    done = on_threads(2, lambda ranks: build_scene_on_ranks(sources, tmp_path / f"host {ranks.rank}", ranks))
    assert isinstance(done[0], FailedElsewhere)
    assert isinstance(done[1], InputError)
    assert str(done[1]).startswith(f"{tmp_path / 'host 1'}: found no folder that rank 0 shares")
    assert not list(tmp_path.iterdir())


def test_memory_is_that_of_the_host(tmp_path):
    with pytest.raises(InputError, match="memory_bytes = 1000000, expected at least"):
        build_together(several_sources(), tmp_path / "s", 4, memory_bytes=4_000_000)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.binary(max_size=80), st.binary(max_size=600))
def test_checksums_of_parts_make_that_of_the_whole(a, b):
    assert crc32_combine(zlib.crc32(a), zlib.crc32(b), len(b)) == zlib.crc32(a + b)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    st.lists(st.tuples(st.integers(1, 400), st.sampled_from([None, 1, 50])), min_size=1, max_size=6), st.integers(1, 9)
)
def test_shares_of_inputs_are_all_points_once_and_in_order(files, size):
    sources = []
    for n, part_points in files:
        source = PartSource(np.full((n, 3), float(len(sources))))
        source.positions[:, 1] = np.arange(n)
        source.part_points = part_points
        sources.append(source)
    shares = [input_share(sources, rank, size) for rank in range(size)]
    read = [(i, batch.positions) for share in shares for i, source in share for batch in source.batches(33)]
    assert np.array_equal(np.concatenate([p for _, p in read]), np.concatenate([s.positions for s in sources]))
    assert all((positions[:, 0] == i).all() for i, positions in read)
    if all(part_points == 1 for _, part_points in files):
        counts = [sum(source.info.n_points for _, source in share) for share in shares]
        assert max(counts) - min(counts) <= 1


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.lists(st.integers(1, 1000), max_size=40), st.integers(1, 9))
def test_consecutive_items_of_nearly_equal_weight(weights, size):
    parts = [consecutive(np.array(weights, np.int64), rank, size) for rank in range(size)]
    assert [i for part in parts for i in range(len(weights))[part]] == list(range(len(weights)))
    assert all(sum(weights[part]) <= sum(weights) / size + max(weights, default=0) for part in parts)


def in_parts(source, cuts, max_points):
    ends = [0, *sorted(cuts), source.info.n_points]
    parts = [source.part(a, b) for a, b in pairwise(ends) if a < b]
    return concatenate([batch for part in parts for batch in part.batches(max_points)])


def assert_parts_are_the_whole(source, max_points=70_000):
    whole = concatenate(list(source.batches(max_points)))
    n = source.info.n_points
    for cuts in ((n // 2,), (1, n // 3, n - 1)):
        parts = in_parts(source, cuts, max_points)
        assert parts.positions.tobytes() == whole.positions.tobytes()
        assert {k: v.tobytes() for k, v in parts.attributes.items()} == {
            k: v.tobytes() for k, v in whole.attributes.items()
        }


@pytest.mark.parametrize("name", ["3.las", "3.laz", "7.laz", "a.npy", "city"])
def test_parts_of_a_file_are_the_file(tmp_path, name):
    positions = np.random.default_rng(0).uniform(0, 100, (120_000, 3))
    if name == "city":
        source = CityScan(80_000)
    elif name == "a.npy":
        np.save(tmp_path / name, positions)
        source = open_source(tmp_path / name)
    else:
        columns = {"intensity": np.arange(120_000) % 65536, "red": np.arange(120_000) % 65521}
        path = write_las(tmp_path / name, positions, point_format=int(name[0]), **columns)
        source = open_source(path)
    assert_parts_are_the_whole(source)


@pytest.mark.data
@pytest.mark.parametrize("file", ["lone-star.copc.laz", "lion_takanawa.copc.laz", "zurich.laz"])
def test_parts_of_files_with_chunks_of_several_sizes(data_dir, file):
    assert_parts_are_the_whole(open_source(data_dir / "formats" / file), 100_000)


def test_what_a_source_says_crosses_and_it_is_opened_to_be_read(tmp_path):
    positions, columns = cloud("uniform", 50)
    source = PartSource(positions, columns, name="x.npy", crs="some")
    opened = []

    def open_named(name):
        opened.append(name)
        return source

    told = DescribedSource(described(source), open_named)
    assert (told.part_points, opened) == (1, [])
    assert described(told) == described(source)
    assert np.array_equal(concatenate(list(told.batches(7))).positions, positions)
    assert np.array_equal(concatenate(list(told.part(5, 9).batches(7))).positions, positions[5:9])
    assert opened == ["x.npy", "x.npy"]


def test_options_of_the_ranks():
    assert without_ranks(["build", "a", "--ranks", "3", "-o", "b"]) == ["build", "a", "-o", "b"]
    assert without_ranks(["build", "--ranks=3", "a"]) == ["build", "a"]


def call(*arguments, timeout=100):
    return subprocess.run([*map(str, arguments)], capture_output=True, text=True, timeout=timeout)


@pytest.fixture
def survey(tmp_path):
    positions = np.random.default_rng(0).uniform(0, 100, (60_000, 3))
    write_las(tmp_path / "a.laz", positions)
    write_las(tmp_path / "b.las", positions[:20_000] + 3)
    return tmp_path


@needs_mpi
@pytest.mark.mpi
def test_ranks_that_the_command_starts_build_the_scene_of_one(survey):
    build_scene([open_source(survey / name) for name in ("a.laz", "b.las")], survey / "one", settings=BuildSettings())
    done = call(*SPLATPIPE, "build", survey / "*.la?", "-o", survey / "s", "--ranks", 3, "--json", survey / "s.json")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"wrote {survey / 's'}: 80,000 points")
    assert cells_of(survey / "s") == cells_of(survey / "one")
    assert '"n_ranks": 3' in (survey / "s.json").read_text()


def test_ranks_do_not_write_point_files(tmp_path):
    done = call(*SPLATPIPE, "synth", tmp_path / "a.las", "--points", 1000, "--ranks", 2)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "a point file is written by one process" in done.stderr


@needs_mpi
@pytest.mark.mpi
def test_bad_file_of_one_of_the_ranks_that_mpirun_started_is_one_line(survey):
    (survey / "z.csv").write_text("x,y,z\n" + "1,2,3\n" * 100_000 + "2,bad,3\n")
    before = {path.name for path in survey.iterdir()}
    done = call(find_mpiexec(), "-n", 2, *SPLATPIPE, "build", survey, "-o", survey / "s")
    assert done.returncode == 2
    said = [line for line in done.stderr.splitlines() if line.startswith("splatpipe:")]
    assert said == [f"splatpipe: rank 1: {survey / 'z.csv'}: line 100002: found 'bad', expected a number"]
    assert {path.name for path in survey.iterdir()} == before


def pid_of_rank(out: Path, rank: int) -> int | None:
    for entry in Path("/proc").iterdir():
        try:
            names_it = entry.name.isdigit() and str(out).encode() in (entry / "cmdline").read_bytes()
            if names_it and f"PMI_RANK={rank}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                return int(entry.name)
        except OSError:
            continue
    return None


@needs_mpi
@pytest.mark.mpi
def test_a_killed_rank_leaves_nothing_that_looks_whole(tmp_path):
    """And what it leaves, the next build removes."""
    out = tmp_path / "s"
    command = [*SPLATPIPE, "synth", str(out), "--points", "20000000", "--ranks", "2"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 60
    while not list(tmp_path.glob(".s.partial/rank-00001/runs")):
        assert time.monotonic() < end
        assert process.poll() is None
        time.sleep(0.02)
    pid = pid_of_rank(out, 1)
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "died: killed by SIGKILL" in said
    assert not out.exists()
    build_scene([PartSource(*cloud("uniform", 100))], out, settings=BuildSettings())
    Scene.open(out).verify()
    assert [path.name for path in tmp_path.iterdir()] == ["s"]
