"""What one rank measures by itself: its CPU, its memory, and its rasterizer's rates.

Each probe repeats a short piece of work and gives the median and the spread; none takes longer than a few seconds.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit

from ...nodes.raster import PointSize, ResidentPoints
from ...nodes.raster.choose import make_rasterizer
from ...shared.build.settings import available_memory_bytes
from ...shared.camera import Camera
from ...shared.messages import RENDER_POINT

CACHE_LINE_BYTES = 64
CACHED_BYTES = 256 << 10
"""Working set that stays in the private caches of a core."""

_MOST_UNCACHED_BYTES = 512 << 20
_CHASE_STEPS = 200_000
_FLOP_ELEMENTS = 256
_FLOP_ROUNDS = 500_000
_MOST_POINTS = 4_000_000
_SQUARE_PX = 64
_SQUARES = 2_000
_REPEATS = 7


class Figure(NamedTuple):
    """Median, lowest and highest of repeated measurements."""

    value: float
    low: float
    high: float
    repeats: int

    @property
    def spread(self) -> str:
        """The spread, for people."""
        return f"{self.low:.3g} … {self.high:.3g}, {self.repeats} times"


def cpu_flop_per_s(dtype: type[np.floating]) -> Figure:
    """Multiply-adds of one core, two operations each: compiled, vectorised, operands in the first-level cache."""
    values, factor, term = np.ones(_FLOP_ELEMENTS, dtype), dtype(0.999), dtype(0.001)
    _multiply_add(values, factor, term, 1)
    times = _times_s(lambda: _multiply_add(values, factor, term, _FLOP_ROUNDS), _REPEATS)
    return _figure(2 * _FLOP_ELEMENTS * _FLOP_ROUNDS / times)


def uncached_bytes() -> int:
    """Working set of the uncached probes: twice the last-level cache, within 512 MiB and a quarter of what is free."""
    return min(max(2 * cache_bytes(), 64 << 20), _MOST_UNCACHED_BYTES, available_memory_bytes() // 4)


def memory_latency_s(working_set_bytes: int) -> Figure:
    """Seconds of a read whose address is the result of the read before, in random order (address translation included).

    Cost: one pass of writes over the working set, then a fixed number of reads.
    """
    n_lines = working_set_bytes // CACHE_LINE_BYTES
    following = np.empty((n_lines, CACHE_LINE_BYTES // 8), np.int64)
    _one_cycle(following, 1)
    _chase(following, min(_CHASE_STEPS, n_lines))
    return _figure(_times_s(lambda: _chase(following, _CHASE_STEPS), _REPEATS) / _CHASE_STEPS)


def memory_bytes_per_s(working_set_bytes: int) -> Figure:
    """Bytes one core reads in order in a second."""
    words = np.ones(working_set_bytes // 8, np.uint64)
    rounds = max(1, (32 << 20) // working_set_bytes)
    _read(words, 1)
    return _figure(rounds * words.nbytes / _times_s(lambda: _read(words, rounds), _REPEATS))


def memory_bytes() -> int:
    """Main memory of this machine."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def cache_bytes() -> int:
    """Last-level cache of the first core; 0 where the system does not say."""
    sizes = Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size")
    units = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30}
    found = [text.strip() for text in map(Path.read_text, sizes)]
    return max((int(text[:-1]) * units[text[-1]] for text in found if text[-1:] in units), default=0)


def points_per_s(name: str, points: ResidentPoints, camera: Camera, threads: int | None) -> Figure:
    """Points drawn in a second, one pixel each, frame included: O_VP as a whole, as the thesis measures it (3.3.1).

    Draws the first points of the scene, however many of them the frame shows.
    """
    entries = np.zeros(1, RENDER_POINT)
    entries["range"], entries["stride"] = min(len(points), _MOST_POINTS), 1
    return _drawn_per_s(name, points, camera, PointSize(), entries, threads, int(entries["range"][0]))


def fragments_per_s(name: str, camera: Camera, threads: int | None) -> Figure:
    """Pixels filled in a second by large squares, hidden ones included: O_FP (thesis 3.3.1, by quadrilaterals).

    The squares lie at random in the image, at random depths.
    """
    side = min(_SQUARE_PX, camera.width, camera.height)
    points = squares_in_view(camera, side, _SQUARES)
    entries = np.zeros(1, RENDER_POINT)
    entries["range"], entries["stride"] = _SQUARES, 1
    size = PointSize(pixels=side)
    return _drawn_per_s(name, points, camera, size, entries, threads, _SQUARES * side * side)


def squares_in_view(camera: Camera, side: int, n: int) -> ResidentPoints:
    """Points whose squares, ``side`` px wide, lie wholly in the image, at random places and depths."""
    rng = np.random.default_rng(1)
    inverse = np.linalg.inv(camera.clip_from_world)
    margin = 1 - side / np.array([camera.width, camera.height])
    clip = np.ones((n, 4))
    clip[:, :2] = rng.uniform(-1, 1, (n, 2)) * margin
    on_near_plane = clip @ inverse.T  # z/w = 1 there
    towards = on_near_plane[:, :3] / on_near_plane[:, 3:] - camera.eye
    x, y, z = np.ascontiguousarray((towards * rng.uniform(2, 100, (n, 1))).T, np.float32)
    colour = np.full(n, 0xFF00_00FF, np.uint32)
    return ResidentPoints(x, y, z, colour, np.zeros(1, np.int64), camera.eye[None].astype(np.float64))


def _drawn_per_s(
    name: str,
    points: ResidentPoints,
    camera: Camera,
    size: PointSize,
    entries: np.ndarray,
    threads: int | None,
    amount: int,
) -> Figure:
    """What a frame draws, ``amount``, over the time of the frame."""
    with make_rasterizer(name, points, camera.width, camera.height, size, threads) as rasterizer:
        rasterizer.draw(camera, entries)
        return _figure(amount / _times_s(lambda: rasterizer.draw(camera, entries), _REPEATS))


def _figure(samples: np.ndarray) -> Figure:
    return Figure(float(np.median(samples)), float(samples.min()), float(samples.max()), len(samples))


def _times_s(work: Callable[[], object], repeats: int) -> np.ndarray:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return np.array(times)


@njit(nogil=True, cache=True)
def _multiply_add(values, factor, term, rounds):
    """``values`` ← values · factor + term, ``rounds`` times: independent chains, so throughput and not latency."""
    for _ in range(rounds):
        for i in range(len(values)):
            values[i] = values[i] * factor + term


@njit(nogil=True, cache=True)
def _one_cycle(following, seed):
    """Column 0 of (n, m) int64 becomes a random permutation with a single cycle (Sattolo 1986)."""
    state = np.uint64(seed)
    n = len(following)
    for i in range(n):
        following[i, 0] = i
    for i in range(n - 1, 0, -1):
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)  # Knuth, MMIX
        j = np.int64((state >> np.uint64(33)) % np.uint64(i))
        following[i, 0], following[j, 0] = following[j, 0], following[i, 0]


@njit(nogil=True, cache=True)
def _chase(following, steps):
    at = 0
    for _ in range(steps):
        at = following[at, 0]
    return at


@njit(nogil=True, cache=True)
def _read(words, rounds):
    """Something that depends on every word, at a cost that memory hides."""
    mixed = np.uint64(0)
    for k in range(rounds):
        for i in range(len(words)):
            mixed += words[i] ^ np.uint64(k)
    return mixed
