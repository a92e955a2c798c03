"""Tiles: every render rank sends the words of its window, and the display rank lays them side by side. What is in no
window stays background.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...shared.framebuffer_runs import merge_runs
from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.windows import Window
from ..transport import Transport
from .exchange import receive_part, send_part


class Tiles:
    """ranks : that draw, in the order of their windows; the first has the picture."""

    def __init__(self, transport: Transport, ranks: Sequence[int]) -> None:
        self._transport = transport
        self._ranks = ranks
        self._whole = np.empty((0, 0), np.uint64)

    def assemble(self, frame: int, words: np.ndarray, windows: Sequence[Window]) -> np.ndarray | None:
        """(height, width) uint64 words of all windows on the first rank, None elsewhere; collective.

        words : what this rank has drawn, not changed.  What is returned is valid until the next call.
        Raises MessageError for what is no framebuffer of this frame and window.
        """
        mine = self._ranks.index(self._transport.rank)
        if mine:
            part = np.ascontiguousarray(windows[mine].of(words)).reshape(-1)
            send_part(self._transport, self._ranks[0], frame, part)
            return None
        if self._whole.shape != words.shape:
            self._whole = np.full_like(words, FRAMEBUFFER_EMPTY)
        windows[0].of(self._whole)[:] = windows[0].of(words)
        for rank, window in zip(self._ranks[1:], windows[1:], strict=True):
            payload = receive_part(self._transport, rank, frame, window.n_pixels)
            tile = np.full(window.n_pixels, FRAMEBUFFER_EMPTY)
            if len(payload):
                merge_runs(payload, tile)
            part = window.of(self._whole)
            part[:] = tile.reshape(part.shape)
        return self._whole
