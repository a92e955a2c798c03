"""Who is connected to whom in a live run: the run's pictures to all viewers, what viewers want to the run.

It knows viewers and the run but no transport, and belongs to the hub's loop. It waits for nobody.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from ...shared.errors import InputError, MessageError
from .asked import Services, Worker
from .gathered import Gathered, parts_ms
from .protocol import (
    PROTOCOL_VERSION,
    RUN_KINDS,
    Acknowledged,
    Bye,
    CameraMoved,
    Hello,
    ScreenshotWanted,
    SettingsWanted,
    Subscribed,
    ViewerMessage,
    said_by_viewer,
)
from .screenshots import Screenshots
from .viewers import CAMERAS_PER_S, CHANGES_PER_S, FLOOD_PER_S, HELLO_S, MESSAGES_PER_S, Outlet, Parcel, Viewer

MAX_VIEWERS = 256
FRAMES_KNOWN = 64
"""Pictures of which the hub still knows from where they were taken."""
METRICS_S = 0.5
PROBE_S = 10.0
"""A program that has been sent nothing for so long is sent the settings once more, which tells whether it is there."""


class Switchboard:
    """Viewers on one side, the run on the other.

    to_run : sends a header to rank 0 without waiting; False: it has not been sent.
    write : takes what is to be recorded.  version : of splatpipe.  host : of the hub.
    """

    def __init__(
        self,
        services: Services,
        to_run: Callable[[dict[str, Any]], bool],
        write: Callable[[dict[str, Any]], None],
        version: str,
        host: str,
    ) -> None:
        self._worker = Worker(services, self._answer)
        self._screenshots = Screenshots(to_run, self._refuse_number)
        self._to_run, self._write, self._version = to_run, write, version
        self._viewers: dict[int, Viewer] = {}
        self._numbers = 0
        self._closed = False
        self._ready: dict[str, Any] | None = None
        self._ready_at = self._told_at = 0.0
        self._settings: dict[str, Any] = {}
        self._frames: OrderedDict[int, dict[str, Any]] = OrderedDict()  # frame → its "started"
        self._early: OrderedDict[tuple[str, int], tuple[dict[str, Any], bytes]] = (
            OrderedDict()
        )  # before their "started"
        self._picture: Parcel | None = None
        self._prediction: Parcel | None = None
        self._shown = self._shown_told = -1
        self._camera: dict[str, Any] | None = None
        self._n_watching = -1
        self._predicted: dict[str, float] = {}
        self._predicting: asyncio.Task[None] | None = None
        self._host = host
        self._gathered = Gathered(host)
        self.unexpected: Exception | None = None
        """The first error of the hub's own that a message has brought about."""

    # --- viewers ---

    def connect(self, outlet: Outlet) -> Viewer | None:
        """A new viewer, who has not said hello; None where there are too many."""
        if len(self._viewers) >= MAX_VIEWERS or self._closed:
            return None
        self._numbers += 1
        viewer = self._viewers[self._numbers] = Viewer(self._numbers, outlet)
        return viewer

    def leave(self, viewer: Viewer, why: str = "") -> None:
        """It has gone or, for a reason, goes now."""
        if self._viewers.pop(viewer.number, None) is not None:
            viewer.end(Parcel({"kind": "bye", "why": why}) if why else None)
            self._screenshots.forget(viewer.number)
            self._count()

    def hear(self, viewer: Viewer, header: dict[str, Any]) -> None:
        """A viewer says something. Raises MessageError where it is to be dropped for it."""
        if viewer.gone or self._closed:
            return
        try:
            self._hear(viewer, header)
        except MessageError:
            raise
        except Exception as error:  # a message may cost its viewer the connection, and nobody else anything
            self.unexpected = self.unexpected or error
            raise MessageError(f"{header['kind'][:40]}: not understood ({type(error).__name__})") from error

    def _hear(self, viewer: Viewer, header: dict[str, Any]) -> None:
        if header["kind"] == "camera" and not viewer.cameras.take():
            self._put_off(viewer, header)
            return
        if header["kind"] != "camera" and not viewer.messages.take():
            raise MessageError(f"found more than {MESSAGES_PER_S:g} messages a second")
        message = said_by_viewer(header)
        if viewer.hello is None:
            self._greet(viewer, message)
        elif isinstance(message, CameraMoved):
            viewer.late_camera = None
            self._move(viewer, message)
        elif isinstance(message, Acknowledged):
            if viewer.acknowledged(message.frame) and message.frame > self._shown:
                self._first_shown(message.frame)
        elif isinstance(message, Subscribed):
            self._subscribe(viewer, message)
        elif isinstance(message, Bye):
            self.leave(viewer)
        else:
            try:
                self._ask(viewer, message)
            except InputError as error:
                self._refuse(viewer, getattr(message, "request", 0), str(error))

    def _greet(self, viewer: Viewer, message: ViewerMessage) -> None:
        if not isinstance(message, Hello):
            raise MessageError("found another message, expected hello first")
        if message.protocol != PROTOCOL_VERSION:
            raise MessageError(f"protocol: found {message.protocol}, expected {PROTOCOL_VERSION}")
        viewer.hello = message
        viewer.subscribe(message.pictures, message.metrics)
        if self._ready is not None:
            self._welcome(viewer)

    def _welcome(self, viewer: Viewer) -> None:
        viewer.welcomed = True
        self._answer(viewer, Parcel(self._welcoming(viewer.number)))
        self._give_what_there_is(viewer)
        self._count()

    def _welcoming(self, number: int) -> dict[str, Any]:
        head = {"kind": "welcome", "protocol": PROTOCOL_VERSION, "version": self._version, "viewer": number}
        ready = self._ready or {}
        return {**head, **{name: ready.get(name) for name in ("run", "view", "choices")}, "settings": self._settings}

    def _give_what_there_is(self, viewer: Viewer) -> None:
        if viewer.pictures and self._picture is not None:
            viewer.show(self._picture)
        if viewer.metrics and self._prediction is not None:
            viewer.latest(self._prediction)

    def _subscribe(self, viewer: Viewer, wanted: Subscribed) -> None:
        had = viewer.pictures, viewer.metrics
        viewer.subscribe(wanted.pictures, wanted.metrics)
        if viewer.welcomed and (wanted.pictures, wanted.metrics) != had:
            self._give_what_there_is(viewer)
            self._count()

    def _count(self) -> None:
        """Tell the run how many want pictures, if that has changed."""
        n = sum(viewer.welcomed and viewer.pictures for viewer in self._viewers.values())
        told = n == self._n_watching or self._ready is None or self._closed
        if not told and self._to_run({"kind": "viewers", "pictures": n}):
            self._n_watching = n

    def _put_off(self, viewer: Viewer, header: dict[str, Any]) -> None:
        """A camera above what is allowed: heard a little later, unless there is another by then."""
        if not viewer.flood.take():
            raise MessageError(f"found more than {FLOOD_PER_S:g} cameras a second")
        if viewer.late_camera is None:
            asyncio.get_running_loop().call_later(1 / CAMERAS_PER_S, self._hear_late, viewer)
        viewer.late_camera = header

    def _hear_late(self, viewer: Viewer) -> None:
        late, viewer.late_camera = viewer.late_camera, None
        if late is not None:
            try:
                self.hear(viewer, late)
            except MessageError as error:
                self.leave(viewer, str(error))

    def _move(self, viewer: Viewer, moved: CameraMoved) -> None:
        if self._ready is None:
            return
        if self._camera is None:
            asyncio.get_running_loop().call_soon(self._send_camera)  # once for all that come in this turn
        self._camera = {**moved.model_dump(), "viewer": viewer.number, "at": time.monotonic()}

    def _send_camera(self) -> None:
        camera = self._camera
        if camera is not None and not self._closed and self._to_run(camera):
            self._camera = None

    def _first_shown(self, frame: int) -> None:
        self._shown = frame
        self._tell_shown()
        at = self._frames.get(frame, {}).get("camera_at")
        if at is not None:
            self._gathered.shown(time.monotonic() - at)

    def _tell_shown(self) -> None:
        if self._shown > self._shown_told and self._to_run({"kind": "shown", "frame": self._shown}):
            self._shown_told = self._shown

    def _ask(self, viewer: Viewer, message: Any) -> None:
        """Raises InputError for what is refused."""
        if isinstance(message, Hello):
            raise MessageError("hello: said already")
        if self._ready is None:
            raise InputError("the run has not started yet")
        asked = {"viewer": viewer.number, "request": message.request}
        if isinstance(message, SettingsWanted):
            if not viewer.changes.take():
                raise InputError(f"found more than {CHANGES_PER_S:g} changes a second")
            if not self._to_run({"kind": "settings", "set": message.set, **asked}):
                raise InputError("the run is behind; try again")
        elif isinstance(message, ScreenshotWanted):
            self._screenshots.ask(viewer.number, message)
        else:
            frame = self._frames.get(getattr(message, "frame", -1), {})
            if message.kind == "pick" and "width" not in frame:
                raise InputError(f"picture {message.frame} is not known any more")
            self._worker.ask(viewer, message, frame, dict(self._settings))

    def _refuse(self, viewer: Viewer, request: int, why: str) -> None:
        self._answer(viewer, Parcel({"kind": "refused", "request": request, "why": why}))

    def _refuse_number(self, number: int, request: int, why: str) -> None:
        viewer = self._viewers.get(number)
        if viewer is not None:
            self._refuse(viewer, request, why)

    def _answer(self, viewer: Viewer, parcel: Parcel) -> None:
        if not viewer.gone and not viewer.answer(parcel):
            self.leave(viewer, "takes no answers")

    # --- the run ---

    def from_run(self, header: dict[str, Any], payload: bytes) -> None:
        """A rank says something. What is wrong is left out: ranks are of this version, and none may end the hub."""
        if header["kind"] not in RUN_KINDS or self._closed:
            return
        with suppress(MessageError, LookupError, TypeError, ValueError, AttributeError):
            getattr(self, f"_run_{header['kind']}")(header, payload)

    def _run_hello(self, header: dict[str, Any], payload: bytes) -> None:
        """Of a rank that has connected again; what was told to rank 0 before may be lost."""
        self._n_watching = -1

    def _run_ready(self, header: dict[str, Any], payload: bytes) -> None:
        self._settings = header["settings"]
        self._ready, self._ready_at = header, time.monotonic()
        self._write(self._welcoming(0))
        for viewer in list(self._viewers.values()):
            if viewer.hello is not None and not viewer.welcomed:
                self._welcome(viewer)
        self._count()

    def _run_started(self, header: dict[str, Any], payload: bytes) -> None:
        frame = header["frame"]
        self._frames[frame] = header
        while len(self._frames) > FRAMES_KNOWN:
            self._frames.popitem(last=False)
        for kind in ("picture", "screenshot"):
            if (kind, frame) in self._early:
                self.from_run(*self._early.pop((kind, frame)))

    def _started(self, header: dict[str, Any], payload: bytes) -> dict[str, Any] | None:
        """What rank 0 said of a frame; None: it comes from another rank and is still to come, and this waits for it."""
        started = self._frames.get(header["frame"])
        if started is None:
            self._early[header["kind"], header["frame"]] = header, payload
            while len(self._early) > 2:
                self._early.popitem(last=False)
        return started

    def _run_picture(self, header: dict[str, Any], payload: bytes) -> None:
        started = self._started(header, payload)
        if started is None:
            return
        started.update(width=header["width"], height=header["height"])
        sent = {name: header[name] for name in ("kind", "frame", "width", "height", "encoding")}
        begun = {name: started.get(name) for name in ("view", "t", "viewer", "still", "scale")}
        self._picture = Parcel({**sent, **begun, "parts_ms": parts_ms(started, header, self._host)}, payload)
        for viewer in self._viewers.values():
            if viewer.welcomed and viewer.pictures:
                viewer.show(self._picture)

    def _run_screenshot(self, header: dict[str, Any], payload: bytes) -> None:
        started = self._started(header, payload)
        if started is None:
            return
        asked = started["screenshot"]
        viewer = self._viewers.get(asked["viewer"])
        if self._screenshots.done(asked["viewer"], asked["request"]) and viewer is not None:
            size = {"width": header["width"], "height": header["height"]}
            self._answer(viewer, Parcel({"kind": "screenshot", "request": asked["request"], **size}, payload))

    def _run_settings(self, header: dict[str, Any], payload: bytes) -> None:
        self._settings = header["settings"]
        parcel = Parcel({"kind": "settings", "settings": self._settings})
        for viewer in self._viewers.values():
            if viewer.welcomed:
                viewer.latest(parcel)

    def _run_refused(self, header: dict[str, Any], payload: bytes) -> None:
        if header.get("of") == "screenshot":
            self._screenshots.done(header["viewer"], header["request"])
        self._refuse_number(header["viewer"], header["request"], str(header["why"]))

    def _run_metrics(self, header: dict[str, Any], payload: bytes) -> None:
        self._gathered.take(header)

    def _run_prediction(self, header: dict[str, Any], payload: bytes) -> None:
        self._tell({"kind": "prediction", "ranks": header["ranks"]})

    def _tell(self, header: dict[str, Any]) -> None:
        """To who wants metrics, and to the record."""
        parcel = Parcel(header)
        if header["kind"] == "prediction":
            self._prediction = parcel
        for viewer in self._viewers.values():
            if viewer.welcomed and viewer.metrics:
                viewer.latest(parcel)
        self._write(header)

    # --- time ---

    def tick(self) -> None:
        """To be called a few times a second: drops who does not do his part, and tells metrics."""
        now = time.monotonic()
        for viewer in list(self._viewers.values()):
            self._look_after(viewer, now)
        self._send_camera()
        self._tell_shown()
        self._screenshots.tick()
        self._count()
        if self._ready is not None and now - self._told_at >= METRICS_S:
            self._told_at = now
            pictures, n_bytes = self._sent()
            n_viewers = sum(viewer.welcomed for viewer in self._viewers.values())
            self._tell(self._gathered.message(now - self._ready_at, n_viewers, pictures, n_bytes))
            self._predict()

    def _predict(self) -> None:
        """Have it worked out, if anybody looks at it, what the model expects of frames as they are now."""
        counts = self._gathered.counts()
        wanted = any(viewer.welcomed and viewer.metrics for viewer in self._viewers.values())
        if wanted and counts and counts != self._predicted and (self._predicting is None or self._predicting.done()):
            self._predicted = counts
            self._predicting = asyncio.get_running_loop().create_task(self._tell_prediction(counts))

    async def _tell_prediction(self, counts: dict[str, float]) -> None:
        ranks = await self._worker.expected(len((self._ready or {})["run"]["ranks"]), counts)
        if ranks and not self._closed:
            self._tell({"kind": "prediction", "ranks": ranks})

    def _look_after(self, viewer: Viewer, now: float) -> None:
        if viewer.gone:
            self.leave(viewer)
        elif viewer.hello is None and now - viewer.since > HELLO_S:
            self.leave(viewer, f"no hello within {HELLO_S:g} s")
        elif viewer.stalled(now):
            self.leave(viewer, "takes nothing")
        else:
            if viewer.welcomed and now - viewer.sent_at > PROBE_S and viewer.outlet.probed:
                viewer.latest(Parcel({"kind": "settings", "settings": self._settings}))

    def _sent(self) -> tuple[int, int]:
        """Pictures and bytes sent to viewers since it was asked last."""
        sent = [viewer.take_sent() for viewer in self._viewers.values()]
        return sum(pictures for pictures, _ in sent), sum(n_bytes for _, n_bytes in sent)

    def close(self, why: str) -> None:
        """Say bye to all."""
        self._to_run({"kind": "quit"})
        self._closed = True
        for viewer in list(self._viewers.values()):
            self.leave(viewer, why)

    def close_worker(self) -> None:
        """Wait for the services."""
        self._worker.close()
