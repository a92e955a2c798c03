"""Compositing in rounds: in each, ranks in groups of k cut what they hold into k parts, and each is sent one of them.

After rounds of k₁, k₂, … each of m = k₁ k₂ … ranks holds 1/m of the picture, complete, and the root gathers them. Ranks
beyond m send what they have drawn to a rank below m before the first round. One round of n is direct-send, rounds of
two are binary swap.

No round can block another: between two ranks there is at most one message a round and way, a rank sends before it
receives, and what it sent in earlier rounds has been taken by all ranks that are not behind it. Ranks may be ahead by
rounds and frames; messages of a pair keep their order.

Source: Peterka, Goodell, Ross, Shen, Thakur, "A Configurable Algorithm for Parallel Image-Compositing Applications",
SC 2009.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ..transport import Transport
from .exchange import Held, Room, receive_part, send_part


def k_values(n_ranks: int, radix: int) -> tuple[int, ...]:
    """Group sizes of the rounds, none above ``radix`` ≥ 2, for as many of ``n_ranks`` as have such factors.

    The fewest ranks are left over (n − product); of the groups the largest come first, where parts are largest and few
    rounds are left.
    """
    n_met = n_ranks
    while True:
        rest, values = n_met, []
        while rest > 1:
            k = next((k for k in range(min(radix, rest), 1, -1) if rest % k == 0), 0)
            if not k:
                break
            values.append(k)
            rest //= k
        if rest == 1:
            return tuple(values)
        n_met -= 1


def border(n_pixels: int, part: int, parts: int) -> int:
    """First pixel of a part where n pixels are cut into parts as even as can be."""
    return n_pixels * part // parts


def part_held(position: int, values: Sequence[int], n_pixels: int) -> tuple[int, int]:
    """First pixel, and that after the last, of what the rank at a position holds after all rounds."""
    first, stop = 0, n_pixels
    for k in values:
        position, digit = divmod(position, k)
        first, stop = (first + border(stop - first, part, k) for part in (digit, digit + 1))
    return first, stop


class Rounds:
    """Rounds of groups of ``values``; ``ranks`` beyond their product fold into the first ones.

    Cost: a rank sends and merges less than a picture in all rounds together, and the root gathers another.
    """

    def __init__(self, transport: Transport, ranks: Sequence[int], values: Sequence[int]) -> None:
        self._transport = transport
        self._ranks = ranks
        self._values = values
        self._rooms = Room(), Room()  # of what is held, and of the whole picture
        self._n_met = math.prod(values)
        self._position = ranks.index(transport.rank)

    def composite(self, frame: int, words: np.ndarray) -> np.ndarray | None:
        """See ``Compositor``."""
        flat = words.reshape(-1)
        held = Held(flat, self._rooms[0])
        self._fold(frame, held)
        if self._position < self._n_met:
            for place, group in self._groups():
                self._exchange(frame, held, place, group)
        whole = self._gather(frame, flat, held)
        return None if whole is None else whole.reshape(words.shape)

    def _groups(self) -> Iterator[tuple[int, list[int]]]:
        """Of each round: this rank's place in its group, and the ranks of the group."""
        stride = 1
        for k in self._values:
            place = self._position // stride % k
            yield place, [self._ranks[self._position + (other - place) * stride] for other in range(k)]
            stride *= k

    def _fold(self, frame: int, held: Held) -> None:
        if self._position >= self._n_met:
            send_part(self._transport, self._ranks[self._position - self._n_met], frame, held.words)
        elif self._position + self._n_met < len(self._ranks):
            source = self._ranks[self._position + self._n_met]
            held.merge(receive_part(self._transport, source, frame, len(held.words)))

    def _exchange(self, frame: int, held: Held, place: int, group: list[int]) -> None:
        k = len(group)
        borders = [border(len(held.words), part, k) for part in range(k + 1)]
        following = [(place + step) % k for step in range(1, k)]  # so that not all send to the same one first
        for other in following:
            if borders[other] < borders[other + 1]:
                send_part(self._transport, group[other], frame, held.words[borders[other] : borders[other + 1]])
        held.narrow(borders[place], borders[place + 1])
        if len(held.words):
            for other in reversed(following):
                held.merge(receive_part(self._transport, group[other], frame, len(held.words)))

    def _gather(self, frame: int, flat: np.ndarray, held: Held) -> np.ndarray | None:
        """All parts on the root: what it has drawn elsewhere is not nearer than what the others hold by now."""
        if self._position:
            if self._position < self._n_met and len(held.words):
                send_part(self._transport, self._ranks[0], frame, held.words)
            return None
        if len(self._ranks) == 1:
            return flat
        whole = self._rooms[1].copy_of(flat)
        whole[: len(held.words)] = held.words
        for position in range(1, self._n_met):
            first, stop = part_held(position, self._values, len(flat))
            if first < stop:
                part = Held(whole[first:stop], None)
                part.merge(receive_part(self._transport, self._ranks[position], frame, stop - first))
        return whole
