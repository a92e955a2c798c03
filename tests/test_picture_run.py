"""`splatpipe run` with every kind of picture: files whole, the same bits on one rank and three, and what they show."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import png
import pytest
from PIL import Image
from splatpipe.cluster.error.config import load_error_config
from splatpipe.cluster.job import Job
from splatpipe.cluster.launch import mpi_available
from splatpipe.cluster.plan.topology import estimate
from splatpipe.cluster.plan.workload import Workload
from splatpipe.cluster.predict.costs import Measured
from splatpipe.cluster.predict.workload import count_workload
from splatpipe.cluster.sink import prepare_output
from splatpipe.nodes.picture.colour import to_linear, to_stored
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config
from splatpipe.shared.errors import ConfigError
from splatpipe.shared.synth import CityScan

needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")

OPTIONS = {
    "lit": ["render.edl_strength=0.4"],
    "averaged": ["render.supersampling=2", "render.background=transparent", "output.png_bits=16"],
    "stereo": ["camera.view=stereo", "output.depth=true", "output.normals=true", "render.edl_strength=0.2"],
    "over-under": ["camera.view=stereo", "camera.stereo_layout=over-under", "output.png_bits=16"],
    "panorama": ["camera.view=panorama", "camera.height=48", "output.depth=true", "output.normals=true"],
    "geometry": ["output.png=false", "output.depth=true", "output.normals=true", "render.supersampling=2"],
}
FILES = {
    "lit": ["frame"],
    "averaged": ["frame"],
    "stereo": ["depth", "frame", "normal"],
    "over-under": ["frame"],
    "panorama": ["depth", "frame", "normal"],
    "geometry": ["depth", "normal"],
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "city"
    build_scene([CityScan(n_points=40_000)], path, settings=BuildSettings(points_per_cell=300))
    return path


@pytest.fixture
def config(scene, tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(
        f'[scene]\npath = "{scene}"\n[camera]\nwidth = 96\nheight = 64\n[output]\nframes = 2\ndirectory = "out"\n'
        '[render]\nrasterizer = "cpu"\npoint_size_px = 2\n[pipeline]\ntopology = "single"\n'
    )
    return path


def run(config: Path, *sets: str, out: str = "out", status: int = 0) -> tuple[dict, Path]:
    """The record of a run and where its pictures are; what it said, if it is to fail."""
    folder = config.parent / out
    command = [sys.executable, "-m", "splatpipe.cluster", "run", str(config)]
    for item in (*sets, f"output.directory={folder}"):
        command += ["--set", item]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == status, done.stderr
    if status:
        return {"said": done.stderr}, folder
    return json.loads((folder / "run.json").read_text()), folder


def image(path: Path) -> np.ndarray:
    """Of 16 bits where the file has them: Pillow would drop half of them."""
    if path.suffix == ".png":
        width, height, lines, info = png.Reader(bytes=path.read_bytes()).read()
        kind = np.uint8 if info["bitdepth"] == 8 else np.uint16
        return np.array([list(line) for line in lines], kind).reshape(height, width, -1)
    return np.asarray(Image.open(path))


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize("option", OPTIONS)
def test_one_rank_and_three_write_the_same_files(config, option):
    record, alone = run(config, *OPTIONS[option], "render.threads=1", out="alone")
    piped, three = run(config, *OPTIONS[option], "render.threads=2", "pipeline.topology=pipelined", out="three")
    written = sorted(path.name for path in alone.iterdir() if path.name != "run.json")
    suffix = {"depth": "tiff", "frame": "png", "normal": "png"}
    assert written == sorted(f"{name}_000{i}.{suffix[name]}" for name in FILES[option] for i in range(2))
    for name in written:
        assert (alone / name).read_bytes() == (three / name).read_bytes(), name
    views = {"stereo": 2, "over-under": 2, "panorama": 6}.get(option, 1)
    for done in (record, piped):
        assert (done["frames"], done["views_per_picture"]) == (2, views)
        assert {len(done["per_frame"][name]) for name in ("points", "render_s", "cells_visible")} == {2 * views}
        assert (
            len(
                done["per_frame"][
                    {"frame": "png", "depth": "depth"}[FILES[option][-1 if option == "lit" else 0]] + "_s"
                ]
            )
            == 2
        )
    assert [Path(said.split(" … ")[0]).name.split("_")[0] for said in record["output"][:-1]] == sorted(
        FILES[option], key=["frame", "depth", "normal"].index
    )


def test_light_only_darkens_and_leaves_the_background(config):
    plain, lit = (image(run(config, *sets)[1] / "frame_0000.png") for sets in ([], OPTIONS["lit"]))
    background = (plain == (0x1E, 0x21, 0x27)).all(axis=2)
    assert background.mean() > 0.1
    assert np.array_equal(lit[background], plain[background])
    assert (lit <= plain).all()
    assert (lit[~background] < plain[~background]).mean() > 0.3


def test_an_averaged_picture_is_the_mean_of_the_one_it_is_drawn_as(config):
    _, folder = run(config, "render.supersampling=2", "output.png_bits=16", out="averaged")
    found = image(folder / "frame_0000.png")
    large = ["camera.width=192", "camera.height=128", "render.point_size_px=4", "sampling.pixel_threshold=32"]
    drawn = image(run(config, *large, out="drawn")[1] / "frame_0000.png") / 255
    light = to_linear(drawn).reshape(64, 2, 96, 2, 3).mean(axis=(1, 3))
    assert found.dtype == np.uint16
    assert np.abs(found - 65535 * to_stored(light)).max() <= 1


def test_a_transparent_background_has_no_colour_and_averaged_edges_are_in_between(config):
    found = image(run(config, *OPTIONS["averaged"])[1] / "frame_0000.png")
    alpha = found[..., 3]
    assert (found[alpha == 0] == 0).all()
    assert {0, 65535} < set(np.unique(alpha).tolist()) <= {0, 16384, 32768, 49151, 65535}


def test_each_eye_of_a_pair_is_the_picture_of_its_own_camera(config):
    found = image(run(config, "camera.view=stereo", "camera.stereo_base=4.0")[1] / "frame_0001.png")
    assert found.shape == (64, 192, 3)
    left, right = found[:, :96], found[:, 96:]
    plain = image(run(config)[1] / "frame_0001.png")
    unlike = [np.abs(a.astype(int) - b).mean() for a, b in ((left, plain), (right, plain), (left, right))]
    assert min(unlike) > 0.5, "three eyes, three pictures"
    over, under = np.split(
        image(run(config, *OPTIONS["over-under"], "camera.stereo_base=4.0")[1] / "frame_0001.png"), 2
    )
    assert np.array_equal(over, left.astype(np.uint16) * 257)
    assert np.array_equal(under, right.astype(np.uint16) * 257)


def test_depth_is_in_world_units_along_the_axis_and_normals_face_the_eye(config):
    folder = run(config, "output.depth=true", "output.normals=true")[1]
    depth, normal = image(folder / "depth_0000.tiff"), image(folder / "normal_0000.png")
    assert (depth.dtype, depth.shape, normal.shape) == (np.float32, (64, 96), (64, 96, 4))
    job = Job(load_config(config))
    distance = np.linalg.norm(job.camera(0).eye - (np.array(job.scene.info.lower) + job.scene.info.upper) / 2)
    assert depth[32, 48] == pytest.approx(distance, rel=0.3)
    assert np.array_equal(depth > 0, normal[..., 3] == 255)
    vectors = normal[depth > 0][:, :3] / 127.5 - 1
    assert np.abs(np.linalg.norm(vectors, axis=1) - 1).max() < 0.02
    camera = job.camera(0)
    fx, fy, cx, cy = camera.pinhole_px
    row, column = np.nonzero(depth)
    towards = np.column_stack([(column + 0.5 - cx) / fx, (cy - row - 0.5) / fy, -np.ones(len(row))])
    assert ((vectors * towards).sum(axis=1) < 0.05).all()


def test_a_film_of_sixteen_bits_is_made_and_one_without_background_refused(config):
    pytest.importorskip("av")
    _, folder = run(config, "output.mp4=true", "output.png_bits=16", "render.edl_strength=0.2")
    assert (folder / "film.mp4").stat().st_size > 500
    said = run(config, "output.mp4=true", "render.background=transparent", status=2)[0]["said"]
    assert said.count("\n") == 1
    assert "render.background = 'transparent', expected a colour" in said


def test_a_picture_too_large_to_draw_is_refused(config):
    with pytest.raises(ConfigError, match=r"render.supersampling = 8: 80000 px a side"):
        Job(load_config(config, ["camera.width=10000", "render.supersampling=8"]))


def test_a_plain_run_imports_nothing_that_composes(config):
    program = (
        "import sys\nfrom splatpipe.cluster.cli import app\n"
        "try:\n    app(sys.argv[1:])\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        "heavy = [n for n in sys.modules if n.startswith('splatpipe.nodes.picture.') or n == 'png']\n"
        "print('imported', heavy)\n"
    )
    command = [sys.executable, "-c", program, "run", str(config)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    assert done.stdout.endswith("imported ['splatpipe.nodes.picture.compose']\n"), done.stdout


def test_every_layer_of_an_earlier_run_is_taken_away(tmp_path):
    for name in ("frame_0000.png", "depth_0001.tiff", "normal_0002.png", ".depth_0003.tiff.part", "mine.tiff"):
        (tmp_path / name).touch()
    prepare_output(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.tiff"]


# --- what plans and predicts ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("view", "views", "pixels"), [("mono", 1, 192 * 128), ("stereo", 2, 192 * 128), ("panorama", 6, 82**2)]
)
def test_counts_are_of_views_as_they_are_drawn(config, view, views, pixels):
    job = Job(load_config(config, [f"camera.view={view}", "render.supersampling=2"]))
    load, look = count_workload(job), Workload.of_look(job)
    assert (load.n_frames, load.pixels, look.pixels) == (2 * views, pixels, pixels)
    assert load.covered.max() >= 16 * load.points.max(), "points of 2 px are drawn with 4"
    panels = 2 if view == "stereo" else 1
    assert job.composed_share * job.views.per_picture * pixels == pytest.approx(panels * 96 * 64)
    assert estimate(job, replace(look, culling_s=1e-4, sampling_s=1e-4), cores=2).busy_s > 0
    measured = Measured(job.config, load, [{"frames_per_s": 3.0}])
    assert measured.frame_s == pytest.approx(1 / (3 * views))


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [("camera", "view", '"stereo"'), ("render", "supersampling", 2), ("render", "edl_strength", 0.4)],
)
def test_the_error_command_refuses_what_it_does_not_measure(tmp_path, section, key, value):
    path = tmp_path / "error.toml"
    path.write_text(
        f'[run.{section}]\n{key} = {value}\n[[scene]]\nname = "a"\npath = "a"\n'
        '[[sweep]]\nmethod = "m"\nkey = "sampling.pixel_threshold"\nvalues = [4]\n'
    )
    with pytest.raises(ConfigError, match=rf"{section}\.{key} = .*frames as they are drawn, expected"):
        load_error_config(path)
