"""Transformation streams: a cell's grid points as vertex–transformation pools, and the points that no pool covers.

====================  =========================================================================================
bytes                 content
====================  =========================================================================================
head                  number of points, and which of them repeat (``container.write_head``)
varint                number of pools. Nothing follows where there are no points
2 varints a pool      v ≥ 1 vertices and 1 ≤ m ≤ 256 translations, for each pool in turn
3·m                   the first pool's translations: x, y, z as int8, one after the other
3·v                   its vertices: x, y, z as uint8
4·v·⌈m / 32⌉          its tags: uint32, little-endian; bits above m are 0, none is 0 altogether
…                     the other pools
3 a point             the points left over: x, y, z as uint8
====================  =========================================================================================

Coded order: pool after pool in the order that ``pools`` says, then the points left over. So a colour for each point
stays a column beside, in that order, and whoever draws reads it from front to back while it goes through the tags. A
column of words costs four bytes a point, which positions at one byte cannot win back; ``palette`` is a byte.

Grids have 8 bits an axis at most. Above, scans are sparse on the grid, and translations long.

Source: Kim, Lee, Varshney, "Vertex Transformation Streams", sections 3 to 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit

from ..errors import CodecError
from . import MAX_STREAM_BITS, Encoded
from .container import read_head, write_head
from .grid import check_points
from .order import distinct, gather_runs, sorted_order
from .pools import TAG_BITS, Pool, greedy_pools
from .varints import read_varints, write_varints

name = "streams"

DEFAULT_BITS = 7
"""Bits an axis: enough for a cell that is at most 128/√2 px wide and high on the screen (section 6)."""

MOST_TRANSLATIONS = 256
POINT_BYTES = 3

LEAST_GAIN = 4 / 3
"""Pools are worth having where the points without them would need this many times the bytes."""


@dataclass(frozen=True)
class PooledPoints:
    """Distinct grid points in the form they are drawn from.  loose : (l, 3) uint8, what no pool covers."""

    pools: tuple[Pool, ...]
    loose: np.ndarray

    def __len__(self) -> int:
        return sum(pool.n_points for pool in self.pools) + len(self.loose)

    @property
    def n_bytes(self) -> int:
        """Bytes of vertices, translations, tags and loose points."""
        return sum(pool.n_bytes for pool in self.pools) + self.loose.nbytes

    @property
    def coverage(self) -> float:
        """Share of the points that pools cover; 0 of none."""
        return 1 - len(self.loose) / len(self) if len(self) else 0.0


def keeps_pools(pooled: PooledPoints, least_gain: float = LEAST_GAIN) -> bool:
    """The gate: whether the same points, three bytes each, would need at least ``least_gain`` times the bytes."""
    return bool(pooled.pools) and POINT_BYTES * len(pooled) >= least_gain * pooled.n_bytes


def encode(
    points: np.ndarray,
    bits: int = DEFAULT_BITS,
    n_pools: int = 2,
    width: int | None = None,
    longest: int | None = None,
) -> Encoded:
    """(n, 3) integers in [0, 2**bits), duplicates allowed. Raises CodecError for anything else.

    n_pools : most pools; those that save no bytes are left out.  width : translations that a tag has room for, a
    multiple of 32 up to 256; None: what saves most.  longest : translation along an axis; None: 127.
    """
    points = check_points(points, bits)
    _check_bits(bits)
    if width is not None and not (0 < width <= MOST_TRANSLATIONS and width % TAG_BITS == 0):
        raise CodecError(f"tags: found a width of {width}, expected a multiple of {TAG_BITS} up to {MOST_TRANSLATIONS}")
    x, y, z = points.T.astype(np.int64)
    keys = x << 2 * bits | y << bits | z
    order = sorted_order(keys, 3 * bits)
    first, counts = distinct(keys[order])
    if not len(points):
        return Encoded(write_head(counts), order)
    pools, which = find_pools(points[order[first]], n_pools, width, longest)
    data = [write_head(counts[which]), write_varints(np.array([len(pools)]))]
    data += [write_varints(np.array([len(pool.vertices), len(pool.translations)])) for pool in pools]
    for pool in pools:
        data += [
            pool.translations.view(np.uint8).ravel(),
            pool.vertices.ravel(),
            pool.tags.astype("<u4").view(np.uint8).ravel(),
        ]
    n_covered = sum(pool.n_points for pool in pools)
    data.append(points[order[first[which[n_covered:]]]].astype(np.uint8).ravel())
    return Encoded(np.concatenate(data), gather_runs(order, first, counts, which))


def find_pools(
    points: np.ndarray, n_pools: int, width: int | None, longest: int | None
) -> tuple[list[Pool], np.ndarray]:
    """Pools of (n, 3) distinct grid points, n > 0, and (n,) int64: the points in coded order."""
    from .autocorrelation import common_translations

    if n_pools <= 0:
        return [], np.arange(len(points))
    translations, _ = common_translations(points, longest=longest)
    pools, covered, loose = greedy_pools(points, translations, n_pools, width)
    return pools, np.concatenate([covered, loose])


def decode(data: np.ndarray, bits: int, most_points: int) -> np.ndarray:
    """(n, 3) uint32 grid points, in coded order. Raises CodecError for damaged data or above ``most_points``."""
    _, points, counts = _read(data, bits, most_points)
    return points if counts is None else np.repeat(points, counts, axis=0)


def read_pools(data: np.ndarray, bits: int, most_points: int) -> PooledPoints:
    """The distinct points as pools, checked in full: what to draw from. Raises CodecError as ``decode``."""
    return _read(data, bits, most_points)[0]


def read_with_points(data: np.ndarray, bits: int, most_points: int) -> tuple[PooledPoints, np.ndarray]:
    """As ``read_pools``, and (n, 3) uint32: the same points in coded order."""
    pooled, points, _ = _read(data, bits, most_points)
    return pooled, points


def _check_bits(bits: int) -> None:
    if not 1 <= bits <= MAX_STREAM_BITS:
        raise CodecError(f"bits: found {bits}, expected 1 … {MAX_STREAM_BITS}")


def _read(data: np.ndarray, bits: int, most_points: int) -> tuple[PooledPoints, np.ndarray, np.ndarray | None]:
    _check_bits(bits)
    head, at = read_head(data, most_points)
    if head.n > 8 * (len(data) - at):  # a point takes one bit at least: nothing is allocated for data that is too short
        raise CodecError(f"coded points: found {len(data) - at} bytes for {head.n} points")
    points, n = np.empty((head.n, 3), np.uint32), 0
    pools = []
    if head.n:
        (n_pools,), at = read_varints(data, at, 1)
        sizes, at = read_varints(data, at, 2 * int(n_pools))
        seen = np.zeros((8**bits + 7) // 8, np.uint8)
        for v, m in sizes.reshape(-1, 2).tolist():
            pool, at = _read_pool(data, at, v, m)
            n = _expand(pool.vertices, pool.translations, pool.tags, bits, seen, points, n)
            if n < 0:
                raise CodecError("coded points: found a pool with a point twice, outside of the grid, or not counted")
            pools.append(pool)
        n_bytes = POINT_BYTES * (head.n - n)
        if len(data) - at != n_bytes:
            raise CodecError(f"coded points: found {len(data) - at} bytes behind the pools, expected {n_bytes}")
        loose = data[at:].reshape(-1, 3).copy()
        every = np.ones((len(loose), 1), np.uint32)
        if _expand(loose, np.zeros((1, 3), np.int8), every, bits, seen, points, n) != head.n:
            raise CodecError("coded points: found a point twice, or outside of the grid")
    elif at != len(data):
        raise CodecError(f"coded points: found {len(data) - at} bytes behind no points")
    else:
        loose = np.empty((0, 3), np.uint8)
    return PooledPoints(tuple(pools), loose), points, head.counts


def _read_pool(data: np.ndarray, at: int, v: int, m: int) -> tuple[Pool, int]:
    """A pool of v vertices and m translations, and the index of the byte after it."""
    words = -(-m // TAG_BITS)
    ends = at + np.cumsum([0, 3 * m, 3 * v, 4 * v * words], dtype=object)
    if not (1 <= m <= MOST_TRANSLATIONS and v >= 1) or ends[-1] > len(data):
        raise CodecError(f"coded points: found {len(data) - at} bytes for a pool of {v} vertices, {m} translations")
    translations, vertices, tags = (data[a:b].copy() for a, b in pairwise(ends))
    tags = tags.view("<u4").astype(np.uint32).reshape(v, words)
    if (tags == 0).all(axis=1).any() or (m % TAG_BITS and (tags[:, -1] >> m % TAG_BITS).any()):
        raise CodecError("coded points: found a tag that is empty, or has a bit without a translation")
    return Pool(vertices.reshape(v, 3), translations.view(np.int8).reshape(m, 3), tags), ends[-1]


@njit(nogil=True, cache=True)
def _expand(vertices, translations, tags, bits, seen, points, n):
    """Write a pool's points from ``points[n]`` on and mark them in the bit map ``seen``; return where they end.

    −1 for a point that is marked already, lies outside of the grid, or has no place.
    """
    last = (1 << bits) - 1
    for i in range(len(vertices)):
        for t in range(len(translations)):
            if not tags[i, t // TAG_BITS] >> np.uint32(t % TAG_BITS) & np.uint32(1):
                continue
            x = np.int64(vertices[i, 0]) + translations[t, 0]
            y = np.int64(vertices[i, 1]) + translations[t, 1]
            z = np.int64(vertices[i, 2]) + translations[t, 2]
            if x < 0 or y < 0 or z < 0 or x > last or y > last or z > last or n == len(points):
                return -1
            key = x << 2 * bits | y << bits | z
            if seen[key >> 3] >> (key & 7) & 1:
                return -1
            seen[key >> 3] |= 1 << (key & 7)
            points[n, 0], points[n, 1], points[n, 2] = x, y, z
            n += 1
    return n
