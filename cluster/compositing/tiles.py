"""Tiles: every render rank sends the words of its window, background left out, and the display rank lays them side by
side. Where a rank drew nothing in its window, a head is all that crosses.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...shared.errors import MessageError
from ...shared.framebuffer_runs import encode_runs, merge_runs, most_bytes
from ...shared.messages import FRAMEBUFFER_EMPTY, Framebuffer, Kind
from ...shared.windows import Window
from ..transport import Transport


class Tiles:
    """ranks : that draw, in the order of their windows; the first has the picture."""

    def __init__(self, transport: Transport, ranks: Sequence[int]) -> None:
        self._transport = transport
        self._ranks = ranks
        self._whole = np.empty((0, 0), np.uint64)

    def assemble(self, frame: int, words: np.ndarray, windows: Sequence[Window]) -> np.ndarray | None:
        """As of ``Assembler``. Raises MessageError for what is no framebuffer of this frame and window."""
        mine = self._ranks.index(self._transport.rank)
        if mine:
            runs = encode_runs(np.ascontiguousarray(windows[mine].of(words)).reshape(-1))
            self._transport.send(self._ranks[0], Framebuffer(frame, runs))
            return None
        if self._whole.shape != words.shape:
            self._whole = np.empty_like(words)
        windows[0].of(self._whole)[:] = windows[0].of(words)
        for rank, window in zip(self._ranks[1:], windows[1:], strict=True):
            received = self._transport.receive(rank, Kind.FRAMEBUFFER, most_bytes(window.n_pixels))
            if received.frame != frame:
                raise MessageError(f"framebuffer of rank {rank}: found frame {received.frame}, expected frame {frame}")
            tile = np.full(window.n_pixels, FRAMEBUFFER_EMPTY)
            merge_runs(received.payload, tile)
            window.of(self._whole)[:] = tile.reshape(window.y1 - window.y0, -1)
        return self._whole
