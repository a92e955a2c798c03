"""Framebuffer words as they cross between ranks: runs of pixels on which points fell; background is left out.

Bytes: uint32 number of runs and of words, then (first pixel, number of pixels) of each run as uint32, ascending and
without overlap, then the words of all runs as uint64. A range of a picture is a slice of its words, and its pixels are
numbered from its first. ``framebuffer_runs_reference`` is the readable twin.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .errors import MessageError
from .messages import FRAMEBUFFER_EMPTY

HEAD = np.dtype("<u4")
RUN = np.dtype([("first", "<u4"), ("count", "<u4")])
WORD = np.dtype("<u8")
HEAD_BYTES = 2 * HEAD.itemsize
"""All that there is of background alone."""


def most_bytes(n_pixels: int) -> int:
    """Most bytes that ``n_pixels`` words take: where nothing is background, a word more than they are, and the head."""
    return HEAD_BYTES + WORD.itemsize * (n_pixels + 1)


def encode_runs(words: np.ndarray) -> np.ndarray:
    """(m,) uint8, m at most ``most_bytes``, of (n,) uint64 words. Cost: two passes over the words."""
    n_runs, n_words = _count_runs(words)
    out = np.empty(HEAD_BYTES + RUN.itemsize * n_runs + WORD.itemsize * n_words, np.uint8)
    out[:HEAD_BYTES].view(HEAD)[:] = n_runs, n_words
    body = len(out) - WORD.itemsize * n_words
    _copy_runs(words, out[HEAD_BYTES:body].view(HEAD), out[body:].view(WORD))
    return out


def merge_runs(payload: bytes | bytearray | memoryview, words: np.ndarray) -> None:
    """Take the minimum of (n,) uint64 ``words`` and those of a payload, in place.

    Raises MessageError, and changes nothing, for a payload that is no runs of ``n`` pixels. Cost: a pass over the runs
    and one over the payload's words; no memory.
    """
    found = len(payload)
    if found < HEAD_BYTES:
        raise MessageError(f"framebuffer: found {found} bytes, expected at least {HEAD_BYTES}")
    n_runs, n_words = map(int, np.frombuffer(payload, HEAD, 2))
    expected = HEAD_BYTES + RUN.itemsize * n_runs + WORD.itemsize * n_words
    if found != expected:
        raise MessageError(f"framebuffer: found {found} bytes, expected {expected} for {n_runs} runs, {n_words} words")
    runs = np.frombuffer(payload, HEAD, 2 * n_runs, HEAD_BYTES)
    n_named = _check_runs(runs, len(words))
    if n_named < 0:
        raise MessageError(f"framebuffer: found runs that are empty, overlap or lie beyond its {len(words)} pixels")
    if n_named != n_words:
        raise MessageError(f"framebuffer: found {n_words} words, expected {n_named} for its runs")
    _take_minimum(runs, np.frombuffer(payload, WORD, n_words, expected - WORD.itemsize * n_words), words)


@njit(nogil=True, cache=True)
def _count_runs(words):
    """(number of runs, number of words in them). Without branches, so that it is done for several words at once."""
    n_runs = n_words = np.int64(len(words) > 0 and words[0] != FRAMEBUFFER_EMPTY)
    for pixel in range(1, len(words)):
        filled = words[pixel] != FRAMEBUFFER_EMPTY
        n_words += filled
        n_runs += filled & (words[pixel - 1] == FRAMEBUFFER_EMPTY)
    return n_runs, n_words


@njit(nogil=True, cache=True)
def _copy_runs(words, runs, kept):
    """Fill (2 r,) uint32 ``runs`` with first pixel and length in turn, (k,) uint64 ``kept`` with their words."""
    run = n = pixel = 0
    while pixel < len(words):
        if words[pixel] == FRAMEBUFFER_EMPTY:
            pixel += 1
            continue
        first = pixel
        while pixel < len(words) and words[pixel] != FRAMEBUFFER_EMPTY:
            kept[n] = words[pixel]
            n += 1
            pixel += 1
        runs[run], runs[run + 1] = first, pixel - first
        run += 2


@njit(nogil=True, cache=True)
def _check_runs(runs, n_pixels):
    """Number of words that the runs name; −1 where one is empty, begins before the last has ended or ends too late."""
    end = n_words = 0
    for run in range(0, len(runs), 2):
        first, count = np.int64(runs[run]), np.int64(runs[run + 1])
        if count < 1 or first < end or first + count > n_pixels:
            return -1
        end = first + count
        n_words += count
    return n_words


@njit(nogil=True, cache=True)
def _take_minimum(runs, theirs, words):
    n = 0
    for run in range(0, len(runs), 2):
        first = np.int64(runs[run])
        for pixel in range(first, first + np.int64(runs[run + 1])):
            words[pixel] = min(words[pixel], theirs[n])
            n += 1
