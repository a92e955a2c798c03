"""`splatpipe error`: the sweep end to end on a tiny city, its parts one by one, and what it refuses."""

import csv
import json
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from build_sources import ArraySource, cells_of, columns_for
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.cluster import cli
from splatpipe.cluster import job as job_module
from splatpipe.cluster.error import scene as swept_scene
from splatpipe.cluster.error import sweep
from splatpipe.cluster.error.config import ImageSection, load_error_config, sweep_points
from splatpipe.cluster.error.picture import decode_picture, encode_picture
from splatpipe.cluster.error.reference import POINTS_AT_A_TIME, _pieces
from splatpipe.cluster.error.report import pareto_front
from splatpipe.cluster.progress import FrameProgress
from splatpipe.nodes.raster import ResidentPoints
from splatpipe.nodes.raster.fixed_point import block_half_edges, fixed_point
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.errors import ConfigError, DeviceError
from splatpipe.shared.rebuild import SceneSource, rebuild_in_order
from splatpipe.shared.store import Scene
from splatpipe.shared.synth import CityScan

ROOT = Path(__file__).parent.parent
HEAD = """
frames = [0, 5]
repeats = 2
[run.camera]
width = 128
height = 72
[run.sampling]
pixel_threshold = 0
[run.render]
rasterizer = "cpu"
point_size_px = 2
[run.output]
directory = "out"
frames = 12
[[scene]]
name = "city"
path = "city.scene"
"""
SWEEPS = """
[[sweep]]
method = "layered"
key = "sampling.pixel_threshold"
values = [0, 4, 8, 16]
[[sweep]]
method = "stride"
key = "sampling.pixel_threshold"
values = [0, 8]
order = "depth-first"
[[sweep]]
method = "bits"
key = "positions.bits_per_axis"
values = [4, 8, 16]
[[sweep]]
method = "jpeg"
key = "image.jpeg_quality"
values = [30, 95]
set = { image.codec = "jpeg" }
[[sweep]]
method = "rasterizer"
key = "render.rasterizer"
values = ["cpu", "gl"]
[[sweep]]
method = "density"
key = "sampling.points_per_pixel"
values = [1, 3, 9]
set = { sampling.pixel_threshold = 8 }
"""


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    path = tmp_path_factory.mktemp("error") / "city.scene"
    build_scene([CityScan(n_points=40_000)], path, settings=BuildSettings(points_per_cell=300, up="z"))
    return path


@pytest.fixture
def config(city, tmp_path):
    path = tmp_path / "error.toml"
    path.write_text(HEAD.replace("city.scene", str(city)) + SWEEPS)
    return path


@pytest.fixture
def no_gl(monkeypatch):
    """A machine without OpenGL."""
    real = job_module.make_rasterizer

    def make(name, *rest, **settings):
        if name == "gl":
            raise DeviceError("OpenGL: libEGL.so.1 is missing")
        return real(name, *rest, **settings)

    monkeypatch.setattr(job_module, "make_rasterizer", make)


def call(*arguments, monkeypatch):
    """Exit status of ``splatpipe ARGUMENTS``."""
    monkeypatch.setattr(sys, "argv", ["splatpipe", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code or 0


def test_a_sweep_end_to_end(config, no_gl, monkeypatch, capsys):
    assert call("error", config, "--json", config.with_name("e.json"), monkeypatch=monkeypatch) == 0
    out = config.parent / "out"
    assert "15 points on 1 scenes" in capsys.readouterr().out
    result = json.loads(config.with_name("e.json").read_text())
    rows = {(row["method"], row["value"]): row for row in result["rows"]}
    assert len(rows) == len(result["rows"]) == 15

    exact = rows["layered", 0]
    assert exact["coverage_error"] < 1e-3, "float32 moves a square's border over a pixel centre now and then"
    assert exact["colour_psnr_db"] > 40
    assert exact["points"] > 30_000, "the whole city is in view"
    layered = [rows["layered", threshold] for threshold in (0, 4, 8, 16)]
    assert all(row["points"] < exact["points"] / 2 for row in layered[1:])
    assert all(row["flip"] > exact["flip"] and row["coverage_error"] > exact["coverage_error"] for row in layered[1:])
    for sparse, dense in pairwise([rows["density", density] for density in (1, 3, 9)] + [exact]):
        assert sparse["points"] < dense["points"]
        assert sparse["flip"] > dense["flip"]
        assert sparse["coverage_error"] >= dense["coverage_error"]
    for finer, coarser in pairwise(layered[1:]):
        assert finer["message_bytes"] > coarser["message_bytes"], "a coarser cut has fewer entries"
    assert rows["density", 1]["holes"] > 0.01
    assert layered[-1]["message_bytes"] > exact["message_bytes"], (
        "a cut has more entries than whole leaves, which merge"
    )

    assert rows["stride", 0]["order"] == "depth-first"
    assert rows["stride", 0]["points"] == exact["points"]
    assert rows["stride", 0]["coverage_error"] < 1e-3
    assert rows["stride", 8]["flip"] > rows["stride", 0]["flip"]

    errors = [rows["bits", bits]["flip"] for bits in (4, 8, 16)]
    assert errors == sorted(errors, reverse=True)
    assert [rows["bits", bits]["position_bytes"] for bits in (4, 8, 16)] == [1.5, 3.0, 6.0]

    assert rows["jpeg", 30]["picture_bytes"] < rows["jpeg", 95]["picture_bytes"] < exact["picture_bytes"]
    assert rows["jpeg", 30]["ssim"] < rows["jpeg", 95]["ssim"] < exact["ssim"]
    assert rows["jpeg", 30]["coverage_error"] is None
    for row in rows.values():
        assert row["frame_q1_ms"] <= row["frame_ms"] <= row["frame_q3_ms"]
        assert row["frame_bytes"] == row["message_bytes"] + row["picture_bytes"]
        assert row["psnr_db"] <= 100

    with (out / "errors.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["value"] for row in table] == [str(row["value"]) for row in result["rows"]]
    assert {"scene", "method", "key", "value", "frame_ms", "frame_bytes", "flip", "ssim", "depth_rmse"} <= table[
        0
    ].keys()

    omitted = {(item["what"], item["why"]) for item in result["omissions"]}
    assert ("rasterizer: render.rasterizer = gl", "OpenGL: libEGL.so.1 is missing") in omitted
    assert ("jpeg: coverage and depth", "a lossy picture has neither") in omitted
    assert any("splat" in what and "the reference is of points" in why for what, why in omitted)
    for report in (out / "errors.md", out / "errors.html"):
        text = report.read_text()
        for said in ("Pareto", "libEGL.so.1 is missing", "rounding of stored positions", "layered", "FLIP"):
            assert said in text
    assert len(list(out.glob("errors-*.png"))) == 5, "against time, bytes read, message bytes, bytes and position bytes"


def test_no_error_is_computed_while_anything_is_timed(config, no_gl, monkeypatch):
    happened = []

    def watch(owner, name, what):
        real = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *a, **k: (happened.append(what), real(*a, **k))[1])

    watch(swept_scene.Pipeline, "timed_draw", "time")
    for name in ("flip", "ssim", "rmse", "coverage", "depth_rmse"):
        watch(sweep.metrics, name, "error")
    watch(swept_scene.References, "frame", "error")
    with FrameProgress(None) as progress:
        found = sweep.run_sweep(load_error_config(config), str(config), progress)
    first_error = happened.index("error")
    assert happened[:first_error] == ["time"] * (len(found.rows) * 2 * 2)
    assert "time" not in happened[first_error:]


def test_reference_frames_are_kept_and_a_damaged_one_is_drawn_again(config, monkeypatch):
    settings_ = load_error_config(config)
    scene = swept_scene.SweptScene(settings_, settings_.scene[0], "x")
    drawn = []
    with FrameProgress(None) as progress:
        monkeypatch.setattr(progress, "show", lambda doing, *_: drawn.append(doing))
        scene.prepare(progress)
        drawn.clear()
        first = scene.references(progress)
        assert drawn == ["city: reference 1", "city: reference 2"]
        drawn.clear()
        again = scene.references(progress)
        assert drawn == []
        kept = sorted((config.parent / "out" / "references").iterdir())
        assert len(kept) == 2
        kept[0].write_bytes(kept[0].read_bytes()[:100])
        third = scene.references(progress)
        assert len(drawn) == 1
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, third)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.integers(0, 50), st.integers(1, 3 * POINTS_AT_A_TIME)), min_size=1, max_size=6))
def test_pieces_draw_the_ranges_a_bounded_number_of_points_at_a_time(gaps_and_lengths):
    ranges, end = [], 0
    for gap, length in gaps_and_lengths:
        ranges.append((end + gap, end + gap + length))
        end += gap + length
    pieces = list(_pieces(ranges))
    assert all(0 < piece["range"].sum() <= POINTS_AT_A_TIME for piece in pieces)
    drawn = [(offset, offset + length) for offset, length, stride in np.concatenate(pieces).tolist() if stride == 1]
    assert merged(drawn) == merged(ranges)


def merged(ranges):
    """Ranges in the given order, those that touch joined."""
    out = []
    for first, end in ranges:
        if out and out[-1][1] == first:
            out[-1] = (out[-1][0], end)
        else:
            out.append((first, end))
    return out


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=12))
def test_the_pareto_front_is_what_no_other_point_beats(points):
    front = pareto_front([c for c, _ in points], [e for _, e in points])
    beaten = {p for p in points if any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in points)}
    assert {points[i] for i in front} == set(points) - beaten
    assert len({points[i] for i in front}) == len(front)


@pytest.mark.parametrize("bits", [1, 4, 8, 12, 16, 24])
def test_fixed_point_moves_a_point_by_half_a_bin_at_most(bits):
    rng = np.random.default_rng(5)
    edge, first = 100.0, np.array([0, 400, 401])
    x, y, z = (rng.uniform(-12.5, 12.5, 1000).astype(np.float32) for _ in range(3))
    x[0], y[1], z[2] = 12.5, -12.5, 12.5  # on the faces of the cube
    x[400] = y[400] = z[400] = 0.0  # a block of one point at its origin
    points = ResidentPoints(x, y, z, np.zeros(1000, np.uint32), first, rng.uniform(size=(3, 3)))
    half = block_half_edges(points, edge)
    np.testing.assert_array_equal(half[[0, 2]], 12.5)
    assert half[1] < 1e-9
    moved = fixed_point(points, edge, bits)
    bound = np.repeat(np.ldexp(half, -bits), [400, 1, 599])
    for axis in "xyz":
        before, after = getattr(points, axis).astype(float), getattr(moved, axis).astype(float)
        assert (np.abs(after - before) <= bound + 2.0**-24 * np.abs(before)).all()
        assert (np.abs(after) <= np.repeat(half, [400, 1, 599])).all()
    assert moved.colour is points.colour
    assert len(np.unique(moved.x[401:])) <= 2**bits

    x[5] = np.nan  # filtered out: stays so and moves no other
    filtered = fixed_point(points, edge, bits)
    assert np.isnan(filtered.x[5])
    np.testing.assert_array_equal(np.delete(filtered.x, 5), np.delete(moved.x, 5))


def test_a_scene_read_back_is_its_input_and_builds_the_same_cells_in_the_other_order(tmp_path):
    rng = np.random.default_rng(2)
    positions = rng.normal(size=(3000, 3)) * [40, 30, 5] + [6.4e6, -5.1e6, 300]
    source = ArraySource(positions, columns_for(3000, ("rgb", "intensity")))
    told = BuildSettings(points_per_cell=64, up="z")
    build_scene([source], tmp_path / "layered", settings=told)
    layered = Scene.open(tmp_path / "layered")
    back = SceneSource(layered)
    batches = list(back.batches(100))
    assert max(map(len, batches)) <= 100
    rgb = np.concatenate([batch.attributes["rgb"] for batch in batches])
    assert sorted(rgb) == list(range(3000)), "every input point once, no level-of-detail copy"
    found = np.concatenate([batch.positions for batch in batches])
    np.testing.assert_allclose(found, positions[rgb], rtol=0, atol=layered.info.edge * 2.0**-25 + np.spacing(6.4e6))
    assert rebuild_in_order(layered, "layered", tmp_path / "unused", lambda *_: None) is layered
    rebuilt = rebuild_in_order(layered, "depth-first", tmp_path / "new" / "depth-first", lambda *_: None)
    rebuilt.verify()
    assert rebuilt.info.point_order == "depth-first"
    assert rebuilt.info.up == "z"
    build_scene([source], tmp_path / "direct", settings=BuildSettings(points_per_cell=64, point_order="depth-first"))
    assert {k: v[:2] for k, v in cells_of(rebuilt.path).items()} == {
        k: v[:2] for k, v in cells_of(tmp_path / "direct").items()
    }


@pytest.mark.parametrize("codec", ["png", "jpeg", "h264"])
def test_a_picture_survives_its_codec(codec):
    if codec == "h264":
        pytest.importorskip("av", reason="PyAV is missing: splatpipe[video]")
    y, x = np.mgrid[:33, :51]
    rgb = np.stack([4 * x, 5 * y, x + y], axis=2).astype(np.uint8)
    image = ImageSection(codec=codec, jpeg_quality=95, h264_crf=5)
    shown = decode_picture(encode_picture(rgb, image), image, 51, 33)
    assert shown.shape == rgb.shape
    assert np.abs(shown.astype(int) - rgb).mean() <= {"png": 0, "jpeg": 3, "h264": 3}[codec]


@pytest.mark.parametrize("path", sorted(ROOT.glob("configs/error/*.toml")), ids=lambda path: path.name)
def test_every_shipped_file_is_valid(path):
    config = load_error_config(path)
    assert config.sweep


@pytest.mark.parametrize(
    ("replace", "by", "said"),
    [
        ("repeats", "repeets", "unknown key repeets, did you mean repeats?"),
        ("[run.sampling]", "[run.samplng]", "unknown key run.samplng, did you mean run.sampling?"),
        ("repeats = 2", "repeats = 0", "repeats = 0, expected greater than or equal to 1"),
        ("frames = [0, 5]", "frames = [0, 12]", "frames = [0, 12], expected numbers up to run.output.frames − 1 = 11"),
        ("frames = [0, 5]", "frames = []", "frames = []"),
        ('"sampling.pixel_threshold"', '"sampling.pixel_treshold"', "sweep 'layered': unknown key sampling.pixel_treshold, did you mean sampling.pixel_threshold?"),
        ("values = [0, 4, 8, 16]", "values = [0, -4]", "sweep 'layered': sampling.pixel_threshold = -4, expected greater than or equal to 0"),
        ("values = [0, 4, 8, 16]", "values = []", "sweep.0.values = []"),
        ('"render.rasterizer"', '"camera.width"', "sweep 'rasterizer': camera.width cannot be swept"),
        ('"render.rasterizer"', '"render.colour"', "sweep 'rasterizer': render.colour cannot be swept"),
        ("image.codec", "image.codek", "unknown key image.codek, did you mean image.codec?"),
        ("[4, 8, 16]", "[4, 25]", "positions.bits_per_axis = 25"),
        ('"depth-first"', '"breadth-first"', "sweep.1.order = 'breadth-first'"),
        ('method = "stride"', 'method = "layered"', "sweep 'layered' occurs twice"),
        ('name = "city"', 'name = "../city"', "scene.0.name = '../city'"),
        ("[[scene]]", "[[skene]]", "unknown key skene, did you mean scene?"),
        ('path = "', 'path = "/nowhere', "not a scene"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_line_with_status_2(config, replace, by, said, monkeypatch, capsys):
    text = config.read_text()
    assert replace in text
    config.write_text(text.replace(replace, by, 1))
    assert call("error", config, monkeypatch=monkeypatch) == 2
    message = capsys.readouterr().err
    assert said in message
    assert len(message.strip().splitlines()) == 1
    assert not (config.parent / "out").exists()


def test_a_setting_of_a_scene_or_a_sweep_leaves_the_rest_of_its_section_alone(config):
    text = config.read_text().replace("[[sweep]]", 'set = { camera.width = 64, "camera.fov_deg" = 30 }\n[[sweep]]', 1)
    config.write_text(text)
    loaded = load_error_config(config)
    points = list(sweep_points(loaded, loaded.scene[0], "x"))
    jpeg = [point.config for point in points if point.method == "jpeg"]
    assert [(c.image.codec, c.image.jpeg_quality) for c in jpeg] == [("jpeg", 30), ("jpeg", 95)]
    assert {(c.camera.width, c.camera.height, c.camera.fov_deg) for c in jpeg} == {(64, 72, 30.0)}
    assert {c.sampling.pixel_threshold for c in jpeg} == {0}


def test_layers_are_refused(tmp_path):
    (tmp_path / "e.toml").write_text(
        '[[scene]]\nname = "a"\npath = "b"\n[[sweep]]\nmethod = "m"\nkey = "sampling.pixel_threshold"\nvalues = [1]\n'
        '[[run.layers]]\npath = "c.layer"\n'
    )
    with pytest.raises(ConfigError, match=r"layers: found 1, expected none: .*e\.toml.* measures errors of points"):
        load_error_config(tmp_path / "e.toml")


def test_a_missing_file_and_a_file_without_a_sweep_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        load_error_config(tmp_path / "none.toml")
    (tmp_path / "e.toml").write_text('[[scene]]\nname = "a"\npath = "b"\n')
    with pytest.raises(ConfigError, match="sweep"):
        load_error_config(tmp_path / "e.toml")


def test_an_empty_view_has_no_coverage_and_says_so(config, no_gl):
    text = config.read_text().replace("[run.camera]", "[run.camera]\ncenter = [1e5, 1e5, 0]\nradius = 10.0")
    config.write_text(
        text.partition("[[sweep]]")[0] + '[[sweep]]\nmethod = "m"\nkey = "sampling.pixel_threshold"\nvalues = [0]\n'
    )
    with FrameProgress(None) as progress:
        found = sweep.run_sweep(load_error_config(config), str(config), progress)
    (row,) = found.rows
    assert (row["coverage_error"], row["depth_rmse"], row["colour_rmse"], row["flip"]) == (None, None, None, 0.0)
    assert any("no point is in view" in item.why for item in found.omissions)
