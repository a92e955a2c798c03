"""A scene by messages (``scene.delivery``): the sampling rank has it, the render rank asks for arrays as it loads.

Nobody keeps a list of what a run needs. The render rank's scene stands on ``ReceivedArrays``, which asks for an array
when something loads it, so what nothing loads does not cross. Arrays cross as they are stored: coded positions are
decoded where they are drawn. Checksums are those of ``scene.json``, compared on the render rank as ``scene.verify``
says.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..shared.errors import MessageError
from ..shared.messages import (
    MAX_OFFER_BYTES,
    MAX_REQUEST_BYTES,
    SCENE_PIECE_BYTES,
    Kind,
    SceneBytes,
    SceneInfo,
    SceneOffer,
    SceneRequest,
    decode_scene_bytes,
    decode_scene_offer,
    decode_scene_request,
)
from ..shared.store import Scene
from .transport import Transport

ASKED_AHEAD = 3
"""Requests under way at a time, so that the link does not wait for the next."""


def serve_scene(scene: Scene, colour: str, transport: Transport, rank: int) -> None:
    """Offer a scene to a rank and send it what it asks for, until it needs no more.

    colour : the run's colour mode, settled.  Raises MessageError for a request of what the scene has not.
    """
    transport.send(rank, SceneOffer(scene.info, colour))
    names = list(scene.info.arrays)
    while True:
        received = transport.receive(rank, Kind.SCENE_REQUEST, MAX_REQUEST_BYTES, patient=True)
        request = decode_scene_request(*received, scene.info)
        if not request.n_bytes:
            return
        stored = scene.stored_bytes(names[request.array])
        part = stored[request.first : request.first + request.n_bytes]
        transport.send(rank, SceneBytes(request.number, part))


def receive_scene(transport: Transport, rank: int) -> tuple[Scene, str]:
    """The scene that a rank offers, none of its arrays received yet, and the colour mode of the run.

    Raises MessageError for an offer that is none.
    """
    source = Path(f"scene of rank {rank}")
    offer = decode_scene_offer(transport.receive(rank, Kind.SCENE_OFFER, MAX_OFFER_BYTES).payload, source)
    return Scene(source, offer.info, ReceivedArrays(offer.info, transport, rank)), offer.colour


class ReceivedArrays:
    """The arrays of a scene that another rank serves (``array_source.ArraySource``), each asked for once and then kept.

    Raises MessageError for a reply that is not what was asked for, or where memory does not hold what is promised.
    """

    def __init__(self, info: SceneInfo, transport: Transport, rank: int) -> None:
        self._info = info
        self._transport = transport
        self._rank = rank
        self._held: dict[str, np.ndarray] = {}
        self._n_requests = 0
        self._released = False

    def load(self, name: str, mmap: bool) -> np.ndarray:
        """The array: read-only and shared, or a copy."""
        if self._released:
            raise RuntimeError(f"array {name} was loaded after the scene was released")  # nobody would answer
        if name not in self._held:
            promised = self._info.arrays[name]
            data = self._fetch(list(self._info.arrays).index(name), promised.bytes)
            self._held[name] = data.view(promised.dtype).reshape(promised.shape)
            self._held[name].flags.writeable = False
        return self._held[name] if mmap else self._held[name].copy()

    def chunks(self, name: str) -> Iterator[memoryview]:
        """The bytes of the array, in one piece."""
        yield self.load(name, mmap=True).reshape(-1).view(np.uint8).data

    def release(self) -> None:
        """Tell the other rank that no request will follow."""
        self._transport.send(self._rank, SceneRequest(self._n_requests, 0, 0, 0))
        self._held.clear()
        self._released = True

    def _fetch(self, array: int, n_bytes: int) -> np.ndarray:
        """(n_bytes,) uint8 of an array, in pieces, some of them asked for ahead."""
        try:
            data = np.empty(n_bytes, np.uint8)
        except (MemoryError, ValueError):
            name = list(self._info.arrays)[array]
            raise MessageError(
                f"scene of rank {self._rank}: {name} has {n_bytes} bytes, more than memory has"
            ) from None
        under_way: deque[SceneRequest] = deque()
        for first in range(0, n_bytes, SCENE_PIECE_BYTES):
            if len(under_way) == ASKED_AHEAD:
                self._take(under_way.popleft(), data)
            request = SceneRequest(self._n_requests, array, first, min(SCENE_PIECE_BYTES, n_bytes - first))
            self._transport.send(self._rank, request)
            self._n_requests += 1
            under_way.append(request)
        while under_way:
            self._take(under_way.popleft(), data)
        return data

    def _take(self, request: SceneRequest, data: np.ndarray) -> None:
        received = self._transport.receive(self._rank, Kind.SCENE_BYTES, request.n_bytes)
        data[request.first : request.first + request.n_bytes] = decode_scene_bytes(*received, request).data
