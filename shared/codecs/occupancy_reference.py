"""Occupancy coding of a few points, written to be read: contexts from sets of coordinates, no tables of neighbours.

Same bytes as ``occupancy``. The probabilities and the range coder are shared with it.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np

from .mixing import learn, learn_one, new_counters, new_weights, predict, predict_one, tables
from .range_coder import MOST_BYTES, finish_writing, start_writing, write_bit

Point = tuple[int, int, int]
_CHILDREN: list[Point] = [(c & 1, c >> 1 & 1, c >> 2) for c in range(8)]
_AROUND: list[Point] = [d for d in product((-1, 0, 1), (-1, 0, 1), (-1, 0, 1)) if any(d)]
_BEFORE = sorted((d for d in _AROUND if d[::-1] < (0, 0, 0)), key=lambda d: d[::-1])
_ACROSS_FACES: list[Point] = [(0, 0, 1), (0, 1, 0), (1, 0, 0), (-1, 0, 0), (0, -1, 0), (0, 0, -1)]


def encode_stream(points: Iterable[Point], bits: int) -> bytes:
    """The range coder's bytes of distinct points."""
    left, writer = set(points), _Writer(80 * (bits + 1) * len(set(points)))
    for n_left in range(bits, 0, -1):
        left -= _write_level(left, n_left, writer)
    return finish_writing(writer.state, writer.out).tobytes()


class _Writer:
    """The range coder and all that is learnt."""

    def __init__(self, most_answers: int):
        self.state, self.out = start_writing(), np.empty(MOST_BYTES * most_answers, np.uint8)
        self.stretch, self.squash, self.rate = tables()
        self.counters, self.weights = new_counters(255 * 64 + 2**14 + 2**16), new_weights(64)
        self.of_direct = new_counters(22)

    def child(self, contexts: list[int], which_weights: int, bit: int) -> None:
        """Whether a child is there."""
        logits, weights, at = np.empty(3, np.int64), self.weights[which_weights], np.array(contexts)
        probability = predict(self.counters, at, weights, self.stretch, self.squash, logits)
        write_bit(self.state, self.out, bit, probability)
        learn(self.counters, at, weights, self.rate, logits, probability, bit)

    def direct(self, n_left: int, bit: int) -> None:
        """Whether a node without neighbours holds a single point."""
        write_bit(self.state, self.out, bit, predict_one(self.of_direct[n_left]))
        self.of_direct[n_left] = learn_one(self.of_direct[n_left], self.rate, bit)

    def plain(self, value: int, n_bits: int) -> None:
        """Bits as they are, the highest first."""
        for i in reversed(range(n_bits)):
            write_bit(self.state, self.out, value >> i & 1, 1 << 15)


def _write_level(points: set[Point], n_left: int, writer: _Writer) -> set[Point]:
    """Write the nodes ``n_left`` levels above the points; return those written whole."""
    inside: dict[Point, list[Point]] = {}
    for point in points:
        inside.setdefault(_half(point, n_left), []).append(point)
    children = {_half(point, n_left - 1) for point in points}
    later, known, direct = set(inside), set(), set()
    for node in sorted(inside, key=_morton):
        later.remove(node)
        if not any(_add(node, d) in inside for d in _AROUND):
            writer.direct(n_left, len(inside[node]) == 1)
            if len(inside[node]) == 1:
                writer.plain(_morton(inside[node][0]), 3 * n_left)
                direct.add(inside[node][0])
                continue
        faces = sum((_add(node, d) in inside) << i for i, d in enumerate(_ACROSS_FACES))
        own = 0
        for c, corner in enumerate(_CHILDREN):
            child = _add((2 * node[0], 2 * node[1], 2 * node[2]), corner)
            bit = int(child in children)
            if c < 7 or own:
                there = [d for d in _AROUND if _add(child, d) in known]
                perhaps = [d for d in _AROUND if _half(_add(child, d), 1) in later]
                near = 2 * _touching(there, 1) + _touching(there, 2) + (_touching(there, 3) + 1) // 2
                far = len(perhaps) + _touching(perhaps, 1)
                pattern = sum((d in there) << i for i, d in enumerate(_BEFORE))
                contexts = [
                    ((1 << c) - 1 + own) * 64 + faces,
                    255 * 64 + ((c * 16 + min(near, 15)) * 16 + min(far, 15)) * 8 + own.bit_count(),
                    255 * 64 + 2**14 + c * 2**13 + pattern,
                ]
                writer.child(contexts, c * 8 + own.bit_count(), bit)
            if bit:
                own |= 1 << c
                known.add(child)
    return direct


def _touching(offsets: list[Point], n_axes: int) -> int:
    """How many share a face (one axis), an edge (two) or a corner (three)."""
    return sum(sum(map(abs, d)) == n_axes for d in offsets)


def _morton(point: Point) -> int:
    return sum((point[axis] >> bit & 1) << 3 * bit + axis for axis in range(3) for bit in range(21))


def _half(point: Point, times: int) -> Point:
    return point[0] >> times, point[1] >> times, point[2] >> times


def _add(a: Point, b: Point) -> Point:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
