"""Positions of a scene that are held cell by cell in the form of a codec: whose code is where, and decoding.

A code holds the grid points of one cell's own range of the point-array, in the cell's cube, in whatever order suits the
codec. The order in which they are *stored*, which attributes, prefixes and strides go by, follows from the points:
stratified in layered order, random in depth-first order (``set_order``), points in one bin in the order of the code. A
point stands at the centre of its bin, relative to the origin of its block, in float32.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from .codecs import Codec
from .codecs.grid import from_grid
from .codecs.occupancy_kernels import morton_keys
from .codecs.order import sorted_order
from .codecs.positions import position_codec
from .errors import CodecError
from .octree import Octree
from .set_order import random_order, stratified_order

_PIECE_POINTS = 1 << 15
"""Points that a thread decodes before it looks for more."""


@dataclass(frozen=True)
class OwnerCells:
    """The cells that own points, in stored order, with what coding their positions needs.

    cell : (c,) int64, index in the octree.  level : (c,) int64.  code : (c,) uint64.
    first_point : (c + 1,) int64, where the range of each begins in the point-array, and the end of the last.
    lower : (c, 3) float64, lower corner of the cell's cube relative to the origin of its block, world units.
    edge : (c,) float64, of the cube, world units.
    """

    cell: np.ndarray
    level: np.ndarray
    code: np.ndarray
    first_point: np.ndarray
    lower: np.ndarray
    edge: np.ndarray

    def __len__(self) -> int:
        return len(self.cell)

    @classmethod
    def of(cls, octree: Octree, block_first_point: np.ndarray, block_origin: np.ndarray) -> OwnerCells:
        """Those of an octree; blocks as ``Scene.blocks`` gives them."""
        cell = octree.owners
        first_point = octree.first_point[cell]
        block = np.searchsorted(block_first_point, first_point, side="right") - 1
        edge = 2 * octree.half_edges[cell]
        return cls(
            cell,
            octree.level[cell].astype(np.int64),
            octree.code[cell],
            np.append(first_point, first_point[-1] + octree.n_points[cell[-1]]),
            octree.centers[cell] - block_origin[block] - edge[:, None] / 2,
            edge,
        )

    def n_points(self, i: int) -> int:
        """Points of the i-th of these cells."""
        return int(self.first_point[i + 1] - self.first_point[i])

    def stored_order(self, i: int, points: np.ndarray, bits: int, point_order: str) -> np.ndarray:
        """(n,) int64: which of the (n, 3) decoded grid points of the i-th cell stands in which place of its range."""
        if point_order == "depth-first":
            return random_order(self.level[i], self.code[i], len(points))
        along = sorted_order(morton_keys(points, bits), 3 * bits)
        return stratified_order(self.level[i], self.code[i], along)

    def relative(self, i: int, points: np.ndarray, bits: int) -> np.ndarray:
        """(3, n) float32 x, y, z of (n, 3) grid points of the i-th cell, relative to the origin of its block."""
        return np.ascontiguousarray(from_grid(points, self.lower[i], self.edge[i], bits).T, np.float32)


@dataclass(frozen=True)
class CodedPositions:
    """The positions of all stored points, as codes.

    cells : whose they are.
    first_byte : (c + 1,) int64, where the code of each cell begins in ``codes``, and the end of the last.
    codes : (m,) uint8, may be mapped from a file.
    codec : one of ``scene_info.POSITIONS`` but float32.  bits : an axis of the grid in each cell's cube.
    point_order : of the scene.
    """

    cells: OwnerCells
    first_byte: np.ndarray
    codes: np.ndarray
    codec: str
    bits: int
    point_order: str

    def code(self, i: int) -> np.ndarray:
        """(m,) uint8: the code of the i-th cell."""
        return np.asarray(self.codes[self.first_byte[i] : self.first_byte[i + 1]])

    def grid_points(self, i: int, codec: Codec | None = None) -> np.ndarray:
        """(n, 3) uint32 grid points of the i-th cell, in coded order.

        codec : that of ``codec``, for who has it.  Raises CodecError naming the cell if its code is damaged.
        """
        codec, n = codec or position_codec(self.codec), self.cells.n_points(i)
        try:
            points = codec.decode(self.code(i), self.bits, n)
        except CodecError as error:
            raise CodecError(f"cell {self.cells.cell[i]}: {error}") from error
        if len(points) != n:
            raise CodecError(f"cell {self.cells.cell[i]}: found {len(points)} points, expected {n}")
        return points

    def columns(self, start: int, stop: int, threads: int) -> np.ndarray:
        """(3, stop − start) float32 x, y, z of a range of stored points, relative to the origin of their block.

        Cells that lie in it partly are decoded whole.  Raises CodecError naming the cell whose code is damaged.
        Cost: decoding, cell by cell on ``threads`` threads; memory 12 bytes a point, beside one cell a thread.
        """
        out = np.empty((3, stop - start), np.float32)
        if start >= stop:
            return out
        codec = position_codec(self.codec)
        first, last = np.searchsorted(self.cells.first_point, [start, stop - 1], side="right") - 1

        def decode(begin: int, end: int) -> None:
            for i in range(begin, end):
                points = self.grid_points(i, codec)
                points = points[self.cells.stored_order(i, points, self.bits, self.point_order)]
                at = int(self.cells.first_point[i]) - start
                part = slice(max(-at, 0), stop - start - at)
                out[:, max(at, 0) : at + len(points)] = self.cells.relative(i, points[part], self.bits)

        pieces = point_pieces(self.cells.first_point, first, last + 1, _PIECE_POINTS)
        if len(pieces) == 1 or threads == 1:
            decode(first, last + 1)
        else:
            with ThreadPoolExecutor(threads) as executor:
                for _ in executor.map(decode, *zip(*pieces, strict=True)):
                    pass
        return out


def point_pieces(first_point: np.ndarray, begin: int, end: int, n_points: int) -> list[tuple[int, int]]:
    """(begin, end) of runs of the cells ``begin`` … ``end`` − 1: each a single cell, or of at most ``n_points``.

    first_point : (c + 1,) int64, as of ``OwnerCells``.
    """
    pieces = []
    while begin < end:
        fits = int(np.searchsorted(first_point, first_point[begin] + n_points, side="right")) - 1
        pieces.append((begin, min(max(fits, begin + 1), end)))
        begin = pieces[-1][1]
    return pieces
