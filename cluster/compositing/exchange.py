"""What crosses between two ranks that composite, and what a rank holds of the picture meanwhile."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ...shared.errors import MessageError
from ...shared.framebuffer_runs import HEAD_BYTES, encode_runs, merge_runs, most_bytes
from ...shared.messages import Framebuffer, Kind
from ..transport import Transport

_NOTHING = np.empty(0, np.uint8)


class Compositor(Protocol):
    """A policy, made ready for the ranks that take part."""

    def composite(self, frame: int, words: np.ndarray) -> np.ndarray | None:
        """(height, width) uint64 words of all ranks on the root, None elsewhere; ``words`` are what this rank drew.

        Collective over the ranks that take part, frame after frame in the same order; those other than the root go on
        as soon as their part is done. ``words`` are not changed. What is returned may be ``words``, or memory that the
        next frame is made in.
        Raises MessageError for what is no framebuffer of this frame and size.
        """
        ...


class Room:
    """Memory for copies of words, kept from frame to frame: the first touch of fresh pages takes longer than a copy."""

    def __init__(self) -> None:
        self._words = np.empty(0, np.uint64)

    def copy_of(self, words: np.ndarray) -> np.ndarray:
        """(n,) uint64 copy of (n,) words, until the next call."""
        if len(self._words) < len(words):
            self._words = np.empty(len(words), np.uint64)
        copied = self._words[: len(words)]
        copied[:] = words
        return copied


class Held:
    """What a rank holds of a picture: words that are not to be changed until something is merged, then a copy.

    words : (n,) uint64.  room : where the copy is made; None: the words may be changed.
    """

    def __init__(self, words: np.ndarray, room: Room | None) -> None:
        self.words = words
        self._room = room

    def merge(self, payload: memoryview) -> None:
        """Take the minimum with a part of as many pixels. Cost: none for an empty one."""
        if not len(payload):
            return
        if self._room is not None:
            self.words = self._room.copy_of(self.words)
            self._room = None
        merge_runs(payload, self.words)

    def narrow(self, first: int, stop: int) -> None:
        """Keep the pixels first … stop − 1."""
        self.words = self.words[first:stop]


def send_part(transport: Transport, dest: int, frame: int, words: np.ndarray) -> None:
    """Start sending (n,) uint64 words of a part of the picture; nothing but a header where all are background."""
    runs = encode_runs(words)
    transport.send(dest, Framebuffer(frame, runs if len(runs) > HEAD_BYTES else _NOTHING))


def receive_part(transport: Transport, source: int, frame: int, n_pixels: int) -> memoryview:
    """The payload for ``n_pixels`` pixels that a rank sends next. Raises MessageError if it is of another frame.

    The messages of a pair of ranks keep their order, and both go through the same rounds, so no round is named.
    """
    received = transport.receive(source, Kind.FRAMEBUFFER, most_bytes(n_pixels))
    if received.frame != frame:
        raise MessageError(f"framebuffer of rank {source}: found frame {received.frame}, expected frame {frame}")
    return received.payload
