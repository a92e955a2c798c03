"""A film of pictures that several ranks have drawn: in order, no more of them at a time than may be, none of another."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from splatpipe.cluster import film as module
from splatpipe.cluster.film import GatheredFilm, SentFilm
from splatpipe.cluster.sink import film_rgb
from splatpipe.cluster.transport import Received
from splatpipe.shared.errors import MessageError
from splatpipe.shared.messages import FilmPicture, Kind, encode, parse_header

HEIGHT, WIDTH = 5, 7


class Encoder:
    """In place of an encoder: keeps the first byte of each picture, which is its number."""

    def __init__(self, path: Path, fps: float) -> None:
        self.numbers: list[int] = []
        self.times: list[float] = []
        self.kept: bool | None = None

    def put(self, rgba: np.ndarray) -> None:
        rgb = film_rgb(rgba)
        assert rgb.shape == (HEIGHT - 1, WIDTH - 1, 3)
        self.numbers.append(int(rgb[0, 0, 0]))

    def close(self, keep: bool) -> None:
        self.kept = keep


class Wire:
    """In place of a transport: messages to rank 0 by rank, in their order."""

    def __init__(self, n_ranks: int) -> None:
        self.sent: list[list[FilmPicture]] = [[] for _ in range(n_ranks)]

    def of(self, rank: int) -> "Wire":
        self.rank = rank
        return self

    def send(self, dest: int, message: FilmPicture) -> None:
        assert dest == 0
        self.sent[self.rank].append(message)

    def receive(self, source: int, expected: Kind, max_bytes: int) -> Received:
        head, payload = encode(self.sent[source].pop(0))
        kind, frame, length = parse_header(head)
        assert (kind, length) == (expected, len(payload))
        assert length <= max_bytes
        return Received(frame, payload)


def picture(number: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 4), number, np.uint8)


@pytest.fixture(autouse=True)
def encoder(monkeypatch):
    monkeypatch.setattr(module, "H264Film", Encoder)


@given(st.integers(1, 12), st.integers(1, 5))
def test_pictures_are_encoded_in_their_order_whoever_has_drawn_them(n_pictures, n_ranks):
    wire = Wire(n_ranks)
    pictures = [range(rank, n_pictures, n_ranks) for rank in range(n_ranks)]
    for rank in range(1, n_ranks):
        for number in pictures[rank]:
            SentFilm(wire.of(rank), [number]).put(picture(number))
    film = gathered(wire, pictures)
    for number in pictures[0]:
        film.put(picture(number))
        assert film._film.numbers == list(range(number + 1)), "no more than those up to its own"
    film.close(keep=True)
    assert film._film.numbers == list(range(n_pictures))
    assert film._film.kept
    assert not any(wire.sent)


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        (FilmPicture(2, film_rgb(picture(2))), "from rank 1: found picture 2 of 72 bytes, expected 1 of 72"),
        (FilmPicture(1, film_rgb(picture(1))[:2]), "from rank 1: found picture 1 of 36 bytes, expected 1 of 72"),
    ],
)
def test_what_is_not_the_next_picture_is_refused_and_no_film_is_left(sent, expected):
    wire = Wire(2)
    wire.sent[1].append(sent)
    film = gathered(wire, [[0], [1]])
    film.put(picture(0))
    with pytest.raises(MessageError, match=expected):
        film.close(keep=True)
    assert film._film.kept is False


def test_a_run_that_failed_waits_for_no_picture():
    film = gathered(Wire(2), [[0], [1]])
    film.close(keep=False)
    assert film._film.kept is False


def gathered(wire: Wire, pictures) -> GatheredFilm:
    return GatheredFilm(Path("film.mp4"), 30.0, wire, pictures, WIDTH, HEIGHT)
