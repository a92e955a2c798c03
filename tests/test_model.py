"""`splatpipe model`: the thesis's worked example, conditions at the edge of the floats, files, and three real ranks."""

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.cluster.launch import mpi_available
from splatpipe.cluster.model.command import make_model
from splatpipe.cluster.model.fit import fit_latency_and_rate
from splatpipe.cluster.model.inequalities import Need, bottleneck, conditions
from splatpipe.cluster.model.parameters import Source
from splatpipe.cluster.model.present import make_report, record
from splatpipe.cluster.model.probes import _chase, _one_cycle, squares_in_view
from splatpipe.cluster.model.system_file import read_system_file, write_system_file
from splatpipe.nodes.raster import PointSize, ResidentPoints
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.nodes.raster.gl_probe import SIZES_BYTES, flop_per_s, transfer_times
from splatpipe.nodes.raster.reference import covered_pixels, point_indices, squares
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.errors import ConfigError, InputError
from splatpipe.shared.messages import RENDER_POINT
from splatpipe.shared.synth import CityScan

SYSTEMS = Path(__file__).parent.parent / "configs" / "systems"
AVAILABLE, REASON = gl_available()
THESIS = SYSTEMS / "thesis-2005.toml"


def splatpipe(*arguments, timeout=60):
    command = [sys.executable, "-m", "splatpipe.cluster", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout)


def condition(found, number, where):
    return next(c for c in found if (c.number, c.where) == (number, where))


@pytest.fixture(scope="module")
def thesis():
    return conditions(*read_system_file(THESIS))


# --- worked example 6.2.3 and the gigabit case


@pytest.mark.parametrize(
    ("number", "where", "largest", "unit"),
    [
        ("2", "culling → sampling", 729.74, 1024),  # KB; the thesis prints 730.417
        ("2", "sampling → render", 729.74, 1024),
        ("3", "render", 29.14, 1e6),  # million vertices
        ("4", "render", 49.12, 1e6),  # MB
    ],
)
def test_the_thesis_worked_example(thesis, number, where, largest, unit):
    found = condition(thesis, number, where)
    assert found.verdict == "holds"
    assert round(found.need.largest_data(15) / unit, 2) == largest


def test_the_thesis_bottleneck_is_the_sampling_node(thesis):
    found = bottleneck(thesis)
    assert (found.number, found.where, found.verdict) == ("7", "sampling", "violated")
    assert found.need.largest_frames_per_s == pytest.approx(12.5)
    assert found.margin_s == pytest.approx(1 / 15 - 1 / 12.5)


def test_what_the_thesis_does_not_give_is_unknown_and_what_it_does_not_do_holds(thesis):
    assert condition(thesis, "7", "render").verdict == "unknown"
    assert condition(thesis, "6", "render").verdict == "unknown"
    assert condition(thesis, "1", "render").verdict == "holds"  # l_u is unknown, but nothing is read back
    assert condition(thesis, "5", "render").need.seconds == 0
    assert {c.verdict for c in thesis} == {"holds", "violated", "unknown", "not applicable"}


def test_the_misprints_are_named():
    text = json.dumps(record(make_model(None, [], THESIS, None, None))["errata"], ensure_ascii=False)
    assert "730.417" in text
    assert "729.74" in text
    for equation in ("(1)", "(3)", "(6)", "(7)"):
        assert equation in text


def test_frames_of_1920_by_1200_over_gigabit_ethernet():
    found = conditions(*read_system_file(SYSTEMS / "1920x1200-gigabit.toml"))
    rates = {c.where: c.need.largest_frames_per_s for c in found if c.number == "2"}
    assert {where: round(rate, 1) for where, rate in rates.items()} == {
        "render → RGB display": 18.1,
        "render → RGBA display": 13.6,
    }
    assert [c.verdict for c in found if c.number == "2"] == ["holds", "violated"]


# --- the time form at its edges


def test_latencies_longer_than_a_frame_are_violated_not_negative():
    need = Need(count=1, latency_s=1.0, data=1.0, rate_per_s=1e9)  # F·l = 15
    assert need.seconds > 1 / 15
    assert need.largest_data(15) == 0
    assert 0 < need.largest_frames_per_s < 1


def test_zero_bandwidth_and_zero_data():
    assert Need(0, 0, 1.0, 0.0).seconds == math.inf
    assert Need(0, 0, 1.0, 0.0).largest_frames_per_s == 0
    assert Need(0, 0, 0.0, 0.0).seconds == 0
    assert Need(0, 0, 0.0, 0.0).largest_frames_per_s == math.inf


def test_rates_a_million_apart_lose_no_digit():
    fast, slow = Need(0, 0, 1.0, 1e9), Need(0, 0, 1.0, 1e3)
    assert slow.seconds / fast.seconds == pytest.approx(1e6, rel=1e-15)
    assert Need(1, 1e-9, 1.0, 1e3).seconds == pytest.approx(1.000001e-3, rel=1e-15)


numbers = st.floats(0, sys.float_info.max)


@settings(max_examples=200, derandomize=True)
@given(numbers, numbers, numbers, numbers, st.floats(1e-300, 1e300))
def test_any_numbers_give_an_answer_and_a_verdict_that_agrees_with_the_limit(count, latency_s, data, rate, frames):
    need = Need(count, latency_s, data, rate)
    assert need.seconds >= 0
    assert need.largest_data(frames) >= 0
    if need.largest_frames_per_s > frames * (1 + 1e-12):
        assert need.seconds <= 1 / frames
    if need.largest_frames_per_s < frames * (1 - 1e-12):
        assert need.seconds > 1 / frames


# --- files


def test_a_system_file_is_read_back_as_it_was_written(tmp_path):
    for path in SYSTEMS.glob("*.toml"):
        system, application = read_system_file(path)
        write_system_file(tmp_path / "copy.toml", 'a "name" \\ ü', system, application)
        assert read_system_file(tmp_path / "copy.toml") == (system, application)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("cpu_flop_per_s = 265.4e6\n", "", "system.rank[0].cpu_flop_per_s: found nothing, expected a finite number"),
        ("cpu_flop_per_s = 265.4e6", "cpu_flop_per_s = -1", "system.rank[0].cpu_flop_per_s: found -1, expected"),
        ("cpu_flop_per_s = 265.4e6", "cpu_flop_per_s = inf", "system.rank[0].cpu_flop_per_s: found inf, expected"),
        ("cpu_flop_per_s = 265.4e6", "cpu_flop_per_s = nan", "system.rank[0].cpu_flop_per_s: found nan, expected"),
        ("cpu_flop_per_s = 265.4e6", "cpu_flop_per_s = true", "system.rank[0].cpu_flop_per_s: found True, expected"),
        ("cpu_flop_per_s = 265.4e6", "cpu_flop_per_s = [1]", "system.rank[0].cpu_flop_per_s: found [1], expected"),
        ("cpu_flop_per_s = 265.4e6", "cpu_flop_per_s = 1" + "0" * 400, "system.rank[0].cpu_flop_per_s: found 1000"),
        ("cpu_flop_per_s", "cpu_flops_per_s", "unknown key system.rank[0].cpu_flops_per_s, did you mean"),
        ("version = 1", "version = 2", "version: found 2, expected 1"),
        ("version = 1\n", "", "version: found nothing, expected 1"),
        ("receiver = 1", "receiver = 3", "system.link[0].receiver: found 3, expected a rank, 0…2"),
        ("receiver = 1", "receiver = 0", "system.link[0].receiver: found 0, expected another rank than the sender"),
        ("frames_per_s = 15.0", "frames_per_s = 0", "application.frames_per_s: found 0.0, expected a number > 0"),
        (
            "sender = 1\nreceiver = 2\nlatency",
            "sender = 0\nreceiver = 1\nlatency",
            "system.link[1]: found 0 to 1 again, expected each pair once",
        ),
        ('role = "render"', "role = 3", "system.rank[2].role: found 3, expected a text"),
        ("[application]", "[applications]", "unknown key applications, did you mean application?"),
        ("version = 1", "version =", "not valid TOML"),
    ],
)
def test_a_wrong_system_file_is_one_line_and_status_2(tmp_path, old, new, said):
    path = tmp_path / "system.toml"
    text = THESIS.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        read_system_file(path)
    assert str(error.value).startswith(f"{path}: ")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_ranks_of_system_and_application_must_be_as_many(tmp_path):
    path = tmp_path / "system.toml"
    text = THESIS.read_text()
    path.write_text(text[: text.rindex("[[application.rank]]")] + text[text.index("[[application.traffic]]") :])
    with pytest.raises(InputError, match=r"application\.rank: found 2 ranks, expected 3 as in system\.rank"):
        read_system_file(path)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "found neither CONFIG nor --system FILE"),
        (("--system", "absent.toml"), "absent.toml: cannot be read"),
        (("--system", THESIS, "--fps", "0"), "--fps 0.0: expected a finite number > 0"),
        (("--system", THESIS, "--fps", "nan"), "--fps nan: expected a finite number > 0"),
        (("absent-config.toml",), "absent-config.toml: cannot be read"),
    ],
)
def test_bad_usage_is_one_line_and_status_2(arguments, said):
    done = splatpipe("model", *arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_file_alone_is_evaluated_and_reported(tmp_path):
    done = splatpipe(
        "model", "--system", THESIS, "--fps", 12, "--json", tmp_path / "m.json", "--report", tmp_path / "thesis"
    )
    assert done.returncode == 0, done.stderr
    assert "bottleneck: (7) computation on the CPU, sampling: at most 12.5 frames/s" in done.stdout
    content = json.loads((tmp_path / "m.json").read_text(), parse_constant=pytest.fail)
    assert content["frames_per_s"] == 12
    assert {c["verdict"] for c in content["conditions"]} == {"holds", "unknown", "not applicable"}
    for suffix in (".md", ".html"):
        text = (tmp_path / f"thesis{suffix}").read_text()
        assert "730.417" in text
        assert "not applicable" in text


def test_a_link_without_bandwidth_is_reported_as_never_in_time(tmp_path):
    path = tmp_path / "stuck.toml"
    path.write_text((SYSTEMS / "1920x1200-gigabit.toml").read_text().replace("= 125000000.0", "= 0"))
    model = make_model(None, [], path, None, None)
    sending = [c for c in record(model)["conditions"] if c["number"] == "2"]
    assert [(c["verdict"], c["needed_s"], c["largest_frames_per_s"]) for c in sending] == [("violated", "inf", 0)] * 2
    text = make_report(model, "test").write(tmp_path / "stuck")[1].read_text()
    assert "at most 0 frames/s" in text


def test_a_run_with_layers_is_refused(tmp_path):
    (tmp_path / "run.toml").write_text('[scene]\npath = "a"\n[[layers]]\npath = "c.layer"\n')
    with pytest.raises(ConfigError, match="layers: found 1, expected none: the model counts points alone"):
        make_model(tmp_path / "run.toml", [], None, None, None)


def test_the_report_gives_every_parameter_its_unit_and_source():
    model = make_model(None, [], THESIS, None, None)
    tables = [part for part in make_report(model, "test").parts if hasattr(part, "columns")]
    parameters = [table for table in tables if "unit" in table.columns and "source" in table.columns]
    assert len(parameters) == 4
    for table in parameters:
        for row in table.rows:
            assert row[table.columns.index("unit")]
            assert set(row[-1].split("; ")) <= {"file", "unknown", "not applicable"}


# --- fits and counts


@settings(max_examples=50, derandomize=True)
@given(st.floats(1e-9, 1e-2), st.floats(1e3, 1e12))
def test_a_fit_finds_latency_and_rate(latency_s, rate):
    amounts = [0, 1 << 10, 1 << 14, 1 << 17, 1 << 20, 1 << 22]
    fit = fit_latency_and_rate(amounts, [latency_s + n / rate for n in amounts])
    assert fit.worst_residual < 1e-6
    assert fit.latency_s == pytest.approx(latency_s, rel=1e-6)


def test_a_fit_never_has_a_negative_latency_or_rate():
    falling = fit_latency_and_rate([0, 1000, 2000], [3e-6, 2e-6, 1e-6])
    assert falling.per_s is None
    assert falling.latency_s > 0
    through_zero = fit_latency_and_rate([1, 10, 100], [1e-9, 50e-6, 700e-6])
    assert through_zero.latency_s >= 0
    assert through_zero.per_s > 0


def test_covered_pixels_are_counted_within_the_image():
    rng = np.random.default_rng(3)
    x, y, z = rng.uniform(-1, 1, (3, 500)).astype(np.float32)
    points = ResidentPoints(x, y, z, np.zeros(500, np.uint32), np.zeros(1, np.int64), np.zeros((1, 3)))
    pose = look_at(np.array([0.0, -3.0, 0.5]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    camera = perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.6, width=64, height=48, near=0.1)
    entries = np.array([(0, 500, 3)], RENDER_POINT)
    size = PointSize(2, 0.2, 9)
    counted = 0
    for row, column, side, *_ in zip(*squares(points, camera, point_indices(entries), size), strict=True):
        mask = np.zeros((48, 64), bool)
        mask[max(row, 0) : row + side, max(column, 0) : column + side] = True
        counted += int(mask.sum())
    assert covered_pixels(points, camera, entries, size) == counted > 500


def test_the_squares_that_measure_fragments_lie_wholly_in_the_image():
    pose = look_at(np.array([5e5, -3.0, 0.5]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    camera = perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.6, width=640, height=64, near=0.1)
    entries = np.array([(0, 100, 1)], RENDER_POINT)
    points = squares_in_view(camera, 64, 100)
    assert covered_pixels(points, camera, entries, PointSize(64)) == pytest.approx(100 * 64 * 64, rel=0.02)


def test_the_memory_latency_probe_visits_every_line():
    following = np.zeros((1000, 2), np.int64)
    _one_cycle(following, 1)
    at, seen = 0, set()
    for _ in range(1000):
        at = int(following[at, 0])
        seen.add(at)
    assert len(seen) == 1000
    assert _chase(following, 1000) == 0


@pytest.mark.gl
@pytest.mark.skipif(not AVAILABLE, reason=REASON)
def test_the_gl_device_is_measured():
    times = transfer_times()
    assert set(times) == {"down", "up"}
    for seconds in times.values():
        assert len(seconds) == len(SIZES_BYTES)
        assert min(seconds) > 0
    assert 0 < flop_per_s() < math.inf


# --- a real run


@pytest.mark.mpi
@pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
def test_three_ranks_are_measured_and_what_they_save_says_the_same(tmp_path):
    build_scene([CityScan(n_points=30_000)], tmp_path / "city", settings=BuildSettings(points_per_cell=300))
    config = tmp_path / "run.toml"
    config.write_text(
        f'[scene]\npath = "{tmp_path}/city"\n[camera]\nwidth = 160\nheight = 90\n[render]\nrasterizer = "cpu"\n'
        '[pipeline]\ntopology = "pipelined"\n[output]\nframes = 3\n'
    )
    saved = tmp_path / "saved.toml"
    done = splatpipe("model", config, "--fps", 5, "--save-system", saved, "--json", tmp_path / "m.json")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "m.json").read_text())
    roles = [rank["role"] for rank in content["system"]["ranks"]]
    assert roles == ["culling", "sampling", "render"]
    for rank in content["system"]["ranks"]:
        sources = {name: value["source"] for name, value in rank.items() if name != "role"}
        gpu = {name for name in sources if name.startswith(("gpu_", "video_"))}
        assert {sources[name] for name in gpu} == {Source.NOT_APPLICABLE}
        assert {sources[name] for name in set(sources) - gpu} == {Source.MEASURED}
    assert [(link["sender"], link["receiver"]) for link in content["system"]["links"]] == [(0, 1), (0, 2), (1, 2)]
    render = content["application"]["ranks"][2]
    assert render["fragments"]["value"] >= 1
    assert render["vertices"]["value"] >= 1
    assert all(value["value"] > 0 for name in ("vertices_per_s", "fragments_per_s") for value in [render[name]])
    sent = {(t["sender"], t["receiver"]): t["bytes"]["value"] for t in content["application"]["traffic"]}
    messages = content["run"]["messages"]
    frames = content["run"]["frames"]
    assert sent[0, 2] * 2 * frames == messages["FRAME_START"]["bytes"]
    assert sent[0, 1] * frames == messages["FRAME_START"]["bytes"] / 2 + messages["VISIBILITY"]["bytes"]
    assert sent[1, 2] * frames >= messages["RENDER_POINTS"]["bytes"]  # the largest of any frame
    assert sent[2, 0] * frames == messages["FRAME_DONE"]["bytes"]

    system, application = read_system_file(saved)
    again = [
        (c.number, c.where, c.verdict, c.need.seconds if c.need else None) for c in conditions(system, application)
    ]
    assert again == [(c["number"], c["where"], c["verdict"], c.get("needed_s")) for c in content["conditions"]]
