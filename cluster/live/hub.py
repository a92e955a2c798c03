"""The hub of a live run: passes the run's pictures to all who look, and what they want to the run.

It is a thread with an event loop. Ranks reach it by ZeroMQ, viewers by ZeroMQ or from a page (``sockets``, ``web``);
to it viewers are alike (``viewers``). It never waits for any of them: of what one does not take the latest remains, and
who takes nothing is dropped.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import socket
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from ...shared.errors import MessageError, SplatpipeError
from ..record import package_version
from .connection import Connection, RunAddress
from .gathered import Gathered, Record
from .protocol import (
    MAX_HEADER_BYTES,
    PROTOCOL_VERSION,
    RUN_KINDS,
    Acknowledged,
    Bye,
    CameraMoved,
    Hello,
    PathKey,
    PathWanted,
    PickWanted,
    PlanWanted,
    ScreenshotWanted,
    SettingsWanted,
    Subscribed,
    View,
    ViewerMessage,
    parse_json,
    said_by_viewer,
    to_json,
)
from .sockets import Gone, HubSockets, new_keys
from .viewers import HELLO_S, MESSAGES_PER_S, Outlet, Parcel, Viewer
from .web import Site

MAX_VIEWERS = 256
MAX_SERVICES = 8
"""Requests that the worker thread has or that wait for it; of them ``MAX_SERVICES_EACH`` of one viewer."""
MAX_SERVICES_EACH = 2
MAX_SCREENSHOTS_EACH = 2
SCREENSHOT_S = 120.0
FRAMES_KNOWN = 64
"""Pictures of which the hub still knows from where they were taken."""
METRICS_S = 0.5
TICK_S = 0.25
_PROBE_S = 10.0
_START_S = 30.0


class Services(Protocol):
    """What is answered beside the run, in a worker thread of the hub's. A SplatpipeError is told to who asked."""

    def pick(self, view: View, width: int, height: int, x: float, y: float, settings: dict[str, Any]) -> dict[str, Any]:
        """{"found": bool, "position": [x, y, z], "attributes": {name: value}} at a place of a picture, in shares."""
        ...

    def path(self, keys: list[PathKey], fps: float, settings: dict[str, Any]) -> str:
        """A recorded path as TOML."""
        ...

    def left_out(self) -> list[dict[str, Any]]:
        """[{"what", "why", "saves"}]."""
        ...


class _Program:
    """A viewer's end over ZeroMQ. Its socket cannot be closed for one peer: what it says further is not listened to."""

    def __init__(self, hub: Hub, peer: bytes) -> None:
        self._hub, self._peer = hub, peer

    async def send(self, parcel: Parcel) -> None:
        while not self._now(parcel):
            await asyncio.sleep(0.02)

    def _now(self, parcel: Parcel) -> bool:
        try:
            return self._hub._sockets.viewers.send(self._peer, parcel.text, parcel.payload)
        except Gone:
            raise ConnectionError from None

    def waiting_bytes(self) -> int:
        return 0

    def end(self, last: Parcel | None) -> None:
        self._hub._programs.pop(self._peer, None)
        if last is not None:
            with suppress(ConnectionError):
                self._now(last)


class Hub:
    """Context manager: runs from entering to leaving it, and nothing of it remains: no thread, socket or file.

    bind, port, zmq_port : where it listens; 0: any port.
    connection : where the connection file is written.  record : where metrics are written down.
    Entering raises InputError where an address or a file cannot be had.
    """

    run_address: RunAddress
    url: str
    """Of the page, with its token."""

    def __init__(
        self,
        services: Services,
        *,
        bind: str = "127.0.0.1",
        port: int = 0,
        zmq_port: int = 0,
        connection: Path,
        record: Path | None = None,
    ) -> None:
        self._services = services
        self._bind, self._port, self._zmq_port = bind, port, zmq_port
        self.connection = connection
        self._record_path = record
        self._record: Record | None = None
        self._why = "the run is over"
        self._started = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="hub", daemon=True)
        self._loop: asyncio.AbstractEventLoop | None = None

    # --- life ---

    def __enter__(self) -> Self:
        self._thread.start()
        self._started.wait()
        if self._failure is not None:
            self._thread.join()
            raise self._failure
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self, why: str = "the run is over") -> None:
        """Tell all viewers why, and end; from any thread, any number of times."""
        if self._thread.is_alive() and self._loop is not None:
            self._why = why
            with suppress(RuntimeError):  # it has ended meanwhile
                self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join()

    def end_run(self) -> None:
        """Ask the run to end after the frame it is at; from any thread."""
        if self._loop is not None:
            with suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._to_coordinator, {"kind": "quit"})

    def _run(self) -> None:
        try:
            asyncio.run(self._live())
        except BaseException as error:
            self._failure = error
        finally:
            self._started.set()

    async def _live(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._stop = asyncio.Event()
        self._viewers: dict[int, Viewer] = {}
        self._programs: dict[bytes, Viewer] = {}
        self._numbers = 0
        self._ranks: dict[bytes, int] = {}
        self._coordinator: bytes | None = None
        self._ready: dict[str, Any] | None = None
        self._ready_at = time.monotonic()
        self._settings: dict[str, Any] = {}
        self._frames: OrderedDict[int, dict[str, Any]] = OrderedDict()
        self._early: OrderedDict[int, tuple[dict[str, Any], bytes]] = OrderedDict()  # pictures before their "started"
        self._picture: Parcel | None = None
        self._shown = -1
        self._camera: tuple[int, CameraMoved, float] | None = None
        self._n_watching = -1
        self._prediction: Parcel | None = None
        self._version = package_version("splatpipe") or ""
        self._gathered = Gathered(socket.gethostname())
        self._n_services = 0
        self._tasks: set[asyncio.Task[None]] = set()

        server, run, viewer = new_keys(), new_keys(), new_keys()
        token = secrets.token_urlsafe(32)
        self._sockets = HubSockets(self._bind, self._zmq_port, server, run[0], viewer[0])
        self._worker = ThreadPoolExecutor(1, "hub services")
        site = Site(self._bind, token, self._connect, self._hear, self._leave)
        try:
            await site.start(self._port)
            host = _name_of(self._bind)
            self.url = f"http://{host}:{site.port}/?token={token}"
            self.run_address = RunAddress(f"tcp://{host}:{self._sockets.run.port}", server[0], *run)
            if self._record_path is not None:
                self._record = Record(self._record_path)
            address = f"tcp://{host}:{self._sockets.viewers.port}"
            Connection(PROTOCOL_VERSION, address, server[0], *viewer, self.url, os.getpid()).write(self.connection)
            serving = [
                self._sockets.serve(self._from_rank, self._sockets.run),
                self._sockets.serve(self._from_program, self._sockets.viewers),
                self._loop.create_task(self._tick()),
            ]
            self._started.set()
            await asyncio.wait(
                [*serving, stop := self._loop.create_task(self._stop.wait())], return_when="FIRST_COMPLETED"
            )
            for task in (*serving, stop):
                task.cancel()
            await asyncio.gather(*serving, stop, return_exceptions=True)
        finally:
            self.connection.unlink(missing_ok=True)
            self._to_coordinator({"kind": "quit"})
            for one in list(self._viewers.values()):
                self._drop(one, self._why)
            await asyncio.sleep(0.05)  # so that the last words leave
            await site.close()
            for task in self._tasks:
                task.cancel()
            self._sockets.close()
            self._worker.shutdown(wait=True, cancel_futures=True)
            if self._record is not None:
                self._record.close()

    async def _tick(self) -> None:
        told = 0.0
        while True:
            await asyncio.sleep(TICK_S)
            now = time.monotonic()
            for viewer in list(self._viewers.values()):
                self._look_after(viewer, now)
            self._send_camera()
            if now - told >= METRICS_S and self._ready is not None:
                told = now
                self._tell_metrics(now)

    def _look_after(self, viewer: Viewer, now: float) -> None:
        if viewer.gone:
            self._drop(viewer, None)
        elif viewer.hello is None:
            if now - viewer.since > HELLO_S:
                self._drop(viewer, f"no hello within {HELLO_S:g} s")
        elif viewer.stalled(now):
            self._drop(viewer, "takes nothing")
        else:
            late, viewer.late_camera = viewer.late_camera, None
            if late is not None:
                self._hear(viewer, late)
            if isinstance(viewer.outlet, _Program) and viewer.welcomed and now - viewer.sent_at > _PROBE_S:
                viewer.latest(Parcel({"kind": "settings", "settings": self._settings}))  # is it still there?
            for request, at in list(viewer.screenshots.items()):
                if now - at > SCREENSHOT_S:
                    del viewer.screenshots[request]

    def _tell_metrics(self, now: float) -> None:
        header = self._gathered.message(now - self._ready_at, sum(v.welcomed for v in self._viewers.values()))
        parcel = Parcel(header)
        for viewer in self._viewers.values():
            if viewer.welcomed and viewer.metrics:
                viewer.latest(parcel)
        self._write(header)

    def _write(self, header: dict[str, Any]) -> None:
        if self._record is not None:
            self._record.write(header)

    # --- viewers ---

    def _connect(self, outlet: Outlet) -> Viewer | None:
        if len(self._viewers) >= MAX_VIEWERS:
            return None
        self._numbers += 1
        viewer = self._viewers[self._numbers] = Viewer(self._numbers, outlet)
        return viewer

    def _leave(self, viewer: Viewer, why: str) -> None:
        self._drop(viewer, why or None)

    def _drop(self, viewer: Viewer, why: str | None) -> None:
        if self._viewers.pop(viewer.number, None) is not None:
            viewer.end(Parcel({"kind": "bye", "why": why}) if why else None)
            self._count()

    def _count(self) -> None:
        n = sum(viewer.welcomed and viewer.pictures for viewer in self._viewers.values())
        if (
            n != self._n_watching
            and self._ready is not None
            and self._to_coordinator({"kind": "viewers", "pictures": n})
        ):
            self._n_watching = n

    def _from_program(self, peer: bytes, frames: list[bytes]) -> None:
        viewer = self._programs.get(peer)
        if viewer is None:
            outlet = _Program(self, peer)
            viewer = self._connect(outlet)
            if viewer is None:
                outlet.end(Parcel({"kind": "bye", "why": "too many viewers"}))
                return
            self._programs[peer] = viewer
        try:
            if len(frames) != 2 or frames[1]:
                raise MessageError("message: expected a header, and a payload that is empty")
            self._hear(viewer, parse_json(frames[0]))
        except MessageError as error:
            self._drop(viewer, str(error))

    def _hear(self, viewer: Viewer, header: dict[str, Any]) -> None:
        """A viewer says something. Raises MessageError where it is to be dropped."""
        if viewer.gone:
            return
        moved = header["kind"] == "camera"
        if not viewer.messages.take():
            if not moved or not viewer.cameras.take():
                raise MessageError(f"found more than {MESSAGES_PER_S:g} messages a second")
            viewer.late_camera = header
            return
        message = said_by_viewer(header)
        if moved:
            viewer.late_camera = None
        if viewer.hello is None:
            if not isinstance(message, Hello):
                raise MessageError(f"{header['kind']}: expected hello first")
            if message.protocol != PROTOCOL_VERSION:
                raise MessageError(f"protocol: found {message.protocol}, expected {PROTOCOL_VERSION}")
            viewer.hello = message
            viewer.subscribe(message.pictures, message.metrics)
            if self._ready is not None:
                self._welcome(viewer)
        elif isinstance(message, Hello):
            raise MessageError("hello: said already")
        else:
            self._obey(viewer, message)

    def _welcome(self, viewer: Viewer) -> None:
        viewer.welcomed = True
        viewer.answer(Parcel(self._welcoming(viewer.number)))
        self._give_what_there_is(viewer)
        self._count()

    def _welcoming(self, number: int) -> dict[str, Any]:
        ready = self._ready or {}
        named = {name: ready.get(name) for name in ("run", "view", "choices")}
        head = {"kind": "welcome", "protocol": PROTOCOL_VERSION, "version": self._version, "viewer": number}
        return {**head, **named, "settings": self._settings}

    def _give_what_there_is(self, viewer: Viewer) -> None:
        if viewer.pictures and self._picture is not None:
            viewer.show(self._picture)
        if viewer.metrics and self._prediction is not None:
            viewer.latest(self._prediction)

    def _obey(self, viewer: Viewer, message: ViewerMessage) -> None:
        if isinstance(message, Bye):
            self._drop(viewer, None)
        elif isinstance(message, Subscribed):
            had = viewer.pictures, viewer.metrics
            viewer.subscribe(message.pictures, message.metrics)
            if viewer.welcomed and (viewer.pictures, viewer.metrics) != had:
                self._give_what_there_is(viewer)
                self._count()
        elif isinstance(message, Acknowledged):
            self._acknowledged(viewer, message.frame)
        elif self._ready is None:
            if not isinstance(message, CameraMoved):
                self._refuse(viewer, getattr(message, "request", 0), "the run has not started yet")
        elif isinstance(message, CameraMoved):
            if self._camera is None and self._loop is not None:
                self._loop.call_soon(self._send_camera)
            self._camera = viewer.number, message, time.monotonic()
        elif isinstance(message, SettingsWanted):
            wanted = {"set": message.set, "viewer": viewer.number, "request": message.request}
            if not self._to_coordinator({"kind": "settings", **wanted}):
                self._refuse(viewer, message.request, "the run is behind")
        elif isinstance(message, ScreenshotWanted):
            self._ask_screenshot(viewer, message)
        else:
            self._ask_service(viewer, message)

    def _acknowledged(self, viewer: Viewer, frame: int) -> None:
        if not viewer.acknowledged(frame) or frame <= self._shown:
            return
        self._shown = frame
        self._to_coordinator({"kind": "shown", "frame": frame})
        camera_at = self._frames.get(frame, {}).get("camera_at")
        if camera_at is not None:
            self._gathered.shown(time.monotonic() - camera_at)

    def _refuse(self, viewer: Viewer, request: int, why: str) -> None:
        self._answer(viewer, Parcel({"kind": "refused", "request": request, "why": why}))

    def _answer(self, viewer: Viewer, parcel: Parcel) -> None:
        if not viewer.answer(parcel):
            self._drop(viewer, "takes no answers")

    def _ask_screenshot(self, viewer: Viewer, message: ScreenshotWanted) -> None:
        if len(viewer.screenshots) >= MAX_SCREENSHOTS_EACH:
            self._refuse(viewer, message.request, "other screenshots are still under way")
            return
        size = {"width": message.width, "height": message.height}
        if self._to_coordinator({"kind": "screenshot", "viewer": viewer.number, "request": message.request, **size}):
            viewer.screenshots[message.request] = time.monotonic()
        else:
            self._refuse(viewer, message.request, "the run is behind")

    def _ask_service(self, viewer: Viewer, message: Any) -> None:
        settings = dict(self._settings)
        work: Callable[[], dict[str, Any]]
        if isinstance(message, PickWanted):
            frame = self._frames.get(message.frame, {})
            if "width" not in frame:
                self._refuse(viewer, message.request, f"picture {message.frame} is not known any more")
                return
            view = View.model_validate_json(to_json(frame["view"]))
            at = view, frame["width"], frame["height"], message.x, message.y, settings
            work = lambda: self._services.pick(*at)  # noqa: E731
        elif isinstance(message, PathWanted):
            work = lambda: {"toml": self._services.path(message.keys, message.fps, settings)}  # noqa: E731
        elif isinstance(message, PlanWanted):
            work = lambda: {"left_out": self._services.left_out()}  # noqa: E731
        else:
            return
        if viewer.services >= MAX_SERVICES_EACH or self._n_services >= MAX_SERVICES:
            self._refuse(viewer, message.request, "too many requests are waiting")
            return
        task = asyncio.get_running_loop().create_task(self._serve(viewer, message, work))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, viewer: Viewer, message: Any, work: Callable[[], dict[str, Any]]) -> None:
        viewer.services += 1
        self._n_services += 1
        try:
            found = await asyncio.get_running_loop().run_in_executor(self._worker, work)
            parcel = Parcel({"kind": message.kind, "request": message.request, **found})
            if len(parcel.text) > MAX_HEADER_BYTES:
                raise SplatpipeError(f"the answer has {len(parcel.text)} bytes, at most {MAX_HEADER_BYTES} can be sent")
            self._answer(viewer, parcel)
        except SplatpipeError as error:
            self._refuse(viewer, message.request, str(error).splitlines()[0] if str(error) else "failed")
        except Exception as error:
            self._refuse(viewer, message.request, f"{message.kind} failed: {type(error).__name__}")
        finally:
            viewer.services -= 1
            self._n_services -= 1

    # --- the run ---

    def _to_coordinator(self, header: dict[str, Any]) -> bool:
        if self._coordinator is None:
            return False
        try:
            return self._sockets.run.send(self._coordinator, to_json(header))
        except Gone:
            return False

    def _send_camera(self) -> None:
        if self._camera is None:
            return
        number, moved, at = self._camera
        header = {"view": moved.view.model_dump(), "moving": moved.moving, "t": moved.t, "viewer": number, "at": at}
        if self._to_coordinator({"kind": "camera", **header}):
            self._camera = None

    def _from_rank(self, peer: bytes, frames: list[bytes]) -> None:
        with suppress(MessageError, KeyError, TypeError, ValueError):  # ranks are ours, but a wrong one ends nothing
            header = parse_json(frames[0])
            kind = header["kind"]
            if kind == "hello":
                self._ranks[peer] = header["rank"]
                if header["rank"] == 0:
                    self._coordinator = peer
            elif kind in RUN_KINDS and peer in self._ranks:
                getattr(self, f"_run_{kind}")(header, frames[1])

    def _run_ready(self, header: dict[str, Any], _: bytes) -> None:
        self._ready = header
        self._ready_at = time.monotonic()
        self._settings = header["settings"]
        self._write(self._welcoming(0))
        for viewer in list(self._viewers.values()):
            if viewer.hello is not None and not viewer.welcomed:
                self._welcome(viewer)
        self._count()

    def _run_started(self, header: dict[str, Any], _: bytes) -> None:
        frame = header["frame"]
        self._frames[frame] = header
        while len(self._frames) > FRAMES_KNOWN:
            self._frames.popitem(last=False)
        if frame in self._early:
            early, payload = self._early.pop(frame)
            getattr(self, f"_run_{early['kind']}")(early, payload)

    def _wait_for_started(self, header: dict[str, Any], payload: bytes) -> None:
        self._early[header["frame"]] = header, payload
        while len(self._early) > 2:
            self._early.popitem(last=False)

    def _run_picture(self, header: dict[str, Any], payload: bytes) -> None:
        started = self._frames.get(header["frame"])
        if started is None:
            self._wait_for_started(header, payload)
            return
        started["width"], started["height"] = header["width"], header["height"]
        joined = {name: started.get(name) for name in ("view", "t", "viewer", "still", "scale")}
        sent = {name: header[name] for name in ("kind", "frame", "width", "height", "encoding")}
        self._picture = Parcel({**sent, **joined, "parts_ms": _parts_ms(started, header)}, payload)
        for viewer in self._viewers.values():
            if viewer.welcomed and viewer.pictures:
                viewer.show(self._picture)
                self._gathered.sent(len(payload))

    def _run_screenshot(self, header: dict[str, Any], payload: bytes) -> None:
        started = self._frames.get(header["frame"])
        if started is None:
            self._wait_for_started(header, payload)
            return
        asked = started["screenshot"]
        viewer = self._viewers.get(asked["viewer"])
        if viewer is not None and viewer.screenshots.pop(asked["request"], None) is not None:
            size = {"width": header["width"], "height": header["height"]}
            self._answer(viewer, Parcel({"kind": "screenshot", "request": asked["request"], **size}, payload))

    def _run_settings(self, header: dict[str, Any], _: bytes) -> None:
        self._settings = header["settings"]
        parcel = Parcel({"kind": "settings", "settings": self._settings})
        for viewer in self._viewers.values():
            if viewer.welcomed:
                viewer.latest(parcel)

    def _run_refused(self, header: dict[str, Any], _: bytes) -> None:
        viewer = self._viewers.get(header["viewer"])
        if viewer is not None:
            viewer.screenshots.pop(header["request"], None)
            self._refuse(viewer, header["request"], str(header["why"]))

    def _run_metrics(self, header: dict[str, Any], _: bytes) -> None:
        self._gathered.take(header)

    def _run_prediction(self, header: dict[str, Any], _: bytes) -> None:
        told = {"kind": "prediction", "ranks": header["ranks"]}
        self._prediction = Parcel(told)
        for viewer in self._viewers.values():
            if viewer.welcomed and viewer.metrics:
                viewer.latest(self._prediction)
        self._write(told)


def _parts_ms(started: dict[str, Any], picture: dict[str, Any]) -> dict[str, float]:
    """Where the time went from the camera's arrival here to that of its picture; of clocks of one host."""
    moments = {
        "to_run": started["asked_at"],
        "waiting": started["begun_at"],
        "drawing": picture["composed_at"],
        "queued": picture["encoding_at"],
        "encoding": picture["sent_at"],
        "to_hub": time.monotonic(),
    }
    parts, before = {}, started["camera_at"]
    for name, at in moments.items():
        if before is not None:
            parts[name] = round(1e3 * max(at - before, 0.0), 2)
        before = at
    return parts


def _name_of(bind: str) -> str:
    """How others reach an address that is listened on."""
    name = socket.gethostname() if bind in ("0.0.0.0", "::") else bind
    return f"[{name}]" if ":" in name else name
