# ruff: noqa: E402
"""Who must not get in, and viewers that are slow, vanish or talk nonsense: the run and the others do not notice."""

import asyncio
import os
import random
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress

import pytest

zmq = pytest.importorskip("zmq", reason="pyzmq is missing: splatpipe[live]")
aiohttp = pytest.importorskip("aiohttp", reason="aiohttp is missing: splatpipe[live]")

import live_example as example
from live_example import HELLO, JPEG, VIEW, Answers, FakeRun, Page, next_of, until
from mangled_messages import mangled
from splatpipe.cluster.live import hub as hub_module
from splatpipe.cluster.live import programs, switchboard, viewers, web
from splatpipe.cluster.live.connection import Connection
from splatpipe.cluster.live.hub import Hub
from splatpipe.cluster.live.protocol import parse_binary, to_json
from splatpipe.cluster.live.sockets import Client, new_keys
from splatpipe.shared.errors import MessageError


@pytest.fixture
def hub(tmp_path, monkeypatch):
    monkeypatch.setattr(hub_module, "TICK_S", 0.05)
    with Hub(Answers(), connection=tmp_path / "live.json") as hub:
        yield hub
        assert hub._board.unexpected is None


@pytest.fixture
def run(hub):
    with FakeRun(hub.run_address) as run:
        run.ready()
        run.show()
        yield run


@pytest.fixture
def good(hub, run):
    """A viewer that does his part, and must go on getting pictures."""
    with Client(hub.connection, pictures=True) as viewer:
        next_of(viewer, "welcome")
        see(viewer)
        yield viewer
        run.show(b"the last")
        while see(viewer) != b"the last":
            pass


def see(viewer) -> bytes:
    """The next picture, acknowledged."""
    shown = next_of(viewer, "picture")
    viewer.send({"kind": "ack", "frame": shown.header["frame"]})
    return bytes(shown.payload)


def camera(x: float = 0.0, moving: bool = True):
    return {"kind": "camera", "view": {**VIEW, "eye": [x, 0.0, 1.0]}, "moving": moving, "t": x}


def places(hub) -> tuple[tuple[str, int], tuple[str, int], tuple[str, int]]:
    """Where the page, the programs' socket and the ranks' listen."""
    addresses = hub.url, Connection.read(hub.connection).address, hub.run_address.address
    found = []
    for address in addresses:
        name, _, port = address.partition("://")[2].partition("/")[0].rpartition(":")
        found.append((name, int(port)))
    return tuple(found)


def drained(run) -> None:
    """Everything that was on its way to the run has arrived."""
    time.sleep(0.15)


# --- who does not get in ---------------------------------------------------------------------------------------------


class Stranger:
    """A ZeroMQ socket of whoever. keys : server, public and secret key, or None: no CURVE at all."""

    def __init__(self, address: str, keys: tuple[str, str, str] | None, routing_id: bytes = b"") -> None:
        self._context = zmq.Context()
        self.socket = self._context.socket(zmq.DEALER)
        self.socket.linger = 0
        if keys is not None:
            self.socket.curve_serverkey, self.socket.curve_publickey, self.socket.curve_secretkey = map(
                str.encode, keys
            )
        if routing_id:
            self.socket.routing_id = routing_id
        self.socket.connect(address)

    def say(self, *headers, payload=b""):
        for header in headers:
            with suppress(zmq.Again):
                self.socket.send_multipart([to_json(header), payload], zmq.NOBLOCK)

    def hears(self, timeout_s: float) -> bool:
        return bool(self.socket.poll(round(timeout_s * 1000)))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close(linger=0)
        self._context.term()


@pytest.mark.parametrize("door", ["viewers", "ranks"])
@pytest.mark.parametrize("who", ["no CURVE", "unknown key", "another server", "the other's key", "stolen public key"])
def test_without_the_right_keys_nobody_gets_in(hub, run, good, door, who):
    connection, ranks = Connection.read(hub.connection), hub.run_address
    own, other = (connection, ranks) if door == "viewers" else (ranks, connection)
    keys = {
        "no CURVE": None,
        "unknown key": (own.server_key, *new_keys()),
        "another server": (new_keys()[0], own.public_key, own.secret_key),
        "the other's key": (own.server_key, other.public_key, other.secret_key),
        "stolen public key": (own.server_key, own.public_key, new_keys()[1]),
    }[who]
    heard = len(run.heard)
    with Stranger(own.address, keys, b"rank0" if door == "ranks" else b"") as stranger:
        stranger.say(HELLO, {**HELLO, "rank": 0, "role": "coordinator", "host": "evil"}, camera(666.0))
        stranger.say({"kind": "ready", "run": {}, "view": VIEW, "settings": {"evil": 1}, "choices": {}})
        stranger.say({"kind": "started", "frame": 666, "view": VIEW}, {"kind": "quit"})
        stranger.say(example.picture(666), payload=b"evil")
        run.show()
        assert see(good) == JPEG
        assert not stranger.hears(0.2)
    assert {message.kind for message in run.heard[heard:]} <= {"shown", "viewers"}
    until(lambda: run.last("viewers", "pictures") == 1, "the run to know")
    good.send(camera(1.0))
    assert run.told("camera")[0]["t"] == 1.0  # and not to a rank 0 that is none


def test_another_version_is_told_so_and_dropped(hub, run, good):
    for version in (0, 2, -1, 10**9, "1", 1.5, None, True):
        hello = {**HELLO, "protocol": version}
        with Page(hub.url, hello=hello) as page:
            page.send(camera(666.0))
            assert "protocol" in next_of(page, "bye").header["why"]
            assert nothing_more(page)
        with Stranger(*curve(hub)) as program:
            program.say(hello, camera(666.0))
            assert program.hears(5)
            assert b"protocol" in program.socket.recv_multipart()[0]
            assert not program.hears(0.05)
    drained(run)
    assert not run.all("camera")


def nothing_more(page: Page) -> bool:
    """Whether the hub has closed a page's WebSocket, and said nothing before."""
    with suppress(ConnectionError):
        raise AssertionError(page.receive(5))
    return True


def curve(hub) -> tuple[str, tuple[str, str, str]]:
    connection = Connection.read(hub.connection)
    return connection.address, (connection.server_key, connection.public_key, connection.secret_key)


def test_a_page_needs_the_token_its_own_origin_and_a_name_of_this_host(hub, run, good):
    port = places(hub)[0][1]
    evil = f"http://evil.example:{port}"
    for wrong in (
        {"token": ""},
        {"token": "x" * 43},
        {"token": "%ff%00é"},
        {"token": hub.url.partition("token=")[2][:-1]},
        {"Origin": ""},
        {"Origin": "null"},
        {"Origin": evil},
        {"Origin": f"https://127.0.0.1:{port}"},
        {"Origin": "http://127.0.0.1"},
        {"Origin": f"http://127.0.0.1:{port}.evil.example"},
        {"Origin": f"http://localhost:{port}"},
        {"Host": "evil.example", "Origin": "http://evil.example"},
        {"Host": f"evil.example:{port}", "Origin": evil},
        {"Host": f"127.0.0.1.evil.example:{port}", "Origin": f"http://127.0.0.1.evil.example:{port}"},
        {"Host": f"127.0.0.1@evil.example:{port}", "Origin": evil},
    ):
        with pytest.raises(aiohttp.WSServerHandshakeError) as error:
            Page(hub.url, **wrong)
        assert error.value.status in (400, 403, 421), wrong
    for right in ({}, {"Host": "localhost:8000", "Origin": "http://localhost:8000"}):  # the latter through a tunnel
        with Page(hub.url, **right) as page:
            assert see(page) == JPEG


@pytest.mark.parametrize(
    "said",
    [
        "nonsense",
        b"binary",
        b"\x0e\x00\x00\x00" + b'{"kind":"bye"}' + b"payload",
        "[" * 30_000,
        "{" + "x" * 70_000 + "}",
        camera(1.0),
        {"kind": "open", "file": "/etc/passwd"},
        {**HELLO, "file": "/etc/passwd"},
        {**HELLO, "client": "x" * 1000},
        {**HELLO, "pictures": "yes"},
    ],
    ids=lambda said: str(said)[:20],
)
def test_who_does_not_say_hello_as_it_should_be_is_dropped(hub, run, good, said):
    with Page(hub.url, hello=None) as page:
        page.send(said)
        with suppress(ConnectionError):  # too long a message has no answer but the end
            assert next_of(page, "bye").header["why"]
        assert nothing_more(page)
    with Stranger(*curve(hub)) as program:
        frames = (
            [said, b""] if isinstance(said, bytes) else [said.encode() if isinstance(said, str) else to_json(said), b""]
        )
        program.socket.send_multipart(frames)
        assert program.hears(0.5) == (len(frames[0]) < 60_000 or said == "[" * 30_000)
        program.socket.send_multipart([to_json(HELLO), b""])
        if len(frames[0]) < 1 << 16:  # else it has lost its connection, and a new one may say hello
            assert b'"welcome"' not in b"".join(program.socket.recv() for _ in range(2) if program.hears(0.1))
    drained(run)
    assert not run.all("camera")


def test_a_program_may_send_a_header_and_an_empty_payload_only(hub, run, good):
    for frames in ([to_json(HELLO)], [to_json(HELLO), b"", b""], [to_json(HELLO), b"payload"], [b""], [b""] * 500):
        with Stranger(*curve(hub)) as program:
            program.socket.send_multipart(frames)
            assert program.hears(5)
            assert b'"bye"' in program.socket.recv_multipart()[0]


def test_who_says_nothing_is_dropped_after_a_while(hub, run, good, monkeypatch):
    monkeypatch.setattr(switchboard, "HELLO_S", 0.2)
    with Page(hub.url, hello=None) as page:
        assert "no hello" in next_of(page, "bye").header["why"]


def test_so_many_may_look_and_no_more(hub, run, good, monkeypatch):
    monkeypatch.setattr(switchboard, "MAX_VIEWERS", 2)
    with Page(hub.url) as page:
        see(page)
        with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
            Page(hub.url)
        with Client(hub.connection) as program:
            assert next_of(program, "bye").header["why"] == "too many viewers"
    until(lambda: len(hub._board._viewers) == 1, "the page to have gone")
    with Page(hub.url) as page:
        see(page)


# --- who is slow, or vanishes ----------------------------------------------------------------------------------------


def handshake(hub, *, read: bool = True) -> socket.socket:
    """A page's WebSocket, raw; what it was sent first is not read."""
    link = socket.create_connection(places(hub)[0])
    site = "{}:{}".format(*places(hub)[0])
    token = hub.url.partition("token=")[2]
    link.sendall(
        f"GET /live?token={token} HTTP/1.1\r\nHost: {site}\r\nOrigin: http://{site}\r\nConnection: Upgrade\r\n"
        "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
    )
    if read:
        assert b"101" in link.recv(1000)
    return link


def text_frame(data: bytes) -> bytes:
    return struct.pack(">BBH", 0x81, 0x80 | 126, len(data)) + b"\0\0\0\0" + data  # masked with zeros


def test_viewers_that_never_read_are_dropped_and_cost_the_others_nothing(hub, run, good, monkeypatch):
    monkeypatch.setattr(viewers, "PATIENCE_S", 1.5)
    with ExitStack() as stack:
        links = [stack.enter_context(handshake(hub)) for _ in range(4)]
        for link in links:
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            link.sendall(text_frame(to_json(HELLO)))
        asleep = [stack.enter_context(Client(hub.connection, pictures=True, metrics=True)) for _ in range(4)]
        until(lambda: run.last("viewers", "pictures") == 9, "all viewers")
        payload = os.urandom(1 << 20)
        for _ in range(60):
            run.show(payload)
            assert len(see(good)) in (len(payload), len(JPEG))
        before = example.resident_bytes()
        until(lambda: run.show(payload) and bool(see(good)) and len(hub._board._viewers) == 1, "them to be dropped")
        assert example.resident_bytes() - before < 200 << 20
        assert "takes nothing" in next_of(asleep[0], "bye").header["why"]
    until(lambda: run.last("viewers", "pictures") == 1, "the others to be gone")


def test_who_is_slow_but_takes_something_stays(hub, run, good, monkeypatch):
    monkeypatch.setattr(viewers, "PATIENCE_S", 1.0)
    with handshake(hub) as link:
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        link.sendall(text_frame(to_json(HELLO)))
        until(lambda: len(hub._board._viewers) == 2, "it")
        large = run.show(bytes(16 << 20))
        until(lambda: hub._board._picture.header["frame"] == large, "it to be on its way")
        run.show()
        end = time.monotonic() + 1.5
        taken = 0
        while time.monotonic() < end:
            taken += len(link.recv(1 << 17))
            time.sleep(0.02)
        assert taken < 16 << 20
        assert len(hub._board._viewers) == 2


def test_pages_that_vanish_in_mid_message_leave_nothing(hub, run, good):
    before = example.left_behind()[1]
    whole = text_frame(to_json(HELLO))
    for length in (0, 1, 3, 8, len(whole) // 2, len(whole) - 1, len(whole)):
        for reset in (False, True):
            link = handshake(hub)
            link.sendall(whole[:length])
            if reset:
                link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            link.close()
    for said in (b"", b"GET / HT", b"GET /live?token=x HTTP/1.1\r\nHost:", b"\x16\x03\x01\x02" * 100, b"\0" * 20_000):
        with socket.create_connection(places(hub)[0]) as link:
            link.sendall(said)
    run.show()
    see(good)
    until(lambda: len(hub._board._viewers) == 1 and example.left_behind()[1] == before, "their ends")


def test_connections_that_ask_for_nothing_are_ended(hub, run, good, monkeypatch):
    monkeypatch.setattr(web, "REQUEST_S", 0.3)
    with socket.create_connection(places(hub)[0]) as link, handshake(hub) as page:
        page.sendall(text_frame(to_json(HELLO)))
        link.sendall(b"GET / HTTP/1.1\r\nHost: ")
        with suppress(ConnectionResetError):
            assert link.recv(100) == b""
        until(lambda: len(hub._board._viewers) == 2, "the WebSocket, which stays")


def test_of_too_many_connections_the_oldest_that_are_no_viewers_are_ended(hub, run, good, monkeypatch):
    monkeypatch.setattr(web, "MAX_CONNECTIONS", 4)
    with Page(hub.url) as page, ExitStack() as stack:
        see(page)
        links = [stack.enter_context(socket.create_connection(places(hub)[0])) for _ in range(12)]
        with suppress(ConnectionResetError):
            assert links[0].recv(100) == b""
        with Page(hub.url) as another:
            see(another)
        run.show()
        see(page)


class Cut(threading.Thread):
    """Passes a connection on to ``place``, of what comes back and forth only so many bytes, then closes or stops."""

    def __init__(self, place: tuple[str, int], n_bytes: int, close: bool) -> None:
        super().__init__(name="cut")
        self._place, self._left, self._close = place, n_bytes, close
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self.done, self.end = threading.Event(), threading.Event()
        self.start()

    def run(self) -> None:
        with self._listener, self._listener.accept()[0] as near, socket.create_connection(self._place) as far:
            self._listener.close()
            back = threading.Thread(target=self._back, args=(far, near), name="cut back")
            back.start()
            with suppress(OSError):
                while self._left and (data := near.recv(min(self._left, 4096))):
                    far.sendall(data)
                    self._left -= len(data)
            self.done.set()
            if not self._close:
                self.end.wait()
            for link in (far, near):
                with suppress(OSError):
                    link.shutdown(socket.SHUT_RDWR)
            back.join()

    def _back(self, far: socket.socket, near: socket.socket) -> None:
        with suppress(OSError):
            while data := far.recv(4096):
                near.sendall(data)


@pytest.mark.parametrize("close", [True, False])
def test_programs_that_vanish_in_mid_message_leave_nothing(hub, run, good, close, monkeypatch):
    monkeypatch.setattr(viewers, "PATIENCE_S", 1.0)
    keys = curve(hub)[1]
    before = example.left_behind()[1]
    with ExitStack() as stack:
        for n_bytes in (
            1,
            40,
            64,
            100,
            300,
            500,
            700,
            900,
            1100,
            1500,
        ):  # in the greeting, the handshake, hello, a camera
            cut = Cut(places(hub)[1], n_bytes, close)
            stack.callback(cut.join)
            stack.callback(cut.end.set)
            program = stack.enter_context(Stranger(cut.address, keys))
            program.say(HELLO, *[camera(1.0) for _ in range(10)])
        until(cut.done.is_set, "the last to be cut")
        run.keep_showing(20)
        end = time.monotonic() + 1.2
        while time.monotonic() < end:
            see(good)
        until(lambda: bool(see(good)) and len(hub._board._viewers) == 1, "them to be dropped")
    assert run.all("camera")  # the longest did say something
    run._stop.set()
    until(lambda: example.left_behind()[1] <= before, "their ends")


def test_programs_that_vanish_without_a_word_are_noticed_though_nothing_is_sent_to_them(hub, run, good, monkeypatch):
    monkeypatch.setattr(switchboard, "PROBE_S", 0.3)
    with Stranger(*curve(hub)) as program:
        program.say({**HELLO, "pictures": False})
        until(lambda: len(hub._board._viewers) == 2, "it")
        assert b'"welcome"' in program.socket.recv_multipart()[0]
        assert b'"settings"' in program.socket.recv_multipart()[0]
    until(lambda: len(hub._board._viewers) == 1, "it to be gone")


# --- who talks nonsense ----------------------------------------------------------------------------------------------


def test_thousands_of_mangled_messages_disturb_nobody(hub, run, good, monkeypatch):
    monkeypatch.setattr(viewers, "MESSAGES_PER_S", 1e6)
    monkeypatch.setattr(programs, "DEAF_S", 0.0)
    rng = random.Random(80)
    run.keep_showing(30)
    before = {*example.left_behind()[0], "hub services_0"}
    with Stranger(*curve(hub)) as program:
        for number in range(4000):
            frames = [mangled(rng)] + [
                rng.choice([b"", b"", b"", rng.randbytes(20)]) for _ in range(rng.choice([1, 1, 1, 0, 2]))
            ]
            if rng.random() < 0.2:
                frames = [to_json(HELLO), b""]
            program.socket.send_multipart(frames)
            while program.hears(0):
                program.socket.recv_multipart()
            if number % 100 == 0:
                see(good)
    asyncio.run(mangled_pages(hub, rng, 1500))
    assert see(good) == JPEG
    assert example.left_behind()[0] <= before
    until(lambda: len(hub._board._viewers) == 1, "them to be gone")


async def mangled_pages(hub, rng: random.Random, count: int) -> None:
    """WebSockets that say something mangled until they are dropped, or frames that are none."""
    said = 0
    while said < count:
        link = await asyncio.to_thread(handshake, hub)
        with link:
            link.settimeout(5)
            if rng.random() < 0.8:
                link.sendall(text_frame(to_json(HELLO)))
            with suppress(ConnectionError):
                for _ in range(rng.randrange(60)):
                    data = mangled(rng)[:60_000]
                    link.sendall(text_frame(data) if rng.random() < 0.9 else rng.randbytes(rng.randrange(40)))
                    said += 1


# --- fifty at once ---------------------------------------------------------------------------------------------------


async def look(hub, number: int, pictures: int) -> int:
    """A page that looks at so many pictures, then goes: by saying bye, by closing, or just so."""
    site, _, token = hub.url.partition("/?token=")
    seen = 0
    address = f"{site}/live?token={token}"
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(address, headers={"Origin": site}, max_msg_size=0) as link,
    ):
        await link.send_str(to_json(HELLO).decode())
        while seen < pictures:
            message = await link.receive(20)
            if message.type is not aiohttp.WSMsgType.BINARY:
                assert message.type is aiohttp.WSMsgType.TEXT
                continue
            shown = parse_binary(message.data)
            assert len(shown.payload) == 100_000
            await link.send_str(to_json({"kind": "ack", "frame": shown.header["frame"]}).decode())
            await link.send_str(to_json(camera(float(number))).decode())
            seen += 1
        if number % 3 == 0:
            await link.send_str('{"kind":"bye"}')
        elif number % 3 == 1:
            link.get_extra_info("socket").shutdown(socket.SHUT_RDWR)
    return seen


def look_as_program(hub, seen: list[int], pictures: int) -> None:
    with Client(hub.connection, pictures=True, metrics=True) as viewer:
        for _ in range(pictures):
            assert len(see(viewer)) == 100_000
            viewer.send(camera(1.0, False))
        seen.append(pictures)


def test_fifty_viewers_come_and_go_and_memory_stays_flat(hub, run, monkeypatch):
    run.show(os.urandom(100_000))
    run.keep_showing(30, os.urandom(100_000))
    resident = []
    left = []

    async def pages() -> list[int]:
        return await asyncio.gather(*[look(hub, number, 12) for number in range(25)])

    for _ in range(5):
        seen: list[int] = []
        threads = [threading.Thread(target=look_as_program, args=(hub, seen, 12)) for _ in range(25)]
        for thread in threads:
            thread.start()
        assert asyncio.run(pages()) == [12] * 25
        for thread in threads:
            thread.join()
        assert seen == [12] * 25
        until(lambda: not hub._board._viewers, "all to have gone")
        resident.append(example.resident_bytes())
        left.append(example.left_behind())
    until(lambda: run.last("viewers", "pictures") == 0, "the run to know")
    assert max(resident[2:]) - resident[1] < 30 << 20
    assert left[-1][0] == left[0][0]
    assert abs(left[-1][1] - left[0][1]) <= 2
    assert run.all("camera")


def test_a_message_that_is_not_foreseen_costs_its_viewer_only(tmp_path, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError

    with (
        Hub(Answers(), connection=tmp_path / "live.json") as hub,
        FakeRun(hub.run_address) as run,
        Page(hub.url) as page,
    ):
        run.ready()
        next_of(page, "welcome")
        monkeypatch.setattr(switchboard.Switchboard, "_move", fail)
        with Client(hub.connection, pictures=True) as good:
            page.send(camera(1.0))
            assert "not understood (ZeroDivisionError)" in next_of(page, "bye").header["why"]
            run.show()
            assert see(good) == JPEG
        assert isinstance(hub._board.unexpected, ZeroDivisionError)


def test_a_run_that_nobody_looks_at_loads_nothing_of_this():
    code = "import sys, splatpipe.cluster.run, splatpipe.cluster.live.connection; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"zmq", "aiohttp", "asyncio"} & set(loaded)


def test_services_cannot_be_made_to_read_a_file():
    from splatpipe.cluster.live.protocol import VIEWER_MESSAGES, said_by_viewer

    for kind, model in VIEWER_MESSAGES.items():
        text = {name for name, field in model.model_fields.items() if field.annotation is str}
        assert text <= {"client"}, kind  # settings are the run's to check, against a list
    with pytest.raises(MessageError):
        said_by_viewer({"kind": "path", "request": 1, "keys": "/etc/passwd"})
