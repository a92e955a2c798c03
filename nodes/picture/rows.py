"""Kernels over the rows of a frame. A kernel computes each pixel from its input alone, so threads change no bit."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

_TURNS_PER_THREAD = 4


class Rows:
    """A pool of threads that share the rows of a frame; its owner closes it."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._executor = ThreadPoolExecutor(threads, "picture")

    def run(self, n_rows: int, kernel: Callable[..., None], *arguments: Any) -> None:
        """Call ``kernel(*arguments, first, end)`` for ranges that together are all rows. Raises what a call raises."""
        step = max(1, -(-n_rows // (self._threads * _TURNS_PER_THREAD)))
        starts = range(0, n_rows, step)
        for _ in self._executor.map(lambda first: kernel(*arguments, first, min(first + step, n_rows)), starts):
            pass

    def close(self) -> None:
        """End the threads."""
        self._executor.shutdown()
