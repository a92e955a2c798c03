"""Viewers, whatever the transport: what waits for each of them, what is under way, and how much they may say.

All of this belongs to the hub's loop. Nothing here grows with time or with how slow a viewer is: of pictures, metrics
and settings only the latest waits, and all viewers share the bytes of a picture.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable
from functools import cached_property
from typing import Any, Protocol

from .protocol import Hello, LiveMessage, to_binary, to_json

UNDER_WAY = 3
"""Pictures that a viewer may have without having acknowledged them."""
PATIENCE_S = 10.0
"""A viewer that takes nothing for this long while something waits for it is dropped."""
HELLO_S = 5.0
MESSAGES_PER_S = 200.0
"""What a viewer may say beside cameras; more ends it. Twice as many may come at once."""
CAMERAS_PER_S = 200.0
"""Cameras that are passed on; of more the latest counts. ``FLOOD_PER_S`` end the viewer."""
FLOOD_PER_S = 2000.0
CHANGES_PER_S = 60.0
"""Changes of settings that are passed on, each of which the run checks against its scene; more are refused."""
_BURST_S = 2.0
_ANSWERS = 32
_ANSWER_BYTES = 256 << 20
"""Of payloads that wait; one is taken in any case."""


class Parcel:
    """A message to viewers, coded once for all of them."""

    def __init__(self, header: dict[str, Any], payload: bytes = b"") -> None:
        self.header, self.payload = header, payload
        self._shared: Any = None

    def shared(self, make: Callable[[bytes], Any]) -> Any:
        """What ``make`` gave for the payload the first time: a transport's own form of it."""
        if self._shared is None:
            self._shared = make(self.payload)
        return self._shared

    @cached_property
    def text(self) -> bytes:
        """The header."""
        return to_json(self.header)

    @cached_property
    def binary(self) -> bytes:
        """The binary WebSocket message."""
        return to_binary(LiveMessage(self.header, self.payload))


class Outlet(Protocol):
    """The transport's side of a viewer. probed : whether only sending tells that the viewer has gone."""

    probed: bool

    async def send(self, parcel: Parcel) -> None:
        """Send; returns when the transport has taken it. Raises ConnectionError when the viewer has gone."""
        ...

    def waiting_bytes(self) -> int:
        """What the transport still has of it; falls while the viewer takes something."""
        ...

    def end(self, last: Parcel | None) -> None:
        """Close, if possible with a last message; returns at once."""
        ...


class Allowance:
    """So many a second, and as many at once as come together in ``_BURST_S``."""

    def __init__(self, per_s: float) -> None:
        self._per_s = per_s
        self._left = per_s * _BURST_S
        self._at = time.monotonic()

    def take(self) -> bool:
        """Whether one more is allowed."""
        now = time.monotonic()
        self._left = min(self._left + (now - self._at) * self._per_s, self._per_s * _BURST_S)
        self._at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Viewer:
    """One of those who look.

    number : what ranks and other messages call it.
    """

    def __init__(self, number: int, outlet: Outlet) -> None:
        self.number = number
        self.outlet = outlet
        self.hello: Hello | None = None
        self.welcomed = False
        self.pictures = self.metrics = False
        self.services = 0
        """Requests of its that a service works on or has waiting."""
        self.messages, self.cameras = Allowance(MESSAGES_PER_S), Allowance(CAMERAS_PER_S)
        self.flood, self.changes = Allowance(FLOOD_PER_S), Allowance(CHANGES_PER_S)
        self.late_camera: dict[str, Any] | None = None
        """The latest camera of those above the allowance."""
        self.sent_at = self.since = time.monotonic()
        self._answers: deque[Parcel] = deque()
        self._latest: dict[str, Parcel] = {}  # kind → what waits of it
        self._picture: Parcel | None = None
        self._picture_since = 0.0
        self._under_way: deque[int] = deque()
        self._sending_since: float | None = None
        self._waiting_bytes = 0
        self._sent_pictures = self._sent_bytes = 0
        self._wake = asyncio.Event()
        self._pump = asyncio.get_running_loop().create_task(self._send_all(), name=f"viewer {number}")
        self.gone = False

    def answer(self, parcel: Parcel) -> bool:
        """Send this, after what has been said before. False: too many wait, the viewer takes nothing."""
        n_bytes = sum(len(waiting.payload) for waiting in self._answers)
        if len(self._answers) >= _ANSWERS:
            return False
        if parcel.payload and n_bytes and n_bytes + len(parcel.payload) > _ANSWER_BYTES:
            return False
        self._answers.append(parcel)
        self._wake.set()
        return True

    def latest(self, parcel: Parcel) -> None:
        """Send this instead of what still waits of its kind."""
        self._latest[parcel.header["kind"]] = parcel
        self._wake.set()

    def show(self, picture: Parcel) -> None:
        """Send this picture, instead of one that still waits, once few enough are under way."""
        if self._picture is None:
            self._picture_since = time.monotonic()
        self._picture = picture
        self._wake.set()

    def acknowledged(self, frame: int) -> bool:
        """The viewer has shown a picture, and with it has done with those before. Whether it was under way."""
        if frame not in self._under_way:
            return False
        while self._under_way.popleft() != frame:
            pass
        self._picture_since = time.monotonic()
        self._wake.set()
        return True

    def subscribe(self, pictures: bool, metrics: bool) -> None:
        """What it wants from here on."""
        self.pictures, self.metrics = pictures, metrics
        if not pictures:
            self._picture = None
        if not metrics:
            self._latest.pop("metrics", None)
            self._latest.pop("prediction", None)

    def take_sent(self) -> tuple[int, int]:
        """How many pictures, and bytes of payloads, have been sent since it was asked last."""
        sent = self._sent_pictures, self._sent_bytes
        self._sent_pictures = self._sent_bytes = 0
        return sent

    def stalled(self, now: float) -> bool:
        """Whether it has taken nothing for ``PATIENCE_S`` while something waited for it."""
        waiting = self.outlet.waiting_bytes()
        if waiting < self._waiting_bytes:  # slow is not stalled
            self._picture_since = now
            if self._sending_since is not None:
                self._sending_since = now
        self._waiting_bytes = waiting
        since = [self._picture_since] if self._picture is not None else []
        since += [self._sending_since] if self._sending_since is not None else []
        return bool(since) and now - min(since) > PATIENCE_S

    def end(self, last: Parcel | None) -> None:
        """Stop sending, and close."""
        self.gone = True
        self._pump.cancel()
        self._answers.clear()
        self._latest.clear()
        self._picture = None
        self.outlet.end(last)

    def _next(self) -> Parcel | None:
        if self._answers:
            return self._answers.popleft()
        if self._latest:
            return self._latest.pop(next(iter(self._latest)))
        if self._picture is not None and len(self._under_way) < UNDER_WAY:
            picture, self._picture = self._picture, None
            self._under_way.append(picture.header["frame"])
            self._picture_since = time.monotonic()
            return picture
        return None

    async def _send_all(self) -> None:
        try:
            while True:
                await self._wake.wait()
                self._wake.clear()
                while (parcel := self._next()) is not None:
                    self._sending_since = time.monotonic()
                    await self.outlet.send(parcel)
                    self._sending_since = None
                    self.sent_at = time.monotonic()
                    self._sent_pictures += parcel.header["kind"] == "picture"
                    self._sent_bytes += len(parcel.payload)
        except (ConnectionError, RuntimeError):  # RuntimeError: a WebSocket that has never opened
            self.gone = True  # the hub's next round takes it away
