"""The readable twin of ``framebuffer_runs``: the same bytes by passes over arrays. For tests."""

from __future__ import annotations

import numpy as np

from .framebuffer_runs import HEAD, RUN, WORD
from .messages import FRAMEBUFFER_EMPTY


def encode_runs(words: np.ndarray) -> np.ndarray:
    """(m,) uint8 of (n,) uint64 words."""
    filled = words != FRAMEBUFFER_EMPTY
    edges = np.flatnonzero(np.diff(filled, prepend=False, append=False))
    runs = np.empty(len(edges) // 2, RUN)
    runs["first"], runs["count"] = edges[::2], edges[1::2] - edges[::2]
    kept = words[filled]
    parts = np.array([len(runs), len(kept)], HEAD), runs, kept.astype(WORD, copy=False)
    return np.concatenate([part.view(np.uint8) for part in parts])


def merge_runs(payload: bytes | bytearray | memoryview, words: np.ndarray) -> None:
    """Take the minimum of (n,) uint64 ``words`` and those of a payload that ``encode_runs`` made, in place."""
    n_runs, n_words = map(int, np.frombuffer(payload, HEAD, 2))
    runs = np.frombuffer(payload, RUN, n_runs, 2 * HEAD.itemsize)
    first, count = runs["first"].astype(np.int64), runs["count"].astype(np.int64)
    pixel = np.arange(n_words) + np.repeat(first - (np.cumsum(count) - count), count)
    words[pixel] = np.minimum(words[pixel], np.frombuffer(payload, WORD, n_words, len(payload) - 8 * n_words))
