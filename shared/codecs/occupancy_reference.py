"""Occupancy coding of a few points, written to be read: contexts from sets of coordinates, no tables of neighbours.

Same bytes as ``occupancy``. The probabilities and the range coder are shared with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import product

import numpy as np

from .mixing import learn, new_counters, new_weights, predict, tables
from .range_coder import MOST_BYTES, finish_writing, start_writing, write_bit

Point = tuple[int, int, int]
_CHILDREN: list[Point] = [(c & 1, c >> 1 & 1, c >> 2) for c in range(8)]
_AROUND: list[Point] = [d for d in product((-1, 0, 1), (-1, 0, 1), (-1, 0, 1)) if any(d)]
_BEFORE = sorted((d for d in _AROUND if d[::-1] < (0, 0, 0)), key=lambda d: d[::-1])
_ACROSS_FACES: list[Point] = [(0, 0, 1), (0, 1, 0), (1, 0, 0), (-1, 0, 0), (0, -1, 0), (0, 0, -1)]


def encode_stream(points: Iterable[Point], bits: int) -> bytes:
    """The range coder's bytes of distinct points."""
    stretch, squash, rate = tables()
    counters, weights, logits = new_counters(255 * 64 + 2**14 + 2**16), new_weights(64, 3), np.empty(3, np.int64)
    state, out = start_writing(), np.empty(8 * MOST_BYTES * (bits + 1) * (len(list(points)) + 1), np.uint8)
    for level in range(bits):
        for contexts, which, bit in _answers({_half(p, bits - 1 - level) for p in points}):
            probability = predict(counters, np.array(contexts), weights[which], stretch, squash, logits)
            write_bit(state, out, bit, probability)
            learn(counters, np.array(contexts), weights[which], rate, logits, probability, bit)
    return finish_writing(state, out).tobytes()


def _answers(children: set[Point]) -> Iterator[tuple[list[int], int, int]]:
    """(contexts, set of weights, whether it is there) of each child of the nodes of a level."""
    nodes = {_half(child, 1) for child in children}
    known: set[Point] = set()
    passed: set[Point] = set()
    for node in sorted(nodes, key=_morton):
        passed.add(node)
        faces = sum((_add(node, d) in nodes) << i for i, d in enumerate(_ACROSS_FACES))
        own = 0
        for c, corner in enumerate(_CHILDREN):
            child = _add((2 * node[0], 2 * node[1], 2 * node[2]), corner)
            if c == 7 and own == 0:
                known.add(child)
                continue
            there = [d for d in _AROUND if _add(child, d) in known]
            later = [d for d in _AROUND if _half(_add(child, d), 1) in nodes - passed]
            near = 2 * _touching(there, 1) + _touching(there, 2) + (_touching(there, 3) + 1) // 2
            perhaps = len(later) + _touching(later, 1)
            pattern = sum((d in there) << i for i, d in enumerate(_BEFORE))
            contexts = [
                ((1 << c) - 1 + own) * 64 + faces,
                255 * 64 + ((c * 16 + min(near, 15)) * 16 + min(perhaps, 15)) * 8 + own.bit_count(),
                255 * 64 + 2**14 + c * 2**13 + pattern,
            ]
            bit = int(child in children)
            yield contexts, c * 8 + own.bit_count(), bit
            if bit:
                own |= 1 << c
                known.add(child)


def _touching(offsets: list[Point], n_axes: int) -> int:
    """How many share a face (one axis), an edge (two) or a corner (three)."""
    return sum(sum(map(abs, d)) == n_axes for d in offsets)


def _morton(point: Point) -> int:
    return sum((point[axis] >> bit & 1) << 3 * bit + axis for axis in range(3) for bit in range(21))


def _half(point: Point, times: int) -> Point:
    return point[0] >> times, point[1] >> times, point[2] >> times


def _add(a: Point, b: Point) -> Point:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
