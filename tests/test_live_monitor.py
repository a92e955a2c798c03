"""The monitor: what it shows of messages, recorded runs, hostile files, and a real hub with a run that is none."""

import io
import json
import random
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import pytest
from rich.console import Console
from splatpipe.cluster.job import Job
from splatpipe.cluster.live import monitor
from splatpipe.cluster.live.board import HISTORY, MAX_SERIES, MAX_VALUES, Board, text
from splatpipe.cluster.live.monitor import monitor_command
from splatpipe.cluster.live.protocol import MAX_HEADER_BYTES
from splatpipe.cluster.live.replay import replayed
from splatpipe.cluster.live.screen import amount, line, screen, sparkline
from splatpipe.cluster.pipeline import run_single
from splatpipe.cluster.plan.topology import Decision
from splatpipe.cluster.run import _finish
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config
from splatpipe.shared.errors import InputError, MessageError, SplatpipeError
from splatpipe.shared.synth import CityScan

ROLES = ("culling", "sampling", "render")


def welcome(**changed):
    ranks = [{"rank": rank, "role": role, "host": "node1"} for rank, role in enumerate(ROLES)]
    run = {"scene": "city.scene", "points": 2_000_000, "cells": 2275, "topology": "pipelined", "rasterizer": "cpu"}
    return {"kind": "welcome", "protocol": 1, "viewer": 0, "run": run | {"ranks": ranks} | changed}


def metrics(t, render_ms=31.0, rate=25.6):
    common = {"frames_per_s": rate, "cpu": 0.5, "memory_bytes": 2.1e8, "sent_bytes_per_s": 4.1e5}
    values = [
        {"culling.work_ms": 1.3, "culling.wait_ms": 29.5, "queue": 3, "cells": 812, **common},
        {"sampling.work_ms": 2.6, "sampling.wait_ms": 30.0, "entries": 2100, "points": 1.2e6, **common},
        {"render.work_ms": render_ms, "render.wait_ms": 3.0, "missing": 0.034, "cache_hits": 0.91, **common},
    ]
    ranks = [{"rank": r, "role": ROLES[r], "host": "node1", "values": values[r]} for r in range(3)]
    hub = {"viewers": 2, "pictures_per_s": 48.1, "sent_bytes_per_s": 5e6, "latency_ms": 61.2}
    return {"kind": "metrics", "t": t, "ranks": [*ranks, {"rank": -1, "role": "hub", "host": "node1", "values": hub}]}


def prediction():
    values = [{"culling.work_ms": 1.2, "frames_per_s": 31.0}, {"sampling.work_ms": 8.0}, {"render.work_ms": 20.0}]
    return {"kind": "prediction", "ranks": [{"rank": r, "role": ROLES[r], "values": values[r]} for r in range(3)]}


def recorded(n=10):
    return [welcome(), prediction(), *(metrics(i / 2, 30 + i) for i in range(n))]


def record(path, messages):
    path.write_text("".join(json.dumps(message) + "\n" for message in messages))
    return path


def board_of(messages, watched=()):
    board = Board(watched)
    for message in messages:
        board.hear(message)
    return board


def shown(board, width, colours=False):
    out = io.StringIO()
    system = "standard" if colours else None
    Console(file=out, width=width, force_terminal=colours, color_system=system).print(screen(board, width, "live"))
    return out.getvalue()


def say(target, *, terminal=False, width=100, **options):
    """What the command prints, but for JSON."""
    out = io.StringIO()
    console = Console(file=out, width=width, force_terminal=terminal, highlight=False)
    assert monitor_command(target, console=console, **options) == 0
    return out.getvalue()


# --- tables ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [80, 160])
def test_the_screen_says_where_the_time_goes(width):
    said = shown(board_of(recorded(), ["render.*"]), width)
    assert all(len(row.rstrip()) <= width for row in said.splitlines())
    rows = [" ".join(row.split()) for row in said.splitlines()]
    assert any(
        row.startswith("splatpipe · city.scene · pipelined · cpu") and row.endswith("4.5 s live") for row in rows
    )
    assert any(row.startswith("25.6 frames/s of 31.0 predicted") for row in rows)
    assert any(row.startswith("0 culling culling 1.30 ms 29.5 ms 1.20 ms 1.08 ") for row in rows)
    assert any(row.startswith("1 sampling sampling 2.60 ms 30.0 ms 8.00 ms 0.33 ") for row in rows)
    assert any(row.startswith("2 render render 39.0 ms 3.00 ms 20.0 ms 1.95 ") for row in rows)
    assert any(row.startswith("2 render.work_ms 39.0 ms 30.0 ms 39.0 ms ▁▂▃▃▄▅▆▆▇█") for row in rows)
    for part in ("queue 3", "points 1.20 M", "memory 630 MB", "missing 3.4 %", "viewers 2", "latency 61.2 ms"):
        assert part in " ".join(rows).replace("\N{NO-BREAK SPACE}", " ")
    assert ("node1" in said) == ("2.10 k" in said) == (width > 100), "hosts and entries where there is room"


def test_what_is_off_has_a_colour_and_what_is_not_has_none():
    said = shown(board_of(recorded(1)), 100, colours=True)
    red, yellow = "\x1b[1;31m", "\x1b[33m"
    assert f"{red} 1.50" in said
    assert f"{yellow} 0.33" in said or f"{yellow}0.33" in said
    assert f"{red}1.08" not in said


def test_any_width_any_number_of_ranks_and_nothing_yet():
    assert "nothing has been measured yet" in shown(Board(), 80)
    many = [of | {"rank": rank} for rank in range(100) for of in metrics(0)["ranks"][2:3]]
    board = board_of([welcome(), {"kind": "metrics", "t": 1, "ranks": many}], ["*"])
    for width in (20, 40, 79, 111, 300):
        said = shown(board, width)
        assert all(len(row.rstrip()) <= width for row in said.splitlines())
    assert "and 36 more ranks" in said
    assert len(board.series) == MAX_SERIES


def test_nothing_grows_with_time():
    board = Board(["cpu"])
    for i in range(3 * HISTORY):
        board.hear(metrics(i))
        board.hear(welcome())
    assert len(board.rate) == HISTORY == max(map(len, board.series.values()))
    assert len(board.ranks) == 4


def test_a_run_that_rests_shows_the_times_that_it_had():
    resting = metrics(9, rate=0.0)
    for of in resting["ranks"]:
        of["values"] = {name: value for name, value in of["values"].items() if not name.endswith("_ms")}
    said = shown(board_of([*recorded(), resting]), 100)
    assert "at rest" in said
    assert "2  render    render    39.0 ms  3.00 ms    20.0 ms   1.95" in said
    board = Board()
    for i in range(1000):
        values = {f"stage{i}.{j}_ms": 1.0 for j in range(96)}
        board.hear({"kind": "metrics", "t": i, "ranks": [{"rank": 0, "values": values}]})
    assert len(board.ranks[0].values) == MAX_VALUES


def test_text_moves_no_cursor():
    evil = "\x1b[2J\x1b]0;title\x07\u202e\ud800[bold]" + 1000 * "x"
    message = metrics(0)
    message["ranks"][2] |= {"role": evil, "host": evil, "values": {f"{evil}.work_ms": 1.0}}
    said = shown(board_of([welcome(scene=evil), message], ["*"]), 160)
    assert not set("\x1b\x07\u202e\ud800") & set(said)
    assert "[bold]" in said, "no markup either"
    assert len(text(evil)) == 64


def test_one_line_says_the_same():
    said = line(board_of(recorded(), ["cpu"]))
    assert said.startswith("      4.5 s, 25.6 frames/s of 31.0 predicted, 0 culling 1.30 ms (×1.08 of predicted)")
    assert "2 cpu 0.50" in said
    assert "\n" not in said


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("render.work_ms", 0.1234, "0.12 ms"),
        ("render.work_ms", 12345.0, "12,345 ms"),
        ("memory_bytes", 9.996e8, "1.00 GB"),
        ("sent_bytes_per_s", 20, "20 B/s"),
        ("missing", 0.0345, "3.5 %"),
        ("points", 1_234_567, "1.23 M"),
        ("queue", 3.0, "3"),
        ("anything", -1.5e300, "-1.5e+300"),
    ],
)
def test_amounts(name, value, said):
    assert amount(name, value) == said


def test_sparklines():
    assert sparkline([0, 1, 2, 3, 4, 5, 6, 7], 20) == "▁▂▃▄▅▆▇█"
    assert sparkline([0, 1, 2, 3], 2) == "▁█", "the latest"
    assert sparkline([5, 5], 9) == "▁▁"
    assert sparkline([], 9) == sparkline([1], 0) == ""
    assert sparkline([-1e300, 1e300], 5) in ("▁█", "▁▁")


@pytest.mark.parametrize(
    "damaged",
    [
        {"kind": "metrics"},
        {"kind": "metrics", "t": "now", "ranks": []},
        {"kind": "metrics", "t": 10**400, "ranks": []},
        {"kind": "metrics", "t": 0, "ranks": {"0": 1}},
        {"kind": "metrics", "t": 0, "ranks": [7]},
        {"kind": "metrics", "t": 0, "ranks": [{"rank": True}]},
        {"kind": "metrics", "t": 0, "ranks": [{"rank": -2}]},
        {"kind": "metrics", "t": 0, "ranks": [{"rank": 0, "values": []}]},
        {"kind": "metrics", "t": 0, "ranks": [{"rank": 0, "values": {"a": "1"}}]},
        {"kind": "metrics", "t": 0, "ranks": [{"rank": 0, "values": {"a": float("inf")}}]},
        {"kind": "metrics", "t": 0, "ranks": [{"rank": 0, "role": 7}]},
        {"kind": "prediction", "ranks": None},
        {"kind": "welcome", "run": []},
    ],
)
def test_damaged_messages_change_nothing(damaged):
    board = board_of(recorded())
    before = shown(board, 100)
    with pytest.raises(MessageError) as raised:
        board.hear(damaged)
    assert "\n" not in str(raised.value)
    assert damaged["kind"] == "metrics" or shown(board, 100) == before


# --- recorded runs ---------------------------------------------------------------------------------------------------


def test_a_recording_is_replayed(tmp_path, capsys):
    path = record(tmp_path / "run.jsonl", [*recorded(), {"kind": "settings", "settings": {}}])
    assert "2  render    render    39.0 ms" in say(path, once=True, width=80)
    assert "2  render    render    34.0 ms" in say(path, once=True, at=2.2, width=80)
    lines = say(path, shows=["queue"]).splitlines()
    assert len(lines) == 11
    assert lines[-1] == "end of the recording"
    assert "0 queue 3" in lines[0]
    assert monitor_command(path, as_json=True) == 0
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert told == [*recorded(), {"kind": "bye", "why": "end of the recording"}]


def test_a_replay_takes_its_time_and_ends_when_told(tmp_path, monkeypatch):
    slept = []
    clock = [0.0]
    monkeypatch.setattr(monitor.time, "monotonic", lambda: clock[0])

    def sleep(seconds):
        slept.append(seconds)
        clock[0] += seconds

    monkeypatch.setattr(monitor.time, "sleep", sleep)
    path = record(tmp_path / "run.jsonl", [*recorded(5), metrics(1e6)])
    assert "1,000,0" not in say(path, speed=4.0)
    assert sum(slept) == pytest.approx((2.0 + monitor.LONGEST_GAP_S) / 4)
    said = say(path, speed=4.0, at=1.0, terminal=True)
    assert "\x1b[?1049h" in said, "its own screen"
    assert "end of the recording" in said.rpartition("\x1b[?1049l")[2], "the last state stays"

    def interrupt(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(monitor.time, "sleep", interrupt)
    said = say(path, terminal=True)
    assert "\x1b[?1049l" in said, "the screen is given back"
    assert "Traceback" not in said


@pytest.fixture(scope="module")
def batch(tmp_path_factory):
    """The run.json of a run."""
    folder = tmp_path_factory.mktemp("batch")
    build_scene([CityScan(n_points=20_000)], folder / "city.scene", settings=BuildSettings())
    (folder / "run.toml").write_text(
        '[scene]\npath = "city.scene"\n[output]\ndirectory = "out"\nframes = 4\npng = false\n'
    )
    wanted = ["camera.width=64", "camera.height=36", "render.rasterizer=cpu", "pipeline.topology=single"]
    job = Job(load_config(folder / "run.toml", wanted))
    job.output.mkdir()
    _finish(job, Decision("single", ""), run_single(job, lambda *_: None), folder / "run.toml", None)
    return folder / "out" / "run.json"


def test_a_batch_run_is_replayed(batch):
    record = json.loads(batch.read_text())
    told = list(replayed(batch))
    assert [message["kind"] for message in told[:2]] == ["welcome", "metrics"]
    assert told[0]["run"]["scene"] == "city.scene"
    assert told[-1]["t"] == pytest.approx(4 / record["frames_per_s"])
    values = told[1]["ranks"][0]["values"]
    assert values["render.work_ms"] == pytest.approx(1e3 * sum(record["per_frame"]["render_s"]) / 4)
    assert values["points"] == sum(record["per_frame"]["points"]) / 4
    said = say(batch, once=True)
    assert "city.scene · single" in said
    assert "render" in said


def test_a_batch_run_of_several_ranks_says_whose_times_they_are(batch):
    run = json.loads(batch.read_text())
    stages = [["culling"], ["sampling"], ["render"], ["render"]]
    run["ranks"] = [
        run["ranks"][0] | {"rank": i, "role": f"{has[0]} {i}", "stages": {has[0]: {}}} for i, has in enumerate(stages)
    ]
    run["per_frame"] |= {"missing": [0.5] * 4, "objects": [[1], [2], [3], [4]]}
    path = batch.with_name("several.json")
    path.write_text(json.dumps(run))
    told = list(replayed(path))
    by_rank = {of["rank"]: of for of in told[1]["ranks"]}
    assert by_rank[2]["role"] == "render 2 (slowest of 2)"
    assert by_rank[2]["values"]["missing"] == 0.5
    assert "culling.work_ms" in by_rank[0]["values"]
    assert "sampling.work_ms" in by_rank[1]["values"]
    assert "render.work_ms" not in by_rank[3]["values"]


# --- hostile files ---------------------------------------------------------------------------------------------------


def test_a_last_line_that_was_cut_short_is_left_out(tmp_path):
    path = record(tmp_path / "run.jsonl", recorded())
    whole = path.read_bytes()
    path.write_bytes(whole[:-40])
    assert len(list(replayed(path))) == len(recorded()) - 1
    path.write_bytes(whole.rstrip(b"\n"))
    assert len(list(replayed(path))) == len(recorded())


def lines_of(*contents):
    return b"\n".join(contents) + b"\n"


GOOD = json.dumps(metrics(0)).encode()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "found no metrics"),
        (lines_of(json.dumps(welcome()).encode()), "found no metrics"),
        (lines_of(GOOD, b"{", GOOD), "line 2: header: expected JSON"),
        (lines_of(GOOD, b"{"), "line 2: header: expected JSON"),
        (lines_of(GOOD, b'{"kind": "metrics", "t": NaN, "ranks": []}'), "line 2: header: expected JSON"),
        (lines_of(GOOD, b'{"kind": "metrics", "t": 1e999, "ranks": []}'), "line 2: header: expected JSON"),
        (lines_of(GOOD, b'{"kind": "metrics", "t": "1", "ranks": []}'), "line 2: metrics.t: expected finite"),
        (lines_of(GOOD, b'{"kind": "metrics", "t": 1, "ranks": 7}'), "line 2: metrics.ranks: expected a list"),
        (lines_of(GOOD, b"[" * 60_000), "line 2: header: expected"),
        (lines_of(GOOD, b"[7]"), "line 2: header: expected a JSON object"),
        (lines_of(GOOD, b"\xff\xfe"), "line 2: header: expected JSON in UTF-8"),
        (GOOD + b"\n" + b"x" * (3 << 20), f"line 2: header: found {MAX_HEADER_BYTES + 2} bytes"),
        (b"\0" * (1 << 20), "line 1: header: found"),
    ],
)
def test_damaged_recordings(tmp_path, content, said):
    path = tmp_path / "run.jsonl"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as raised:
        say(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no JSON"),
        (b"{}", "no per_frame"),
        (b"[" * 100_000, "no JSON"),
        (b'{"per_frame": {}, "stages": {}}', "not as splatpipe run writes it"),
        (b" " * ((64 << 20) + 1), "more than 64 MiB"),
    ],
)
def test_files_that_are_no_run(tmp_path, content, said):
    path = tmp_path / "run.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        say(path)


def test_what_is_no_file(tmp_path):
    for path, said in [(tmp_path, "Is a directory"), (tmp_path / "none", "No such file"), ("/dev/zero", "regular")]:
        with pytest.raises(InputError, match=said):
            say(tmp_path / path)


def test_mutilated_files_end_in_one_line(tmp_path, batch):
    chance = random.Random(8)
    run = json.loads(batch.read_text())
    small = {name: run[name] for name in ("per_frame", "stages", "ranks", "scene", "frames_per_s", "topology")}
    sources = {".jsonl": record(tmp_path / "a", recorded(2)).read_bytes(), ".json": json.dumps(small).encode()}
    odd = [b"null", b"-1", b"1e999", b"NaN", b"{}", b"[]", b'""', b"true", b"1e308", b'"\\ud800"', b"9" * 400]
    outcomes = {"fine": 0, "refused": 0}
    for i in range(3000):
        suffix = chance.choice([".jsonl", ".json"])
        data = bytearray(sources[suffix])
        for _ in range(chance.randint(1, 3)):
            at = chance.randrange(len(data))
            match chance.randrange(4):
                case 0:
                    data[at] = chance.randrange(256)
                case 1:
                    del data[at : at + chance.randrange(200)]
                case 2:  # a value becomes another
                    begin = data.find(b":", at) + 1
                    ends = [e for e in (data.find(c, begin) for c in (b",", b"}", b"]")) if e > 0]
                    data[begin : min(ends, default=begin)] = chance.choice(odd)
                case _:
                    data[at:at] = data[chance.randrange(len(data)) :][: chance.randrange(400)]
            data = data or bytearray(b" ")
        path = tmp_path / f"mutilated{i % 2}{suffix}"
        path.write_bytes(data)
        try:
            say(path, shows=["*"])
            outcomes["fine"] += 1
        except InputError as error:
            outcomes["refused" if "\n" not in str(error) else "wordy"] += 1
    assert min(outcomes.values()) > 100, outcomes


# --- a live run ------------------------------------------------------------------------------------------------------


class NoServices:
    def pick(self, *_):
        return {"found": False, "position": [], "attributes": {}}

    def path(self, *_):
        return ""

    def left_out(self):
        return []

    def expected(self, ranks, counts):
        return []


@contextmanager
def live_run(tmp_path, messages, every_s=0.05):
    """A hub, and ranks that say these messages over and over."""
    pytest.importorskip("zmq", reason="pyzmq is missing: splatpipe[live]")
    pytest.importorskip("aiohttp", reason="aiohttp is missing: splatpipe[live]")
    from splatpipe.cluster.live.hub import Hub
    from splatpipe.cluster.live.sockets import RunLink

    over = threading.Event()
    with (
        Hub(NoServices(), connection=tmp_path / "connection.json", record=tmp_path / "recorded.jsonl") as hub,
        RunLink(hub.run_address, 0, "culling", "node1") as link,
    ):

        def tell():
            link.send({"kind": "ready", "run": welcome()["run"], "view": {}, "settings": {}, "choices": {}})
            while not over.wait(every_s):
                for message in messages:
                    link.send(message)

        thread = threading.Thread(target=tell)
        thread.start()
        try:
            yield hub
        finally:
            over.set()
            thread.join()


def of_ranks(message):
    """As ranks say it, each for itself."""
    return [{"kind": "metrics", "t": 0.0, **of} for of in message["ranks"] if of["rank"] >= 0]


def test_a_live_run_once_and_as_json(tmp_path, capsys):
    with live_run(tmp_path, [*of_ranks(metrics(0)), prediction()]) as hub:
        said = say(hub.connection, once=True, width=80)
        assert "2  render    render    31.0 ms  3.00 ms    20.0 ms   1.55" in said
        assert "viewers" in said
        assert monitor_command(hub.connection, once=True, as_json=True) == 0
        told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert told[0]["kind"] == "welcome"
    assert {message["kind"] for message in told} <= {"welcome", "metrics", "prediction"}
    assert told[-1]["kind"] == "metrics"
    assert {of["rank"] for of in told[-1]["ranks"]} == {-1, 0, 1, 2}
    replay = say(tmp_path / "recorded.jsonl", once=True, width=80)
    assert "2  render    render    31.0 ms  3.00 ms    20.0 ms   1.55" in replay, "what was recorded says the same"


def test_a_run_that_ends_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(monitor, "RECONNECT_TICKS", 1)
    said = []
    with live_run(tmp_path, of_ranks(metrics(0))) as hub:
        watching = threading.Thread(target=lambda: said.append(say(hub.connection)))
        watching.start()
        time.sleep(1.5)
        hub.close("the scene has been seen")
        watching.join(20)
    assert "25.6 frames/s" in said[0]
    assert said[0].splitlines()[-1] == "the scene has been seen"


def test_a_monitor_connects_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(monitor, "RECONNECT_TICKS", 1)
    with live_run(tmp_path, of_ranks(metrics(0))) as hub:
        from splatpipe.cluster.live import sockets

        clients = []

        class Client(sockets.Client):
            def __init__(self, *arguments, **options):
                super().__init__(*arguments, **options)
                clients.append(self)

        monkeypatch.setattr(sockets, "Client", Client)
        source = monitor.LiveRun(hub.connection)
        messages = source.messages()
        kinds = []
        for header in messages:
            kinds.append(header["kind"] if header else None)
            if kinds.count("metrics") == 1 and "bye" not in kinds:
                kinds.append("bye")
                clients[0].send({"kind": "nonsense"})  # for which the hub drops it
            if kinds.count("welcome") == 2 or len(kinds) > 300:
                break
        assert source.state == "live"
        messages.close()
    assert kinds.count("welcome") == 2


def test_no_run_and_no_answer(tmp_path, monkeypatch):
    pytest.importorskip("zmq", reason="pyzmq is missing: splatpipe[live]")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with pytest.raises(InputError, match="no live run found"):
        say(None)
    with live_run(tmp_path, []) as hub:
        content = json.loads(hub.connection.read_text())
        wrong = tmp_path / "wrong.json"
        wrong.write_text(json.dumps(content | {"address": "tcp://127.0.0.1:9"}))
        monkeypatch.setattr(monitor, "PATIENCE_S", 0.3)
        with pytest.raises(SplatpipeError, match=r"127.0.0.1:9: no answer in 0.3 s"):
            say(wrong, once=True)


def test_a_recording_takes_neither_sockets_nor_compiled_kernels(tmp_path):
    path = record(tmp_path / "run.jsonl", recorded())
    code = f"""
import sys
from pathlib import Path
from splatpipe.cluster.live.monitor import monitor_command
monitor_command(Path({str(path)!r}), once=True)
print({{"zmq", "aiohttp", "numba", "mpi4py", "scipy"}} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "set()"
