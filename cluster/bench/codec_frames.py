"""Frames drawn from encoded cells, for ``splatpipe bench codecs``: all cells, one pixel a point."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np

from ...nodes.raster import ResidentPoints, kernels
from ...nodes.raster.blocks import frustum
from ...nodes.raster.cpu import TURNS_PER_THREAD, CpuRasterizer, framebuffers_worth
from ...nodes.raster.groups import draw_groups, group_cells
from ...nodes.raster.pools import PoolCell, draw_pools, pool_cells
from ...shared.camera import Camera
from ...shared.codecs import linear_groups, streams
from ...shared.codecs.palette import to_palette
from ...shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from .codec_cells import Cell

Draw = Callable[[], np.ndarray]
"""→ (height, width) uint64 framebuffer words, valid until the next call."""


@contextmanager
def points_frame(
    cells: Sequence[Cell], positions: Sequence[np.ndarray], orders: Sequence[np.ndarray], camera: Camera, compact: bool
) -> Iterator[Draw]:
    """From float32, or from fixed point: positions of each cell, relative to its cube, and which points they are."""
    points = resident(cells, positions, orders)
    everything = np.array([(0, len(points), 1)], RENDER_POINT)
    with CpuRasterizer(points, camera.width, camera.height, compact=compact) as rasterizer:
        yield lambda: rasterizer.draw(camera, everything)


def resident(cells: Sequence[Cell], positions: Sequence[np.ndarray], orders: Sequence[np.ndarray]) -> ResidentPoints:
    """Points as a rasterizer takes them, blocks being cells."""
    x, y, z = (np.ascontiguousarray(column, np.float32) for column in np.concatenate(positions).T)
    colour = np.concatenate([cell.colour[order] for cell, order in zip(cells, orders, strict=True)])
    first = np.cumsum([0, *map(len, positions[:-1])], dtype=np.int64)
    return ResidentPoints(x, y, z, colour, first, np.array([cell.lower for cell in cells]))


@contextmanager
def pools_frame(
    cells: Sequence[Cell], data: Sequence[np.ndarray], orders: Sequence[np.ndarray], camera: Camera, bits: int
) -> Iterator[Draw]:
    """From the bytes of ``codecs.streams``."""
    held = []
    for cell, coded, order in zip(cells, data, orders, strict=True):
        palette, colour = to_palette(cell.colour[order])
        pooled = streams.read_pools(coded, bits, len(order))
        held.append(PoolCell(pooled, cell.lower, cell.edge / 2**bits, palette, colour))
    with _kernel_frame(draw_pools, pool_cells(held), len(cells), sum(map(len, orders)), camera) as draw:
        yield draw


@contextmanager
def groups_frame(
    cells: Sequence[Cell], data: Sequence[np.ndarray], orders: Sequence[np.ndarray], camera: Camera, bits: int
) -> Iterator[Draw]:
    """From the bytes of ``codecs.linear_groups``."""
    held = group_cells(
        [linear_groups.read(coded, bits, len(order)) for coded, order in zip(data, orders, strict=True)],
        np.array([cell.lower for cell in cells]),
        np.array([cell.edge / 2**bits for cell in cells]),
        np.zeros(len(cells)),
        np.concatenate([cell.colour[order] for cell, order in zip(cells, orders, strict=True)]),
    )
    with _kernel_frame(draw_groups, held, len(cells), sum(map(len, orders)), camera) as draw:
        yield draw


@contextmanager
def _kernel_frame(kernel: Any, form: Any, n_cells: int, n_points: int, camera: Camera) -> Iterator[Draw]:
    """Drawn by a kernel of encoded cells, with as many threads and framebuffers as ``CpuRasterizer`` takes."""
    threads = len(os.sched_getaffinity(0))
    n = framebuffers_worth(n_points, threads, camera.width * camera.height)
    pitch = kernels.pitch_of(camera.width)
    words = np.full((n, camera.height * pitch + 1), FRAMEBUFFER_EMPTY)
    words[:, -1] = 0
    dirty = np.zeros((n, camera.height * pitch // kernels.RUN + 1), np.uint8)
    frame = np.empty((camera.height, camera.width), np.uint64)
    filled = np.ones(camera.height * pitch // kernels.RUN, np.uint8)
    near, columns, rows, one = map(np.float32, (camera.near, camera.width, camera.height, 1))
    view = kernels.View(near, columns, rows, one, one, np.int32(pitch), True)
    every, turn = np.arange(n_cells), max(1, n_cells // (n * TURNS_PER_THREAD))

    with ThreadPoolExecutor(threads) as executor:

        def draw() -> np.ndarray:
            seen, counter, merged = frustum(camera, 1.5), np.zeros(1, np.int64), np.zeros(1, np.int64)
            for _ in executor.map(
                lambda i: kernel(form, every, seen, view, words[i], dirty[i], turn, counter), range(n)
            ):
                pass
            for _ in executor.map(lambda _: kernels.merge(words, dirty, frame, filled, merged), range(threads)):
                pass
            return frame

        yield draw
