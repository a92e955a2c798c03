"""Layers in the plan, in the record of a run, and what is said of them."""

import json
import subprocess
import sys

import numpy as np
import pytest
from layer_example import TECHNIQUES, random_cuboids
from splatpipe.cluster.job import Job
from splatpipe.cluster.plan import part as named
from splatpipe.cluster.plan.needs import parts
from splatpipe.cluster.plan.topology import Decision
from splatpipe.cluster.plan.workload import Workload
from splatpipe.nodes.layers.sizes import layer_bytes
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config
from splatpipe.shared.layer_config import ArcStyle, LayerSection, TrajectoryStyle
from splatpipe.shared.layers import arcs, blocks
from splatpipe.shared.layers.layer import simple_layer
from splatpipe.shared.layers.layer_store import write_layer
from splatpipe.shared.layers.polygons import polygon_layer
from splatpipe.shared.synth import CityScan
from trajectory_example import random_tracks

needs_gl = pytest.mark.skipif(not gl_available()[0], reason=gl_available()[1])


def some_arcs(n=20):
    rng = np.random.default_rng(2)
    objects = np.zeros(n, arcs.OBJECT)
    objects["angle"][:, 1] = rng.choice([1.0, 2 * np.pi], n)
    objects["radius"], objects["height"] = (1, 2), (0, 1)
    return simple_layer("arcs", "arcs", np.zeros(3), objects)


def some_blocks(n=20):
    objects = np.zeros(n, blocks.OBJECT)
    objects["cell"] = np.random.default_rng(3).integers(-9, 9, (n, 3))
    return simple_layer("blocks", "blocks", np.zeros(3), objects, block_size=0.5, colours=["#aabbcc"])


def some_polygons():
    l_shape = np.array([(0, 0), (4, 0), (4, 1), (1, 1), (1, 3), (0, 3)], np.float64)
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64)
    ring = [10 + 4 * square, 11 + square]
    height = np.tile((0.0, 5.0), (3, 1))
    return polygon_layer("houses", [[[l_shape]], [ring], [[20 + square], [22 + square]]], height, np.arange(3.0))[0]


LAYERS = {
    "cuboids": lambda: random_cuboids(20),
    "arcs": some_arcs,
    "blocks": some_blocks,
    "polygons": some_polygons,
    "tubes": lambda: random_tracks(200, 40),
    "spheres": lambda: random_tracks(200, 3),
}


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize("technique", TECHNIQUES)
@pytest.mark.parametrize("kind", LAYERS)
def test_what_is_counted_is_what_lies_on_the_device(kind, technique):
    from splatpipe.nodes.layers.gl_canvas import GlLayers

    layer = LAYERS[kind]()
    style = TrajectoryStyle(style="spheres" if kind == "spheres" else "auto", highlight=(0.5, 0.7), selected=("t1",))
    settings = LayerSection(path="", technique=technique, arcs=ArcStyle(segments=9), trajectories=style)
    with GlLayers([layer], [settings], 16, 16) as canvas:
        resident = canvas.resident_bytes[0]
    template = resident - layer_bytes(layer, settings, technique)
    assert template == 0 if technique != "instancing" else 0 < template < 4000


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plan")
    build_scene([CityScan(n_points=20_000)], folder / "city.scene", settings=BuildSettings(points_per_cell=512))
    write_layer(random_cuboids(300, size=60.0), folder / "boxes.layer")
    write_layer(some_blocks(), folder / "blocks.layer")
    return folder


def config_of(folder, *layers, scene="city.scene"):
    config = folder / "run.toml"
    tables = "\n".join(f"[[layers]]\npath = '{layer}.layer'" for layer in layers)
    place = f"[scene]\npath = '{scene}'\n" if scene else ""
    config.write_text(
        f"{place}[camera]\nwidth = 96\nheight = 64\n[render]\nrasterizer = 'cpu'\ncolour = '#808080'\n{tables}\n"
        "[output]\ndirectory = 'out'\nframes = 3\npng = false\n"
    )
    return config


def parts_of(config, *sets):
    job = Job(load_config(config, [*sets]))
    return {part.what: part for part in parts(job, Workload.of_look(job), Decision("single", "so"))}


def test_without_layers_they_are_left_out(folder):
    found = parts_of(config_of(folder))
    assert found[named.LAYERS].left_out
    assert "no [[layers]]: no OpenGL and no shader" in found[named.LAYERS].why
    assert found[named.OPENGL].left_out


@needs_gl
def test_layers_are_kept_with_what_they_take_and_what_triangles_would(folder):
    found = parts_of(config_of(folder, "boxes", "blocks"))
    assert named.LAYERS not in found
    boxes = found["layer random"]
    assert not boxes.left_out
    assert boxes.gain == pytest.approx(300 * 28e-6)
    assert "300 cuboids" in boxes.why
    assert "8.4 kB resident, as triangles 302.4 kB" in boxes.why
    assert not found[named.OPENGL].left_out
    assert "layers are drawn with it; rasterizer cpu" in found[named.OPENGL].why
    assert not found[named.COLOUR_MAPS].left_out
    assert "random" in found[named.COLOUR_MAPS].why
    assert parts_of(config_of(folder, "blocks"))[named.COLOUR_MAPS].left_out


@needs_gl
def test_a_run_of_layers_alone_has_a_plan(folder):
    found = parts_of(config_of(folder, "boxes", scene=""))
    assert not found["layer random"].left_out
    assert "300 a frame" in found["layer random"].why


def test_info_says_what_a_layer_holds(folder, tmp_path):
    write_layer(some_polygons(), folder / "houses.layer", overwrite=True)
    for name, said in (
        ("houses", {"kind": "polygons", "objects": 3, "values": [0, 2], "lower": [0, 0, 0], "upper": [23, 23, 5]}),
        ("blocks", {"kind": "blocks", "objects": 20, "elements": 0, "cells": 1}),
    ):
        done = program("info", folder / f"{name}.layer", "--json", tmp_path / "info.json")
        assert done.returncode == 0, done.stderr
        told = json.loads((tmp_path / "info.json").read_text())
        assert {key: told[key] for key in said} == said
        assert told["bytes"] == sum(path.stat().st_size for path in (folder / f"{name}.layer").glob("*.npy"))
    assert told["parameters"] == {"block_size": 0.5, "colours": ["#aabbcc"]}
    assert "values" not in told
    assert "block_size 0.5, colours #aabbcc" in done.stdout
    (folder / "blocks.layer" / "objects.npy").rename(folder / "objects.npy")
    missing = program("info", folder / "blocks.layer")
    (folder / "objects.npy").rename(folder / "blocks.layer" / "objects.npy")
    assert (missing.returncode, len(missing.stderr.strip().splitlines())) == (2, 1)


def program(*arguments):
    command = [sys.executable, "-m", "splatpipe.cluster", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)


@pytest.mark.gl
@pytest.mark.mpi
@needs_gl
def test_the_record_says_how_many_objects_each_frame_drew(folder):
    config = config_of(folder, "boxes", "blocks")
    near = ["--set", "camera.radius=40", "--set", "camera.fov_deg=20"]
    records = []
    for topology in ("single", "pipelined"):
        done = program("run", config, "--set", f"pipeline.topology={topology}", *near)
        assert done.returncode == 0, done.stderr
        assert " of 300 cuboids a frame" in done.stdout
        records.append(json.loads((folder / "out" / "run.json").read_text()))
    one, three = records
    assert one["per_frame"]["objects"] == three["per_frame"]["objects"]
    assert [layer["objects"] for layer in one["layers"]] == [300, 20]
    assert len(one["per_frame"]["objects"]) == 3
    assert all(drawn[0] < 300 for drawn in one["per_frame"]["objects"]), "some are out of sight"
    assert max(drawn[0] for drawn in one["per_frame"]["objects"]) > 0
    job = Job(load_config(config, near[1::2]))
    assert Workload.of_run(job, one["per_frame"]).objects == Workload.of_look(job).objects
