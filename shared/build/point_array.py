"""The stored points: gathered from memory in their final order, made relative to their block, appended to files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import njit

from ..octree import cell_centers
from ..points import ATTRIBUTES, RADIUS_STEPS, PointBatch
from .parallel import Workers
from .subtree import LinkedCells
from .writer import ColumnFile, ColumnFolder, writing

POINT_ARRAY_PART = ("n_stored", "block_first", "block_origin", "block_ends", "columns")
"""What ``PointArrayWriter.part`` gives."""
_CHUNK = 1 << 18
_LAYERED_BLOCK_POINTS = 1024
_DEPTH_FIRST_BLOCK_POINTS = 2048


def block_levels_of(point_order: str, points_per_cell: int) -> int:
    """How many levels above a cell its block stands in layered order, so that a block holds 1024 points or more.

    Decided by the settings alone, so that the first partition can be written before the last one is read: cells of a
    surface hold about half of ``points_per_cell`` points, and four times as many a level up. 0 in depth-first order.
    """
    levels = 0
    while point_order == "layered" and points_per_cell / 2 * 4**levels < _LAYERED_BLOCK_POINTS:
        levels += 1
    return levels


def least_partition(point_order: str, points_per_cell: int) -> int:
    """The fewest points for which cells that hold more are divided into partitions: no block is larger."""
    return max(2 * points_per_cell, 0 if point_order == "layered" else _DEPTH_FIRST_BLOCK_POINTS)


def block_level(cells: LinkedCells, point_order: str, points_per_cell: int) -> np.ndarray:
    """(n,) int64: the level of the ancestor or self of each cell whose centre its points are stored relative to.

    Layered: ``block_levels_of`` above the cell. Depth-first, where leaves of several levels alternate: the highest
    ancestor with at most 2048 points below, or ``points_per_cell`` if that is more; so blocks are never interrupted.
    """
    level = cells.level.astype(np.int64)
    if point_order == "layered":
        return np.maximum(level - block_levels_of(point_order, points_per_cell), 0)
    inside = cells.count <= max(points_per_cell, _DEPTH_FIRST_BLOCK_POINTS)
    for at in np.unique(level)[1:]:
        here = np.flatnonzero(level == at)
        parent = cells.parent[here]
        level[here[inside[parent]]] = level[parent[inside[parent]]]
    return level


@njit(nogil=True, cache=True)
def _gather_positions(positions, stored, begin, end, block_first, block_origin, x, y, z):
    block = np.searchsorted(block_first, begin, side="right") - 1
    for j in range(begin, end):
        while block + 1 < len(block_first) and block_first[block + 1] <= j:
            block += 1
        i = stored[j]
        x[j - begin] = positions[i, 0] - block_origin[block, 0]
        y[j - begin] = positions[i, 1] - block_origin[block, 1]
        z[j - begin] = positions[i, 2] - block_origin[block, 2]


def radius_steps(n_below: np.ndarray, n_points: np.ndarray) -> np.ndarray:
    """(c,) int64: codes by which radii grow in sets of ``n_points`` that stand for ``n_below`` points of a surface.

    Spacings grow with the square root of their ratio; rounded up.
    """
    return np.ceil(RADIUS_STEPS / 2 * np.log2(n_below / np.maximum(n_points, 1)) - 1e-9).astype(np.int64)


@njit(nogil=True, cache=True)
def _gather_radii(column, stored, begin, end, cell_end, steps, out):
    cell = np.searchsorted(cell_end, begin, side="right")
    for j in range(begin, end):
        while cell_end[cell] <= j:
            cell += 1
        out[j - begin] = max(np.int64(column[stored[j]]) - steps[cell], 0)


@njit(nogil=True, cache=True)
def _gather(column, stored, begin, end, out):
    for j in range(begin, end):
        out[j - begin] = column[stored[j]]


class PointArrayWriter:
    """Appends points to x, y, z and the attribute files, and keeps the table of blocks.

    Each file is one task: it gathers, writes and sums up its own bytes in order, side by side with the others.
    """

    def __init__(self, writer: ColumnFolder, attributes: tuple[str, ...], origin: np.ndarray, edge: float) -> None:
        self.n_stored = 0
        self.attributes = attributes
        self._writer = writer
        self._origin, self._edge = origin, edge
        self._xyz = [writer.open_column(name, np.dtype("<f4")) for name in "xyz"]
        self._columns = {a: writer.open_column(f"attr_{a}", ATTRIBUTES[a]) for a in attributes}
        self._block_first: list[np.ndarray] = []
        self._block_origin: list[np.ndarray] = []
        self._first_block = self._last_block = (-1, -1)  # (level, code)

    def append(
        self,
        points: PointBatch,
        stored: np.ndarray,
        level: np.ndarray,
        code: np.ndarray,
        n_points: np.ndarray,
        n_below: np.ndarray,
        block_level: np.ndarray,
        workers: Workers,
        advance: Callable[[int], None] | None = None,
    ) -> None:
        """Append ``points`` picked by ``stored``.

        stored : (m,) uint32 indices of points.
        level, code, n_points, n_below, block_level : the cells that own them, one after another; n_points sums up to m,
            n_below counts the input points that they stand for.
        advance : called with the points written of these.
        """
        first, origin = self._open_blocks(level, code, n_points, block_level)
        with writing(self._writer.partial):
            tasks: list[tuple] = [(self._append_positions, points.positions, stored, first, origin, advance)]
            for name, column in points.attributes.items():
                if name == "radius":
                    cells = np.cumsum(n_points), radius_steps(n_below, n_points)
                    tasks.append((self._append_column, name, column, stored, _gather_radii, *cells))
                else:
                    tasks.append((self._append_column, name, column, stored, _gather))
            workers.map(lambda task, *arguments: task(*arguments), tasks)
        self.n_stored += len(stored)

    def _open_blocks(
        self, level: np.ndarray, code: np.ndarray, n_points: np.ndarray, block_level: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """First point within these points, and origin, of the runs of cells with one block; noted for the table."""
        block_code = code >> 3 * (level.astype(np.int64) - block_level)
        starts = np.flatnonzero(np.r_[True, (np.diff(block_level) != 0) | (np.diff(block_code) != 0)])
        first = (np.cumsum(n_points) - n_points)[starts]
        origin = cell_centers(self._origin, self._edge, block_level[starts], block_code[starts].astype(np.uint64))
        blocks = list(zip(block_level[starts].tolist(), block_code[starts].tolist(), strict=True))
        if not self._block_first:
            self._first_block = blocks[0]
        known = int(blocks[0] == self._last_block)  # goes on from the last call
        self._block_first.append(first[known:] + self.n_stored)
        self._block_origin.append(origin[known:])
        self._last_block = blocks[-1]
        return first, origin

    def _append_positions(self, positions, stored, first, origin, advance) -> None:
        xyz = np.empty((3, min(_CHUNK, len(stored))), np.float32)
        for begin in range(0, len(stored), _CHUNK):
            end = min(begin + _CHUNK, len(stored))
            _gather_positions(positions, stored, begin, end, first, origin, *xyz)
            for file, column in zip(self._xyz, xyz, strict=True):
                file.write(column[: end - begin])
            if advance:
                advance(end)

    def _append_column(self, name: str, column: np.ndarray, stored: np.ndarray, gather, *more: np.ndarray) -> None:
        out = np.empty(min(_CHUNK, len(stored)), column.dtype)
        for begin in range(0, len(stored), _CHUNK):
            end = min(begin + _CHUNK, len(stored))
            gather(column, stored, begin, end, *more, out)
            self._columns[name].write(out[: end - begin])

    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """((b,) int64 first point, (b, 3) float64 origin) of all blocks so far."""
        none = np.zeros(0, np.int64), np.zeros((0, 3))
        return np.concatenate([none[0], *self._block_first]), np.concatenate([none[1], *self._block_origin])

    def part(self) -> dict[str, np.ndarray]:
        """What has been appended, but for the files, as arrays, for ``go_on`` in another process."""
        first, origin = self.blocks()
        return {
            "n_stored": np.array(self.n_stored),
            "block_first": first,
            "block_origin": origin,
            "block_ends": np.array([self._first_block, self._last_block]),
            "columns": np.array([file.part for file in self._files()]),
        }

    def abandon(self) -> None:
        """Close the files, so that other processes may write behind what is in them."""
        for file in self._files():
            file.abandon()

    def copy_into(self, directory: Path, first_point: int) -> None:
        """Copy all points, behind which no more come, into the files of another writer, from ``first_point`` on."""
        with writing(directory):
            for file in self._files():
                file.copy_into(directory / file.path.name, first_point)

    def go_on(self, parts: list[dict[str, np.ndarray]]) -> None:
        """After ``abandon``: take over the points that other processes have copied behind, in the order of parts."""
        with writing(self._writer.partial):
            for i, file in enumerate(self._files()):
                file.go_on([part["columns"][i].tolist() for part in parts])
        for part in parts:
            if part["n_stored"]:
                first, last = map(tuple, part["block_ends"].tolist())
                known = int(first == self._last_block)
                self._block_first.append(part["block_first"][known:] + self.n_stored)
                self._block_origin.append(part["block_origin"][known:])
                self._last_block = last
                self.n_stored += int(part["n_stored"])

    def _files(self) -> list[ColumnFile]:
        return [*self._xyz, *self._columns.values()]
