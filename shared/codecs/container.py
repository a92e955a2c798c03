"""What stands before the bit stream of a codec: how many points, which repeat, which blocks of the grid hold them.

====================  =========================================================================================
bytes                 content
====================  =========================================================================================
varint                2·n + r: n distinct points; r = 1 where some repeat, else 0. Nothing follows where n = 0
varint k              only if r = 1: the number of distinct points that repeat, ≥ 1
k varints             their places among the n in coded order, ascending: gaps (``varints.write_ascending``)
k varints             how often each stands there beyond the first time, less one
varint                only with blocks: their number, less one
varints               only with blocks: their indices, ascending: gaps
stream                the codec's own bits, first bit in the top bit of a byte, the last byte filled up with zeros
====================  =========================================================================================

A *block* is the paper's cube of 32×32×32 positions; a grid of five bits an axis or less is a single one, smaller where
it has fewer bits, and is not listed. The index of a block is (x·2**k + y)·2**k + z, for k = bits − 5: the paper's order
of cells, z fastest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import CodecError
from .varints import read_ascending, read_varints, write_ascending, write_varints

BLOCK_BITS = 5
"""Bits an axis of the paper's cube."""


@dataclass(frozen=True)
class Head:
    """n : distinct points.  counts : (n,) int64, how often each stands there, or None where none repeats."""

    n: int
    counts: np.ndarray | None

    def repeat(self, points: np.ndarray) -> np.ndarray:
        """(m, 3) points, each as often as it stands there, from the (n, 3) distinct ones."""
        return points if self.counts is None else np.repeat(points, self.counts, axis=0)


def write_number(counts: np.ndarray) -> np.ndarray:
    """(m,) uint8: the first varint for (n,) counts."""
    return write_varints(np.array([2 * len(counts) + bool((counts > 1).any())]))


def read_number(data: np.ndarray, most_points: int) -> tuple[int, bool, int]:
    """(n, whether some repeat, index of the byte after them). Raises CodecError, also above ``most_points``."""
    (number,), at = read_varints(data, 0, 1)
    n = int(number) >> 1
    if n > most_points:
        raise CodecError(f"coded points: found {n} points, expected at most {most_points}")
    return n, bool(number & 1), at


def write_head(counts: np.ndarray) -> np.ndarray:
    """(m,) uint8 of (n,) counts ≥ 1 of the distinct points in coded order."""
    repeats = np.flatnonzero(counts > 1)
    head = write_number(counts)
    if not len(repeats):
        return head
    more = counts[repeats] - 2
    return np.concatenate(
        [head, write_varints(np.array([len(repeats)])), write_ascending(repeats), write_varints(more)]
    )


def read_head(data: np.ndarray, most_points: int) -> tuple[Head, int]:
    """Head of (m,) uint8 data, and the index of the byte after it. Raises CodecError, also above ``most_points``."""
    n, repeats, at = read_number(data, most_points)
    if not repeats:
        return Head(n, None), at
    (k,), at = read_varints(data, at, 1)
    where, at = read_ascending(data, at, int(k), n)
    more, at = read_varints(data, at, int(k))
    if not k or (more >= most_points).any() or n + int(k) + sum(map(int, more)) > most_points:
        raise CodecError(f"coded points: found repeats of no point, or more than {most_points} points")
    counts = np.ones(n, np.int64)
    counts[where] = more + 2
    return Head(n, counts), at


def block_bits(bits: int) -> int:
    """Bits an axis of the grid of blocks; 0 where the grid is a single block."""
    return max(bits - BLOCK_BITS, 0)


def write_blocks(blocks: np.ndarray, bits: int) -> np.ndarray:
    """(m,) uint8 of (k,) ascending block indices; nothing where the grid is a single block."""
    if not block_bits(bits):
        return np.empty(0, np.uint8)
    return np.concatenate([write_varints(np.array([len(blocks) - 1])), write_ascending(blocks)])


def read_blocks(data: np.ndarray, at: int, bits: int, n_points: int) -> tuple[np.ndarray, int]:
    """(k, 3) uint32 lowest grid points of the blocks, and the index of the byte after them.

    Raises CodecError for damaged data and for more blocks than points: each block holds one at least.
    """
    k = block_bits(bits)
    if not k:
        return np.zeros((1, 3), np.uint32), at
    (less_one,), at = read_varints(data, at, 1)
    if less_one >= n_points:
        raise CodecError(f"coded points: found {int(less_one) + 1} blocks for {n_points} points")
    index, at = read_ascending(data, at, int(less_one) + 1, 1 << 3 * k)
    axes = [index >> 2 * k, index >> k & (1 << k) - 1, index & (1 << k) - 1]
    return (np.column_stack(axes) << BLOCK_BITS).astype(np.uint32), at
