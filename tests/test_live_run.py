"""The ranks of a live run: what viewers ask for is drawn, in every topology with the bits of one rank."""

import io
import queue
import threading
import time

import numpy as np
import pytest
from helpers_ranks import World
from PIL import Image
from splatpipe.cluster.job import Job
from splatpipe.cluster.layout import ALONE
from splatpipe.cluster.live.protocol import LiveMessage, View
from splatpipe.cluster.live.rank import LiveRank
from splatpipe.cluster.live.settings import check_size, configured
from splatpipe.cluster.live.view import live_config
from splatpipe.cluster.live.views import camera_of
from splatpipe.cluster.pipeline import FrameLoop
from splatpipe.cluster.topologies import layout_of
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config
from splatpipe.shared.errors import ConfigError
from splatpipe.shared.synth import CityScan

SIZE = {"camera.width": 163, "camera.height": 91}
VIEW = {"eye": [60.0, -90.0, 70.0], "target": [50.0, 40.0, 5.0], "up": [0.0, 0.0, 1.0], "fov_deg": 40.0}
LOW = VIEW | {"eye": [50.0, -60.0, 20.0]}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("live") / "scene"
    build_scene([CityScan(n_points=20_011)], path, settings=BuildSettings(points_per_cell=300))
    return path


@pytest.fixture(scope="module")
def forms(tmp_path_factory):
    """The city with whatever a run may want of a scene."""
    folder = tmp_path_factory.mktemp("forms")
    city = [CityScan(n_points=20_011)]
    build_scene(city, folder / "splats", settings=BuildSettings(points_per_cell=300, splats=True, features=True))
    build_scene(city, folder / "groups", settings=BuildSettings(points_per_cell=300, positions="groups"))
    build_scene(city, folder / "pools", settings=BuildSettings(points_per_cell=300, pools=True))
    return folder


@pytest.fixture
def config(scene, tmp_path):
    path = tmp_path / "live.toml"
    path.write_text(
        f'[scene]\npath = "{scene}"\n[camera]\nwidth = 163\nheight = 91\n'
        '[render]\npoint_size_px = 2\nrasterizer = "cpu"\nthreads = 1\n[live]\nfps = 200\nstill_after_s = 0.05\n'
    )
    return path


class Hub:
    """The other end of the ranks' links, with the script of a test in place of viewers."""

    def __init__(self):
        self.to_run, self.said, self.there = queue.Queue(), [], threading.Condition()

    def link(self):
        return Link(self)

    def tell(self, **header):
        self.to_run.put(LiveMessage(header))

    def look(self, view, moving=False, viewer=1):
        self.tell(kind="camera", view=view, moving=moving, t=1.5, viewer=viewer, at=time.monotonic())

    def wait(self, wanted, after=0):
        """The first message from number ``after`` on that is wanted, and the number of the next."""
        end = time.monotonic() + 60
        with self.there:
            while time.monotonic() < end:
                for i, message in enumerate(self.said[after:], after):
                    if wanted(message):
                        return message, i + 1
                self.there.wait(0.1)
        raise AssertionError(f"not said: {[(m.kind, m.header) for m in self.said[after:]][-6:]}")

    def still(self, after=0):
        """The next still picture that no camera of before ``after`` is seen in: header, (h, w, 3) uint8, next."""
        started, after = self.wait(
            lambda m: m.kind == "started" and m.header["still"] and "screenshot" not in m.header, after
        )
        frame = started.header["frame"]
        picture, _ = self.wait(lambda m: m.kind == "picture" and m.header["frame"] == frame)
        assert picture.header["encoding"] == "png"
        self.tell(kind="shown", frame=frame)
        return started.header, pixels(picture), after


class Link:
    def __init__(self, hub):
        self._hub = hub

    def send(self, header, payload=b""):
        with self._hub.there:
            self._hub.said.append(LiveMessage(header, bytes(payload)))
            self._hub.there.notify_all()
        return True

    def receive(self, timeout_s):
        found = []
        try:
            found.append(self._hub.to_run.get(timeout=max(timeout_s, 1e-4)))
            while True:
                found.append(self._hub.to_run.get_nowait())
        except queue.Empty:
            return found


def pixels(message):
    return np.asarray(Image.open(io.BytesIO(message.payload)).convert("RGB"))


def live(config, sets, topology, ranks, script):
    """Run a script of a hub beside the ranks of a live run; what the hub heard."""
    hub = Hub()
    sets = [*sets, f"pipeline.topology={topology}"]

    def work(transport):
        job = Job(live_config(load_config(config, sets)))
        layout = layout_of(job.config.pipeline, ranks) if transport else ALONE
        with LiveRank(job, hub.link()) as rank:
            return FrameLoop(job, layout, transport, lambda *_: None, live=rank).run()

    failed = []

    def director():
        try:
            script(hub)
        except BaseException as error:
            failed.append(error)
        hub.tell(kind="quit")

    thread = threading.Thread(target=director)
    thread.start()
    try:
        World(ranks).run(work) if topology != "single" else work(None)
    finally:
        thread.join(60)
    if failed:
        raise failed[0]
    assert not thread.is_alive()
    return hub


def reference(config, view, settings=None, size=None, sets=()):
    """(h, w, 3) uint8 of one rank with these settings, without anything that is live."""
    given = live_config(load_config(config, list(sets)))
    job = Job(configured(given, settings or {}))
    if size:
        job = Job(configured(given, (settings or {}) | dict(zip(SIZE, size, strict=True))))
    octree = job.load_octree()
    views = job.views
    camera = camera_of(View.model_validate(view, strict=False), views.width, views.height, 0, job.camera(0).near)
    chosen = job.sampling_node(octree).process(camera, [job.culling_node(octree).process(camera)][0])
    with job.open_render(lambda *_: None, writes=False) as render:
        return render.compose(camera, render.rasterize(camera, chosen)).rgba[..., :3]


TOPOLOGIES = [
    ("single", 1),
    ("pipelined", 2),
    ("pipelined", 3),
    ("pipelined", 4),
    ("master-slave", 3),
    ("hybrid", 5),
    ("sort-first", 4),
    ("sort-first-only", 3),
    ("sort-last", 4),
    ("sort-last-only", 3),
]


@pytest.mark.parametrize(("topology", "ranks"), TOPOLOGIES)
def test_every_topology_draws_what_is_asked_for_with_the_bits_of_one_rank(config, topology, ranks):
    changes = [
        {},
        {"render.colour": "elevation", "render.colormap": "turbo"},
        {"render.point_size_px": 4, "render.edl_strength": 0.4},
        {"filter.boxes": [{"lower": [0, 0, 0], "upper": [70, 70, 90]}], "sampling.pixel_threshold": 4},
        {"camera.width": 200, "camera.height": 67, "render.supersampling": 2},
        {"filter.boxes": None, "camera.width": None, "camera.height": None, "render.supersampling": None},
    ]

    def script(hub):
        hub.tell(kind="viewers", pictures=1)
        _, _, after = hub.still()
        hub.look(VIEW)
        settings = {}
        for change in changes:
            if change:
                hub.tell(kind="settings", set=change, viewer=1, request=7)
            settings |= change
            settings = {key: value for key, value in settings.items() if value is not None}
            started, picture, after = hub.still(after)
            while started["view"]["eye"] != VIEW["eye"]:
                started, picture, after = hub.still(after)
            assert np.array_equal(picture, reference(config, VIEW, settings)), settings

    hub = live(config, [], topology, ranks, script)
    assert not [m for m in hub.said if m.kind == "refused"]


def dragged(hub, n):
    """The last of n moving pictures, each seen before the camera moves on, and the number of the next message."""
    hub.tell(kind="viewers", pictures=1)
    _, _, after = hub.still()
    for i in range(n):
        hub.look(VIEW | {"eye": [60.0 + i, -90.0, 70.0]}, moving=True)
        moving, after = hub.wait(lambda m: m.kind == "picture" and m.header["encoding"] == "jpeg", after)
        hub.tell(kind="shown", frame=moving.header["frame"])
    return moving, after


def test_a_moving_camera_is_followed_by_jpeg_and_then_a_whole_picture(config):
    def script(hub):
        moving, after = dragged(hub, 20)
        _, picture, _ = hub.still(after)
        assert np.array_equal(picture, reference(config, VIEW | {"eye": [79.0, -90.0, 70.0]}))
        assert moving.payload[:2] == b"\xff\xd8"

    live(config, [], "pipelined", 3, script)


def test_a_slow_run_draws_smaller_pictures_while_the_camera_moves(config):
    def script(hub):
        moving, after = dragged(hub, 30)
        assert (moving.header["width"], moving.header["height"]) < (163, 91)
        started, picture, _ = hub.still(after)
        assert started["scale"] == 1.0
        assert picture.shape == (91, 163, 3)

    # nothing is drawn in a 240th of a second at eight times the sides
    live(config, ["live.fps=240", "render.supersampling=8", "live.least_scale=0.2"], "pipelined", 3, script)


@pytest.mark.parametrize(
    "sets",
    [
        ["render.positions=compact"],
        ["render.positions=coded"],
        ["render.style=splats"],
        ["render.style=splats", "splats.features=true"],
        ["render.point_size_adaptive=true"],
        ["memory.residency=paged", "memory.budget=1MB", "memory.complete=true"],
        ["sampling.pools=bytes"],
        pytest.param(["render.rasterizer=gl"], marks=pytest.mark.gl),
    ],
    ids=lambda sets: " ".join(sets),
)
def test_points_in_every_form_follow_settings(forms, config, sets):
    """Colours, filters and sizes, each changed after the other."""
    if "render.rasterizer=gl" in sets and not gl_available()[0]:
        pytest.skip("no OpenGL 4.5 device")
    of = "groups" if "render.positions=coded" in sets else "pools" if "sampling.pools=bytes" in sets else "splats"
    sets = [*sets, f"scene.path={forms / of}"]
    changes = [{"render.colour": "elevation"}, {"camera.width": 120}, {"render.background": "#ffffff"}]
    changes += [{"filter.boxes": [{"lower": [0, 0, 0], "upper": [120, 90, 90]}]}] * (of == "splats")
    changes += [{"render.edl_strength": 0.3}, {"render.colour": None}]

    def script(hub):
        hub.tell(kind="viewers", pictures=1)
        _, _, after = hub.still()
        hub.look(VIEW)
        settings = {}
        for change in changes:
            hub.tell(kind="settings", set=change, viewer=1, request=7)
            settings = {k: v for k, v in (settings | change).items() if v is not None}
            hub.wait(lambda m: m.kind in ("settings", "refused"), after)
            started, picture, after = hub.still(after)
            while started["view"]["eye"] != VIEW["eye"]:
                started, picture, after = hub.still(after)
            assert np.array_equal(picture, reference(config, VIEW, settings, sets=sets)), settings

    hub = live(config, sets, "pipelined", 3, script)
    assert not [m.header for m in hub.said if m.kind == "refused"]


@pytest.mark.parametrize(("topology", "ranks"), [("single", 1), ("pipelined", 3), ("sort-first", 4)])
def test_a_screenshot_has_its_own_size_and_leaves_the_pictures_as_they_are(config, topology, ranks):
    def script(hub):
        hub.tell(kind="viewers", pictures=1)
        hub.look(LOW)
        _, _, after = hub.still()
        hub.tell(kind="screenshot", viewer=4, request=9, width=321, height=203)
        shot, _ = hub.wait(lambda m: m.kind == "screenshot")
        started, _ = hub.wait(lambda m: m.kind == "started" and m.header["frame"] == shot.header["frame"])
        assert started.header["screenshot"] == {"viewer": 4, "request": 9}
        view = started.header["view"]
        assert np.array_equal(pixels(shot), reference(config, view, size=(321, 203)))
        hub.look(LOW)
        started, picture, _ = hub.still(after)
        assert np.array_equal(picture, reference(config, LOW))

    live(config, [], topology, ranks, script)


def test_a_filter_that_is_taken_away_brings_pools_back(forms, config):
    """A run that begins without the pooled forms of its octree reads them when a setting allows them."""
    box = {"lower": [0, 0, 0], "upper": [120, 90, 90]}
    config.write_text(config.read_text() + f"[[filter.boxes]]\nlower = {box['lower']}\nupper = {box['upper']}\n")
    sets = ["sampling.pools=bytes", f"scene.path={forms / 'pools'}"]

    def script(hub):
        hub.tell(kind="viewers", pictures=1)
        hub.look(VIEW)
        _, _, after = hub.still()
        for boxes in ([], None):
            hub.tell(kind="settings", set={"filter.boxes": boxes}, viewer=1, request=7)
            _, after = hub.wait(lambda m: m.kind == "settings", after)
            _, picture, after = hub.still(after)
            settings = {} if boxes is None else {"filter.boxes": boxes}
            assert np.array_equal(picture, reference(config, VIEW, settings, sets=sets))

    live(config, sets, "pipelined", 3, script)


def test_pictures_of_any_size_that_is_allowed_end_no_run(config):
    """Larger than pictures that are drawn again and again, tiny, and with settings that have changed meanwhile."""

    def script(hub):
        hub.tell(kind="viewers", pictures=0)
        for width, height, why in [(4096, 2100, None), (1, 1, None), (16384, 2048, None), (16384, 2049, "at most")]:
            hub.tell(kind="screenshot", viewer=4, request=width, width=width, height=height)
            answer, _ = hub.wait(lambda m, w=width, h=height: m.kind == "refused" or m.header.get("height") == h)
            assert (answer.kind == "refused") == (why is not None)
        hub.tell(kind="settings", set={"render.supersampling": 4}, viewer=4, request=5)
        hub.tell(kind="screenshot", viewer=4, request=6, width=16384, height=16)
        refused, _ = hub.wait(lambda m: m.kind == "refused" and m.header["request"] == 6)
        assert refused.header["of"] == "screenshot"
        hub.tell(kind="settings", set={"camera.width": 2048, "camera.height": 2048}, viewer=4, request=7)
        refused, _ = hub.wait(lambda m: m.kind == "refused" and m.header["request"] == 7)
        assert "supersampling" in refused.header["why"]

    live(config, [], "sort-first", 4, script)


def test_a_run_of_larger_pictures_than_viewers_may_ask_for_can_be_steered(config):
    """Smaller ones while the camera moves are larger than what viewers may ask for, too."""
    sets = ["camera.width=4096", "camera.height=2300", "sampling.points_per_pixel=0.1"]
    given = live_config(load_config(config, sets))
    job = Job(given)
    with LiveRank(job, Hub().link()) as rank:
        assert rank.changed({"camera.width": 4000, "camera.height": 2240}).views.width == 4000
    check_size(configured(given, {"render.colour": "intensity"}), given)
    with pytest.raises(ConfigError, match="take a screenshot"):
        check_size(configured(given, {"camera.height": 2400}), given)


def test_what_cannot_be_drawn_is_refused_to_who_asked_and_changes_nothing(config):
    asked = [
        ({"kind": "settings", "set": {"scene.path": "/etc"}}, "cannot be changed"),
        ({"kind": "settings", "set": {"render.colour": "nope"}}, "expected one of"),
        ({"kind": "settings", "set": {"filter.boxes": [{"lower": [1, 0, 0], "upper": [0, 1, 1]}]}}, "lower x"),
        ({"kind": "settings", "set": {"render.point_size_px": 3, "render.colormap": "nope"}}, "nope"),
        ({"kind": "screenshot", "width": 16384, "height": 16384}, "at most 33,554,432"),
        ({"kind": "camera", "view": VIEW | {"target": VIEW["eye"]}, "moving": False, "t": 0.0, "at": 0.0}, "eye"),
    ]

    def script(hub):
        hub.tell(kind="viewers", pictures=1)
        hub.look(VIEW)
        after = 0
        for i, (message, said) in enumerate(asked):
            hub.tell(**message, viewer=5, request=i)
            refused, after = hub.wait(lambda m: m.kind == "refused", after)
            assert refused.header["viewer"] == 5
            assert said in refused.header["why"]
            assert "\n" not in refused.header["why"]
        _, after = hub.wait(lambda m: m.kind == "started" and m.header["view"]["eye"] == VIEW["eye"])
        hub.look(LOW)
        _, picture, _ = hub.still(after)
        assert np.array_equal(picture, reference(config, LOW))

    live(config, [], "single", 1, script)


def test_a_run_says_what_it_is_and_draws_nothing_while_nobody_looks(config):
    def script(hub):
        ready, _ = hub.wait(lambda m: m.kind == "ready")
        run = ready.header["run"]
        assert (run["points"], run["topology"]) == (20_011, "pipelined")
        assert [rank["role"] for rank in run["ranks"]] == ["culling", "sampling", "render"]
        assert ready.header["settings"]["render.point_size_px"] == 2
        assert "rgb" in ready.header["choices"]["render.colour"]["options"]
        hub.look(VIEW, moving=True)
        time.sleep(0.2)
        assert not [m for m in hub.said if m.kind == "started"]

    live(config, [], "pipelined", 3, script)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("camera.view=stereo", "camera.view"),
        ("wall.columns=2", "wall"),
        ("scene.delivery=messages", "scene.delivery"),
        ("pipeline.topology=frame-parallel", "pipeline.topology"),
    ],
)
def test_what_a_live_run_cannot_show_is_refused_before_it_starts(config, override, said):
    with pytest.raises(ConfigError, match=said):
        live_config(load_config(config, [override]))
