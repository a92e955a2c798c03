"""The order of points that a codec asks for: a key for each point, a stable sort by it, and what repeats."""

from __future__ import annotations

import numpy as np
from numba import njit

_DIGIT = 11
_FEW = 2048
"""Below this, clearing and summing the counts of a radix sort costs more than sorting by comparison."""


def sorted_order(keys: np.ndarray, n_bits: int) -> np.ndarray:
    """(n,) int64: the stable order that sorts (n,) int64 keys in [0, 2**n_bits). Cost: a pass for each 11 bits."""
    if len(keys) < _FEW:
        return np.argsort(keys, kind="stable")
    return _radix_order(keys, n_bits)


@njit(nogil=True, cache=True)
def _radix_order(keys, n_bits):
    n = len(keys)
    order, next_order = np.arange(n), np.empty(n, np.int64)
    keys, next_keys = keys.copy(), np.empty(n, np.int64)
    count = np.empty(1 << _DIGIT, np.int64)
    for shift in range(0, n_bits, _DIGIT):
        count[:] = 0
        for key in keys:
            count[key >> shift & (1 << _DIGIT) - 1] += 1
        total = 0
        for d in range(1 << _DIGIT):
            count[d], total = total, total + count[d]
        for i in range(n):
            d = keys[i] >> shift & (1 << _DIGIT) - 1
            next_keys[count[d]] = keys[i]
            next_order[count[d]] = order[i]
            count[d] += 1
        keys, next_keys = next_keys, keys
        order, next_order = next_order, order
    return order


def distinct(sorted_keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(first, counts) of the runs of equal keys in (n,) sorted keys: each (m,) int64."""
    first = np.flatnonzero(np.diff(sorted_keys, prepend=-1))
    return first, np.diff(first, append=len(sorted_keys))


@njit(nogil=True, cache=True)
def gather_runs(values, first, counts, which):
    """The runs ``values[first[i]:first[i] + counts[i]]``, end to end, for i in ``which``: all runs, in some order."""
    out = np.empty(len(values), values.dtype)
    at = 0
    for i in which:
        for k in range(counts[i]):
            out[at] = values[first[i] + k]
            at += 1
    return out
