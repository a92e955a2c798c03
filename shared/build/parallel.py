"""Threads over compiled kernels that release the interpreter lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise
from typing import Any


class Workers:
    """A pool of threads; a context manager.

    n_threads : None takes every core this process may run on.
    """

    def __init__(self, n_threads: int | None = None) -> None:
        self.n_threads = n_threads or len(os.sched_getaffinity(0))
        self._pool = ThreadPoolExecutor(self.n_threads)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def map(self, task: Callable[..., Any], arguments: Iterable[tuple]) -> list[Any]:
        """``task(*a)`` for each a, in any order; results in order. Raises the first task's exception.

        No task goes on behind the caller's back: those that have not started then are left out, others awaited.
        """
        futures = [self._pool.submit(task, *a) for a in arguments]
        try:
            return [f.result() for f in futures]
        finally:
            for future in futures:
                future.cancel()
            wait(futures)

    def ranges(self, n: int, *, pieces: int | None = None) -> list[tuple[int, int]]:
        """[0, n) in at most ``pieces`` (one per thread) contiguous non-empty ranges of nearly equal length."""
        pieces = max(1, min(pieces or self.n_threads, n))
        cuts = [n * i // pieces for i in range(pieces + 1)]
        return list(pairwise(cuts)) if n else []
