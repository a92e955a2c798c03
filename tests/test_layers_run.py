"""Layers in a run: one picture with the points, on one rank and on three."""

import os
import subprocess
import sys

import numpy as np
import pytest
from layer_example import random_cuboids
from PIL import Image
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.layers.layer_store import write_layer
from splatpipe.shared.synth import CityScan

needs_gl = pytest.mark.skipif(not gl_available()[0], reason=gl_available()[1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("layers")
    build_scene([CityScan(n_points=30_000)], folder / "city.scene", settings=BuildSettings(points_per_cell=512))
    write_layer(random_cuboids(200, size=60.0), folder / "boxes.layer")
    write_layer(random_cuboids(50, seed=2, size=30.0, origin=(50.0, 50.0, 20.0)), folder / "more.layer")
    return folder


def run(folder, name, *settings, layers=("boxes", "more"), environment=None):
    config = folder / f"{name}.toml"
    tables = "\n".join(f"[[layers]]\npath = '{layer}.layer'" for layer in layers)
    config.write_text(
        "[scene]\npath = 'city.scene'\n[camera]\nwidth = 160\nheight = 100\nradius = 260\n"
        f"[render]\nrasterizer = 'cpu'\n{tables}\n[output]\ndirectory = '{name}'\nframes = 3\n"
    )
    command = [sys.executable, "-m", "splatpipe.cluster", "run", str(config)]
    for setting in settings:
        command += ["--set", setting]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, env=environment)


def picture(folder, name, frame=1):
    return np.asarray(Image.open(folder / name / f"frame_{frame:04}.png"))


@pytest.mark.gl
@pytest.mark.mpi
@needs_gl
def test_several_ranks_draw_the_bits_of_one_and_both_show_points_and_objects(folder):
    topologies = {"one": ("single", 1), "three": ("pipelined", 3), "tiles": ("hybrid", 4), "shares": ("sort-last", 4)}
    for name, (topology, ranks) in topologies.items():
        done = run(folder, name, f"pipeline.topology={topology}", f"pipeline.ranks={ranks}")
        assert done.returncode == 0, done.stderr
    bare = run(folder, "bare", "pipeline.topology=single", layers=())
    assert bare.returncode == 0, bare.stderr
    points, both = picture(folder, "bare"), picture(folder, "one")
    for name in topologies:
        assert all(np.array_equal(picture(folder, "one", i), picture(folder, name, i)) for i in range(3)), name
    differs = (points != both).any(axis=2)
    assert 0.005 < differs.mean() < 0.5
    assert "layers (" in (folder / "one" / "run.json").read_text()


def test_without_opengl_one_line_names_what_is_missing(folder):
    code = "import sys; from splatpipe.cluster.cli import main; sys.exit(main())"
    run(folder, "none", layers=())  # writes the file
    config = folder / "none.toml"
    config.write_text(config.read_text() + "\n[[layers]]\npath = 'boxes.layer'\n")
    blocked = folder / "blocked"
    blocked.mkdir()
    (blocked / "sitecustomize.py").write_text(
        "import sys\n"
        "class Missing:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'moderngl':\n"
        "            raise ModuleNotFoundError('No module named moderngl', name=name)\n"
        "sys.meta_path.insert(0, Missing())\n"
        "import importlib.util as u\n"
        "found = u.find_spec\n"
        "u.find_spec = lambda name, package=None: None if name == 'moderngl' else found(name, package)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(blocked)}
    done = subprocess.run(
        [sys.executable, "-c", code, "run", str(config)],
        capture_output=True,
        text=True,
        timeout=100,
        env=environment,
    )
    assert done.returncode != 0
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert "layers are drawn with OpenGL" in done.stderr
    assert "splatpipe[gl]" in done.stderr


def test_a_run_without_layers_imports_neither_opengl_nor_layer_shaders(folder):
    run(folder, "plain", layers=())
    code = (
        "import sys; sys.argv = ['splatpipe', 'run', sys.argv[1], '--set', 'pipeline.topology=single']\n"
        "from splatpipe.cluster.cli import app\n"
        "app(standalone_mode=False)\n"
        "print(sorted(m for m in sys.modules if m.startswith(('moderngl', 'splatpipe.nodes.layer', 'splatpipe.shared.layers.', 'splatpipe.shared.build'))))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder / "plain.toml")], capture_output=True, text=True, timeout=100
    )
    assert done.stdout.strip().splitlines()[-1] == "[]", done.stdout + done.stderr


@pytest.mark.gl
@needs_gl
def test_a_layer_that_is_not_there_is_refused(folder):
    done = run(folder, "gone", layers=("nowhere",))
    assert done.returncode == 2
    assert "nowhere.layer" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.gl
@needs_gl
def test_objects_alone_need_no_scene(folder):
    done = run(folder, "alone", "scene.path=", "pipeline.topology=single", "output.frames=1")
    assert done.returncode == 0, done.stderr
    shown = picture(folder, "alone", 0)
    assert 0.02 < (shown != shown[0, 0]).any(axis=2).mean() < 0.9
