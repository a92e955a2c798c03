"""Topologies on any number of ranks: the bits of one rank, whatever does not divide; and what is refused."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from splatpipe.cluster.job import Job
from splatpipe.cluster.launch import find_mpiexec, mpi_available
from splatpipe.cluster.plan.command import plan_command
from splatpipe.nodes.raster.cpu import CpuRasterizer
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config
from splatpipe.shared.errors import ConfigError, MessageError
from splatpipe.shared.framebuffer_runs import encode_runs, merge_runs, most_bytes
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from splatpipe.shared.scene_share import SceneShare, clip_entries, share_borders
from splatpipe.shared.store import Scene
from splatpipe.shared.synth import CityScan

SPLATPIPE = [sys.executable, "-m", "splatpipe.cluster"]
needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
BORDER = "[{ lower = [40, 40, -1], upper = [180, 180, 500] }]"


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A small city of a prime number of points in both orders and coded, and one of a single cell."""
    folder = tmp_path_factory.mktemp("scenes")
    city = CityScan(n_points=20_011)
    for order in ("layered", "depth-first"):
        build_scene([city], folder / order, settings=BuildSettings(point_order=order, points_per_cell=300))
    build_scene([city], folder / "coded", settings=BuildSettings(points_per_cell=300, positions="occupancy"))
    build_scene([CityScan(n_points=101)], folder / "one", settings=BuildSettings(points_per_cell=1000))
    return folder


@pytest.fixture
def config(scenes, tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(
        f'[scene]\npath = "{scenes}/layered"\n[camera]\nwidth = 163\nheight = 91\n'
        '[render]\npoint_size_px = 2\nrasterizer = "cpu"\n[output]\nframes = 5\n'
    )
    return path


def command(config: Path, out: Path, *sets: str) -> list[str]:
    return [*SPLATPIPE, "run", str(config)] + [
        part for item in (f"output.directory={out}", *sets) for part in ("--set", item)
    ]


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(arguments, capture_output=True, text=True, timeout=100, check=False)


def drawn(config: Path, out: Path, *sets: str) -> tuple[dict[str, bytes], dict]:
    """The files of the pictures of a run, and its record."""
    done = call(*command(config, out, *sets))
    assert done.returncode == 0, done.stderr
    files = {path.name: path.read_bytes() for path in out.iterdir() if path.suffix in (".png", ".tiff")}
    return files, json.loads((out / "run.json").read_text())


def film_of(out: Path) -> np.ndarray:
    """(n, h, w, 3) uint8: the frames of a run's film."""
    av = pytest.importorskip("av")
    with av.open(str(out / "film.mp4")) as film:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)])


# --- whole runs --------------------------------------------------------------------------------------------------


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize(
    ("order", "sets"),
    [("layered", ["render.positions=compact"]), ("depth-first", ["sampling.pixel_threshold=6"])],
)
def test_a_share_of_the_points_on_each_rank_gives_the_bits_of_one_rank(config, scenes, tmp_path, order, sets):
    sets = [*sets, f"scene.path={scenes / order}", "render.colour=elevation"]
    alone, single = drawn(config, tmp_path / "single", "pipeline.topology=single", *sets)
    assert len(alone) == 5
    for n in (1, 2, 3, 4):
        together, run = drawn(
            config, tmp_path / str(n), "pipeline.topology=sort-last-only", f"pipeline.ranks={n}", *sets
        )
        assert together == alone
        assert (run["topology"], len(run["ranks"])) == ("sort-last-only", n)
        assert run["per_frame"]["points"] == single["per_frame"]["points"]
        held = [rank["points"] for rank in run["ranks"]]
        assert sum(held) == Scene.open(scenes / order).info.n_stored
        assert max(held) - min(held) <= 2 * max(300, 2048), "balanced up to a cell"
        assert run["messages"].get("FRAMEBUFFER", {"count": 0})["count"] == 5 * (n - 1)
        assert all(rank["rss_bytes"] > 1e6 for rank in run["ranks"])


@needs_mpi
@pytest.mark.mpi
def test_functionality_and_data_distributed_together_give_the_bits_of_one_rank(config, tmp_path):
    """Real ranks; every topology on any number of them is in test_layout.py, as threads."""
    alone, single = drawn(config, tmp_path / "single", "pipeline.topology=single")
    for topology, n in (("master-slave", 4), ("hybrid", 7), ("sort-first", 4), ("sort-last", 4)):
        together, run = drawn(config, tmp_path / topology, f"pipeline.topology={topology}", f"pipeline.ranks={n}")
        assert together == alone, topology
        assert (run["topology"], len(run["ranks"])) == (topology, n)
        assert len({rank["role"] for rank in run["ranks"]}) == n
        assert {"culling_s", "sampling_s", "render_s", "points"} <= run["per_frame"].keys()
        if topology != "sort-first":
            assert run["per_frame"]["points"] == single["per_frame"]["points"]


@needs_mpi
@pytest.mark.mpi
def test_whole_pictures_on_each_rank_are_those_of_one_rank(config, tmp_path):
    pytest.importorskip("av")
    sets = ["output.depth=true", "output.normals=true", "camera.view=stereo", "camera.stereo_base=2", "output.mp4=true"]
    alone, single = drawn(config, tmp_path / "single", "pipeline.topology=single", *sets)
    assert len(alone) == 15
    film = film_of(tmp_path / "single")
    assert film.shape == (5, 90, 326, 3)
    for n in (1, 2, 3, 4):
        together, run = drawn(
            config, tmp_path / str(n), "pipeline.topology=frame-parallel", f"pipeline.ranks={n}", *sets
        )
        assert together == alone
        assert np.array_equal(film_of(tmp_path / str(n)), film), "one encoder has seen the same pictures in their order"
        assert len(run["per_frame"]["mp4_s"]) == 5
        assert run["messages"].get("FILM_PICTURE", {}).get("count", 0) == 5 - len(range(0, 5, n))
        assert (run["topology"], len(run["ranks"]), run["frames"]) == ("frame-parallel", n, 5)
        for name in ("points", "entries", "cells_visible"):
            assert run["per_frame"][name] == single["per_frame"][name], "in the order of frames"
        assert [rank["stages"]["render"]["work_ms"]["min"] > 0 for rank in run["ranks"]] == [True] * n
        assert len(run["per_frame"]["png_s"]) == 5


@needs_mpi
@pytest.mark.mpi
def test_ranks_without_a_cell_or_a_picture_have_nothing_to_do(config, scenes, tmp_path):
    sets = [
        f"scene.path={scenes}/one",
        "output.frames=2",
        "render.point_size_adaptive=true",
        "pipeline.compositing=binary-swap",
        "pipeline.ranks=3",
    ]
    alone, _ = drawn(config, tmp_path / "one", *sets[:-1], "pipeline.topology=single")
    for topology in ("sort-last-only", "frame-parallel"):
        assert drawn(config, tmp_path / topology, *sets, f"pipeline.topology={topology}")[0] == alone


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize("topology", ["frame-parallel", "sort-last-only"])
def test_the_world_of_mpirun_is_taken_or_refused_in_one_line(config, tmp_path, topology):
    started = [str(find_mpiexec()), "-n", "2", *command(config, tmp_path / "out", f"pipeline.topology={topology}")]
    done = call(*started)
    assert done.returncode == 0, done.stderr
    assert len(json.loads((tmp_path / "out" / "run.json").read_text())["ranks"]) == 2
    for n in (1, 3):
        done = call(*started, "--set", f"pipeline.ranks={n}")
        assert done.returncode == 2
        said = [line for line in done.stderr.splitlines() if line.startswith("splatpipe:")]
        assert said == [f"splatpipe: pipeline.ranks: found 2 ranks, expected {n}: mpirun -n {n}"]


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize(("topology", "role"), [("frame-parallel", "pictures"), ("sort-last-only", "share 1")])
def test_a_killed_rank_ends_the_run_and_is_named(config, tmp_path, topology, role):
    out = tmp_path / "out"
    sets = ["output.frames=100000", f"pipeline.topology={topology}", "pipeline.ranks=2"]
    process = subprocess.Popen(command(config, out, *sets), stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not (out / "frame_0002.png").exists():
        time.sleep(0.02)
    pid = pid_of(1, out)
    os.kill(pid, signal.SIGKILL)
    _, said = process.communicate(timeout=5)
    assert process.returncode == 1
    assert not (out / "run.json").exists()
    assert said == f"splatpipe: rank 1 ({role}, pid {pid}) died: killed by SIGKILL\n"


def pid_of(rank: int, out: Path) -> int:
    """Process of a rank that writes to ``out``."""
    for entry in Path("/proc").iterdir():
        try:
            ours = entry.name.isdigit() and str(out).encode() in (entry / "cmdline").read_bytes()
            if ours and f"PMI_RANK={rank}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                return int(entry.name)
        except OSError:
            continue
    raise AssertionError(f"no rank {rank}")


# --- what is refused, what is said -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sets", "expected"),
    [
        (["pipeline.ranks=4"], "pipeline.ranks = 4: pipeline.topology = 'auto' has three at most"),
        (["pipeline.topology=frame-parallel", "scene.delivery=messages"], "scene.delivery = 'messages'"),
        (["pipeline.topology=sort-last-only", "scene.delivery=messages"], "scene.delivery = 'messages'"),
        (["pipeline.topology=sort-last-only", "render.positions=coded"], "render.positions = 'coded': .*stored points"),
        (["pipeline.ranks=-1"], "pipeline.ranks = -1"),
    ],
)
def test_what_a_topology_cannot_do_is_refused(config, sets, expected):
    with pytest.raises(ConfigError, match=expected):
        Job(load_config(config, sets))


def test_the_plan_says_what_the_topology_does(config):
    said = {}
    for topology in ("frame-parallel", "sort-last-only"):
        plan = plan_command(config, [f"pipeline.topology={topology}", "pipeline.ranks=4"])
        said[topology] = plan["plan"]["reason"]
        (compositing,) = [part for part in plan["parts"] if part["what"] == "compositing"]
        assert compositing["left_out"] == (topology == "frame-parallel")
    assert compositing["gain"] == pytest.approx(3e-6 * 163 * 91 * 8)
    assert "each of 4 ranks opens the whole scene" in said["frame-parallel"]
    assert "4 ranks, 4 cull, 4 sample, 4 render about" in said["sort-last-only"]


# --- shares ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [2, 7])
@pytest.mark.parametrize(
    ("scene", "sets"),
    [
        ("layered", ["render.point_size_adaptive=true", "render.colour=level"]),
        ("depth-first", ["render.point_size_adaptive=true", "render.colour=intensity"]),
        ("layered", ["filter.classes=[2, 6]", f"filter.boxes={BORDER}", "render.colour=classification"]),
        ("depth-first", [f"filter.boxes={BORDER}", "render.positions=compact"]),
        ("coded", ["render.colour=elevation"]),
        ("one", ["render.colour=#ff8000"]),
    ],
)
def test_shares_drawn_apart_meet_in_the_same_words(config, scenes, scene, sets, n):
    job = Job(load_config(config, [f"scene.path={scenes / scene}", *sets, "pipeline.topology=single"]))
    octree, camera = job.load_octree(), job.camera(1)
    chosen = job.sampling_node(octree).process(camera, job.culling_node(octree).process(camera)).entries
    with job.make_rasterizer(job.load_drawn(verify=True)) as rasterizer:
        expected = rasterizer.draw(camera, chosen).copy()
    assert (expected != FRAMEBUFFER_EMPTY).any()
    borders = share_borders(octree, n).tolist()
    assert (borders[0], borders[-1]) == (0, job.scene.info.n_stored)
    shares = [SceneShare(job.scene, *borders[i : i + 2], checked_by=(i, n)) for i in range(n)]
    if job.colouring.range_is_open:
        samples = [
            job.colouring.range_sample(s, b, job.scene.info.n_stored) for s, b in zip(shares, borders, strict=False)
        ]
        job.colouring = job.colouring.with_range_of(np.concatenate(samples))
    met = np.full(expected.shape, FRAMEBUFFER_EMPTY)
    for i, share in enumerate(shares):
        points = job.load_drawn(share, verify=True)
        assert len(points) == borders[i + 1] - borders[i]
        with job.make_rasterizer(points) as rasterizer:
            assert isinstance(rasterizer, CpuRasterizer)
            words = rasterizer.draw(camera, clip_entries(chosen, *borders[i : i + 2]))
            merge_runs(encode_runs(words.reshape(-1)).data, met.reshape(-1))
    assert np.array_equal(met, expected)


def test_a_share_of_a_coded_scene_decodes_no_other(scenes, monkeypatch):
    scene = Scene.open(scenes / "coded")
    whole = np.stack(scene.positions())
    first, stop = share_borders(scene.octree(), 3)[1:3].tolist()
    asked = []
    monkeypatch.setattr(Scene, "position_reader", lambda _: lambda a, b: asked.append((a, b)) or whole[:, a:b].copy())
    assert np.array_equal(SceneShare(scene, first, stop).positions(), whole[:, first:stop])
    assert asked == [(first, stop)]


entry = st.tuples(st.integers(0, 60), st.integers(1, 40), st.integers(1, 9))


@given(st.lists(entry, max_size=8), st.integers(0, 60), st.integers(0, 60))
def test_clipped_entries_name_the_points_of_the_share(entries, first, more):
    whole = np.array(entries, RENDER_POINT)
    stop = first + more
    found = [p for o, n, s in clip_entries(whole, first, stop).tolist() for p in range(o, o + n, s)]
    assert found == [p - first for o, n, s in entries for p in range(o, o + n, s) if first <= p < stop]


# --- framebuffers by runs ----------------------------------------------------------------------------------------

words_of = st.lists(st.one_of(st.just(int(FRAMEBUFFER_EMPTY)), st.integers(0, 2**64 - 1)), min_size=1, max_size=60).map(
    lambda values: np.array(values, np.uint64)
)


@given(words_of, st.integers(0, 2**32))
def test_runs_are_the_words_and_meet_in_their_minimum(words, seed):
    runs = encode_runs(words)
    assert len(runs) <= most_bytes(len(words))
    ours = np.random.default_rng(seed).integers(0, 2**64, len(words), np.uint64)
    met = ours.copy()
    merge_runs(runs.data, met)
    assert np.array_equal(met, np.minimum(ours, words))


def test_background_takes_no_bytes():
    assert len(encode_runs(np.full(10_000, FRAMEBUFFER_EMPTY))) == 8


@given(words_of, st.data())
def test_damaged_runs_are_refused_or_stay_within_the_picture(words, data):
    payload = bytearray(encode_runs(words).tobytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(payload) - 1))
        payload[at] = data.draw(st.integers(0, 255))
    payload = payload[: data.draw(st.integers(0, len(payload)))] if data.draw(st.booleans()) else payload
    met = np.zeros(len(words), np.uint64)
    before = met.copy()
    with contextlib.suppress(MessageError):
        merge_runs(payload, met)
    assert np.array_equal(met, before), "nothing is below 0"


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ([], "at least 8"),
        ([1, 0], "expected 16"),
        ([2**32 - 1, 2**32 - 1], "expected 68719476728"),
        ([1, 1, 10, 1, 5, 5], "beyond its 10 pixels"),
        ([1, 0, 3, 0], "empty, overlap"),
        ([2, 4, 3, 2, 4, 2, *[0] * 8], "empty, overlap"),
        ([1, 1, 3, 2, 0, 0], "found 1 words, expected 2"),
    ],
)
def test_runs_that_lie_are_refused(numbers, expected):
    with pytest.raises(MessageError, match=expected):
        merge_runs(np.array(numbers, "<u4").tobytes(), np.zeros(10, np.uint64))
