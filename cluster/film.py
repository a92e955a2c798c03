"""One film of the pictures that several ranks have drawn: they send them to rank 0, which encodes them in order.

Picture i is drawn by rank i mod n (``frame_parallel``). Before rank 0 adds one of its own it takes those between, which
have been drawn meanwhile. It waits for the next picture only, and whoever has drawn that waits for none before it:
there is no deadlock, and a rank is at most the messages that may be under way ahead of the film. So is memory bounded.
The film is the one that a single rank makes: one encoder has seen the same pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..shared.errors import MessageError
from ..shared.messages import FilmPicture, Kind
from .sink import H264Film, film_rgb, film_size
from .transport import Transport


class SentFilm:
    """On the other ranks: pictures leave for rank 0. pictures : numbers of those that this rank draws, ascending."""

    def __init__(self, transport: Transport, pictures: Sequence[int]) -> None:
        self._transport = transport
        self._numbers = iter(pictures)
        self.times: list[float] = []

    def put(self, rgba: np.ndarray) -> None:
        """Send the next picture; waits while rank 0 is behind."""
        self._transport.send(0, FilmPicture(next(self._numbers), film_rgb(rgba)))

    def close(self, keep: bool) -> None:
        """Nothing: rank 0 has the film."""


class GatheredFilm:
    """On rank 0: the film of all pictures.

    pictures : of each rank, ascending; that with the lowest number is rank 0's.  width, height : of each, pixels.
    """

    def __init__(
        self, path: Path, fps: float, transport: Transport, pictures: Sequence[Sequence[int]], width: int, height: int
    ) -> None:
        self._transport = transport
        self._left = sorted(((number, rank) for rank, of in enumerate(pictures) for number in of), reverse=True)
        self._shape = (*film_size(height, width), 3)
        self._film = H264Film(path, fps)
        self.times = self._film.times

    def put(self, rgba: np.ndarray) -> None:
        """Add the next picture of this rank behind those of others that come before it."""
        self._take_others()
        self._left.pop()
        self._film.put(rgba)

    def close(self, keep: bool) -> None:
        """As of ``Film``. Takes what other ranks have still to send. Raises MessageError."""
        try:
            if keep:
                self._take_others()
        except BaseException:
            self._film.close(keep=False)
            raise
        self._film.close(keep)

    def _take_others(self) -> None:
        """Add pictures up to the next one of this rank."""
        while self._left and self._left[-1][1]:
            number, rank = self._left.pop()
            n_bytes = int(np.prod(self._shape))
            received = self._transport.receive(rank, Kind.FILM_PICTURE, n_bytes)
            found = received.frame, len(received.payload)
            if found != (number, n_bytes):
                raise MessageError(
                    f"film: from rank {rank}: found picture {found[0]} of {found[1]} bytes, "
                    f"expected {number} of {n_bytes}"
                )
            self._film.put(np.frombuffer(received.payload, np.uint8).reshape(self._shape))
