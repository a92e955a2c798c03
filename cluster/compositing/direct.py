"""Direct: every render rank sends what it has drawn to the first, which takes the minimum rank after rank."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...shared.errors import MessageError
from ...shared.framebuffer_runs import encode_runs, merge_runs, most_bytes
from ...shared.messages import Framebuffer, Kind
from ...shared.windows import Window
from ..transport import Transport


class Direct:
    """ranks : that draw; the first has the picture."""

    def __init__(self, transport: Transport, ranks: Sequence[int]) -> None:
        self._transport = transport
        self._ranks = ranks

    def assemble(self, frame: int, words: np.ndarray, windows: Sequence[Window]) -> np.ndarray | None:
        """As of ``Assembler``.

        Raises MessageError for what is no framebuffer of this frame and size. Cost: the first rank receives and merges
        n − 1 framebuffers, background left out; the others send one and go on.
        """
        transport, root = self._transport, self._ranks[0]
        flat = words.reshape(-1)
        if transport.rank != root:
            transport.send(root, Framebuffer(frame, encode_runs(flat)))
            return None
        flat = flat.copy()  # the rasterizer's own is not to be changed
        for rank in self._ranks[1:]:
            received = transport.receive(rank, Kind.FRAMEBUFFER, most_bytes(len(flat)))
            if received.frame != frame:
                raise MessageError(f"framebuffer of rank {rank}: found frame {received.frame}, expected frame {frame}")
            merge_runs(received.payload, flat)
        return flat.reshape(words.shape)
