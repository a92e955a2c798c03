"""Direct: every rank sends what it has drawn to rank 0, which takes the minimum rank after rank."""

from __future__ import annotations

import numpy as np

from ...shared.errors import MessageError
from ...shared.framebuffer_runs import encode_runs, merge_runs, most_bytes
from ...shared.messages import Framebuffer, Kind
from ..transport import Transport


def composite(frame: int, words: np.ndarray, transport: Transport) -> np.ndarray | None:
    """(height, width) uint64 words of all ranks on rank 0, None elsewhere; ``words`` are what this rank has drawn.

    Raises MessageError for what is no framebuffer of this frame and size. Cost: rank 0 receives and merges n − 1
    framebuffers, background left out; the others send one and go on.
    """
    flat = words.reshape(-1)
    if transport.rank:
        transport.send(0, Framebuffer(frame, encode_runs(flat)))
        return None
    flat = flat.copy()  # the rasterizer's own is not to be changed
    for rank in range(1, transport.size):
        received = transport.receive(rank, Kind.FRAMEBUFFER, most_bytes(len(flat)))
        if received.frame != frame:
            raise MessageError(f"framebuffer of rank {rank}: found frame {received.frame}, expected frame {frame}")
        merge_runs(received.payload, flat)
    return flat.reshape(words.shape)
