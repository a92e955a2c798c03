"""Frames drawn from encoded cells, for ``splatpipe bench codecs``: all cells, one pixel a point."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Any

import numpy as np

from ...nodes.raster import PointSize, ResidentPoints
from ...nodes.raster.cpu import CpuRasterizer
from ...nodes.raster.framebuffers import FramebufferRasterizer
from ...nodes.raster.group_raster import CpuGroupRasterizer, ResidentGroups
from ...nodes.raster.groups import GroupCell, group_cell, group_cells
from ...nodes.raster.pools import PoolCell, draw_pools, pool_cells
from ...shared.camera import Camera
from ...shared.codecs import linear_groups, streams
from ...shared.codecs.palette import to_palette
from ...shared.messages import RENDER_POINT
from .codec_cells import Cell

Draw = Callable[[], np.ndarray]
"""→ (height, width) uint64 framebuffer words, valid until the next call."""


def points_frame(
    cells: Sequence[Cell], positions: Sequence[np.ndarray], orders: Sequence[np.ndarray], camera: Camera, compact: bool
) -> AbstractContextManager[Draw]:
    """From float32, or from fixed point: positions of each cell, relative to its cube, and which points they are."""
    return resident_frame(resident(cells, positions, orders), camera, compact)


@contextmanager
def resident_frame(points: ResidentPoints, camera: Camera, compact: bool) -> Iterator[Draw]:
    """From float32, or from fixed point."""
    everything = np.array([(0, len(points), 1)], RENDER_POINT)
    with CpuRasterizer(points, camera.width, camera.height, compact=compact) as rasterizer:
        yield lambda: rasterizer.draw(camera, everything)


def resident(cells: Sequence[Cell], positions: Sequence[np.ndarray], orders: Sequence[np.ndarray]) -> ResidentPoints:
    """Points as a rasterizer takes them, blocks being cells."""
    x, y, z = (np.ascontiguousarray(column, np.float32) for column in np.concatenate(positions).T)
    colour = np.concatenate([cell.colour[order] for cell, order in zip(cells, orders, strict=True)])
    first = np.cumsum([0, *map(len, positions[:-1])], dtype=np.int64)
    return ResidentPoints(x, y, z, colour, first, np.array([cell.lower for cell in cells]))


def pools_frame(
    cells: Sequence[Cell], data: Sequence[np.ndarray], orders: Sequence[np.ndarray], camera: Camera, bits: int
) -> AbstractContextManager[Draw]:
    """From the bytes of ``codecs.streams``."""
    return cell_pools_frame(list(map(partial(cell_of_pools, bits), cells, data, orders)), camera)


def cell_of_pools(bits: int, cell: Cell, data: np.ndarray, order: np.ndarray) -> PoolCell:
    """A cell's bytes of ``codecs.streams``, in the form they are drawn from."""
    palette, colour = to_palette(cell.colour[order])
    return PoolCell(streams.read_pools(data, bits, len(order)), cell.lower, cell.edge / 2**bits, palette, colour)


@contextmanager
def cell_pools_frame(cells: Sequence[PoolCell], camera: Camera) -> Iterator[Draw]:
    """From cells of pools."""
    n_points = sum(len(cell.colour) for cell in cells)
    with _CellRasterizer(draw_pools, pool_cells(cells), len(cells), n_points, camera) as rasterizer:
        yield rasterizer.draw


def groups_frame(
    cells: Sequence[Cell], data: Sequence[np.ndarray], orders: Sequence[np.ndarray], camera: Camera, bits: int
) -> AbstractContextManager[Draw]:
    """From the bytes of ``codecs.linear_groups``."""
    return cell_groups_frame(list(map(partial(cell_of_groups, bits), cells, data, orders)), camera)


def cell_of_groups(bits: int, cell: Cell, data: np.ndarray, order: np.ndarray) -> GroupCell:
    """A cell's bytes of ``codecs.linear_groups``, in the form they are drawn from."""
    return group_cell(linear_groups.read(data, bits, len(order)), cell.lower, cell.edge / 2**bits, cell.colour[order])


@contextmanager
def cell_groups_frame(cells: Sequence[GroupCell], camera: Camera) -> Iterator[Draw]:
    """From cells of linear groups."""
    n_points = [len(cell.kept_colour) + len(cell.inner_colour) for cell in cells]
    points = ResidentGroups(group_cells(cells), np.cumsum([0, *n_points], dtype=np.int64))
    everything = np.array([(0, len(points), 1)], RENDER_POINT)
    with CpuGroupRasterizer(points, camera.width, camera.height) as rasterizer:
        yield lambda: rasterizer.draw(camera, everything)


class _CellRasterizer(FramebufferRasterizer):
    """Draws all cells of an encoded form with its kernel."""

    def __init__(self, kernel: Any, form: Any, n_cells: int, n_points: int, camera: Camera) -> None:
        super().__init__(camera.width, camera.height, PointSize(), None)
        self._camera, self._n_points = camera, n_points
        self._work = partial(kernel, form, np.arange(n_cells)), n_cells

    def draw(self) -> np.ndarray:
        """As of ``Draw``."""
        return self._draw_frame(self._camera, self._n_points, self._work)
