"""A run that is none: this process acts as its ranks. And those who look at it."""

import asyncio
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import aiohttp
from splatpipe.cluster.live.protocol import LiveMessage, parse_binary, parse_json, to_json
from splatpipe.cluster.live.sockets import RunAddress, RunLink
from splatpipe.shared.errors import InputError

VIEW = {"eye": [0.0, -2.0, 1.0], "target": [0.0, 0.0, 0.0], "up": [0.0, 0.0, 1.0], "fov_deg": 45.0}
RUN = {"scene": "example", "points": 12, "cells": 1, "ranks": [{"rank": 0, "role": "coordinator", "host": "here"}]}
SETTINGS = {"render.point_size_px": 2, "live.fps": 30.0}
CHOICES = {"live.fps": {"type": "number", "least": 1, "most": 60, "default": 30.0}}
JPEG = b"\xff\xd8\xff" + b"picture" * 100 + b"\xff\xd9"
HELLO = {"kind": "hello", "protocol": 1, "client": "test", "pictures": True, "metrics": False}


class Answers:
    """Services that note what they are asked."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.hold = threading.Event()
        self.hold.set()

    def pick(self, view, width, height, x, y, settings):
        self.hold.wait(10)
        self.asked.append((view, width, height, x, y, settings))
        if x == 0:
            raise InputError("nothing\nthere")
        if x == 1:
            raise KeyError("a mistake")
        return {"found": True, "position": [1.0, 2.0, 3.0], "attributes": {"intensity": 7}}

    def path(self, keys, fps, settings):
        return "x" * 100_000 if len(keys) > 1 else f"# {len(keys)} keys at {fps:g}"

    def expected(self, ranks, counts):
        self.asked.append((ranks, counts))
        return [{"rank": 2, "values": {"render.work_ms": counts["points"]}}]

    def left_out(self):
        return [{"what": "edl", "why": "off", "saves": "2 ms"}]


class FakeRun:
    """Rank 0 and the display of a run. Context manager. heard : what rank 0 was told, by kind."""

    def __init__(self, address: RunAddress) -> None:
        self.coordinator = RunLink(address, 0, "coordinator", "here")
        self.display = RunLink(address, 2, "render", "here")
        self.frame = 0
        self.heard: list[LiveMessage] = []
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._listen, name="fake run")]
        self._threads[0].start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self.coordinator.close()
        self.display.close()

    def ready(self) -> None:
        self.coordinator.send({"kind": "ready", "run": RUN, "view": VIEW, "settings": SETTINGS, "choices": CHOICES})

    def show(self, payload: bytes = JPEG, **more: Any) -> int:
        """A frame is started, and its picture drawn; its number."""
        self.frame += 1
        started = {
            "frame": self.frame,
            "view": VIEW,
            "t": 0.0,
            "still": True,
            "scale": 1.0,
            "viewer": 0,
            "begun_at": 1.0,
        }
        self.coordinator.send({"kind": "started", **started, **more})
        self.display.send(picture(self.frame), payload)
        return self.frame

    def keep_showing(self, per_s: float, payload: bytes = JPEG) -> None:
        def work() -> None:
            while not self._stop.wait(1 / per_s):
                self.show(payload)

        self._threads.append(threading.Thread(target=work, name="fake pictures"))
        self._threads[-1].start()

    def told(self, kind: str, count: int = 1) -> list[dict[str, Any]]:
        """All that rank 0 was told of a kind, once it is as many."""
        until(lambda: len(self.all(kind)) >= count, f"{count} × {kind}")
        return self.all(kind)

    def all(self, kind: str) -> list[dict[str, Any]]:
        return [message.header for message in list(self.heard) if message.kind == kind]

    def last(self, kind: str, name: str) -> Any:
        """A field of the last that rank 0 was told of a kind; None: nothing yet."""
        told = self.all(kind)
        return told[-1][name] if told else None

    def _listen(self) -> None:
        while not self._stop.is_set():
            self.heard += self.coordinator.receive(0.02)


def picture(frame: int) -> dict[str, Any]:
    moments = {"composed_at": 1.003, "encoding_at": 1.004, "sent_at": 1.006}
    return {"kind": "picture", "frame": frame, "width": 64, "height": 48, "encoding": "jpeg", **moments}


def until(condition: Callable[[], bool], what: str, patience_s: float = 20.0) -> None:
    end = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < end, f"waited for {what}"
        time.sleep(0.005)


class Page:
    """A page's WebSocket, without a page. Context manager; raises aiohttp.WSServerHandshakeError where it is refused."""

    def __init__(self, url: str, *, hello: dict[str, Any] | None = HELLO, token: str | None = None, **headers: str):
        site, _, own = url.partition("/?token=")
        self._runner = asyncio.Runner()
        self._open(f"{site}/live?token={own if token is None else token}", {"Origin": site, **headers}, hello)

    def _open(self, address: str, headers: dict[str, str], hello: dict[str, Any] | None) -> None:
        try:
            self._session = self._runner.run(self._new_session())
            self._link = self._runner.run(self._connect(address, headers))
        except BaseException:
            self.close()
            raise
        if hello is not None:
            self.send(hello)

    async def _new_session(self) -> aiohttp.ClientSession:
        return aiohttp.ClientSession()

    async def _connect(self, address: str, headers: dict[str, str]) -> Any:
        kept = {name: value for name, value in headers.items() if value}
        return await self._session.ws_connect(address, headers=kept, max_msg_size=0, autoclose=False)

    def send(self, header: dict[str, Any] | str | bytes) -> None:
        if isinstance(header, bytes):
            self._runner.run(self._link.send_bytes(header))
        else:
            text = header if isinstance(header, str) else to_json(header).decode()
            self._runner.run(self._link.send_str(text))

    def receive(self, timeout_s: float = 20.0) -> LiveMessage | None:
        """The next message; None: none in that time; ConnectionError: the hub has closed."""
        try:
            message = self._runner.run(asyncio.wait_for(self._link.receive(), timeout_s))
        except TimeoutError:
            return None
        if message.type is aiohttp.WSMsgType.TEXT:
            return LiveMessage(parse_json(message.data))
        if message.type is aiohttp.WSMsgType.BINARY:
            return parse_binary(message.data)
        raise ConnectionError(message.type)

    def close(self) -> None:
        if hasattr(self, "_link"):
            self._runner.run(self._link.close())
        self._runner.run(self._session.close())
        self._runner.run(asyncio.sleep(0))
        self._runner.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def next_of(viewer: Any, kind: str, patience_s: float = 20.0) -> LiveMessage:
    """The next message of a kind that a viewer gets; those before it are skipped."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        message = viewer.receive(0.2)
        if message is not None and message.kind == kind:
            return message
    raise AssertionError(f"waited for {kind}")


def left_behind() -> tuple[set[str], int]:
    """What a hub must leave as it was: threads, and how many descriptors are open."""
    return {thread.name for thread in threading.enumerate()}, len(list(Path("/proc/self/fd").iterdir()))


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
