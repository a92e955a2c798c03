"""Whole numbers in as few bytes as they need (LEB128): seven bits a byte, lowest first, top bit set where more follow.

Only the shortest form is read, so that every number has one form.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ..errors import CodecError

_MOST_BYTES = 9  # 63 bits


@njit(nogil=True, cache=True)
def _write(values, out):
    at = 0
    for value in values:
        while value > 127:
            out[at] = value & 127 | 128
            value >>= 7
            at += 1
        out[at] = value
        at += 1
    return at


@njit(nogil=True, cache=True)
def _read(data, at, out):
    """Fill ``out`` from ``data[at:]``; return the index after the last byte read, −1 where there is no such number."""
    for i in range(len(out)):
        value = np.int64(0)
        for k in range(_MOST_BYTES):
            if at >= len(data):
                return -1
            byte = np.int64(data[at])
            at += 1
            value |= (byte & 127) << 7 * k
            if byte < 128:
                if byte == 0 and k > 0:
                    return -1
                break
        else:
            return -1
        out[i] = value
    return at


def write_varints(values: np.ndarray) -> np.ndarray:
    """(m,) uint8 of (n,) integers in [0, 2**63)."""
    values = np.ascontiguousarray(values, np.int64)
    out = np.empty(_MOST_BYTES * len(values), np.uint8)
    return out[: _write(values, out)].copy()


def read_varints(data: np.ndarray, at: int, count: int) -> tuple[np.ndarray, int]:
    """(count,) int64 from (m,) uint8 ``data[at:]``, and the index of the byte after them.

    Raises CodecError where they do not fit what is left, before anything is allocated, or are not in shortest form.
    """
    if not 0 <= count <= len(data) - at:
        raise CodecError(f"coded points: found {len(data) - at} bytes, expected {count} numbers")
    out = np.empty(count, np.int64)
    stop = _read(data, at, out)
    if stop < 0:
        raise CodecError(f"coded points: found no {count} numbers at byte {at}")
    return out, stop


def write_ascending(values: np.ndarray) -> np.ndarray:
    """(m,) uint8 of (n,) strictly ascending integers ≥ 0: what lies between each and the one before it."""
    return write_varints(np.diff(values, prepend=-1) - 1)


def read_ascending(data: np.ndarray, at: int, count: int, limit: int) -> tuple[np.ndarray, int]:
    """(count,) int64, strictly ascending, in [0, limit), and the index of the byte after them. Raises CodecError."""
    gaps, stop = read_varints(data, at, count)
    if not _accumulate(gaps, limit):
        raise CodecError(f"coded points: found numbers that do not ascend below {limit}")
    return gaps, stop


@njit(nogil=True, cache=True)
def _accumulate(gaps, limit):
    """Turn gaps into values in place; False where one would reach ``limit`` (no sum overflows on the way there)."""
    last = np.int64(-1)
    for i in range(len(gaps)):
        if gaps[i] >= limit - 1 - last:
            return False
        last += gaps[i] + 1
        gaps[i] = last
    return True
