# ruff: noqa: E402
"""The hub between a run and those who look: who gets what, and that nothing of it remains."""

import json
import os
import socket
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("zmq", reason="pyzmq is missing: splatpipe[live]")
aiohttp = pytest.importorskip("aiohttp", reason="aiohttp is missing: splatpipe[live]")

import live_example as example
from live_example import JPEG, VIEW, Answers, FakeRun, Page, next_of, until
from splatpipe.cluster.live import gathered, screenshots, switchboard, viewers, web
from splatpipe.cluster.live import hub as hub_module
from splatpipe.cluster.live.connection import Connection, RunAddress, find_connection, new_connection_file
from splatpipe.cluster.live.hub import Hub
from splatpipe.cluster.live.protocol import ScreenshotWanted
from splatpipe.cluster.live.sockets import Client, RunLink
from splatpipe.shared.errors import InputError, SplatpipeError


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(hub_module, "TICK_S", 0.05)


@pytest.fixture
def answers():
    return Answers()


@pytest.fixture
def hub(tmp_path, answers):
    with Hub(answers, connection=tmp_path / "run" / "live.json") as hub:
        yield hub
        assert hub._board.unexpected is None


@pytest.fixture
def run(hub):
    with FakeRun(hub.run_address) as run:
        run.ready()
        yield run


@pytest.fixture(params=["page", "program"])
def viewer(request, hub):
    with Page(hub.url) if request.param == "page" else Client(hub.connection, pictures=True) as viewer:
        yield viewer


def camera(x: float, **more):
    return {"kind": "camera", "view": {**VIEW, "eye": [x, 0.0, 1.0]}, "moving": True, "t": x, **more}


def test_a_viewer_is_welcomed_when_the_run_is_ready_and_shown_its_last_picture(hub, viewer):
    with FakeRun(hub.run_address) as run:
        assert viewer.receive(0.2) is None
        run.ready()
        welcome = next_of(viewer, "welcome").header
        assert welcome["run"] == example.RUN
        assert (welcome["view"], welcome["settings"], welcome["choices"]) == (VIEW, example.SETTINGS, example.CHOICES)
        assert welcome["protocol"] == 1
        until(lambda: run.last("viewers", "pictures") == 1, "the count")
        run.show(JPEG, t=4.5)
        shown = next_of(viewer, "picture")
        with Client(hub.connection, pictures=True) as late:
            assert next_of(late, "picture").header == shown.header
        assert shown.payload == JPEG
        assert shown.header["parts_ms"].pop("to_hub") >= 0
        assert shown.header == {
            "kind": "picture",
            "frame": 1,
            "width": 64,
            "height": 48,
            "encoding": "jpeg",
            "still": True,
            "scale": 1.0,
            "view": VIEW,
            "t": 4.5,
            "viewer": 0,
            "parts_ms": {"drawing": 3.0, "queued": 1.0, "encoding": 2.0},
        }


def test_the_latest_camera_reaches_the_run_and_comes_back_with_the_picture(run, viewer):
    number = next_of(viewer, "welcome").header["viewer"]
    for x in range(150):
        viewer.send(camera(float(x)))
    until(lambda: run.last("camera", "t") == 149.0, "the last camera")
    steered = run.all("camera")
    assert [moved["t"] for moved in steered] == sorted(moved["t"] for moved in steered)
    assert steered[-1].pop("at") <= time.monotonic()
    assert steered[-1] == {**camera(149.0), "viewer": number}
    frame = run.show(view=steered[-1]["view"], t=149.0, viewer=number)
    shown = next_of(viewer, "picture").header
    assert (shown["frame"], shown["view"], shown["t"], shown["viewer"]) == (frame, camera(149.0)["view"], 149.0, number)


def test_of_more_cameras_than_are_allowed_the_last_still_counts_and_of_others_nobody_says_so_many(run, viewer):
    next_of(viewer, "welcome")
    for x in range(1500):
        viewer.send(camera(float(x)))
        if x % 50 == 0:
            time.sleep(0.01)  # a program drops what its socket cannot take at once
    time.sleep(0.05)
    viewer.send(camera(5000.0))
    until(lambda: run.last("camera", "t") == 5000.0, "the last camera")
    assert len(run.all("camera")) < 1000
    for _ in range(500):
        viewer.send({"kind": "ack", "frame": 1})
    assert "messages a second" in next_of(viewer, "bye").header["why"]


def test_who_floods_it_with_cameras_is_dropped(hub, run, monkeypatch):
    monkeypatch.setattr(switchboard, "FLOOD_PER_S", 300.0)
    monkeypatch.setattr(viewers, "FLOOD_PER_S", 300.0)
    with Page(hub.url) as viewer:
        next_of(viewer, "welcome")
        for x in range(1200):
            viewer.send(camera(float(x)))
        assert "300 cameras a second" in next_of(viewer, "bye").header["why"]


def test_three_pictures_are_under_way_at_most_and_then_the_latest(run, viewer):
    next_of(viewer, "welcome")
    for _ in range(10):
        run.show()
        time.sleep(0.02)
    assert [next_of(viewer, "picture").header["frame"] for _ in range(3)] == [1, 2, 3]
    viewer.send({"kind": "ack", "frame": 99})  # never sent
    assert viewer.receive(0.1) is None
    viewer.send({"kind": "ack", "frame": 2})  # with those before
    assert next_of(viewer, "picture").header["frame"] == 10


def test_the_first_to_acknowledge_a_picture_tells_the_run(hub, run):
    with Page(hub.url) as page, Client(hub.connection, pictures=True) as program:
        for viewer in (page, program):
            next_of(viewer, "welcome")
        for _ in range(2):
            frame = run.show()
            for viewer in (page, program):
                assert next_of(viewer, "picture").header["frame"] == frame
                viewer.send({"kind": "ack", "frame": frame})
            run.told("shown", frame)
        time.sleep(0.1)
        assert [told["frame"] for told in run.all("shown")] == [1, 2]
        until(lambda: run.last("viewers", "pictures") == 2, "the count")
        program.send({"kind": "subscribe", "pictures": False, "metrics": False})
        until(lambda: run.last("viewers", "pictures") == 1, "one less")
    until(lambda: run.last("viewers", "pictures") == 0, "none")


def test_settings_go_to_the_run_and_its_answer_to_all_or_to_whom_it_concerns(hub, run, viewer):
    with Client(hub.connection) as other:
        number = next_of(viewer, "welcome").header["viewer"]
        next_of(other, "welcome")
        viewer.send({"kind": "settings", "set": {"live.fps": 12, "render.colour": None}, "request": 5})
        told = run.told("settings")[0]
        assert told == {
            "kind": "settings",
            "set": {"live.fps": 12, "render.colour": None},
            "viewer": number,
            "request": 5,
        }
        run.coordinator.send({"kind": "refused", "viewer": number, "request": 5, "why": "live.fps = 12: too few"})
        refused = next_of(viewer, "refused").header
        assert refused == {"kind": "refused", "request": 5, "why": "live.fps = 12: too few"}
        run.coordinator.send({"kind": "settings", "settings": {"live.fps": 24}})
        for one in (viewer, other):
            assert next_of(one, "settings").header["settings"] == {"live.fps": 24}
    with Client(hub.connection) as late:
        assert next_of(late, "welcome").header["settings"] == {"live.fps": 24}


def test_a_refusal_ends_no_screenshot_but_the_one_it_is_of(hub, run, viewer):
    number = next_of(viewer, "welcome").header["viewer"]
    viewer.send({"kind": "screenshot", "request": 0, "width": 64, "height": 48})
    run.told("screenshot")
    run.coordinator.send({"kind": "refused", "viewer": number, "request": 0, "of": "camera", "why": "no"})
    assert next_of(viewer, "refused").header["why"] == "no"
    run.coordinator.send({"kind": "started", "frame": 7, "screenshot": {"viewer": number, "request": 0}})
    run.coordinator.send({"kind": "screenshot", "frame": 7, "width": 64, "height": 48}, b"PNG")
    assert next_of(viewer, "screenshot").payload == b"PNG"


def test_changes_above_what_is_allowed_are_refused(hub, run, monkeypatch):
    monkeypatch.setattr("splatpipe.cluster.live.viewers.CHANGES_PER_S", 1.0)
    with Client(hub.connection) as viewer:
        next_of(viewer, "welcome")
        for request in range(1, 10):
            viewer.send({"kind": "settings", "set": {"live.fps": 12}, "request": request})
        refused = next_of(viewer, "refused").header
        assert refused["why"] == "found more than 60 changes a second"
        assert [told["request"] for told in run.told("settings", 2)][:2] == [1, 2]
        assert refused["request"] > 2


def test_a_run_that_is_ended_before_it_is_there_is_told_when_it_comes(tmp_path, answers):
    with Hub(answers, connection=tmp_path / "run.json") as hub:
        hub.end_run()
        with FakeRun(hub.run_address) as run:
            run.told("quit")


def test_a_screenshot_goes_to_who_asked_for_it(hub, run, viewer):
    with Client(hub.connection) as other:
        next_of(viewer, "welcome"), next_of(other, "welcome")
        for request in (1, 2, 3):
            viewer.send({"kind": "screenshot", "request": request, "width": 640, "height": 480})
        assert next_of(viewer, "refused").header["request"] == 3
        for frame, request in ((7, 1), (8, 2)):  # of the second the picture comes before its "started"
            one = run.told("screenshot", request)[-1]
            assert (one["request"], one["width"], one["height"]) == (request, 640, 480)
            assert len(run.all("screenshot")) == request  # one after the other
            started = {"kind": "started", "frame": frame, "screenshot": {k: one[k] for k in ("viewer", "request")}}
            taken = {"kind": "screenshot", "frame": frame, "width": 640, "height": 480}
            first, second = [lambda m=started: run.coordinator.send(m), lambda m=taken: run.display.send(m, b"PNG")][
                :: 1 if frame == 7 else -1
            ]
            first()
            time.sleep(0.1)
            second()
            got = next_of(viewer, "screenshot")
            assert got == ({"kind": "screenshot", "request": one["request"], "width": 640, "height": 480}, b"PNG")
        assert other.receive(0.1) is None


def test_screenshots_leave_the_run_time_for_pictures(monkeypatch):
    clock, told, refused = [100.0], [], []
    monkeypatch.setattr(screenshots.time, "monotonic", lambda: clock[0])
    shots = screenshots.Screenshots(lambda header: told.append(header) or True, lambda *why: refused.append(why))

    def ask(viewer: int, request: int) -> None:
        shots.ask(viewer, ScreenshotWanted(kind="screenshot", request=request, width=10, height=20))

    for viewer in range(1, 5):
        for request in range(2):
            ask(viewer, request)
    with pytest.raises(InputError, match="under way"):
        ask(1, 7)
    with pytest.raises(InputError, match="too many"):
        ask(5, 0)
    assert told == [{"kind": "screenshot", "viewer": 1, "request": 0, "width": 10, "height": 20}]
    clock[0] += 2
    assert not shots.done(1, 1)
    assert shots.done(1, 0)
    shots.forget(2)
    for second in range(1, 17):
        shots.tick()
        assert len(told) == 1, second
        clock[0] += 1
    shots.tick()
    assert [(one["viewer"], one["request"]) for one in told] == [(1, 0), (1, 1)]
    clock[0] += 121
    shots.tick()  # the run has not answered: the next one
    assert refused == [(1, 1, "no picture within 120 s")]
    assert told[-1]["viewer"] == 3


def test_services_answer_beside_the_run(run, answers, viewer):
    next_of(viewer, "welcome")
    frame = run.show(view={**VIEW, "fov_deg": 30})
    next_of(viewer, "picture")
    viewer.send({"kind": "pick", "request": 1, "frame": frame, "x": 0.5, "y": 0.25})
    found = next_of(viewer, "pick").header
    assert found == {"kind": "pick", "request": 1, "found": True, "position": [1, 2, 3], "attributes": {"intensity": 7}}
    view, *place, settings = answers.asked[0]
    assert (view.fov_deg, place, settings) == (30, [64, 48, 0.5, 0.25], example.SETTINGS)
    viewer.send({"kind": "path", "request": 2, "keys": [{"time": 0, "view": VIEW}], "fps": 24})
    assert next_of(viewer, "path").header == {"kind": "path", "request": 2, "toml": "# 1 keys at 24"}
    viewer.send({"kind": "plan", "request": 3})
    assert next_of(viewer, "plan").header["left_out"] == [{"what": "edl", "why": "off", "saves": "2 ms"}]


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({"kind": "pick", "frame": 1, "x": 0.0, "y": 0.0}, "nothing there"),
        ({"kind": "pick", "frame": 1, "x": 1.0, "y": 0.0}, "pick failed: KeyError"),
        ({"kind": "pick", "frame": 2, "x": 0.5, "y": 0.0}, "picture 2 is not known any more"),
        ({"kind": "path", "keys": [{"time": 0, "view": VIEW}] * 2}, "bytes, at most"),
    ],
)
def test_what_cannot_be_answered_is_refused_in_a_line(hub, run, asked, why):
    with Client(hub.connection, pictures=True) as viewer:
        run.show()
        next_of(viewer, "picture")
        viewer.send({**asked, "request": 9})
        refused = next_of(viewer, "refused").header
        assert refused["request"] == 9
        assert why in refused["why"]
        viewer.send({"kind": "plan", "request": 10})
        assert next_of(viewer, "plan").header["request"] == 10


def test_so_many_requests_wait_and_no_more(hub, run, answers):
    answers.hold.clear()
    viewers = [Client(hub.connection, pictures=True) for _ in range(5)]
    try:
        run.show()
        for viewer in viewers:
            next_of(viewer, "picture")
        for request in range(3):
            viewers[0].send({"kind": "pick", "request": request, "frame": 1, "x": 0.5, "y": 0.5})
        assert next_of(viewers[0], "refused").header["request"] == 2
        for viewer in viewers[1:4]:
            for request in range(2):
                viewer.send({"kind": "pick", "request": request, "frame": 1, "x": 0.5, "y": 0.5})
        time.sleep(0.2)
        viewers[4].send({"kind": "plan", "request": 7})
        assert "too many" in next_of(viewers[4], "refused").header["why"]
        answers.hold.set()
        for viewer in viewers[:4]:
            assert [next_of(viewer, "pick").header["request"] for _ in range(2)] == [0, 1]
    finally:
        answers.hold.set()
        for viewer in viewers:
            viewer.close()


def test_metrics_of_all_ranks_in_one_message_with_the_hub_and_the_prediction(tmp_path, answers):
    record = tmp_path / "record.jsonl"
    with (
        Hub(answers, connection=tmp_path / "live.json", record=record) as hub,
        FakeRun(hub.run_address) as run,
        Client(hub.connection, pictures=True, metrics=True) as viewer,
    ):
        run.ready()
        number = next_of(viewer, "welcome").header["viewer"]
        run.coordinator.send({"kind": "prediction", "ranks": [{"rank": 2, "values": {"render.work_ms": 4.0}}]})
        for link, rank in ((run.coordinator, 0), (run.display, 2)):
            values = {"render.work_ms": 3.14159265, "points": 10**12, "bad": "text", "worse": None, "flag": True}
            link.send({"kind": "metrics", "rank": rank, "role": "render", "host": "here", "t": 1.0, "values": values})
        viewer.send(camera(1.0))
        run.told("camera")
        frame = run.show(viewer=number, t=1.0, camera_at=run.last("camera", "at"))
        next_of(viewer, "picture")
        viewer.send({"kind": "ack", "frame": frame})
        until(lambda: "latency_ms" in str(next_of(viewer, "metrics").header), "the latency")
        told = next_of(viewer, "metrics").header
        assert [one["rank"] for one in told["ranks"]] == [-1, 0, 2]
        assert told["ranks"][1]["values"] == {"render.work_ms": 3.1416, "points": 10**12}
        assert told["ranks"][0]["values"]["viewers"] == 1
        with Client(hub.connection, metrics=True) as late:
            assert next_of(late, "prediction").header["ranks"][0]["values"] == {"render.work_ms": 4.0}
    lines = [json.loads(line) for line in record.read_text().splitlines()]
    assert [line["kind"] for line in lines[:2]] == ["welcome", "prediction"]
    assert {line["kind"] for line in lines[2:]} == {"metrics"}
    assert list(tmp_path.iterdir()) == [record]


def test_what_the_model_expects_is_asked_for_frames_as_they_are(hub, run, answers):
    with Client(hub.connection, metrics=True) as viewer:
        next_of(viewer, "welcome")
        counts = {"cells": 3, "entries": 5, "points": 7, "pixels": 9, "frames_per_s": 11.0}
        for link, rank in ((run.coordinator, 0), (run.display, 2)):
            link.send({"kind": "metrics", "rank": rank, "values": counts})
        assert next_of(viewer, "prediction").header["ranks"][0]["values"] == {"render.work_ms": 14}
    assert answers.asked[-1] == (1, {"cells": 6, "entries": 10, "points": 14, "pixels": 9, "frames_per_s": 11.0})


def test_a_record_stops_with_a_note_where_it_is_full(tmp_path, monkeypatch):
    monkeypatch.setattr(gathered, "MAX_RECORD_BYTES", 1 << 20)
    record = gathered.Record(tmp_path / "record.jsonl")
    for _ in range(3000):
        record.write({"kind": "metrics", "t": 0.0, "ranks": ["x" * 1000]})
    record.close()
    lines = (tmp_path / "record.jsonl").read_text().splitlines()
    assert json.loads(lines[-1]) == {"kind": "bye", "why": "the record stops here, at 1 MiB"}
    assert len("\n".join(lines)) <= (1 << 20) + 200


def test_metrics_of_more_ranks_than_fit_leave_some_out():
    collected = gathered.Gathered("here")
    for rank in range(2000):
        collected.take({"rank": rank, "role": "render", "host": "here", "values": {f"value{i}": i for i in range(10)}})
    assert len(json.dumps(collected.message(1.0, 2, 3, 4))) < 80_000
    assert 50 < len(collected.message(1.0, 2, 3, 4)["ranks"]) < 2000


def test_when_it_ends_all_are_told_why_and_nothing_remains(tmp_path, answers):
    before = example.left_behind()
    with (
        Hub(answers, connection=tmp_path / "live.json") as hub,
        FakeRun(hub.run_address) as run,
        Page(hub.url) as page,
        Client(hub.connection, pictures=True) as program,
    ):
        run.ready()
        run.show()
        for viewer in (page, program):
            next_of(viewer, "picture")
        with Page(hub.url, hello=None) as silent:
            hub.close("rank 2 died")
            for viewer in (page, program, silent):
                assert next_of(viewer, "bye").header["why"] == "rank 2 died"
        hub.close()
        run.told("quit")
    assert not list(tmp_path.iterdir())
    assert example.left_behind() == before


def test_a_run_that_never_gets_ready_says_bye(tmp_path, answers):
    with Hub(answers, connection=tmp_path / "live.json") as hub, Page(hub.url) as page:
        page.send(camera(1.0))
        page.send({"kind": "plan", "request": 1})
        assert "not started" in next_of(page, "refused").header["why"]
        hub.close("no such scene")
        assert next_of(page, "bye").header["why"] == "no such scene"


def test_ranks_that_say_what_is_wrong_end_nothing(hub, run, viewer):
    next_of(viewer, "welcome")
    for header in (
        {"kind": "picture"},
        {"kind": "picture", "frame": []},
        {"kind": "started"},
        {"kind": "refused", "viewer": {}},
        {"kind": "settings"},
        {"kind": "metrics", "rank": 1, "values": 3},
        {"kind": "screenshot", "frame": 1},
        {"kind": "no such kind"},
        {"kind": "__init__"},
    ):
        run.coordinator.send(header, b"payload")
    run.show()
    assert next_of(viewer, "picture").payload == JPEG


def test_a_rank_that_connects_again_is_the_same_rank(hub, run, viewer):
    next_of(viewer, "welcome")
    run.told("viewers")
    with RunLink(hub.run_address, 0, "coordinator", "here") as again:
        until(lambda: viewer.send(camera(1.0)) is not False and bool(again.receive(0.1)), "a command for the new link")


def test_a_link_takes_messages_and_sends_from_several_threads(hub, run):
    with Client(hub.connection, metrics=True) as viewer:
        next_of(viewer, "welcome")

        def measure(rank: int) -> None:
            for n in range(200):
                until(lambda n=n: run.coordinator.send({"kind": "metrics", "rank": rank, "values": {"n": n}}), "room")

        values = [threading.Thread(target=measure, args=(rank,)) for rank in range(4)]
        for thread in values:
            thread.start()
        for x in range(100):
            viewer.send(camera(float(x)))
            time.sleep(0.002)
        for thread in values:
            thread.join()
        until(lambda: run.last("camera", "t") == 99.0, "the last camera")
        until(
            lambda: [r["values"].get("n") for r in next_of(viewer, "metrics").header["ranks"][1:]] == [199] * 4,
            "metrics",
        )


def test_a_hub_that_is_behind_keeps_no_rank_waiting():
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        keys = ["x" * 40] * 3
        with pytest.raises(InputError, match="keys"):
            RunLink(RunAddress("tcp://127.0.0.1:1", "short", *keys[:2]), 0, "coordinator", "here")
        link = RunLink(RunAddress(f"tcp://127.0.0.1:{nobody.getsockname()[1]}", *example_keys()), 0, "render", "here")
        with link:
            sent = [link.send({"kind": "metrics"}, b"x" * 1000) for _ in range(200)]
            assert 10 < sum(sent) < 200
            assert not sent[-1]
            assert link.receive(0.01) == []
        assert link.send({"kind": "metrics"}) is False


def example_keys() -> tuple[str, str, str]:
    from splatpipe.cluster.live.sockets import new_keys

    return new_keys()[0], *new_keys()


# --- the page's files ------------------------------------------------------------------------------------------------


def get(hub, path: str, *headers: str, host: str | None = None) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of a request, as it is written here."""
    site = hub.url.removeprefix("http://").partition("/")[0]
    name, _, port = site.rpartition(":")
    with socket.create_connection((name, int(port))) as link:
        lines = [f"GET {path} HTTP/1.1", f"Host: {host if host is not None else site}", "Connection: close", *headers]
        link.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        whole = b""
        while data := link.recv(1 << 16):
            whole += data
    head, _, body = whole.partition(b"\r\n\r\n")
    status, *fields = head.decode().split("\r\n")
    return int(status.split()[1]), dict(field.split(": ", 1) for field in fields), body


def test_the_site_serves_the_files_of_its_page_and_nothing_else(tmp_path, answers, monkeypatch):
    files = {"/": web._File(b"<!doctype html>", "text/html"), "/live.js": web._File(b"1", "text/javascript")}
    monkeypatch.setattr(web, "page_files", lambda: files)
    with Hub(answers, connection=tmp_path / "live.json") as hub:
        status, headers, body = get(hub, "/?token=any")
        assert (status, headers["Content-Type"], body) == (200, "text/html; charset=utf-8", b"<!doctype html>")
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        for name, value in web.HEADERS.items():
            assert headers[name] == value
        assert get(hub, "/live.js")[2] == b"1"
        for path in (
            "/../pyproject.toml", "/..%2fpyproject.toml", "/%2e%2e/web.py", "//etc/passwd", "/web.py", "/page/", "/live.js/",
            "/__init__.py", "/live%00.js", "/%ff", "/live.json", "/.",
        ):  # fmt: skip
            status, headers, body = get(hub, path)
            assert status in (400, 403, 404), path
            assert b"import" not in body
        assert get(hub, "/live.js", host="splatpipe.example")[0] == 421


def test_the_table_of_the_page_has_files_of_known_kinds_only():
    for address, file in web.page_files().items():
        assert address.count("/") == 1
        assert file.type in web.TYPES.values()


# --- the connection file ---------------------------------------------------------------------------------------------


def test_the_connection_file_is_its_owners_only_and_goes_with_the_run(tmp_path, answers):
    path = tmp_path / "new" / "live.json"
    with Hub(answers, connection=path) as hub:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
        connection = Connection.read(path)
        assert (connection.url, connection.pid, connection.protocol) == (hub.url, os.getpid(), 1)
        assert connection.public_key != hub.run_address.public_key
        assert connection.lives
        path.write_text(json.dumps({**json.loads(path.read_text()), "url": "http://another"}))  # of a run after this
    assert path.exists()


def test_the_newest_run_that_lives_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with pytest.raises(InputError, match="no live run found"):
        find_connection()
    over = subprocess.Popen([sys.executable, "-c", ""])
    over.wait()
    mine = new_connection_file()
    assert mine.parent == tmp_path / "splatpipe"
    keys = {"server_key": "s", "public_key": "p", "secret_key": "k"}
    for name, pid, at in (("old", os.getpid(), 100), ("new", os.getpid(), 200), ("dead", over.pid, 300)):
        file = mine.parent / f"{name}.json"
        Connection(1, f"tcp://{name}", **keys, url="", pid=pid).write(file)
        os.utime(file, (at, at))
    (mine.parent / "junk.json").write_text("[" * 100_000)
    assert find_connection().address == "tcp://new"
    assert find_connection(mine.parent / "old.json").address == "tcp://old"
    new_connection_file()
    assert not (mine.parent / "dead.json").exists()
    mine.parent.chmod(0o755)
    with pytest.raises(InputError, match="mode 700"):
        find_connection()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("{", "no JSON"),
        ("[]", "missing"),
        ('{"protocol": 1}', "missing"),
        (
            '{"protocol": 2, "address": "", "server_key": "", "public_key": "", "secret_key": "", "url": "", "pid": 1}',
            "2",
        ),
        (
            '{"protocol": true, "address": "", "server_key": "", "public_key": "", "secret_key": "", "url": "", "pid": 1}',
            "m",
        ),
    ],
)
def test_what_is_no_connection_file_is_refused(tmp_path, text, why):
    path = tmp_path / "live.json"
    path.write_text(text)
    with pytest.raises(InputError, match=why) as error:
        find_connection(path)
    assert str(path) in str(error.value)
    with pytest.raises(InputError, match="is the run over"):
        find_connection(tmp_path / "absent.json")


def test_ranks_are_told_in_variables(monkeypatch):
    address = RunAddress("tcp://127.0.0.1:5", "server", "public", "secret")
    assert RunAddress.from_environment() is None
    for name, value in address.to_variables().items():
        assert name.startswith("SPLATPIPE_LIVE_")
        monkeypatch.setenv(name, value)
    assert RunAddress.from_environment() == address
    monkeypatch.delenv("SPLATPIPE_LIVE_SECRET_KEY")
    assert RunAddress.from_environment() is None


# --- what goes wrong -------------------------------------------------------------------------------------------------


def test_an_address_or_a_file_that_cannot_be_had_is_said_and_nothing_remains(tmp_path, answers):
    before = example.left_behind()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for wrong in (
            {"port": port},
            {"zmq_port": port},
            {"bind": "192.0.2.1"},
            {"record": tmp_path / "absent" / "x"},
            {"connection": Path("/proc/live.json")},
        ):
            with (
                pytest.raises(InputError, match=r"cannot (listen|write)"),
                Hub(answers, **{"connection": tmp_path / "c", **wrong}),
            ):
                pass
    assert not list(tmp_path.iterdir())
    assert example.left_behind() == before


def test_a_failure_of_the_hub_itself_is_told_at_its_end(tmp_path, answers, monkeypatch):
    def fail(self):
        raise ZeroDivisionError("a mistake")

    hub = Hub(answers, connection=tmp_path / "live.json").__enter__()
    monkeypatch.setattr(switchboard.Switchboard, "tick", fail)
    hub._thread.join(10)
    with pytest.raises(SplatpipeError, match="hub: ZeroDivisionError: a mistake"):
        hub.__exit__(None, None, None)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("missing", "module"), [("zmq", "sockets"), ("aiohttp", "web"), ("aiohttp", "hub")])
def test_without_the_extra_the_message_says_what_to_install(missing, module):
    code = f"import sys; sys.modules[{missing!r}] = None\nimport splatpipe.cluster.live.{module}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.splitlines()[-1].startswith("splatpipe.shared.errors.DeviceError: ")
    assert done.stderr.rstrip().endswith("install splatpipe[live]")


def test_nothing_is_said_when_the_interpreter_ends(tmp_path):
    code = f"""
from pathlib import Path
from live_example import *
from splatpipe.cluster.live.hub import Hub
from splatpipe.cluster.live.protocol import ScreenshotWanted
from splatpipe.cluster.live.sockets import Client
with Hub(Answers(), connection=Path({str(tmp_path / "live.json")!r})) as hub, FakeRun(hub.run_address) as run:
    run.ready()
    with Page(hub.url) as page, Client(hub.connection, pictures=True) as program:
        run.show(JPEG * 1000)
        next_of(page, "picture"), next_of(program, "picture")
"""
    command = [sys.executable, "-X", "dev", "-W", "error", "-c", code]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_another_address_than_loopback_is_called_by_its_name_or_number(tmp_path, answers):
    with Hub(answers, bind="0.0.0.0", connection=tmp_path / "live.json") as hub:
        name, _, port = hub.url.partition("/?")[0].removeprefix("http://").rpartition(":")
        assert name == socket.gethostname()
        assert hub.run_address.address.startswith(f"tcp://{name}:")
        with Page(hub.url.replace(name, "127.0.0.1")) as page:
            page.send({"kind": "plan", "request": 1})
            assert next_of(page, "refused")
        here = hub.url.replace(name, "127.0.0.1")
        with pytest.raises(aiohttp.WSServerHandshakeError):
            Page(here, Host=f"splatpipe.example:{port}", Origin=f"http://splatpipe.example:{port}")
