"""Run on two ranks by ``messages``: messages of given lengths from rank 0 to rank 1, cut into pieces.

``python -m splatpipe.cluster.stability.exchange PIECE_BYTES LENGTH …``; rank 1 sends the launcher the record ``wrong``,
the number of marked bytes that did not arrive as they were sent, or that are marked and should not be.
"""

from __future__ import annotations

import os
import sys

import numpy as np

from ...shared.messages import Kind, VisibilityBits
from ..launch import record
from ..transport import Transport

_TIMEOUT_S = 60.0


def marks(length: int, piece_bytes: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices around every border between pieces and at both ends of a body of this length, and their values."""
    borders = np.arange(0, length + piece_bytes, piece_bytes)
    index = np.unique(np.concatenate([borders + shift for shift in (-1, 0, 1)] + [[length - 1]]))
    index = index[(index >= 0) & (index < length)]
    return index, (1 + index % 251).astype(np.uint8)


def main(piece_bytes: int, lengths: list[int]) -> None:
    """One rank's part. Collective."""
    transport = Transport(_TIMEOUT_S, piece_bytes=piece_bytes)
    record(rank=transport.rank, role="exchange", pid=os.getpid())
    wrong = 0
    for frame, length in enumerate(lengths):
        index, value = marks(length, piece_bytes)
        if transport.rank == 0:
            body = np.zeros(length, np.uint8)
            body[index] = value
            transport.send(1, VisibilityBits(frame, 8 * length, body))
        else:
            received = transport.receive(0, Kind.VISIBILITY, length)
            body = np.frombuffer(received.payload, np.uint8)
            wrong += (received.frame != frame) + abs(len(body) - length)
            wrong += abs(int(np.count_nonzero(body)) - len(index)) + int((body[index] != value).sum())
    transport.finish()
    if transport.rank == 1:
        record(wrong=wrong)


if __name__ == "__main__":
    main(int(sys.argv[1]), [int(length) for length in sys.argv[2:]])
