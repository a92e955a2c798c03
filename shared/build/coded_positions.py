"""Positions of a scene cell by cell in the form of a codec, and its points in the order that follows from the codes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..codecs import Codec
from ..codecs.grid import to_grid
from ..codecs.positions import position_codec
from ..coded_positions import OwnerCells, point_pieces
from ..errors import InputError
from ..octree import Octree
from .parallel import Workers
from .settings import BuildSettings
from .writer import SceneWriter, writing

_PIECE_POINTS = 1 << 15
"""Points that a thread codes at a time."""
_PIECES = 4
"""Of these for a thread, before what they made is written."""
_MOST_BYTES = 2**32 - 1
_FIELDS = ("level", "code", "parent", "first_child", "n_children", "first_point", "n_points", "n_below")


def code_positions(
    cells: dict[str, np.ndarray],
    origin: np.ndarray,
    edge: float,
    block_first_point: np.ndarray,
    block_origin: np.ndarray,
    extent: float,
    settings: BuildSettings,
    capacity: int,
    writer: SceneWriter,
    workers: Workers,
    progress: Callable[[int, int], None],
) -> dict[str, np.ndarray]:
    """Write ``position_codes`` of all stored points; the new cell array ``cell_position_bytes``.

    The columns that are written already are written anew, the points of each cell in the order that their code asks
    for (``shared.coded_positions``), and x, y, z as they will be read from the code.

    extent : longest side of the scene's bounds.  capacity : points that may be coded at once, or those of one cell.
    progress : called with the points done, and in all.
    Raises InputError if the code of a cell is longer than 4 GiB.
    Cost: encoding and decoding each cell; as much disk as the columns take, until they are replaced.
    """
    links: dict[str, Any] = {name: cells[f"cell_{name}"] for name in _FIELDS}
    octree = Octree(origin=origin, edge=edge, cone=None, point_order=settings.point_order, **links)
    owners = OwnerCells.of(octree, block_first_point, block_origin)
    old = {name: np.asarray(writer.written(name)) for name in writer.columns}
    coder = _Coder(owners, [old[axis] for axis in "xyz"], extent, settings)
    n_bytes = np.zeros(len(octree), np.uint32)
    total = int(owners.first_point[-1])
    at_once = min(_PIECES * workers.n_threads * _PIECE_POINTS, capacity)
    with writer.rewriting(old) as new:
        codes = writer.open_column("position_codes", np.dtype("u1"))
        for begin, end in point_pieces(owners.first_point, 0, len(owners), at_once):
            pieces = point_pieces(owners.first_point, begin, end, _PIECE_POINTS)
            for (first, last), piece in zip(pieces, workers.map(coder.code, pieces), strict=True):
                n_bytes[owners.cell[first:last]] = piece.n_bytes
                own = slice(owners.first_point[first], owners.first_point[last])
                columns = {name: column[own][piece.order] for name, column in old.items() if name not in "xyz"}
                columns |= zip("xyz", piece.positions, strict=True)
                with writing(writer.partial):
                    codes.write(piece.codes)
                    for name, column in columns.items():
                        new[name].write(column)
            progress(int(owners.first_point[end]), total)
    return {"cell_position_bytes": n_bytes}


@dataclass(frozen=True)
class _Piece:
    """Consecutive cells that are coded.

    codes : (m,) uint8, one after the other.  n_bytes : (c,) int64, of each.
    order : (n,) int64, which of their points stands in which place.  positions : (3, n) float32, in that order.
    """

    codes: np.ndarray
    n_bytes: list[int]
    order: np.ndarray
    positions: np.ndarray


class _Coder:
    """Codes the cells of a scene; ``columns`` : its x, y and z as they are written."""

    def __init__(self, owners: OwnerCells, columns: list[np.ndarray], extent: float, settings: BuildSettings) -> None:
        self._owners, self._columns = owners, columns
        self._bits, self._point_order = settings.position_bits, settings.point_order
        self._codecs: dict[float, Codec] = {
            edge: position_codec(
                settings.positions,
                settings.group_epsilon * extent / edge * 2.0**self._bits,
                settings.group_detail or None,
            )
            for edge in np.unique(owners.edge).tolist()
        }

    def code(self, begin: int, end: int) -> _Piece:
        """The cells ``begin`` … ``end`` − 1."""
        codes, orders, positions = [], [], []
        start = int(self._owners.first_point[begin])
        for i in range(begin, end):
            code, order, columns = self._cell(i)
            codes.append(code)
            orders.append(order + (int(self._owners.first_point[i]) - start))
            positions.append(columns)
        return _Piece(
            np.concatenate(codes), [len(c) for c in codes], np.concatenate(orders), np.concatenate(positions, axis=1)
        )

    def _cell(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(code, which of the cell's points stands in which place, x, y, z) of a cell."""
        owners, bits = self._owners, self._bits
        own = slice(owners.first_point[i], owners.first_point[i + 1])
        relative = np.column_stack([column[own] for column in self._columns]).astype(np.float64)
        codec = self._codecs[float(owners.edge[i])]
        encoded = codec.encode(to_grid(relative, owners.lower[i], owners.edge[i], bits), bits)
        if len(encoded.data) > _MOST_BYTES:
            raise InputError(
                f"build: the positions of a cell take {len(encoded.data)} bytes, expected at most {_MOST_BYTES}: "
                "fewer points in a cell"
            )
        points = codec.decode(encoded.data, bits, owners.n_points(i))  # what is read decides the order
        order = owners.stored_order(i, points, bits, self._point_order)
        return encoded.data, encoded.order[order], owners.relative(i, points[order], bits)
