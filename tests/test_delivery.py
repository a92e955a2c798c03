"""A scene by messages: the render rank draws what it never opened, bit for bit, and believes nothing it is sent."""

import json
import math
import os
import queue
import subprocess
import sys
import textwrap
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from splatpipe.cluster.delivery import receive_scene, serve_scene
from splatpipe.cluster.job import Job
from splatpipe.cluster.launch import find_mpiexec, mpi_available
from splatpipe.cluster.pipeline import RENDER, SAMPLING, receive_job, run_single
from splatpipe.cluster.transport import Received
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config, parse_config
from splatpipe.shared.errors import MessageError, StoreError
from splatpipe.shared.messages import (
    HEADER,
    SCENE_PIECE_BYTES,
    Kind,
    SceneBytes,
    SceneOffer,
    SceneRequest,
    decode_scene_bytes,
    decode_scene_offer,
    decode_scene_request,
    encode,
    parse_header,
)
from splatpipe.shared.store import Scene
from splatpipe.shared.synth import CityScan

SPLATPIPE = [sys.executable, "-m", "splatpipe.cluster"]
POSITIONS = {"x", "y", "z", "block_first_point", "block_origin"}
needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """The same small city with all that a scene may have, and with coded positions."""
    folder = tmp_path_factory.mktemp("scenes")
    city = CityScan(n_points=20_000)
    build_scene([city], folder / "city", settings=BuildSettings(points_per_cell=300, splats=True, features=True))
    build_scene([city], folder / "coded", settings=BuildSettings(points_per_cell=300, positions="occupancy"))
    build_scene([city], folder / "groups", settings=BuildSettings(points_per_cell=300, positions="groups"))
    build_scene([city], folder / "pools", settings=BuildSettings(points_per_cell=5000, pools=True))
    return folder


@pytest.fixture
def scene(scenes) -> Scene:
    return Scene.open(scenes / "city")


# --- a link in this process --------------------------------------------------------------------------------------


class Link:
    """One end of a link between two threads with the transport's ``send`` and ``receive``; bytes cross, no objects."""

    def __init__(self, inbox: queue.Queue, outbox: queue.Queue) -> None:
        self._inbox, self._outbox = inbox, outbox
        self.sent: list = []

    def send(self, dest: int, message) -> None:
        self.sent.append(message)
        self._outbox.put(tuple(bytes(part) for part in encode(message)))

    def receive(self, source: int, expected: Kind, max_bytes: int, *, patient: bool = False) -> Received:
        head, payload = self._inbox.get(timeout=20)
        kind, frame, length = parse_header(head)
        assert (kind, length) == (expected, len(payload))
        if length > max_bytes:
            raise MessageError(f"found {length} bytes, expected at most {max_bytes}")
        return Received(frame, memoryview(payload))


@contextmanager
def served(scene: Scene, colour: str = "rgb"):
    """The render rank's end of a link whose other end serves a scene until it is released."""
    there, back = queue.Queue(), queue.Queue()
    with ThreadPoolExecutor(1) as pool:
        serving = pool.submit(serve_scene, scene, colour, Link(back, there), RENDER)
        yield Link(there, back)
        serving.result(timeout=20)


def asked_for(link: Link, scene: Scene) -> list[str]:
    """Names of the arrays that an end has asked for, in order."""
    names = list(scene.info.arrays)
    return [names[message.array] for message in link.sent if message.n_bytes]


def test_a_received_scene_is_the_scene(scene):
    with served(scene) as link:
        received, colour = receive_scene(link, SAMPLING)
        assert (received.info, colour) == (scene.info, "rgb")
        received.verify()
        for ours, theirs in zip(received.positions(), scene.positions(), strict=True):
            assert np.array_equal(ours, theirs)
            assert (ours.dtype, ours.flags.writeable, theirs.flags.writeable) == (theirs.dtype, False, False)
        ours, theirs = received.octree(features=True), scene.octree(features=True)
        for field in fields(ours):
            assert np.array_equal(getattr(ours, field.name), getattr(theirs, field.name)), field.name
        assert ours.level.flags.writeable, "cells are the caller's own, as those from files"
        for name in scene.info.attributes:
            assert np.array_equal(received.attribute(name), scene.attribute(name))
        asked = asked_for(link, scene)
        assert sorted(asked) == sorted(scene.info.arrays), "each array crosses once, however often it is loaded"
        received.release()
        with pytest.raises(RuntimeError, match="array x was loaded after"):
            received.positions()


def test_long_arrays_cross_in_pieces(scene, monkeypatch):
    monkeypatch.setattr("splatpipe.cluster.delivery.SCENE_PIECE_BYTES", 10_001)
    with served(scene) as link:
        received, _ = receive_scene(link, SAMPLING)
        assert np.array_equal(received.positions()[0], scene.positions()[0])
        pieces = [message for message in link.sent if message.n_bytes]
        assert len(pieces) == 3 * -(-scene.info.arrays["x"].bytes // 10_001)
        assert [message.number for message in pieces] == list(range(len(pieces)))
        received.release()


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"render": {"colour": "#ff8000"}}, POSITIONS),
        ({}, {*POSITIONS, "attr_rgb"}),
        ({"scene": {"verify": False}}, {*POSITIONS, "attr_rgb"}),
        ({"render": {"colour": "elevation"}}, POSITIONS),
        ({"render": {"colour": "#ff8000"}, "filter": {"classes": [2]}}, {*POSITIONS, "attr_classification"}),
        ({"render": {"style": "splats"}}, {*POSITIONS, "attr_rgb", "attr_normal", "attr_radius"}),
    ],
    ids=["constant", "rgb", "unverified", "elevation", "classes", "splats"],
)
def test_only_what_a_run_needs_crosses_and_it_is_the_same(scenes, scene, settings, expected):
    here = {"rasterizer": "cpu"} | settings.get("render", {})
    config = parse_config(settings | {"render": here, "scene": {"path": str(scenes / "city")}})
    verify = settings.get("scene", {}).get("verify", True)
    by_files = Job(config)
    elsewhere = parse_config(settings | {"render": here, "scene": {"path": str(scenes / "not here")}})
    with served(scene, by_files.colour) as link:
        job = receive_job(elsewhere, link)
        assert not asked_for(link, scene), "the job itself looks at no array"
        ours, theirs = job.load_points(verify=verify), by_files.load_points(verify=verify)
        assert set(asked_for(link, scene)) == expected
        job.scene.release()
    for field in fields(ours):
        if not isinstance(getattr(ours, field.name), np.ndarray):
            continue
        assert np.array_equal(getattr(ours, field.name), getattr(theirs, field.name), equal_nan=True), field.name


def test_what_goes_by_cell_asks_for_cells(scenes, scene):
    config = parse_config({"render": {"rasterizer": "cpu", "colour": "level", "point_size_adaptive": True}})
    with served(scene, "level") as link:
        job = receive_job(config, link)
        points = job.load_points(verify=True)
        asked = asked_for(link, scene)
        job.scene.release()
    assert {"cell_level", "cell_first_point"} < set(asked)
    assert not {"cell_feature", "attr_rgb", "attr_normal"} & set(asked)
    assert len(set(asked)) == len(asked)
    local = parse_config(config.model_dump() | {"scene": {"path": str(scenes / "city")}})
    assert np.array_equal(points.block_spacing, Job(local).load_points(verify=False).block_spacing)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("coded", {}),
        ("coded", {"render": {"point_size_adaptive": True, "colour": "elevation"}}),
        ("groups", {"render": {"positions": "coded"}}),
        ("groups", {"render": {"positions": "coded", "colour": "#ff8000"}}),
        ("pools", {"sampling": {"pools": "bytes"}}),
        ("city", {"render": {"positions": "compact"}}),
        ("city", {"render": {"style": "splats"}, "splats": {"features": True}}),
    ],
    ids=["occupancy", "adaptive", "groups", "groups of one colour", "pools", "compact", "quads"],
)
def test_every_form_of_positions_is_drawn_the_same(scenes, tmp_path, name, settings):
    settings = settings | {
        "camera": {"width": 96, "height": 64},
        "render": {"rasterizer": "cpu"} | settings.get("render", {}),
        "scene": {"path": str(scenes / name)},
        "output": {"directory": str(tmp_path)},
    }
    by_files = Job(parse_config(settings))
    octree, camera = by_files.load_octree(), by_files.camera(0)
    chosen = by_files.sampling_node(octree).process(camera, by_files.culling_node(octree).process(camera))
    assert (chosen.n_pooled > 0) == (name == "pools")

    def drawn(job: Job) -> np.ndarray:
        with job.open_render(lambda *_: None) as render:
            return np.array(render.compose(camera, render.rasterize(camera, chosen)).rgba)

    with served(by_files.scene, by_files.colour) as link:
        elsewhere = parse_config(settings | {"scene": {"path": "not/here"}})
        received = drawn(receive_job(elsewhere, link))
    assert np.array_equal(received, drawn(by_files))
    assert len(np.unique(received.reshape(-1, 4), axis=0)) > (1 if by_files.colouring.mode == "constant" else 50)


# --- what is not as it should be ---------------------------------------------------------------------------------


class Damaged(Scene):
    """Sends one array with a bit turned over."""

    def stored_bytes(self, name: str) -> np.ndarray:
        stored = np.array(super().stored_bytes(name))
        stored[len(stored) // 2] ^= 1
        return stored


def test_damage_on_the_way_is_named(scene):
    with served(Damaged(scene.path, scene.info)) as link:
        received, _ = receive_scene(link, SAMPLING)
        with pytest.raises(StoreError, match=r"scene of rank 1/x\.npy: checksum .*, expected"):
            received.check(["x"])
        with pytest.raises(StoreError, match=r"block_first_point\.npy: checksum"):
            received.blocks()
        received.release()


@pytest.mark.parametrize(
    ("reply", "said"),
    [
        (lambda request: SceneBytes(request.number + 1, np.zeros(request.n_bytes, np.uint8)), "reply to request 1"),
        (
            lambda request: SceneBytes(request.number, np.zeros(request.n_bytes - 1, np.uint8)),
            "found {found} bytes, expected {expected}",
        ),
        (lambda request: SceneBytes(request.number, np.zeros(request.n_bytes + 1, np.uint8)), "at most"),
    ],
    ids=["another", "short", "long"],
)
def test_a_reply_that_was_not_asked_for_is_refused(scene, reply, said):
    there, back = queue.Queue(), queue.Queue()
    server, link = Link(back, there), Link(there, back)
    server.send(RENDER, SceneOffer(scene.info, "rgb"))
    received, _ = receive_scene(link, SAMPLING)
    request = SceneRequest(0, list(scene.info.arrays).index("x"), 0, scene.info.arrays["x"].bytes)
    server.send(RENDER, reply(request))
    with pytest.raises(MessageError, match=said.format(found=request.n_bytes - 1, expected=request.n_bytes)):
        received.positions()


def test_a_promise_beyond_memory_is_one_line(scene):
    text = json.loads(scene.info.to_json())
    n = 1 << 57
    text["n_stored"] = n
    for array in text["arrays"].values():
        if array["shape"][:1] == [scene.info.n_stored]:
            array["bytes"] = array["bytes"] // scene.info.n_stored * n
            array["shape"][0] = n
    offer = decode_scene_offer(b"rgb\n" + json.dumps(text).encode(), Path("it"))
    there, back = queue.Queue(), queue.Queue()
    Link(back, there).send(RENDER, offer)
    received, _ = receive_scene(Link(there, back), SAMPLING)
    with pytest.raises(MessageError, match=f"x has {4 * n} bytes, more than memory has"):
        received.positions()


def damaged(rng: np.random.Generator, payload: bytes) -> bytes:
    """A payload with bytes changed, cut off, put in or repeated."""
    data = bytearray(payload)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(0, len(data) + 1))
        match rng.integers(0, 5):
            case 0:
                data[at : at + 1] = rng.bytes(1)
            case 1:
                del data[at:]
            case 2:
                data[at:at] = rng.bytes(int(rng.integers(1, 9)))
            case 3:
                data[at:at] = data[at : at + int(rng.integers(1, 40))]
            case _:
                digits = [i for i in range(at, min(at + 60, len(data))) if chr(data[i]).isdigit()]
                for i in digits[: rng.integers(1, 20)]:
                    data[i : i + 1] = str(rng.integers(0, 10)).encode()
    return bytes(data)


def decode_damaged(info, n: int, seed: int) -> dict[str, int]:
    """Decode n damaged payloads, an equal share of each kind; how many were refused. The others must hold."""
    rng = np.random.default_rng(seed)
    sizes = [array.bytes for array in info.arrays.values()]
    offer = bytes(encode(SceneOffer(info, "rgb"))[1])
    request = SceneRequest(3, 5, 7, 100)
    payloads = {
        "offer": offer,
        "request": bytes(encode(request)[1]),
        "bytes": rng.bytes(request.n_bytes),
    }
    refused = dict.fromkeys(payloads, 0)
    for i in range(n):
        kind = list(payloads)[i % 3]
        payload = damaged(rng, payloads[kind])
        try:
            match kind:
                case "offer":
                    arrays = decode_scene_offer(payload, Path("it")).info.arrays.values()
                    assert all(a.bytes == math.prod(a.shape) * np.dtype(a.dtype).itemsize for a in arrays)
                case "request":
                    got = decode_scene_request(3, payload, info)
                    assert 0 <= got.n_bytes <= SCENE_PIECE_BYTES
                    assert got.first + got.n_bytes <= sizes[got.array]
                case _:
                    assert len(decode_scene_bytes(3, payload, request).data) == request.n_bytes
        except MessageError:
            refused[kind] += 1
    return refused


def test_damaged_payloads_are_refused_or_stay_within_what_was_promised(scene):
    refused = decode_damaged(scene.info, 24_000, seed=11)
    assert all(n > 3000 for n in refused.values()), refused


def test_damaged_payloads_make_nothing_large(scene):
    tracemalloc.start()
    try:
        decode_damaged(scene.info, 3000, seed=12)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2**20


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        (b"", "expected a colour mode"),
        (b"rgb", "expected a colour mode"),
        (b"\xff\xfe\n{}", "expected a colour mode"),
        (b"x" * 65 + b"\n{}", "expected a colour mode"),
        (b"rgb\n", "it: not valid JSON"),
        (b"rgb\n[]", "it: found list, expected an object"),
        (b"rgb\n" + b"[" * 100_000, "it: not valid JSON"),
        (b'rgb\n{"format_version": 99}', "upgrade splatpipe"),
    ],
)
def test_an_offer_that_is_none_is_refused(payload, said):
    with pytest.raises(MessageError, match=said):
        decode_scene_offer(payload, Path("it"))


# --- whole runs --------------------------------------------------------------------------------------------------

GUARD = """
    import errno, os, sys
    scene = os.environ["GUARDED_SCENE"]
    rank = next((os.environ[n] for n in ("PMI_RANK", "PMIX_RANK", "OMPI_COMM_WORLD_RANK") if n in os.environ), None)
    def refuse(event, arguments):
        if event in ("open", "os.scandir", "os.listdir") and str(arguments[0]).startswith(scene):
            raise PermissionError(errno.EACCES, "Permission denied", arguments[0])
    if rank == "2":
        sys.addaudithook(refuse)
"""
"""Put before every module of a run: the render rank can open nothing in the scene's directory."""


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(
        '[camera]\nwidth = 96\nheight = 64\n[render]\nrasterizer = "cpu"\n'
        '[output]\nframes = 2\n[pipeline]\ntopology = "pipelined"\n'
    )
    return path


def command(config, scene, out, *settings) -> list[str]:
    sets = [f"scene.path={scene}", f"output.directory={out}", *settings]
    return [*SPLATPIPE, "run", str(config), *(part for item in sets for part in ("--set", item))]


def call(arguments, **variables) -> subprocess.CompletedProcess[str]:
    return subprocess.run(arguments, capture_output=True, text=True, timeout=100, env=os.environ | variables)


def guarded(tmp_path, arguments, scene) -> subprocess.CompletedProcess[str]:
    folder = tmp_path / "guard"
    folder.mkdir(exist_ok=True)
    (folder / "sitecustomize.py").write_text(textwrap.dedent(GUARD))
    return call(arguments, PYTHONPATH=str(folder), GUARDED_SCENE=str(scene))


def pictures(folder: Path) -> np.ndarray:
    return np.stack([np.asarray(Image.open(path)) for path in sorted(folder.glob("frame_*.png"))])


def errors(done: subprocess.CompletedProcess[str]) -> list[str]:
    return [line for line in done.stderr.splitlines() if line.startswith("splatpipe:")]


@needs_mpi
@pytest.mark.mpi
def test_a_render_rank_that_can_open_no_file_of_the_scene_draws_the_same_bits(scenes, config, tmp_path):
    sent = {}
    for name in ("city", "coded"):
        scene = scenes / name
        one = tmp_path / f"{name} one"
        one.mkdir()
        run_single(Job(load_config(config, [f"scene.path={scene}", f"output.directory={one}"])), lambda *_: None)
        out = tmp_path / f"{name} three"
        done = guarded(tmp_path, command(config, scene, out, "scene.delivery=messages"), scene)
        assert done.returncode == 0, done.stderr
        assert np.array_equal(pictures(one), pictures(out))
        sent[name] = json.loads((out / "run.json").read_text())["messages"]
        info = Scene.open(scene).info
        form = ["x", "y", "z"] if name == "city" else ["position_codes", "cell_position_bytes"]
        needed = sum(info.arrays[array].bytes for array in [*form, "attr_rgb", "block_first_point", "block_origin"])
        bytes_sent = sent[name]["SCENE_BYTES"]["bytes"] - sent[name]["SCENE_BYTES"]["count"] * HEADER.size
        assert bytes_sent == needed if name == "city" else bytes_sent >= needed
    assert len(np.unique(pictures(out).reshape(-1, 3), axis=0)) > 100, "the picture shows something"
    assert sent["coded"]["SCENE_BYTES"]["bytes"] < 0.75 * sent["city"]["SCENE_BYTES"]["bytes"]


@needs_mpi
@pytest.mark.mpi
def test_by_files_the_same_render_rank_can_not_draw(scenes, config, tmp_path):
    done = guarded(tmp_path, command(config, scenes / "city", tmp_path / "out"), scenes / "city")
    assert done.returncode == 2
    assert len(errors(done)) == 1
    assert errors(done)[0].startswith(f"splatpipe: rank 2 (render): {scenes}/city")
    assert "Permission denied" in errors(done)[0]


def on_ranks(*commands: tuple[int, list[str]]) -> list[str]:
    """The command line that starts each command on so many ranks."""
    parts = [part for n, arguments in commands for part in (":", "-n", str(n), *arguments)]
    return [str(find_mpiexec()), *parts[1:]]


@needs_mpi
@pytest.mark.mpi
def test_the_render_rank_may_have_other_folders(scenes, config, tmp_path):
    """As on a host of its own: no scene where the others have it, and no output directory yet."""
    by_messages = "scene.delivery=messages"
    here = command(config, scenes / "city", tmp_path / "here", by_messages)
    there = command(config, "/not/on/this/host", tmp_path / "a" / "b", by_messages)
    done = call(on_ranks((2, here), (1, there)))
    assert done.returncode == 0, done.stderr
    assert len(pictures(tmp_path / "a" / "b")) == 2
    assert [path.name for path in (tmp_path / "here").iterdir()] == ["run.json"]


@needs_mpi
@pytest.mark.mpi
def test_whatever_is_wrong_on_whichever_rank_is_one_line(scenes, config, tmp_path):
    by_messages, out = "scene.delivery=messages", tmp_path / "out"
    good = command(config, scenes / "city", out, by_messages)

    no_scene = command(config, tmp_path / "none", out, by_messages)
    done = call(on_ranks((1, good), (1, no_scene), (1, good)))
    assert (done.returncode, errors(done)) == (
        2,
        [f"splatpipe: rank 1 (sampling): {tmp_path}/none: not a scene: scene.json not found"],
    )

    by_files = command(config, scenes / "city", out)
    done = call(on_ranks((2, good), (1, by_files)))
    assert (done.returncode, errors(done)) == (2, ["splatpipe: scene.delivery: not the same on every rank"])

    hurt = tmp_path / "hurt"
    hurt.mkdir()
    for path in (scenes / "city").iterdir():
        (hurt / path.name).write_bytes(path.read_bytes())
    data = bytearray((hurt / "x.npy").read_bytes())
    data[-1] ^= 1
    (hurt / "x.npy").write_bytes(data)
    done = call(command(config, hurt, out, by_messages))
    assert done.returncode == 2
    assert len(errors(done)) == 1
    assert errors(done)[0].startswith("splatpipe: rank 2 (render): scene of rank 1/x.npy: checksum ")
