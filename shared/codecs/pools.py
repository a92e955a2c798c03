"""Vertex–transformation pools: points as vertices and translations, and a tag a vertex that says which of them meet.

A pool of v vertices and m translations holds the points vertex + translation whose bit is set in the vertex's *tag*:
bit i of word w stands for translation 32·w + i. Its points stand in the order of the vertices, those of a vertex in
the order of the translations. No point is covered twice.

``pools_reference`` is the readable twin of the greedy choice.

Source: Kim, Lee, Varshney, "Vertex Transformation Streams", sections 3 and 4. Readings taken where the paper can be
read in two ways:

- *Rows.* A tag holds so many translations (the paper: 88, ours 32, 64, 96, …), the best column may have more: the most
  common ones are taken, and k is the number of those that are.
- *Width of the tags*, where the caller leaves it open: the one with which the pool saves most bytes.
- *Updates.* The paper sets the entries of covered points to 0 through reverse translations; here entries are looked up
  among the points that are left, which gives the same table.
- *Order.* Of vertices with equal sums, and of equally good columns, the one that comes first is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

TAG_BITS = 32
LEAST_NEW = 0.25
"""Of a pool's translations, more than this share must reach a point that is not covered yet, for a vertex to stay."""

WIDTHS = (32, 64, 96, 128)
"""Translations that a tag has room for, tried in turn; wider ones never won on the scans."""

_ONE = np.uint32(1)


@dataclass(frozen=True)
class Pool:
    """vertices : (v, 3) uint8 grid points.  translations : (m, 3) int8.  tags : (v, ⌈m / 32⌉) uint32."""

    vertices: np.ndarray
    translations: np.ndarray
    tags: np.ndarray

    @property
    def n_points(self) -> int:
        """Points that are covered: bits that are set."""
        return int(np.bitwise_count(self.tags).sum(dtype=np.int64))

    @property
    def n_bytes(self) -> int:
        """Bytes of the three arrays."""
        return self.vertices.nbytes + self.translations.nbytes + self.tags.nbytes

    @property
    def saved_bytes(self) -> int:
        """Bytes of its points one by one, three each, less its own."""
        return 3 * self.n_points - self.n_bytes


class _Grid(NamedTuple):
    """The points that no pool covers yet, as a grid in which a translation is an offset.

    A row of the grid is longer than the points' extent by the longest translation: what leaves a row at its end falls
    between points, on a value that is 0.

    place : (n,) int64 of each point.  offset : (m,) int64 of each translation.  left : (g,) uint8, 1 at a point that is
    not covered.
    """

    place: np.ndarray
    offset: np.ndarray
    left: np.ndarray


def _grid(points: np.ndarray, translations: np.ndarray) -> _Grid:
    lower = points.min(axis=0).astype(np.int64)
    reach = np.abs(translations).max(axis=0)
    nx, ny, nz = points.max(axis=0) - lower + 1 + reach
    strides = np.array([ny * nz, nz, 1], np.int64)
    before = int(reach @ strides)
    place = (points - lower) @ strides + before
    left = np.zeros(nx * ny * nz + 2 * before, np.uint8)
    left[place] = 1
    return _Grid(place, translations @ strides, left)


def greedy_pools(
    points: np.ndarray, translations: np.ndarray, n_pools: int, width: int | None = None, least_saved: int = 1
) -> tuple[list[Pool], np.ndarray, np.ndarray]:
    """At most ``n_pools`` pools, and the order in which they and what they leave hold the points.

    points : (n, 3) distinct grid points below 256.  translations : (m, 3) int64 in −127 … 127, most common first, as of
    ``autocorrelation.common_translations``.  width : translations that a tag has room for; None: what saves most.
    least_saved : bytes that a pool must save; the search ends at the first that does not.
    Returns the pools; (c,) int64, the points they cover in their order; (n − c,) int64, the other points, ascending.
    Cost: O(n · m) look-ups a pool, and some bytes for each value of a grid about that of the points.
    """
    place, offset, left = _grid(points, translations)
    index = np.zeros(len(left), np.int32)
    index[place] = np.arange(len(place))
    pools: list[Pool] = []
    covered = [place[:0]]
    while len(pools) < n_pools:
        table = vertex_table(place, offset, left)
        best = table[np.bitwise_count(table).sum(axis=1).argmax()]
        rows = np.flatnonzero(np.unpackbits(best.view(np.uint8), bitorder="little"))
        choices = []
        for w in WIDTHS if width is None else (width,):
            k = min(w, len(rows))
            sums = np.bitwise_count(table & _mask(rows[:k], table.shape[1])).sum(axis=1, dtype=np.int16)
            order = np.argsort(-sums, kind="stable")[: np.count_nonzero(sums > LEAST_NEW * k)]
            n_chosen, tags, targets, left_then = _fill(place, offset[rows[:k]], left, order)
            vertices = points[order[:n_chosen]].astype(np.uint8)
            pool = Pool(vertices, translations[rows[:k]].astype(np.int8), tags[:n_chosen])
            choices.append((pool.saved_bytes, -w, pool, targets, left_then))
            if k == len(rows):
                break
        saved_bytes, _, pool, targets, left_then = max(choices, key=lambda choice: choice[:2])
        if saved_bytes < least_saved:
            break
        pools.append(pool)
        left = left_then
        covered.append(index[targets].astype(np.int64))
    return pools, np.concatenate(covered), np.flatnonzero(left[place])


def _mask(rows: np.ndarray, n_words: int) -> np.ndarray:
    """(n_words,) uint32 in which the bits of the rows are set."""
    bits = np.zeros(TAG_BITS * n_words, np.uint8)
    bits[rows] = 1
    return np.packbits(bits, bitorder="little").view("<u4").astype(np.uint32)


@njit(nogil=True, cache=True)
def vertex_table(place, offset, left):
    """(n, ⌈m / 32⌉) uint32: the vertex–transformation table, its columns as tags: a bit where a point left is met."""
    table = np.zeros((len(place), (len(offset) + TAG_BITS - 1) // TAG_BITS), np.uint32)
    for i in range(len(place)):
        for t in range(len(offset)):
            table[i, t // TAG_BITS] |= np.uint32(left[place[i] + offset[t]]) << np.uint32(t % TAG_BITS)
    return table


@njit(nogil=True, cache=True)
def _fill(place, offset, left, order):
    """A pool with these translations: which of the vertices in ``order`` stay (their number, put to its front), their
    tags, the places they cover in the pool's order, and what is left then.
    """
    k = len(offset)
    left = left.copy()
    tags = np.zeros((len(order), (k + TAG_BITS - 1) // TAG_BITS), np.uint32)
    covered = np.empty(len(place), np.int64)
    n_chosen, n_covered = 0, 0
    for i in order:
        new = 0
        for o in offset:
            new += left[place[i] + o]
        if new <= LEAST_NEW * k:
            continue
        for t in range(k):
            target = place[i] + offset[t]
            if left[target]:
                left[target] = 0
                tags[n_chosen, t // TAG_BITS] |= _ONE << np.uint32(t % TAG_BITS)
                covered[n_covered] = target
                n_covered += 1
        order[n_chosen] = i
        n_chosen += 1
    return n_chosen, tags, covered[:n_covered], left
