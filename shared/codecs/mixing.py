"""Adaptive probability of a yes or no, from several contexts at once: one counter each, mixed by learnt weights.

Each context predicts with the share of ones seen in it, recent ones counting more. The predictions are mixed in the
logistic domain, and after each answer the weights move along the gradient of its coding cost. All in whole numbers: a
decoder on another machine must find the same probabilities to the last bit.

Source: M. Mahoney, "Adaptive Weighing of Context Models for Lossless Data Compression", 2005 (logistic mixing).
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit

from .range_coder import PROBABILITY_BITS

N_INPUTS = 3
"""Contexts of an answer."""

COUNTER_BITS = 22
"""Precision of a counter's probability; below it stand the bits of how often the context was seen."""
_SEEN_BITS = 7
_MOST_SEEN = 127
_NEW = (1 << COUNTER_BITS - 1) << _SEEN_BITS  # one half, never seen

_STRETCHED_BITS = 12
_UNIT = 256  # of a logit
_LARGEST = 8 * _UNIT - 1
_WEIGHT_BITS = 16
_RATE_SHIFT = 18
_RATE = 5  # 0.005 a unit of logit and of probability


@cache
def tables() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(stretch, squash, rate), all int32.

    stretch : (4096,) logit in 1/256 of each probability in 1/4096.
    squash : (4095,) probability in 1/65536 of each logit from −2047/256 on.
    rate : (128,) step towards an answer in 1/65536, by how often the context was seen.
    A value is rounded from float64; a test shows that none is so near a half that another machine could differ.
    """
    stretch, squash, rate = (np.rint(values).astype(np.int32) for values in exact_tables())
    return stretch, squash, rate


def exact_tables() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``tables`` before rounding, in float64."""
    probability = (np.arange(1 << _STRETCHED_BITS) + 0.5) / (1 << _STRETCHED_BITS)
    stretch = np.clip(_UNIT * np.log(probability / (1 - probability)), -_LARGEST, _LARGEST)
    squash = (1 << PROBABILITY_BITS) / (1 + np.exp(-np.arange(-_LARGEST, _LARGEST + 1) / _UNIT))
    rate = (1 << 16) / (np.arange(_MOST_SEEN + 1) + 1.6)
    return stretch, squash, rate


def new_counters(n_contexts: int) -> np.ndarray:
    """(n,) int32: no context seen."""
    return np.full(n_contexts, _NEW, np.int32)


def new_weights(n_sets: int) -> np.ndarray:
    """(n_sets, N_INPUTS) int32: each input about as good as another."""
    return np.full((n_sets, N_INPUTS), (1 << _WEIGHT_BITS) * 6 // (5 * N_INPUTS), np.int32)


@njit(nogil=True, cache=True, inline="always")
def predict(counters, contexts, weights, stretch, squash, logits):
    """Probability of 1 in 1/65536, in (0, 65536). Keeps the (N_INPUTS,) ``logits`` of the contexts for ``learn``."""
    total = np.int64(0)
    for k in range(N_INPUTS):
        probability = counters[contexts[k]] >> _SEEN_BITS
        logits[k] = stretch[probability >> COUNTER_BITS - _STRETCHED_BITS]
        total += np.int64(weights[k]) * logits[k]
    return np.int64(squash[min(max(total >> _WEIGHT_BITS, -_LARGEST), _LARGEST) + _LARGEST])


@njit(nogil=True, cache=True, inline="always")
def predict_one(counter):
    """Probability of 1 in 1/65536, in (0, 65536), of a single counter."""
    probability = np.int64(counter) >> _SEEN_BITS + COUNTER_BITS - PROBABILITY_BITS
    return min(max(probability, np.int64(1)), np.int64((1 << PROBABILITY_BITS) - 1))


@njit(nogil=True, cache=True, inline="always")
def learn_one(counter, rate, bit):
    """The counter moved towards the answer."""
    seen, value = np.int64(counter) & _MOST_SEEN, np.int64(counter) >> _SEEN_BITS
    value += (bit * ((1 << COUNTER_BITS) - 1) - value) * rate[seen] >> 16
    return value << _SEEN_BITS | min(seen + 1, _MOST_SEEN)


@njit(nogil=True, cache=True, inline="always")
def learn(counters, contexts, weights, rate, logits, probability, bit):
    """Move the counters of the contexts towards the answer, and the weights to those that were right."""
    error = (bit << PROBABILITY_BITS) - probability
    for k in range(N_INPUTS):
        weights[k] += error * logits[k] * _RATE + (1 << _RATE_SHIFT - 1) >> _RATE_SHIFT
        counters[contexts[k]] = learn_one(counters[contexts[k]], rate, bit)
