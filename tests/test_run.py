"""`splatpipe run` as its user meets it: whole processes, pictures compared, ranks killed."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from splatpipe.cluster.launch import find_mpiexec, mpi_available
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.synth import CityScan

SPLATPIPE = [sys.executable, "-m", "splatpipe.cluster"]
needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """The same small city in both point orders, with cells small enough that level of detail has work to do."""
    folder = tmp_path_factory.mktemp("scenes")
    for order in ("layered", "depth-first"):
        settings = BuildSettings(point_order=order, points_per_cell=300)
        build_scene([CityScan(n_points=60_000)], folder / order, settings=settings)
    return folder


def command(config: Path, out: Path, **settings) -> list[str]:
    settings = {"output.directory": out, "camera.width": 160, "camera.height": 90, **settings}
    return [*SPLATPIPE, "run", str(config)] + [
        part for key, value in settings.items() for part in ("--set", f"{key}={value}")
    ]


@pytest.fixture
def config(scenes, tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(f'[scene]\npath = "{scenes}/layered"\n[render]\npoint_size_px = 2\n[output]\nframes = 3\n')
    return path


def call(*arguments, timeout=100, env=None) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*arguments], capture_output=True, text=True, timeout=timeout, env=env)


def pictures(folder: Path) -> np.ndarray:
    return np.stack([np.asarray(Image.open(path)) for path in sorted(folder.glob("frame_*.png"))])


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize("order", ["layered", "depth-first"])
def test_three_ranks_draw_the_same_bits_as_one(scenes, config, tmp_path, order):
    for threshold in (0, 6):
        drawn = {}
        for topology in ("single", "pipelined"):
            out = tmp_path / f"{topology}{threshold}"
            settings = {"scene.path": scenes / order, "pipeline.topology": topology}
            settings |= {"sampling.pixel_threshold": threshold, "render.rasterizer": "cpu"}
            done = call(*command(config, out, **settings))
            assert done.returncode == 0, done.stderr
            drawn[topology] = pictures(out)
            run = json.loads((out / "run.json").read_text())
            assert (run["topology"], len(run["per_frame"]["points"])) == (topology, 3)
        assert drawn["single"].shape == (3, 90, 160, 3)
        assert np.array_equal(drawn["single"], drawn["pipelined"])
        assert len(np.unique(drawn["single"][0].reshape(-1, 3), axis=0)) > 100, "the picture shows something"
    assert run["per_frame"]["points"][0] < 60_000, "a coarse threshold draws fewer points"


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize(
    "filters",
    [
        {"filter.classes": [2, 6]},
        {"filter.boxes": "[{ lower = [40, 40, -1], upper = [180, 180, 500] }]"},
        {
            "filter.classes": [6],
            "filter.boxes": "[{ lower = [-1e3, -1e3, -9], upper = [150, 150, 99], keep = 'outside' }]",
        },
    ],
    ids=["classes", "box", "both"],
)
def test_three_ranks_filter_as_one_does(config, tmp_path, filters):
    run = {}
    for name, settings in (("all", {}), ("single", filters), ("pipelined", filters)):
        topology = {"pipeline.topology": "pipelined" if name == "pipelined" else "single"}
        done = call(*command(config, tmp_path / name, **topology, **settings, **{"render.colour": "classification"}))
        assert done.returncode == 0, done.stderr
        run[name] = json.loads((tmp_path / name / "run.json").read_text())
    one, three = pictures(tmp_path / "single"), pictures(tmp_path / "pipelined")
    assert np.array_equal(one, three)
    shown = np.ptp(one.reshape(-1, 3), axis=0).max() > 0
    assert shown, "something is left"
    assert (one != pictures(tmp_path / "all")).any(axis=-1).mean() > 0.05
    fewer = run["single"]["per_frame"]["cells_visible"][0] < run["all"]["per_frame"]["cells_visible"][0]
    assert fewer == ("filter.boxes" in filters), "boxes spare cells, classes do not"


@needs_mpi
@pytest.mark.mpi
def test_the_record_says_where_time_and_bytes_went(config, tmp_path):
    copy = tmp_path / "copy.json"
    done = call(*command(config, tmp_path / "out", **{"pipeline.topology": "pipelined"}), "--json", str(copy))
    assert done.returncode == 0, done.stderr
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert json.loads(copy.read_text()) == run
    assert [rank["role"] for rank in run["ranks"]] == ["culling", "sampling", "render"]
    assert set(run["stages"]) == {"culling", "sampling", "render"}
    assert run["messages"]["FRAME_START"]["count"] == 6
    cells = run["scene"]["cells"]
    assert run["messages"]["VISIBILITY"] == {"count": 3, "bytes": 3 * (24 + (cells + 7) // 8)}
    assert run["messages"]["RENDER_POINTS"]["count"] == 3
    assert run["frames_per_s"] > 0
    assert run["latency_ms"]["median"] >= max(stage["work_ms"]["min"] for stage in run["stages"].values())
    assert {item["what"] for item in run["left_out"]} >= {"OpenGL", "film encoding", "back-face test"}


@needs_mpi
@pytest.mark.mpi
def test_mpirun_starts_it_too_and_too_few_ranks_are_refused(config, tmp_path):
    started = [find_mpiexec(), "-n", "3", *command(config, tmp_path / "out", **{"pipeline.topology": "pipelined"})]
    done = call(*started)
    assert done.returncode == 0, done.stderr
    assert len(pictures(tmp_path / "out")) == 3
    started[2] = "2"
    done = call(*started, "--set", "pipeline.ranks=3")
    assert done.returncode == 2
    said = [line for line in done.stderr.splitlines() if line.startswith("splatpipe:")]
    assert said == ["splatpipe: pipeline.ranks: found 2 ranks, expected 3: mpirun -n 3"]


def test_one_rank_imports_neither_mpi_nor_opengl_nor_what_it_does_not_write(config, tmp_path):
    program = (
        "import sys\nfrom splatpipe.cluster.cli import app\n"
        "try:\n    app(sys.argv[1:])\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        "heavy = ('mpi4py', 'moderngl', 'zmq', 'aiohttp', 'jupyter_rfb', 'splatpipe.cluster.live', 'av', 'vtk', "
        "'matplotlib', 'laspy', 'plyfile', 'pye57', "
        "'splatpipe.nodes.raster.paged', 'splatpipe.nodes.page_reader')\n"
        "print('imported', [name for name in heavy if name in sys.modules])\n"
    )
    settings = {"pipeline.topology": "single", "render.rasterizer": "cpu"}
    arguments = command(config, tmp_path / "out", **settings)[len(SPLATPIPE) :]
    done = call(sys.executable, "-c", program, *arguments)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("imported []\n"), done.stdout


@needs_mpi
@pytest.mark.mpi
def test_no_rank_imports_what_only_a_live_run_needs(config, tmp_path):
    done = call(
        *command(config, tmp_path / "out", **{"pipeline.topology": "pipelined"}),
        env=os.environ | {"PYTHONPROFILEIMPORTTIME": "1"},
    )
    assert done.returncode == 0
    imported = {line.rpartition("|")[2].strip().split(".")[0] for line in done.stderr.splitlines()}
    assert "mpi4py" in imported
    assert not imported & {"zmq", "aiohttp", "jupyter_rfb"}
    assert "splatpipe.cluster.live" not in done.stderr


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize("victim", [0, 1, 2])
def test_a_killed_rank_ends_the_run_within_seconds_and_is_named(config, tmp_path, victim):
    out = tmp_path / "out"
    settings = {"output.frames": 100_000, "pipeline.topology": "pipelined"}
    process = subprocess.Popen(command(config, out, **settings), stderr=subprocess.PIPE, text=True)
    pids = wait_for(lambda: rank_pids(out))
    wait_for(lambda: (out / "frame_0002.png").exists())
    os.kill(pids[victim], signal.SIGKILL)
    killed = time.monotonic()
    _, said = process.communicate(timeout=30)
    assert time.monotonic() - killed < 5
    role = ("culling", "sampling", "render")[victim]
    assert process.returncode == 1
    assert_nothing_looks_whole(out)
    assert said == f"splatpipe: rank {victim} ({role}, pid {pids[victim]}) died: killed by SIGKILL\n"


def test_a_run_killed_at_any_moment_leaves_nothing_that_looks_whole_and_the_next_one_works(config, tmp_path):
    out = tmp_path / "out"
    rng = np.random.default_rng(5)
    settings = {"output.frames": 100_000, "output.mp4": "true", "pipeline.topology": "single"}
    for _ in range(3):
        process = subprocess.Popen(command(config, out, **settings), stderr=subprocess.DEVNULL)
        time.sleep(rng.uniform(0.8, 2.5))
        process.kill()
        process.wait()
        assert_nothing_looks_whole(out)
    done = call(*command(config, out, **{"pipeline.topology": "single"}))
    assert done.returncode == 0, done.stderr
    assert len(pictures(out)) == 3
    assert sorted(path.name for path in out.iterdir()) == [*(f"frame_000{i}.png" for i in range(3)), "run.json"]


def test_a_failure_while_running_is_one_line_and_debug_shows_where(config, tmp_path):
    out = tmp_path / "out"
    single = {"pipeline.topology": "single"}
    assert call(*command(config, out, **single)).returncode == 0, "compiles what is not in the cache yet"
    limited = ["sh", "-c", 'ulimit -f 4; exec "$@"', "-"]  # files above 2 KiB (or 4) cannot be written: a full disk
    done = call(*limited, *command(config, out, **single))
    assert done.returncode == 2
    assert re.fullmatch(r"splatpipe: .*/out/frame_\d{4}.png: disk full\n", done.stderr), done.stderr
    assert_nothing_looks_whole(out)


def assert_nothing_looks_whole(out: Path) -> None:
    assert not (out / "run.json").exists()
    assert not (out / "film.mp4").exists()
    for path in out.glob("frame_*.png"):
        Image.open(path).load()


def rank_pids(out: Path) -> dict[int, int]:
    """rank → pid of the three ranks that write to ``out``; empty until all are there."""
    found = {}
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and str(out).encode() in (entry / "cmdline").read_bytes():
                variables = (entry / "environ").read_bytes().split(b"\0")
                ranks = [int(v.partition(b"=")[2]) for v in variables if v.startswith(b"PMI_RANK=")]
                found |= {rank: int(entry.name) for rank in ranks}
        except OSError:
            continue
    return found if len(found) == 3 else {}


def wait_for(condition, timeout_s: float = 60):
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.02)
    raise AssertionError("waited in vain")
