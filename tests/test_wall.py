"""Display walls: the pixels of the whole picture on each screen, whoever draws them; and what is refused."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers_ranks import World
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from splatpipe.cluster.job import Job
from splatpipe.cluster.launch import mpi_available
from splatpipe.cluster.layout import ALONE
from splatpipe.cluster.pipeline import run_layout, run_single
from splatpipe.cluster.plan.command import plan_command
from splatpipe.cluster.sink import prepare_output
from splatpipe.cluster.topologies import layout_of
from splatpipe.cluster.wall import screen_windows, writes_screens
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config
from splatpipe.shared.errors import ConfigError
from splatpipe.shared.synth import CityScan
from splatpipe.shared.wall import Wall
from splatpipe.shared.windows import Window

needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
TILES = ["wall.columns=2", "wall.rows=2", "wall.mullion_x_px=7", "wall.mullion_y_px=5", "wall.output=tiles"]
DEEP = ["render.edl_strength=0.4", "output.depth=true", "output.normals=true"]
WHOLE = ["camera.width=107", "camera.height=67"]
"""The size of that wall of screens of 50 × 31 pixels."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "city"
    build_scene([CityScan(n_points=20_011)], path, settings=BuildSettings(points_per_cell=300))
    return path


@pytest.fixture
def config(scene, tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(
        f'[scene]\npath = "{scene}"\n[camera]\nwidth = 50\nheight = 31\n[output]\nframes = 3\n'
        '[render]\npoint_size_px = 2\nrasterizer = "cpu"\nthreads = 1\n[pipeline]\ntopology = "single"\n'
    )
    return path


def alone(config: Path, out: Path, *sets: str) -> dict[str, bytes]:
    """The files of the pictures of a run in this process."""
    job = Job(load_config(config, [f"output.directory={out}", *sets]))
    prepare_output(job.output)
    run_single(job, lambda *_: None)
    return files(out)


def files(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.iterdir() if path.suffix in (".png", ".tiff")}


def image(path: Path) -> np.ndarray:
    with Image.open(path) as opened:
        return np.asarray(opened)


# --- geometry ----------------------------------------------------------------------------------------------------


@given(*[st.integers(1, 4)] * 2, *[st.integers(1, 9)] * 2, *[st.integers(0, 5)] * 2)
def test_each_pixel_is_on_one_screen_or_behind_a_mullion(columns, rows, width, height, mullion_x, mullion_y):
    wall = Wall(columns, rows, width, height, mullion_x, mullion_y)
    times = np.zeros((wall.height, wall.width), int)
    for screen in wall.screens:
        assert screen.window.of(times).shape == (height, width)
        screen.window.of(times)[:] += 1
    assert np.array_equal(times, np.logical_and.outer(*wall.shown))
    assert [(s.row, s.column) for s in wall.screens] == [(r, c) for r in range(rows) for c in range(columns)]


def test_windows_of_ranks_are_the_screens_and_what_lighting_looks_at_beside_them(config):
    job = Job(load_config(config, [*TILES, "render.supersampling=2", "pipeline.topology=sort-first-only"]))
    four = layout_of(job.config.pipeline, 4)
    assert screen_windows(job, four)[1] == Window(114, 0, 214, 62)
    assert writes_screens(job, four)
    assert not screen_windows(job, layout_of(job.config.pipeline, 3))
    assert not screen_windows(job, ALONE)
    job.layers = [None]
    assert not writes_screens(job, four), "layers are drawn over whole pictures"
    assert screen_windows(job, four)
    lit = Job(load_config(config, [*TILES, "render.edl_strength=1", "render.edl_radius_px=2.5"]))
    assert screen_windows(lit, four)[3] == Window(57 - 4, 36 - 4, 107, 67)


# --- pictures ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sets", [DEEP, ["render.supersampling=2", "output.png_bits=16"]])
def test_screens_are_cut_out_of_the_whole_picture(config, tmp_path, sets):
    alone(config, tmp_path / "whole", *WHOLE, *sets)
    screens = alone(config, tmp_path / "tiles", *TILES, *sets)
    job = Job(load_config(config, [*TILES, *sets]))
    assert job.picture_size == (50, 31)
    layers = [layer for layer in ("png", "depth", "normals") if getattr(job.config.output, layer)]
    assert screens.keys() == {name for layer in layers for n in range(3) for name in job.picture_names(layer, n)}
    for path in (tmp_path / "whole").iterdir():
        for screen in job.wall.screens:
            shown = image(tmp_path / "tiles" / f"{path.stem}_{screen.name}{path.suffix}")
            assert np.array_equal(shown, screen.window.of(image(path)))


def test_the_assembled_wall_has_painted_mullions_or_none(config, tmp_path):
    wall = [*TILES, "wall.output=assembled", "wall.mullion_colour=#ff0080", "output.depth=true", "output.frames=1"]
    alone(config, tmp_path / "whole", *WHOLE, "output.depth=true", "output.frames=1")
    alone(config, tmp_path / "painted", *wall)
    names = "frame_0000.png", "depth_0000.tiff"
    whole, painted = ([image(tmp_path / run / name) for name in names] for run in ("whole", "painted"))
    rows, columns = Job(load_config(config, wall)).wall.shown
    on_screens = np.logical_and.outer(rows, columns)
    for found, expected, colour in zip(painted, whole, ([255, 0, 128], 0), strict=True):
        assert np.array_equal(found[on_screens], expected[on_screens])
        assert (found[~on_screens] == colour).all()
    alone(config, tmp_path / "bare", *wall, "wall.mullion_colour=")
    bare = image(tmp_path / "bare" / "frame_0000.png")
    assert np.array_equal(bare, whole[0][np.ix_(rows, columns)])
    assert Job(load_config(config, [*wall, "wall.mullion_colour="])).picture_size == (bare.shape[1], bare.shape[0])


@pytest.mark.parametrize("output", ["tiles", "assembled"])
def test_the_files_of_a_wall_are_the_same_whoever_draws_them(config, tmp_path, output):
    wall = [*TILES, *DEEP, f"wall.output={output}"]
    expected = alone(config, tmp_path / "alone", *wall)
    assert len(expected) == 3 * 3 * (4 if output == "tiles" else 1)
    for topology, ranks, sent in (
        *(("sort-first-only", n, 3 * (n - 1)) for n in (1, 2, 3)),
        ("sort-first-only", 4, 0 if output == "tiles" else 9),
        ("sort-first", 10, 0 if output == "tiles" else 9),
        ("hybrid", 6, 0 if output == "tiles" else 9),
        ("sort-last-only", 4, None),
    ):
        sets = [f"output.directory={tmp_path / topology}{ranks}", f"pipeline.topology={topology}"]
        sets += ["pipeline.culling_ranks=1", "pipeline.sampling_ranks=1"] if topology == "hybrid" else []
        world = World(ranks)

        def one(transport, sets=sets, ranks=ranks):
            job = Job(load_config(config, [*wall, *sets]))
            job.output.mkdir(exist_ok=True)
            return run_layout(job, layout_of(job.config.pipeline, ranks), transport, lambda *_: None)

        run = world.run(one)[0]
        assert files(tmp_path / f"{topology}{ranks}") == expected, (topology, ranks)
        assert sent is None or world.sent["FRAMEBUFFER"] == sent
        assert len(run["per_frame"]["png_s"]) == len(expected) / 3


@needs_mpi
@pytest.mark.mpi
def test_ranks_write_their_screens(config, tmp_path):
    wall = ["wall.columns=2", "wall.mullion_x_px=9", "wall.output=tiles"]
    command = [sys.executable, "-m", "splatpipe.cluster", "run", str(config)]
    sets = [*wall, f"output.directory={tmp_path / 'out'}", "pipeline.topology=sort-first-only", "pipeline.ranks=2"]
    command += [part for item in sets for part in ("--set", item)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    assert files(tmp_path / "out") == alone(config, tmp_path / "alone", *wall)
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert run["output"][0].endswith("frame_0000_c0_r0.png … frame_0002_c1_r0.png")
    assert (run["messages"]["FRAME_DONE"]["count"], "FRAMEBUFFER" in run["messages"]) == (3, False)


# --- what is refused, what is said -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sets", "expected"),
    [
        ([*TILES, "camera.view=stereo"], "camera.view = 'stereo': wall.columns × rows is 2 × 2, expected 'mono'"),
        ([*TILES, "camera.view=panorama"], "camera.view = 'panorama': wall.columns"),
        ([*TILES, "output.mp4=true"], "output.mp4 = true: wall.output = 'tiles'"),
        (["wall.output=tiles"], "wall.output = 'tiles': wall.columns × rows is 1 × 1, expected more than one screen"),
        (["wall.columns=200", "camera.width=1000"], "wall.columns = 200: .* are 200000 px together, expected at most"),
        (["wall.rows=2", "camera.height=5000", "render.supersampling=8"], "render.supersampling = 8: 80000 px a side"),
        (["wall.rows=2", "wall.mullion_colour=#12"], "wall.mullion_colour"),
        (["wall.rows=2", "wall.mullion_colour=transparent", "output.mp4=true"], "wall.mullion_colour = 'transparent'"),
        (["wall.rows=0"], "wall.rows = 0"),
    ],
)
def test_what_a_wall_cannot_show_is_refused(config, sets, expected):
    with pytest.raises(ConfigError, match=expected):
        Job(load_config(config, sets))


def test_the_plan_says_who_writes_the_screens(config):
    plan = plan_command(config, [*TILES, "pipeline.topology=sort-first-only", "pipeline.ranks=4"])
    assert plan["plan"]["reason"].endswith("4 render a screen of the wall each, and write it")
    (compositing,) = [part for part in plan["parts"] if part["what"] == "compositing"]
    assert compositing["left_out"]
