"""What the rasterizers of the CPU share: their viewport, their threads, and columns of one type to the compiler."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Self

import numpy as np

from ...shared.errors import InputError
from . import MAX_SIDE_PX


class ThreadedRasterizer:
    """Owns the threads of a rasterizer; a context manager.

    width, height : viewport, 1…32768 px.  threads : at most this many; None: all cores this process may run on.
    Raises InputError if one of them is out of range.
    """

    def __init__(self, width: int, height: int, threads: int | None) -> None:
        if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
            raise InputError(f"viewport: found {width}×{height}, expected 1…{MAX_SIDE_PX} px a side")
        self._threads = len(os.sched_getaffinity(0)) if threads is None else threads
        if self._threads < 1:
            raise InputError(f"threads: found {threads}, expected at least 1")
        self.device = f"{self._threads} CPU thread" + "s" * (self._threads > 1)
        self._executor = ThreadPoolExecutor(self._threads, "raster")

    def _run(self, work: Callable[[int], None], n: int | None = None) -> None:
        """Call ``work(0)`` … ``work(n − 1)``, each on its own thread; None: one a thread."""
        for _ in self._executor.map(work, range(self._threads if n is None else n)):
            pass

    def close(self) -> None:
        """End the threads."""
        self._executor.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_only(column: np.ndarray) -> np.ndarray:
    """A read-only view, so that memory-mapped and fresh arrays are one type to the compiler.

    A column of one repeated value (stride 0) stays one value in memory; kernels are compiled for it apart.
    """
    view = column.view() if column.strides == (0,) else np.ascontiguousarray(column).view()
    view.flags.writeable = False
    return view
