"""Block worlds: records, voxels of point clouds, four techniques, the paper's tables."""

import json
import subprocess
import sys

import numpy as np
import pytest
from layer_example import TECHNIQUES, captured, look_at_box, sorted_triangles
from splatpipe.nodes.layers.expand_blocks import strips
from splatpipe.nodes.layers.mesh import separate
from splatpipe.nodes.layers.stages import input_components
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.shared.errors import InputError
from splatpipe.shared.layer_config import LayerSection
from splatpipe.shared.layers.blocks import MOST_CELLS, OBJECT
from splatpipe.shared.layers.layer import simple_layer
from splatpipe.shared.layers.readers.voxels import voxelised
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from splatpipe.shared.points import PointBatch, pack_rgb
from splatpipe.shared.readers.source import Source, SourceInfo

needs_gl = pytest.mark.skipif(not gl_available()[0], reason=gl_available()[1])


def random_blocks(n, seed=0, origin=(0.0, 0.0, 0.0), size=0.5):
    rng = np.random.default_rng(seed)
    objects = np.zeros(n, OBJECT)
    objects["cell"] = rng.integers(-20, 20, (n, 3))
    objects["type"] = rng.integers(0, 3, n)
    colours = ["#ff0000", "#00ff00", "#3366cc"]
    return simple_layer("random", "blocks", np.array(origin), objects, block_size=size, colours=colours)


class Cloud(Source):
    def __init__(self, positions, **attributes):
        from pathlib import Path

        self.positions, self.columns = positions, attributes
        self.info = SourceInfo(Path("cloud"), "npy", len(positions), tuple(attributes))

    def _read(self, max_points, attributes):
        for begin in range(0, len(self.positions), 700):
            part = slice(begin, begin + 700)
            yield PointBatch(self.positions[part], {name: self.columns[name][part] for name in attributes})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"block_size": 0}, "block_size"),
        ({"block_size": float("nan")}, "block_size"),
        ({"colours": []}, "colours"),
        ({"colours": ["red"]}, "colours"),
        ({"colours": ["#ffffff"] * 257}, "colours"),
    ],
)
def test_parameters_are_checked_by_name(change, said):
    parameters = {"block_size": 1.0, "colours": ["#ffffff"]} | change
    with pytest.raises(InputError, match=said):
        simple_layer("x", "blocks", np.zeros(3), np.zeros(2, OBJECT), **parameters)


@pytest.mark.parametrize(
    ("attribute", "value"), [("type", 1), ("type", -1), ("cell", MOST_CELLS + 1), ("cell", -(2**31))]
)
def test_records_are_checked_by_name(attribute, value):
    objects = np.zeros(2, OBJECT)
    objects[attribute][1] = value
    with pytest.raises(InputError, match=f"{attribute} of block 1"):
        simple_layer("x", "blocks", np.zeros(3), objects, block_size=1.0, colours=["#ffffff"])


@pytest.mark.parametrize("far", [0.0, 6.4e6])
def test_a_block_stands_wherever_points_are_with_their_mean_colour(far):
    rng = np.random.default_rng(3)
    positions = far + np.round(rng.uniform(-8, 8, (3000, 3)), 3)
    positions[:, 2] = far + rng.integers(0, 2, 3000)
    rgb = rng.integers(0, 255, (3000, 3)).astype(np.uint8)
    layer = voxelised(Cloud(positions, rgb=pack_rgb(*rgb.T)), "x", 2.0)
    centers = layer.origin + 2.0 * layer.objects["cell"]
    expected = {}
    for p, c in zip(positions, rgb, strict=True):
        expected.setdefault(tuple(np.rint((p - layer.origin) / 2.0).astype(int)), []).append(c)
    assert {tuple(cell) for cell in layer.objects["cell"].tolist()} == set(expected)
    lower, upper = layer.bounds
    assert (np.abs((lower + upper) / 2 - centers) < 1e-6).all()
    for record in layer.objects:
        mean = np.mean(expected[tuple(record["cell"].tolist())], axis=0)
        colour = layer.parameters["colours"][record["type"]]
        assert np.abs([int(colour[i : i + 2], 16) for i in (1, 3, 5)] - mean).max() <= 24  # 256 colours in all


def test_the_most_frequent_class_counts_and_enclosed_blocks_are_left_out():
    grid = np.stack(np.meshgrid(*[np.arange(5.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    positions = np.repeat(grid, 3, axis=0)
    codes = np.tile(np.array([6, 6, 2], np.uint8), len(grid))
    layer = voxelised(Cloud(positions, classification=codes), "x", 1.0, "classification")
    assert len(layer) == 5**3 - 3**3
    assert layer.parameters["colours"] == ["#d84f3f"]
    high = voxelised(Cloud(positions), "x", 1.0)
    assert np.unique(high.objects["type"]).size == 5
    with pytest.raises(InputError, match="rgb"):
        voxelised(Cloud(positions), "x", 1.0, "rgb")
    for size in (0.0, -1.0, np.nan, 1e-9):
        with pytest.raises(InputError, match="block size"):
            voxelised(Cloud(positions), "x", size)


@pytest.mark.gl
@needs_gl
def test_the_geometry_shader_makes_the_triangles_of_the_reference(monkeypatch):
    from splatpipe.nodes.layers.gl_blocks import GlBlocks

    monkeypatch.setattr(GlBlocks, "_defines", ("CAPTURED",))
    layer = random_blocks(150, 1, origin=(6e6, 6e6, 0.0))
    position, normal = captured(layer, LayerSection(path=""), 13 * len(layer))
    mesh = separate(strips(layer))
    assert len(position) == 12 * len(layer)
    found = sorted_triangles(position, np.repeat(normal[:, 2:], 3, axis=1))
    expected = sorted_triangles(mesh.position.reshape(-1, 3, 3), mesh.normal.reshape(-1, 3, 3))
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-6)


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize("texture", ["grain", "plain"])
def test_all_techniques_draw_the_same_picture(texture):
    from splatpipe.nodes.layers.gl_canvas import GlLayers

    layer = random_blocks(400, 2, origin=(6e6, 0.0, 0.0))
    lower, upper = layer.bounds
    camera = look_at_box(lower.min(axis=0), upper.max(axis=0), 1)
    pictures = []
    for technique in TECHNIQUES:
        section = LayerSection(path="", technique=technique, blocks={"texture": texture}, value_filter=(1, 2))
        with GlLayers([layer], [section], camera.width, camera.height) as canvas:
            pictures.append(canvas.draw(camera, [np.array([(0, 400, 1)], RENDER_POINT)]).copy())
    first = pictures[0]
    drawn = first != FRAMEBUFFER_EMPTY
    assert drawn.sum() > 300
    red = first.astype("<u4").view(np.uint8).reshape(*first.shape, 4)[drawn]
    assert not ((red[:, 0] > 60) & (red[:, 1] < 20)).any()  # type 0 is filtered out
    for other in pictures[1:]:
        colours = first.astype("<u4").view(np.uint8).astype(int) - other.astype("<u4").view(np.uint8).astype(int)
        differs = np.abs(colours.reshape(*first.shape, 4)).max(axis=2) > 2
        assert differs.sum() <= 0.004 * drawn.sum() + 2  # edges, and texture places that round to the next texel


def test_components_and_bytes_are_those_of_the_paper():
    from splatpipe.cluster.bench.avc import PAPER

    assert {t: input_components(t) for t in PAPER} == {t: p["stages"] for t, p in PAPER.items()}
    assert OBJECT.itemsize == 16


@pytest.mark.gl
@needs_gl
def test_bench_avc_finds_the_papers_bytes(tmp_path):
    command = [
        sys.executable,
        "-m",
        "splatpipe.cluster",
        "bench",
        "avc",
        "--most",
        "16",
        "--width",
        "64",
        "--height",
        "48",
    ]
    files = ["--repeats", "1", "--json", str(tmp_path / "a.json"), "--plot", str(tmp_path / "a.png")]
    done = subprocess.run([*command, *files], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    rows = {row["technique"]: row for row in json.loads((tmp_path / "a.json").read_text())["rows"]}
    assert {t: row["bytes_per_block"] for t, row in rows.items()} == {
        "triangles": 1440, "strips": 560, "instancing": 16, "avc": 16
    }  # fmt: skip
    assert rows["instancing"]["static_bytes"] == 336
    assert all("failed" not in row for row in rows.values())
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
