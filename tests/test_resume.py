"""Resuming a run that was cut short: the bits of an unbroken one, in every topology; what is of another run is refused."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from splatpipe.cluster.job import Job
from splatpipe.cluster.launch import mpi_available
from splatpipe.cluster.resume import drawn_as, is_whole, prepare, whole_pictures
from splatpipe.cluster.run import run_command
from splatpipe.cluster.sink import _write_png, _write_png_16, _write_tiff
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config
from splatpipe.shared.errors import ConfigError, InputError
from splatpipe.shared.synth import CityScan

SPLATPIPE = [sys.executable, "-m", "splatpipe.cluster"]
needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
TOPOLOGIES = {
    "single": [],
    "pipelined": [],
    "frame-parallel": ["pipeline.ranks=2"],
    "sort-last-only": ["pipeline.ranks=2"],
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    return build_scene([CityScan(n_points=5_003)], folder / "city", settings=BuildSettings(points_per_cell=300)).path


@pytest.fixture
def config(scene, tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(
        f'[scene]\npath = "{scene}"\n[camera]\nwidth = 63\nheight = 41\nview = "stereo"\n'
        '[render]\nrasterizer = "cpu"\n[output]\nframes = 5\ndepth = true\n[pipeline]\ntopology = "single"\n'
    )
    return path


def run(config: Path, out: Path, *sets: str, resume: bool = False) -> dict:
    """The record of a run in a process of its own, which must succeed."""
    command = [*SPLATPIPE, "run", str(config), *["--resume"] * resume]
    for item in (f"output.directory={out}", *sets):
        command += ["--set", item]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads((out / "run.json").read_text())


def pictures(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.iterdir() if path.suffix in (".png", ".tiff")}


def cut_short(out: Path, run: dict, *missing: str) -> None:
    """Leave a directory as a run does that is killed before these files are written."""
    (out / "run.partial.json").write_text(json.dumps({"partial_version": 1, "drawn_as": run["drawn_as"]}))
    (out / "run.json").unlink()
    for name in missing:
        (out / name).unlink()


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize("topology", list(TOPOLOGIES))
def test_a_resumed_run_has_the_bits_of_an_unbroken_one(config, tmp_path, topology):
    out = tmp_path / "out"
    whole = run(config, out)
    expected = pictures(out)
    assert (len(expected), whole["kept"], whole["drawn"]) == (10, 0, 5)
    cut_short(out, whole, "frame_0003.png", "depth_0004.tiff")
    (out / "frame_0001.png").write_bytes(expected["frame_0001.png"][:-1])
    (out / ".frame_0003.png.part").write_bytes(b"half")
    kept = [(out / f"frame_000{i}.png").stat().st_mtime_ns for i in (0, 2)]
    resumed = run(config, out, f"pipeline.topology={topology}", *TOPOLOGIES[topology], resume=True)
    assert pictures(out) == expected
    assert (resumed["frames"], resumed["kept"], resumed["drawn"], resumed["topology"]) == (5, 2, 3, topology)
    assert [(out / f"frame_000{i}.png").stat().st_mtime_ns for i in (0, 2)] == kept
    assert resumed["per_frame"]["points"] == [whole["per_frame"]["points"][i] for i in (2, 3, 6, 7, 8, 9)]
    assert sorted(path.name for path in out.iterdir()) == sorted([*expected, "run.json"])


def test_the_film_of_a_resumed_run_is_made_of_its_pictures(config, tmp_path):
    av = pytest.importorskip("av")
    sets = ["output.mp4=true", "camera.view=mono", "camera.width=64", "camera.height=48"]
    whole = run(config, tmp_path, *sets)
    film = (tmp_path / "film.mp4").read_bytes()
    cut_short(tmp_path, whole, "film.mp4", "frame_0002.png")
    assert run(config, tmp_path, *sets, resume=True)["kept"] == 4
    with av.open(str(tmp_path / "film.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) == 5
    assert (tmp_path / "film.mp4").read_bytes() == film


def test_a_film_without_pictures_cannot_be_resumed(config):
    with pytest.raises(ConfigError, match=r"made of the PNG files, expected output.png = true"):
        Job(load_config(config, ["output.resume=true", "output.mp4=true", "output.png=false"]))


def test_a_finished_run_is_left_alone_and_one_that_only_lacks_its_record_gets_it(config, tmp_path, capsys):
    out = tmp_path / "out"
    whole, sets = run(config, out), [f"output.directory={out}", "output.resume=true"]
    before = {path: path.stat().st_mtime_ns for path in out.iterdir()}
    assert run_command(config, sets, tmp_path / "copy.json") == 0
    assert capsys.readouterr().out.startswith("all 5 frames are there")
    assert {path: path.stat().st_mtime_ns for path in out.iterdir()} == before
    assert json.loads((tmp_path / "copy.json").read_text()) == whole
    cut_short(out, whole)
    assert run_command(config, sets, None) == 0
    assert (json.loads((out / "run.json").read_text())["kept"], len(pictures(out))) == (4, 10)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("camera.width=64", "camera.width: found 63, expected 64"),
        ("output.frames=6", "output.frames: found 5, expected 6"),
        ("render.colour=elevation", 'render.colour: found "auto", expected "elevation"'),
        ("filter.boxes=[{ lower = [0, 0, 0], upper = [1, 1, 1] }]", "filter.boxes: found .*, expected .*"),
    ],
)
def test_pictures_of_another_run_are_refused_and_stay(config, tmp_path, change, said):
    sets = [f"output.directory={tmp_path}"]
    assert prepare(Job(load_config(config, sets)))
    (tmp_path / "frame_0000.png").write_bytes(b"theirs")
    with pytest.raises(InputError, match=rf"run.partial.json: {said}: pictures of another run; leave out --resume"):
        prepare(Job(load_config(config, [*sets, change, "output.resume=true"])))
    assert (tmp_path / "frame_0000.png").read_bytes() == b"theirs"


def test_another_scene_is_another_run_and_the_same_one_elsewhere_is_not(config, scene, tmp_path):
    mine = drawn_as(Job(load_config(config)))
    (tmp_path / "moved").symlink_to(scene)
    assert drawn_as(Job(load_config(config, [f"scene.path={tmp_path}/moved", "pipeline.topology=pipelined"]))) == mine
    other = build_scene([CityScan(n_points=5_003, seed=2)], tmp_path / "other", settings=BuildSettings()).path
    theirs = drawn_as(Job(load_config(config, [f"scene.path={other}"])))
    assert {key for key in mine if mine[key] != theirs[key]} == {"scene"}


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"drawn_as": 3}', b'{"drawn_as": {"a": 1}', b"\xff\xfe"])
def test_a_damaged_record_is_refused_in_one_line(config, tmp_path, content):
    (tmp_path / "run.partial.json").write_bytes(content)
    with pytest.raises(InputError, match="found no record of what was drawn; leave out --resume"):
        prepare(Job(load_config(config, [f"output.directory={tmp_path}", "output.resume=true"])))


def test_without_resume_or_without_a_run_all_is_drawn_and_nothing_is_left(config, tmp_path):
    for resume in ("false", "true"):
        (tmp_path / "frame_0000.png").write_bytes(b"of no run")
        job = Job(load_config(config, [f"output.directory={tmp_path}", f"output.resume={resume}"]))
        assert prepare(job)
        assert (list(job.frames), job.pictures) == (list(range(10)), list(range(5)))
        assert [path.name for path in tmp_path.iterdir() if path.suffix != ".toml"] == ["run.partial.json"]
        os.unlink(tmp_path / "run.partial.json")
    assert whole_pictures(job) == set()


SIZE = (7, 5)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """One of each kind of file a run writes."""
    folder = tmp_path_factory.mktemp("files")
    colours = np.random.default_rng(1).integers(0, 255, (SIZE[1], SIZE[0], 4), np.uint8)
    _write_png(folder / "8.png", colours)
    _write_png_16(folder / "16.png", colours.astype(np.uint16) * 257)
    _write_tiff(folder / "depth.tiff", colours[..., 0].astype(np.float32))
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@given(name=st.sampled_from(["8.png", "16.png", "depth.tiff"]), data=st.data())
def test_a_file_is_whole_only_at_its_full_length(files, tmp_path_factory, name, data):
    content = files[name]
    path = tmp_path_factory.mktemp("cut") / name
    path.write_bytes(content)
    assert is_whole(path, *SIZE)
    assert not is_whole(path, SIZE[0] + 1, SIZE[1])
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    assert not is_whole(path, *SIZE)
    start = data.draw(st.integers(0, len(content) - 1)) if name.endswith("png") else data.draw(st.integers(0, 8))
    path.write_bytes(content[:start] + bytes(len(content) - start))  # as a disk leaves it that lost its power
    assert is_whole(path, *SIZE) == (content[start:].count(0) == len(content) - start)


def test_a_file_that_is_no_picture_is_not_whole(tmp_path):
    for name in ("a.png", "a.tiff"):
        assert not is_whole(tmp_path / name, *SIZE), "absent"
        Image.new("RGB", SIZE).save(tmp_path / name, format="BMP")
        assert not is_whole(tmp_path / name, *SIZE), "of another format"
