"""Framebuffer words as they cross between ranks: runs of pixels on which points fell; background is left out.

Bytes: uint32 number of runs and of words, then (first pixel, number of pixels) of each run as uint32, ascending and
without overlap, then the words of all runs as uint64.
"""

from __future__ import annotations

import numpy as np

from .errors import MessageError
from .messages import FRAMEBUFFER_EMPTY

_HEAD = np.dtype("<u4")
_RUN = np.dtype([("first", "<u4"), ("count", "<u4")])
_WORD = np.dtype("<u8")


def most_bytes(n_pixels: int) -> int:
    """Most bytes that ``n_pixels`` words take: where nothing is background, a word more than they are, and the head."""
    return 2 * _HEAD.itemsize + _WORD.itemsize * (n_pixels + 1)


def encode_runs(words: np.ndarray) -> np.ndarray:
    """(m,) uint8, m at most ``most_bytes``, of (n,) uint64 words. Cost: some passes over the words, in NumPy."""
    filled = words != FRAMEBUFFER_EMPTY
    edges = np.flatnonzero(np.diff(filled, prepend=False, append=False))
    runs = np.empty(len(edges) // 2, _RUN)
    runs["first"], runs["count"] = edges[::2], edges[1::2] - edges[::2]
    kept = words[filled]
    parts = np.array([len(runs), len(kept)], _HEAD), runs, kept.astype(_WORD, copy=False)
    return np.concatenate([part.view(np.uint8) for part in parts])


def merge_runs(payload: bytes | bytearray | memoryview, words: np.ndarray) -> None:
    """Take the minimum of (n,) uint64 ``words`` and those of a payload, in place.

    Raises MessageError, and changes nothing, for a payload that is no runs of ``n`` pixels. Cost: as of encoding;
    memory 16 bytes a word of the payload.
    """
    found = len(payload)
    if found < 2 * _HEAD.itemsize:
        raise MessageError(f"framebuffer: found {found} bytes, expected at least {2 * _HEAD.itemsize}")
    n_runs, n_words = map(int, np.frombuffer(payload, _HEAD, 2))
    expected = 2 * _HEAD.itemsize + _RUN.itemsize * n_runs + _WORD.itemsize * n_words
    if found != expected:
        raise MessageError(f"framebuffer: found {found} bytes, expected {expected} for {n_runs} runs, {n_words} words")
    runs = np.frombuffer(payload, _RUN, n_runs, 2 * _HEAD.itemsize)
    first, count = runs["first"].astype(np.int64), runs["count"].astype(np.int64)
    end = first + count
    if (count < 1).any() or (first[1:] < end[:-1]).any() or (n_runs and end[-1] > len(words)):
        raise MessageError(f"framebuffer: found runs that are empty, overlap or lie beyond its {len(words)} pixels")
    if int(count.sum()) != n_words:
        raise MessageError(f"framebuffer: found {n_words} words, expected {int(count.sum())} for its runs")
    theirs = np.frombuffer(payload, _WORD, n_words, expected - _WORD.itemsize * n_words)
    pixel = np.arange(n_words) + np.repeat(first - (np.cumsum(count) - count), count)
    words[pixel] = np.minimum(words[pixel], theirs)
