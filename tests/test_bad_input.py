"""Bad input at the command line: one clear line, exit status 2, nothing written."""

import io
import json
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import laspy
import numpy as np
import pytest
from splatpipe.cluster.cli import main
from splatpipe.shared.build import build_scene
from splatpipe.shared.synth import CityScan

SPLATPIPE = [sys.executable, "-m", "splatpipe.cluster"]


def splatpipe(*arguments, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*SPLATPIPE, *map(str, arguments)], capture_output=True, text=True, timeout=60, cwd=cwd, check=False
    )


def in_process(*arguments, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The same in this process, for commands that end before they start others."""
    with (
        pytest.MonkeyPatch.context() as patch,
        redirect_stdout(io.StringIO()) as stdout,
        redirect_stderr(io.StringIO()) as stderr,
    ):
        patch.chdir(cwd)
        patch.setattr(sys, "argv", ["splatpipe", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
    return subprocess.CompletedProcess(arguments, ended.value.code, stdout.getvalue(), stderr.getvalue())


def assert_refused(done: subprocess.CompletedProcess[str], *said: str) -> None:
    assert done.returncode == 2, (done.returncode, done.stderr)
    assert done.stderr.startswith("splatpipe: ")
    assert done.stderr.count("\n") == 1, done.stderr
    for part in said:
        assert part in done.stderr


def las_bytes(folder: Path, name: str, n_points: int = 1000) -> bytearray:
    las = laspy.create(point_format=3, file_version="1.2")
    las.header.scales = [0.001] * 3
    las.x, las.y, las.z = np.random.default_rng(1).uniform(0, 100, (3, n_points))
    las.write(folder / name)
    return bytearray((folder / name).read_bytes())


def ply_bytes(n_promised: int, n_there: int) -> bytes:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {n_promised}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    return head.encode() + np.random.default_rng(1).normal(size=(n_there, 3)).astype("<f4").tobytes()


def bad_file(kind: str, folder: Path) -> tuple[str, list[str]]:
    """(file name, what the line must say) of a bad file, written into ``folder``."""
    if kind == "missing":
        return "none.las", ["none.las"]
    if kind == "empty":
        (folder / "a.las").write_bytes(b"")
        return "a.las", ["a.las", "empty"]
    if kind == "truncated las":
        data = las_bytes(folder, "a.las")
        (folder / "a.las").write_bytes(data[:-5000])
        return "a.las", ["a.las", "1000"]
    if kind == "truncated laz":
        data = las_bytes(folder, "a.laz")
        (folder / "a.laz").write_bytes(data[: len(data) // 2])
        return "a.laz", ["a.laz"]
    if kind == "truncated ply":
        (folder / "a.ply").write_bytes(ply_bytes(1000, 900))
        return "a.ply", ["a.ply", "1000"]
    if kind == "las of 4e9 points":
        data = las_bytes(folder, "a.las")
        data[107:111] = (4_000_000_000).to_bytes(4, "little")
        (folder / "a.las").write_bytes(data)
        return "a.las", ["a.las", "4000000000"]
    if kind == "ply of 1e12 points":
        (folder / "a.ply").write_bytes(ply_bytes(10**12, 900))
        return "a.ply", ["a.ply", "1000000000000"]
    if kind == "zero points":
        (folder / "a.ply").write_bytes(ply_bytes(0, 0))
        return "a.ply", ["a.ply"]
    if kind == "unknown extension":
        (folder / "a.docx").write_bytes(b"some words that are no points")
        return "a.docx", ["a.docx"]
    raise AssertionError(kind)


KINDS = ["missing", "empty", "truncated las", "truncated laz", "truncated ply", "las of 4e9 points"]
KINDS += ["ply of 1e12 points", "zero points", "unknown extension"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_bad_file_is_refused_and_no_scene_is_left(tmp_path, kind):
    name, said = bad_file(kind, tmp_path)
    before = sorted(tmp_path.iterdir())
    assert_refused(in_process("build", name, "-o", "a.scene", cwd=tmp_path), *said)
    assert sorted(tmp_path.iterdir()) == before


def test_points_that_are_not_finite_are_dropped_and_counted_or_refused(tmp_path):
    points = np.random.default_rng(1).normal(size=(100, 3))
    points[7, 1], points[8, 0], points[9, 2] = np.nan, np.inf, -np.inf
    np.save(tmp_path / "a.npy", points)
    assert_refused(splatpipe("build", "a.npy", "-o", "a.scene", "--strict", cwd=tmp_path), "a.npy", "finite")
    assert not (tmp_path / "a.scene").exists()
    done = splatpipe("build", "a.npy", "-o", "a.scene", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "dropped 3 points" in done.stdout
    assert json.loads((tmp_path / "a.scene" / "scene.json").read_text())["n_points"] == 97


def test_a_scene_is_not_replaced_unasked_nor_by_a_build_that_fails(tmp_path):
    np.save(tmp_path / "a.npy", np.random.default_rng(1).normal(size=(100, 3)))
    (tmp_path / "bad.ply").write_bytes(ply_bytes(1000, 10))
    assert in_process("build", "a.npy", "-o", "a.scene", cwd=tmp_path).returncode == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "a.scene").iterdir()}
    assert_refused(in_process("build", "a.npy", "-o", "a.scene", cwd=tmp_path), "a.scene", "overwrite")
    assert_refused(in_process("build", "bad.ply", "-o", "a.scene", "--overwrite", cwd=tmp_path), "bad.ply")
    assert {path.name: path.read_bytes() for path in (tmp_path / "a.scene").iterdir()} == before


def test_an_unwritable_output_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.random.default_rng(1).normal(size=(100, 3)))
    assert_refused(in_process("build", "a.npy", "-o", "a.npy/a.scene", cwd=tmp_path), "a.npy")


def test_a_full_disk_is_said_and_nothing_is_left(tmp_path):
    np.save(tmp_path / "a.npy", np.random.default_rng(1).normal(size=(50_000, 3)))
    shell = 'ulimit -f 100; exec "$@"'  # no file above 100 KiB (or 50): what a full disk does to a writer
    done = subprocess.run(
        ["sh", "-c", shell, "-", *SPLATPIPE, "build", "a.npy", "-o", "a.scene"],
        capture_output=True, text=True, timeout=60, cwd=tmp_path, check=False,
    )  # fmt: skip
    assert_refused(done, "disk full")
    assert [path.name for path in tmp_path.iterdir()] == ["a.npy"]


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    build_scene([CityScan(n_points=20_000)], folder / "city.scene")
    return folder / "city.scene"


def copy_of(scene: Path, folder: Path) -> Path:
    copy = folder / "copy.scene"
    copy.mkdir()
    for path in scene.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    return copy


def run(folder: Path, text: str, *settings: str, call=in_process) -> subprocess.CompletedProcess[str]:
    (folder / "run.toml").write_text(text)
    sets = ["output.frames=2", "camera.width=64", "camera.height=64", *settings]
    return call("run", "run.toml", *(part for item in sets for part in ("--set", item)), cwd=folder)


@pytest.mark.parametrize(
    ("text", "settings", "said"),
    [
        ("", [], ["scene.path"]),
        ("[scene]\npath = 'none.scene'", [], ["none.scene"]),
        ("[scene]\npath = 'copy.scene'\n[sampling]\npixel_treshold = 4", [], ["run.toml", "did you mean sampling.pixel_threshold"]),
        ("[scene]\npath = 'copy.scene'\n[sampling]\npixel_threshold = 'x'", [], ["run.toml", "sampling.pixel_threshold = 'x'"]),
        ("[scene]\npath = 'copy.scene'", ["render.colour=sepia"], ["render.colour", "sepia"]),
        ("[scene]\npath = 'copy.scene'", ["render.colormap=virids"], ["render.colormap", "viridis"]),
        ("[scene]\npath = 'copy.scene'", ["render.background=blu"], ["render.background"]),
        ("[scene]\npath = 'copy.scene'", ["render.class_colours={ 6 = 'rde' }"], ["render.class_colours.6 = 'rde'"]),
        ("[scene]\npath = 'copy.scene'", ["render.class_colours.256=red"], ["render.class_colours.256", "0…255"]),
        ("[scene]\npath = 'copy.scene'", ["filter.classes=[2, 256]"], ["filter.classes.1 = 256", "255"]),
        ("[scene]\npath = 'copy.scene'", ["filter.classes=ground"], ["filter.classes = 'ground'", "list"]),
        ("[scene]\npath = 'copy.scene'", ["filter.boxes=[{ lower = [0, 0, 9], upper = [1, 1, 1] }]"], ["filter.boxes[0]", "lower z = 9"]),
        ("[scene]\npath = 'copy.scene'", ["filter.boxes=[{ lower = [0, 0, 0] }]"], ["filter.boxes.0.upper"]),
        ("[scene]\npath = 'copy.scene'", ["filter.boxes=[{ lower = [0, 0, 0], upper = [1, 1, 1], kep = 'inside' }]"], ["did you mean filter.boxes.keep"]),
        ("[scene]\npath = 'copy.scene'", ["render.style=splats"], ["copy.scene", "build it with --splats"]),
        ("[scene]\npath = 'copy.scene'", ["output.directory=run.toml/x"], ["run.toml/x"]),
        ("[scene]\npath = 'copy.scene'", ["camera.path=keyframes"], ["camera.keyframes"]),
        ("[scene]\npath = 'copy.scene'", ["camera.path=poses"], ["camera.poses"]),
    ],
)  # fmt: skip
def test_a_bad_run_is_refused_before_anything_starts(tmp_path, city, text, settings, said):
    copy_of(city, tmp_path)
    if "render.colormap=virids" in settings:
        settings = [*settings, "render.colour=elevation"]
    assert_refused(run(tmp_path, text, *settings), *said)
    assert not (tmp_path / "frames").exists()


def test_a_scene_of_a_newer_version_is_refused(tmp_path, city):
    copy = copy_of(city, tmp_path)
    content = json.loads((copy / "scene.json").read_text()) | {"format_version": 99}
    (copy / "scene.json").write_text(json.dumps(content))
    assert_refused(run(tmp_path, "[scene]\npath = 'copy.scene'"), "format_version = 99")


@pytest.mark.parametrize("array", ["cell_n_points", "x", "attr_rgb", "block_origin"])
@pytest.mark.parametrize("topology", ["single", "pipelined"])
def test_a_damaged_array_is_named_by_run_and_by_verify(tmp_path, city, array, topology):
    path = copy_of(city, tmp_path) / f"{array}.npy"
    data = bytearray(path.read_bytes())
    data[-5] ^= 0x10
    path.write_bytes(data)
    done = run(tmp_path, "[scene]\npath = 'copy.scene'", f"pipeline.topology={topology}", call=splatpipe)
    assert_refused(done, f"{array}.npy", "checksum")
    assert not list((tmp_path / "frames").glob("*.png"))
    assert_refused(in_process("verify", "copy.scene", cwd=tmp_path), f"{array}.npy", "checksum")


def test_bad_usage_is_refused(tmp_path):
    for arguments in (["build"], ["fly"], ["run", "--frames"], ["build", "x.las", "-o", "y", "--memory", "lots"]):
        done = in_process(*arguments, cwd=tmp_path)
        assert done.returncode == 2
        assert done.stderr.strip()
    assert list(tmp_path.iterdir()) == []
