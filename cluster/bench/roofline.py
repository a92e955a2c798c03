"""``splatpipe bench raster --roofline``: what limits the cpu rasterizer, by image size, order and positions.

A row holds the time of a whole frame and the times of its parts, each measured alone on all threads in the same run:

read     every byte of the points that the frame reads, once
project  the points' positions → words, from and to the first-level cache
scatter  the frame's words → framebuffers (12 bytes a point streamed beside them)
merge    the runs of the framebuffers that the frame drew to → the frame, which is left empty

The largest of them limits the frame: parts overlap at best, and add up at worst.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit

from ...nodes.raster import ResidentPoints, kernels
from ...nodes.raster.blocks import FLOAT32, FULL, HIGH, Blocks, frustum
from ...nodes.raster.compact import compact_positions
from ...nodes.raster.cpu import CpuRasterizer
from ...shared.camera import Camera
from ...shared.messages import FRAMEBUFFER_EMPTY
from ..record import machine_record, spread_ms
from .raster import bench_cases, camera_of, everything, read_share

SIZES = ((512, 512), (1024, 1024), (1920, 1080), (3840, 2160))
"""Widths and heights of the images."""


def bench_roofline(n_points: int = 4_000_000, repeats: int = 15) -> dict[str, Any]:
    """Time frames and their parts for each of ``SIZES``, order of the points, and kind of positions.

    Returns a JSON-able dict: ``rows``, ``threads``, the machine.
    """
    threads = len(os.sched_getaffinity(0))
    rows = []
    with ThreadPoolExecutor(threads) as executor:
        for width, height in SIZES:
            for order, points in _cases(n_points, camera_of(0, width, height)):
                for compact in (False, True):
                    parts = _Parts(points, camera_of(0, width, height), compact, executor, threads)
                    times = _times(points, parts, repeats)
                    median_s = {part: float(np.median(times[part])) for part in times}
                    frame_s = median_s.pop("frame")
                    rows.append(
                        {
                            "width": width,
                            "height": height,
                            "order": order,
                            "positions": "compact" if compact else "float32",
                            "bytes_per_point": parts.bytes_per_point,
                            "ms": spread_ms(times["frame"]),
                            "points_per_s": n_points / frame_s,
                            "share_of_read_limit": median_s["read"] / frame_s,
                            "parts_ms": {part: spread_ms(times[part]) for part in median_s},
                            "limit": max(median_s, key=lambda part: median_s[part]),
                        }
                    )
    return {
        "benchmark": "roofline",
        "n_points": n_points,
        "threads": threads,
        "rows": rows,
        "machine": machine_record(),
    }


def _cases(n_points: int, camera: Camera) -> Iterator[tuple[str, ResidentPoints]]:
    """Those of ``bench_cases``, and the stored order without a colour column."""
    for order, points in bench_cases(n_points, camera):
        yield order, points
        if order == "stored":
            yield f"{order}, one colour", replace(points, colour=np.broadcast_to(points.colour[0], len(points)))


def print_roofline(results: dict[str, Any], console: Any) -> None:
    """The result as a table."""
    from rich.table import Table

    table = Table(title=f"{results['n_points']:,} points, cpu, {results['threads']} threads; ms are medians")
    for heading in ("image", "order", "positions"):
        table.add_column(heading, no_wrap=True)
    for heading in ("bytes/point", "ms", "M points/s", "of read limit", "read", "project", "scatter", "merge"):
        table.add_column(heading, justify="right")
    table.add_column("limit")
    for row in results["rows"]:
        table.add_row(
            f"{row['width']}×{row['height']}",
            row["order"],
            row["positions"],
            f"{row['bytes_per_point']:.1f}",
            f"{row['ms']['median']:.2f} ({row['ms']['min']:.2f}–{row['ms']['max']:.2f})",
            f"{row['points_per_s'] / 1e6:.0f}",
            f"{row['share_of_read_limit']:.0%}",
            *(f"{row['parts_ms'][part]['median']:.2f}" for part in ("read", "project", "scatter", "merge")),
            row["limit"],
        )
    console.print(table)
    machine = results["machine"]
    console.print(f"{machine['cpu']}, {machine['cores']} cores, commit {machine['commit'] or 'unknown'}")


def _times(points: ResidentPoints, parts: _Parts, repeats: int) -> dict[str, list[float]]:
    """Seconds of a frame and of each part, taken in turn, so that what disturbs the machine disturbs all of them."""
    width, height = parts.camera.width, parts.camera.height
    with CpuRasterizer(points, width, height, compact=parts.compact) as rasterizer:
        numbers = itertools.count()
        work = {
            "frame": lambda: rasterizer.draw(camera_of(next(numbers), width, height), everything(points)),
            "read": parts.read,
            "project": parts.project,
            "scatter": parts.scatter,
            "merge": parts.merge,  # what scatter drew
        }
        times: dict[str, list[float]] = {part: [] for part in work}
        for _ in range(repeats + 2):
            for part, run in work.items():
                start = time.perf_counter()
                run()
                times[part].append(time.perf_counter() - start)
    return {part: seconds[2:] for part, seconds in times.items()}  # the first ones compile and take memory


@dataclass
class _Parts:
    """The parts of the frame of one camera, each to be timed alone."""

    points: ResidentPoints
    camera: Camera
    compact: bool
    executor: ThreadPoolExecutor
    threads: int

    def __post_init__(self) -> None:
        points, width, height = self.points, self.camera.width, self.camera.height
        n, none = len(points), np.empty((0, 3))
        self._cuts = [n * i // self.threads for i in range(self.threads + 1)]
        self._pitch = kernels.pitch_of(width)
        near, columns, rows, one = map(np.float32, (self.camera.near, width, height, 1))
        self._view = kernels.View(near, columns, rows, one, one, np.int32(self._pitch), True)

        positions = compact_positions(points, self.threads) if self.compact else None
        lower, step = (positions.lower, positions.step) if positions else (none, none)
        n_blocks = len(points.block_origin)
        blocks, seen = Blocks(points.block_origin, np.zeros(n_blocks), lower, step), frustum(self.camera, 1.5)
        self._rows = np.empty((n_blocks, 3, 4), np.float32)
        precision = np.array([kernels.block_rows(blocks, s, seen, self._rows[s]) for s in range(n_blocks)], np.uint8)
        self._precision = precision
        self._first = np.append(points.block_first_point, n).astype(np.int64)
        n_of_block = np.diff(self._first)
        if positions:
            low = int(n_of_block[precision == FULL].sum())
            self.columns_read = [positions.high, positions.low[:low]]
            self._high, self._low = positions.high, positions.low
            self._x = self._y = self._z = np.empty(0, np.float32)
        else:
            self.columns_read = [points.x, points.y, points.z]
            self._high = self._low = np.empty(0, np.uint32)
            self._x, self._y, self._z = points.x, points.y, points.z
        if points.colour.strides != (0,):
            self.columns_read.append(points.colour)
        self.bytes_per_point = 4 * sum(map(len, self.columns_read)) / n

        self._place, self._words = np.empty(n, np.int32), np.empty(n, np.uint64)
        self._outside = np.int32(height * self._pitch)
        self._project(True)
        self._framebuffers = np.full((self.threads, height * self._pitch + 1), FRAMEBUFFER_EMPTY)
        self._framebuffers[:, -1] = 0
        self._dirty = np.zeros((self.threads, height * self._pitch // kernels.RUN + 1), np.uint8)
        self._frame = np.empty((height, width), np.uint64)
        self._filled = np.ones(height * self._pitch // kernels.RUN, np.uint8)

    def read(self) -> None:
        self._run(lambda i: read_share(self.columns_read, i, self.threads))

    def project(self) -> None:
        self._project(False)

    def _project(self, keep: bool) -> None:
        self._run(
            lambda i: _project_range(
                (self._x, self._y, self._z, self._high, self._low, self.points.colour),
                (self._first, self._rows, self._precision),
                (self._cuts[i], self._cuts[i + 1]),
                self._view,
                self._outside,
                self._place,
                self._words,
                keep,
            )
        )

    def scatter(self) -> None:
        self._run(
            lambda i: _scatter_range(
                self._place, self._words, self._cuts[i], self._cuts[i + 1], self._framebuffers[i], self._dirty[i]
            )
        )

    def merge(self) -> None:
        counter = np.zeros(1, np.int64)
        self._run(lambda _: kernels.merge(self._framebuffers, self._dirty, self._frame, self._filled, counter))

    def _run(self, work: Callable[[int], None]) -> None:
        for _ in self.executor.map(work, range(self.threads)):
            pass


@njit(nogil=True)  # numba's cache would not see that the kernels have changed
def _project_range(columns, blocks, cut, view, outside, place, words, keep):
    """Words of the points ``cut[0]`` … ``cut[1]`` − 1: kept, or made again and again from one batch in the cache."""
    x, y, z, high, low, colour = columns
    first, rows, precision = blocks
    begin, end = cut
    batch = kernels.BATCH
    gx, gy, gz = np.empty(batch, np.float32), np.empty(batch, np.float32), np.empty(batch, np.float32)
    batch_place, depth = np.empty(batch, np.int32), np.empty(batch, np.float32)
    packed = np.empty(batch, np.uint64)
    for b in range(len(precision)):
        for start in range(max(first[b], begin), min(first[b + 1], end), batch):
            n = min(batch, min(first[b + 1], end) - start)
            source = start if keep else min(begin, len(place) - n)
            if precision[b] == FLOAT32:
                kernels._project_pixels(x, y, z, source, n, rows[b], view, outside, batch_place, depth)
            elif precision[b] == HIGH or precision[b] == FULL:
                kernels._decode(high, low, source, n, precision[b], False, gx, gy, gz)
                kernels._project_pixels(gx, gy, gz, 0, n, rows[b], view, outside, batch_place, depth)
            else:
                batch_place[:n] = outside
            kernels._pack(depth, colour, source, n, packed)
            if keep:
                for i in range(n):
                    place[start + i], words[start + i] = batch_place[i], packed[i]


@njit(nogil=True, cache=True)
def _scatter_range(place, packed, begin, end, words, dirty):
    """As ``kernels._take_pixels`` does, over a range."""
    for i in range(begin, end):
        p = np.uintp(place[i])
        words[p] = min(words[p], packed[i])
        dirty[p >> kernels.RUN_SHIFT] = 1
