"""Viewers that are programs, over ZeroMQ: what ``web`` is for pages.

A socket of ZeroMQ cannot be closed for one peer. One that was dropped is told so and not listened to for a while, then
it may say hello again.
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from ...shared.errors import MessageError
from .protocol import parse_json
from .sockets import Gone, Router, shared_frame
from .viewers import Parcel, Viewer

DEAF_S = 2.0
_MAX_DEAF = 4096
_RETRY_S = 0.02


class _ProgramOutlet:
    """A viewer's end."""

    probed = True

    def __init__(self, programs: Programs, peer: bytes) -> None:
        self._programs, self.peer = programs, peer

    async def send(self, parcel: Parcel) -> None:
        while not self._programs.send(self.peer, parcel):
            await asyncio.sleep(_RETRY_S)

    def waiting_bytes(self) -> int:
        return 0

    def end(self, last: Parcel | None) -> None:
        self._programs.end(self.peer, last)


class Programs:
    """Takes what programs say.

    connect, said, left : as for ``web.Site``.
    """

    def __init__(
        self,
        router: Router,
        connect: Callable[[_ProgramOutlet], Viewer | None],
        said: Callable[[Viewer, dict[str, Any]], None],
        left: Callable[[Viewer, str], None],
    ) -> None:
        self._router = router
        self._connect, self._said, self._left = connect, said, left
        self._viewers: dict[bytes, Viewer] = {}
        self._deaf_until: OrderedDict[bytes, float] = OrderedDict()

    def take(self, peer: bytes, frames: list[bytes]) -> None:
        """A peer has said something."""
        viewer = self._viewers.get(peer)
        if viewer is None and self._deaf_until.get(peer, 0.0) > time.monotonic():
            return
        try:
            if len(frames) != 2 or frames[1]:
                raise MessageError("message: expected a header, and a payload that is empty")
            header = parse_json(frames[0])
            if viewer is None:
                viewer = self._new(peer, header)
            self._said(viewer, header)
        except MessageError as error:
            if viewer is None:
                self.end(peer, Parcel({"kind": "bye", "why": str(error)}))
            else:
                self._left(viewer, str(error))

    def _new(self, peer: bytes, header: dict[str, Any]) -> Viewer:
        if header["kind"] != "hello":
            raise MessageError(f"{header['kind'][:40]!r}: expected hello first")
        viewer = self._connect(_ProgramOutlet(self, peer))
        if viewer is None:
            raise MessageError("too many viewers")
        self._viewers[peer] = viewer
        return viewer

    def send(self, peer: bytes, parcel: Parcel) -> bool:
        """Send without waiting; False: too much waits for this peer. Raises ConnectionError when it has gone."""
        payload = parcel.shared(shared_frame) if parcel.payload else b""
        try:
            return self._router.send(peer, parcel.text, payload)
        except Gone:
            raise ConnectionError from None

    def end(self, peer: bytes, last: Parcel | None) -> None:
        """Forget a peer, with last words if there are any; without, it may say hello again at once."""
        self._viewers.pop(peer, None)
        if last is None:
            return
        with suppress(ConnectionError):
            self.send(peer, last)
        now = time.monotonic()
        self._deaf_until[peer] = now + DEAF_S
        self._deaf_until.move_to_end(peer)
        while len(self._deaf_until) > _MAX_DEAF or next(iter(self._deaf_until.values())) < now:
            self._deaf_until.popitem(last=False)
