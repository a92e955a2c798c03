"""Ranks of a shared build as threads of one process: what MPI does, without starting it."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np


class _World:
    def __init__(self, size):
        self.size = size
        self.barrier = threading.Barrier(size, timeout=60)
        self.given = [None] * size
        self.failed = threading.Event()


class ThreadRanks:
    """``shared.build.ranks.Ranks`` of one thread."""

    def __init__(self, world, rank):
        self._world, self.rank, self.size = world, rank, world.size

    def _exchange(self, value):
        self._world.given[self.rank] = value
        self._world.barrier.wait()
        given = list(self._world.given)
        self._world.barrier.wait()
        return given

    def ranks_here(self):
        return len(self._exchange(None))

    def agree(self, status):
        return self._exchange(status)

    def join(self, values):
        return np.concatenate(self._exchange(np.array(values, np.float64)))

    def total(self, counts):
        return np.sum(self._exchange(counts.copy()), axis=0)

    def gather(self, data):
        return self._exchange(data)

    def warn(self):
        self._world.failed.set()

    def warned(self):
        return self._world.failed.is_set()


def on_threads(size, task):
    """``task(ranks)`` on each rank; (what each returned, or the exception it raised)."""
    world = _World(size)

    def guarded(rank):
        try:
            return task(ThreadRanks(world, rank))
        except Exception as error:
            return error

    with ThreadPoolExecutor(size) as pool:
        return list(pool.map(guarded, range(size)))
