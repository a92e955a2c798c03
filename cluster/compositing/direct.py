"""Direct: every rank sends what it has drawn to the root, which takes the minimum rank after rank."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..transport import Transport
from .exchange import Held, Room, receive_part, send_part


class Direct:
    """Cost: the root receives and merges n − 1 framebuffers, background left out; the others send one and go on."""

    def __init__(self, transport: Transport, ranks: Sequence[int]) -> None:
        self._transport = transport
        self._room = Room()
        self._root, self._others = ranks[0], ranks[1:]

    def composite(self, frame: int, words: np.ndarray) -> np.ndarray | None:
        """See ``Compositor``."""
        flat = words.reshape(-1)
        if self._transport.rank != self._root:
            send_part(self._transport, self._root, frame, flat)
            return None
        held = Held(flat, self._room)
        for rank in self._others:
            held.merge(receive_part(self._transport, rank, frame, len(flat)))
        return held.words.reshape(words.shape)
