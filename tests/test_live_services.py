"""What is answered beside a live run: picks as the run draws, recorded paths that run, and what is left out."""

import io
import json
import math
import signal
import subprocess
import sys
import tomllib

import numpy as np
import pytest
from build_sources import ArraySource
from PIL import Image
from splatpipe.cluster.job import Job
from splatpipe.cluster.live.protocol import MAX_HEADER_BYTES, PathKey, View
from splatpipe.cluster.live.recorded import in_order, recorded_config
from splatpipe.cluster.live.services import RunServices
from splatpipe.cluster.live.settings import settings_of
from splatpipe.cluster.live.views import camera_of, view_of
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.camera import Camera
from splatpipe.shared.camera_path import axis_vector
from splatpipe.shared.config import load_config, parse_config
from splatpipe.shared.errors import ConfigError, InputError
from splatpipe.shared.points import pack_rgb
from splatpipe.shared.toml_text import toml_document

FAR = 6.4e6
WIDTH, HEIGHT = 96, 64


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """4000 points of a bumpy sheet, 6 400 km away; red, green and blue tell which one it is."""
    rng = np.random.default_rng(1)
    u, v = rng.uniform(-1, 1, (2, 4000))
    i = np.arange(4000)
    cloud = np.column_stack([FAR + u, v - FAR, 100 + 0.2 * np.sin(3 * u) * np.cos(4 * v)])
    columns = {
        "rgb": pack_rgb(*(np.uint8(i >> 4 * k & 15) for k in range(3))),
        "classification": (i % 5).astype(np.uint8),
    }
    path = tmp_path_factory.mktemp("services") / "sheet.scene"
    build_scene([ArraySource(cloud, columns)], path, settings=BuildSettings(points_per_cell=300))
    return path


def config_of(scene, **settings):
    tables = {
        "scene": {"path": str(scene)},
        "camera": {"width": WIDTH, "height": HEIGHT, "elevation_deg": 50.0},
        "render": {"rasterizer": "cpu", "colour": "rgb", "point_size_px": 2, "background": "#ffffff"},
        "pipeline": {"topology": "single"},
        "output": {"frames": 2},
    }
    for key, value in settings.items():
        section, name = key.split(".")
        tables.setdefault(section, {})[name] = value
    return parse_config(tables)


# --- views ----------------------------------------------------------------------------------------------------------


def test_the_first_view_of_a_job_is_its_first_picture(scene):
    for settings in ({}, {"camera.elevation_deg": 90.0}, {"camera.elevation_deg": -90.0}, {"camera.up": "-x"}):
        job = Job(config_of(scene, **settings))
        camera, again = job.camera(0), camera_of(view_of(job), WIDTH, HEIGHT, 0, job.camera(0).near)
        assert np.allclose(again.clip_from_world[:, :3], camera.clip_from_world[:, :3], atol=1e-6)
        assert again.eye == pytest.approx(camera.eye)
    assert view_of(Job(config_of(scene))).up == (0, 0, 1)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -2), (1e-12, 0, 1), (0, 0, 0), (1e300, 0, 1)])
@pytest.mark.parametrize("eye", [(0, 0, 5), (0, 0, -5), (1e-13, 0, 5)])
def test_cameras_at_the_poles_are_cameras(up, eye):
    camera = camera_of(View(eye=eye, target=(0, 0, 0), up=up), 64, 48, 0, 0.1)
    x, y, _, w = camera.clip_from_world @ (0, 0, 0, 1)
    assert (x / w, y / w, w) == pytest.approx((0, 0, 5), abs=1e-9)


@pytest.mark.parametrize(
    "view",
    [
        View(eye=(1, 2, 3), target=(1, 2, 3)),
        View(eye=(0, 0, 0), target=(1, 0, 0), fov_deg=5e-324),
    ],
)
def test_what_is_no_view_is_told_in_one_line(view):
    with pytest.raises(InputError, match="camera") as told:
        camera_of(view, 64, 48, 0, 0.1)
    assert "\n" not in str(told.value)


# --- picking ----------------------------------------------------------------------------------------------------------


def drawn(config, view):
    """(h, w, 4) uint8: what a run of one rank shows of a view."""
    job = Job(config.model_copy(update={"output": config.output.model_copy(update={"depth": True})}))
    octree = job.load_octree()
    size = job.views.width, job.views.height
    camera = camera_of(view, *size, 0, job.camera(0).near)
    with job.open_render(lambda *_: None, writes=False) as stage:
        chosen = job.sampling_node(octree).process(camera, job.culling_node(octree).process(camera))
        return stage.compose(camera, stage.rasterize(camera, chosen))


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"filter.classes": [1, 3]},
        {"filter.boxes": [{"lower": [FAR - 9, -FAR - 9, 0], "upper": [FAR, -FAR + 9, 999], "keep": "inside"}]},
        {"render.point_size_px": 5, "sampling.pixel_threshold": 4.0},
    ],
)
def test_what_is_picked_is_what_is_shown(scene, settings):
    config = config_of(scene)
    services, view = RunServices(config), view_of(Job(config))
    now = settings_of(config) | settings
    picture = drawn(config_of(scene, **settings), view)
    rng = np.random.default_rng(0)
    n_shown = n_same = 0
    for column, row in zip(rng.integers(0, WIDTH, 80), rng.integers(0, HEIGHT, 80), strict=True):
        found = services.pick(view, WIDTH, HEIGHT, (column + 0.5) / WIDTH, (row + 0.5) / HEIGHT, now)
        depth = picture.depth[row, column]
        if depth:
            n_shown += 1
            n_same += found["found"] and found["attributes"]["rgb"] == picture.rgba[row, column, :3].tolist()
    assert n_shown > 5
    assert n_same >= n_shown - 1, "but for what float32 rounds over the edge of a pixel"


def test_a_pick_tells_the_point_to_the_last_bit_and_is_json(scene):
    config = config_of(scene)
    services, view = RunServices(config), view_of(Job(config))
    found = services.pick(view, WIDTH, HEIGHT, 0.5, 0.5, settings_of(config))
    assert found["found"]
    assert json.loads(json.dumps(found)) == found
    assert set(found["attributes"]) == {"index", "depth", "rgb", "classification"}
    x, y, z = found["position"]
    assert (abs(x - FAR) <= 1, abs(y + FAR) <= 1, abs(z - 100) <= 0.2) == (True, True, True)
    assert services.pick(view, WIDTH, HEIGHT, 0.0, 0.0, settings_of(config)) == {"found": False}
    assert services.pick(view, WIDTH, HEIGHT, 1.0, 1.0, settings_of(config)) == {"found": False}


def test_picks_of_a_picture_that_is_averaged(scene):
    config = config_of(scene, **{"render.supersampling": 3, "render.point_size_px": 4})
    services, view = RunServices(config), view_of(Job(config))
    once = services.pick(view, WIDTH, HEIGHT, 0.52, 0.51, settings_of(config) | {"render.supersampling": 1})
    found = services.pick(view, WIDTH, HEIGHT, 0.52, 0.51, settings_of(config))
    assert found["position"] == pytest.approx(once["position"], abs=0.2)


def test_settings_that_the_scene_refuses_are_refused(scene):
    config = config_of(scene)
    with pytest.raises(ConfigError, match=r"render\.colour"):
        RunServices(config).pick(view_of(Job(config)), 9, 9, 0.5, 0.5, {"render.colour": "intensity"})
    with pytest.raises(InputError, match="eye and target coincide"):
        RunServices(config).pick(View(eye=(0, 0, 0), target=(0, 0, 0)), 9, 9, 0.5, 0.5, {})


# --- recorded paths ---------------------------------------------------------------------------------------------------


def turn(n=200, seconds=4.0, begun=7.3):
    """A viewer's half turn, recorded densely, coming nearer with a wider view."""
    keys = []
    for s in np.linspace(0, 1, n):
        angle, radius = 3 * s, 4 - s
        eye = (FAR + radius * math.sin(angle), -FAR - radius * math.cos(angle), 101.5 + s)
        view = View(eye=eye, target=(FAR, -FAR, 100.0 + 0.2 * s), fov_deg=45 + 10 * s)
        keys.append(PathKey(time=begun + seconds * s, view=view))
    return keys


def test_a_recorded_path_is_a_configuration_that_runs(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(scene.parent)
    services = RunServices(config_of(scene.name))
    text = services.path(turn(seconds=0.2), 10.0, {"render.colour": "classification", "render.point_size_px": 3})
    monkeypatch.chdir(tmp_path)
    (tmp_path / "path.toml").write_text(text)
    config = load_config(tmp_path / "path.toml")
    assert config.scene.path == str(scene)
    assert (config.render.colour, config.render.point_size_px, config.render.background) == (
        "classification",
        3,
        "#ffffff",
    )
    assert (config.output.frames, config.output.fps, config.camera.width) == (2, 10.0, WIDTH)
    done = subprocess.run(
        [sys.executable, "-m", "splatpipe.cluster", "run", "path.toml"],
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    shown = [np.asarray(Image.open(tmp_path / "frames" / f"frame_000{i}.png")) for i in (0, 1)]
    assert all((picture != 255).any() for picture in shown)


def pixels_apart(one: Camera, other: Camera, places):
    at = [(c.pixel_from_world[:, :3] @ (places - c.eye).T) for c in (one, other)]
    return np.abs(at[0][:2] / at[0][2] - at[1][:2] / at[1][2]).max()


def test_the_path_goes_where_it_was_recorded_through_few_keys(scene):
    keys = turn()
    config = parse_config(tomllib.loads(RunServices(config_of(scene)).path(keys, 30.0, {})))
    assert config.output.frames == 120
    assert 3 <= len(config.camera.keyframes) <= 40
    first, last = config.camera.keyframes[0], config.camera.keyframes[-1]
    assert (first.time, last.time) == (0.0, 1.0)
    assert (first.eye, last.target) == (keys[0].view.eye, keys[-1].view.target), "to the last bit"
    path, n = Job(config).views.path.path, len(keys) - 1
    corners = np.array([(FAR + x, -FAR + y, 100) for x in (-1, 1) for y in (-1, 1)])
    for i in range(0, len(keys), 13):
        time = i / n
        recorded = camera_of(keys[i].view, WIDTH, HEIGHT, 0, 0.1)
        view = keys[i].view.model_copy(update={"fov_deg": math.degrees(path.fov_y_rad(time))})
        pose = path.pose(time)
        eye, target = pose[:3, 3], pose[:3, 3] - pose[:3, 2]
        view = View(eye=tuple(eye), target=tuple(target), up=tuple(pose[:3, 1]), fov_deg=view.fov_deg)
        assert pixels_apart(recorded, camera_of(view, WIDTH, HEIGHT, 0, 0.1), corners) < 2


def test_however_it_was_recorded_the_text_fits_into_a_message(scene):
    rng = np.random.default_rng(0)
    keys = [
        PathKey(time=float(t), view=View(eye=tuple(rng.normal((FAR, -FAR, 105))), target=(FAR, -FAR, 100 + 1 / 3)))
        for t in rng.permutation(512) / 7
    ]
    services = RunServices(config_of(scene))
    text = services.path(keys, 30.0, {})
    assert len(json.dumps({"kind": "path", "request": 1, "toml": text})) <= MAX_HEADER_BYTES
    times = [key["time"] for key in tomllib.loads(text)["camera"]["keyframes"]]
    assert times == sorted(times)
    assert len(times) > 250


def test_a_single_key_is_a_picture_and_keys_at_one_time_are_one(scene):
    services = RunServices(config_of(scene))
    one = tomllib.loads(services.path(turn(1), 30.0, {}))
    assert (one["output"]["frames"], len(one["camera"]["keyframes"])) == (1, 1)
    keys = [PathKey(time=1.0, view=key.view) for key in turn(3)]
    assert in_order(keys) == [keys[-1]]
    rest = [PathKey(time=float(t), view=keys[0].view) for t in range(50)]
    assert len(tomllib.loads(services.path(rest, 1.0, {}))["camera"]["keyframes"]) == 2


def test_up_is_that_of_the_recording_where_it_is_an_axis(scene):
    for up, name in (((0, 0, 1), "scene"), ((0, 0, -3), "-z"), ((1, 0, 0), "x"), ((1, 1, 0), "scene")):
        keys = [PathKey(time=key.time, view=key.view.model_copy(update={"up": up})) for key in turn(4)]
        text = recorded_config(config_of(scene), keys, 30.0, axis_vector("z"))
        assert tomllib.loads(text)["camera"]["up"] == name


def test_a_key_that_looks_nowhere_is_refused(scene):
    keys = [PathKey(time=0.0, view=View(eye=(1, 1, 1), target=(1, 1, 1)))]
    with pytest.raises(ConfigError, match="eye and target coincide"):
        RunServices(config_of(scene)).path(keys, 30.0, {})


def test_toml_gives_back_what_was_written():
    tables = {
        "a": {"text": 'quote " back \\ tab \t del \x7f 点', "numbers": [0.1, 1e300, 5e-324, -3, True]},
        "b c": {"6": {"x.y": [1.5]}, "none": [], "many": [{"k": 1.25}, {"k": math.pi}]},
        "list": [{"path": "/x"}, {"path": "y", "on": False}],
    }
    assert tomllib.loads(toml_document(tables)) == tables


# --- the plan ---------------------------------------------------------------------------------------------------------


def test_what_is_left_out_is_what_the_plan_says(scene, tmp_path):
    config = config_of(scene)
    services = RunServices(config)
    told = services.left_out()
    assert told == services.left_out()
    assert all(
        set(part) == {"what", "why", "saves"} and all(isinstance(v, str) for v in part.values()) for part in told
    )
    assert {"MPI", "layers", "clip boxes"} <= {part["what"] for part in told}
    assert json.dumps(told)


def test_of_three_ranks_mpi_is_not_left_out(scene):
    told = RunServices(config_of(scene, **{"pipeline.topology": "pipelined"})).left_out()
    assert "MPI" not in {part["what"] for part in told}


# --- in a live run ----------------------------------------------------------------------------------------------------


def test_a_live_run_answers_its_viewers(scene, tmp_path):
    pytest.importorskip("zmq", reason="pyzmq is missing: splatpipe[live]")
    pytest.importorskip("aiohttp", reason="aiohttp is missing: splatpipe[live]")
    from splatpipe.cluster.live.sockets import Client

    config = config_of(scene, **{"camera.width": 160, "camera.height": 96})
    tables = config.model_dump(mode="json", exclude_defaults=True)
    (tmp_path / "live.toml").write_text(toml_document(tables))
    connection = tmp_path / "connection.json"
    command = [sys.executable, "-m", "splatpipe.cluster", "view", "live.toml", "--connection", str(connection)]
    run = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert "look at it" in run.stdout.readline()
        with Client(connection, pictures=True) as client:

            def ask(kind, **fields):
                client.send({"kind": kind, **fields})
                return heard(kind)

            def heard(kind):
                for _ in range(300):
                    message = client.receive(0.1)
                    if message is not None and message.kind in (kind, "refused", "bye"):
                        assert message.kind == kind, message.header
                        return message
                raise AssertionError(f"no {kind}")

            welcome = heard("welcome").header
            picture = heard("picture")
            rgb = np.asarray(Image.open(io.BytesIO(picture.payload)).convert("RGB"))
            rows, columns = np.nonzero((rgb != 255).any(axis=2))
            i = len(rows) // 2
            at = {"x": (columns[i] + 0.5) / 160, "y": (rows[i] + 0.5) / 96}
            picked = ask("pick", request=3, frame=picture.header["frame"], **at).header
            assert (picked["request"], picked["found"]) == (3, True)
            assert picked["attributes"]["rgb"] == rgb[rows[i], columns[i]].tolist()
            key = {"view": welcome["view"]}
            asked = {"keys": [{"time": 0, **key}, {"time": 1, **key}], "fps": 12}
            toml = tomllib.loads(ask("path", request=4, **asked).header["toml"])
            assert (toml["output"]["frames"], toml["scene"]["path"]) == (12, str(scene))
            assert ask("plan", request=5).header["left_out"][0]["what"] == "MPI"

        run.send_signal(signal.SIGINT)
        assert run.wait(30) == 0, run.stdout.read()
    finally:
        run.kill()
        run.wait()
        run.stdout.close()
