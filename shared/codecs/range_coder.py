"""Binary range coder: a yes or no at about as many bits as its probability says.

The coder narrows an interval [low, high] of 32-bit numbers, by probability, to the part of each answer, and gives out
the leading bytes that both ends share. A reader that runs out of bytes goes on with zeros, and ``ends_here`` tells
afterwards whether the bytes were exactly those that a writer ends with.

State: (4,) int64, ``[low, high, code, at]``: the interval, the 32 bits that a reader looks at, the next byte.
Source: the carry-less coder of M. Mahoney, "Adaptive Weighing of Context Models for Lossless Data Compression", 2005.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ..errors import CodecError

PROBABILITY_BITS = 16
MOST_BYTES = 4
"""Of one answer, and of the end."""

_LOW, _HIGH, _CODE, _AT = range(4)
_TOP = 0xFFFFFFFF


@njit(nogil=True, cache=True)
def start_writing():
    """State before the first answer."""
    return np.array([0, _TOP, 0, 0], np.int64)


@njit(nogil=True, cache=True)
def start_reading(data):
    """State before the first answer in (m,) uint8 data."""
    state = np.array([0, _TOP, 0, 0], np.int64)
    for _ in range(MOST_BYTES):
        _next_byte(state, data)
    return state


@njit(nogil=True, cache=True)
def _next_byte(state, data):
    byte = np.int64(data[state[_AT]]) if state[_AT] < len(data) else np.int64(0)
    state[_CODE] = state[_CODE] << 8 & _TOP | byte
    state[_AT] += 1


@njit(nogil=True, cache=True)
def with_room(state, out, n_answers):
    """``out``, or a longer copy where it is too short for so many more answers."""
    if state[_AT] + n_answers * MOST_BYTES <= len(out):
        return out
    longer = np.empty(2 * len(out) + 1024, np.uint8)
    longer[: len(out)] = out
    return longer


@njit(nogil=True, cache=True)
def write_bit(state, out, bit, probability):
    """Write an answer of which 1 has this probability, in (0, 2**16); ``out`` has ``MOST_BYTES`` left."""
    middle = state[_LOW] + ((state[_HIGH] - state[_LOW]) * probability >> PROBABILITY_BITS)
    if bit:
        state[_HIGH] = middle
    else:
        state[_LOW] = middle + 1
    while (state[_LOW] ^ state[_HIGH]) >> 24 == 0:
        out[state[_AT]] = state[_HIGH] >> 24
        state[_AT] += 1
        state[_LOW] = state[_LOW] << 8 & _TOP
        state[_HIGH] = state[_HIGH] << 8 & _TOP | 255


@njit(nogil=True, cache=True)
def read_bit(state, data, probability):
    """The answer that ``write_bit`` wrote with this probability."""
    middle = state[_LOW] + ((state[_HIGH] - state[_LOW]) * probability >> PROBABILITY_BITS)
    bit = state[_CODE] <= middle
    if bit:
        state[_HIGH] = middle
    else:
        state[_LOW] = middle + 1
    while (state[_LOW] ^ state[_HIGH]) >> 24 == 0:
        state[_LOW] = state[_LOW] << 8 & _TOP
        state[_HIGH] = state[_HIGH] << 8 & _TOP | 255
        _next_byte(state, data)
    return np.int64(bit)


@njit(nogil=True, cache=True)
def ran_out(state, data):
    """Whether more was read than a writer ever leaves out at the end."""
    return state[_AT] > len(data) + MOST_BYTES


def _end(state: np.ndarray) -> bytes:
    """The fewest bytes that, followed by zeros, lie in the interval."""
    low, high = int(state[_LOW]), int(state[_HIGH])
    for n in range(MOST_BYTES):
        step = 1 << 8 * (MOST_BYTES - n)
        value = -(-low // step) * step
        if value <= high:
            return value.to_bytes(MOST_BYTES, "big")[:n]
    return low.to_bytes(MOST_BYTES, "big")


def finish_writing(state: np.ndarray, out: np.ndarray) -> np.ndarray:
    """(m,) uint8: all that was written to ``out``, and the end."""
    return np.append(out[: state[_AT]], np.frombuffer(_end(state), np.uint8))


def check_end(state: np.ndarray, data: np.ndarray) -> None:
    """Raise CodecError unless (m,) uint8 data end as a writer in this state ends them."""
    last = int(state[_AT]) - MOST_BYTES
    if data[last:].tobytes() != _end(state) or last > len(data):
        raise CodecError(f"coded points: found {len(data)} bytes that end in another way than points do")
