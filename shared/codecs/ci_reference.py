"""Cell identification (CI) of one cube, written to be read: the paper's sections 3.1 and 4.1, bit by bit.

Source: Mallón, Bóo, Amor, Bruguera, "Algorithms and Hardware for Data Compression in Point Rendering Applications".
Readings taken where it can be read in two ways:

- *Order of cells.* "Positive Z direction, Y and X respectively", and index 67 of 16³ cells is the seed (0, 8, 6): z
  runs fastest, x slowest. Figure 7b wires the low field of the counter to x; text and figures 2 and 4 agree on z, so
  z it is.
- *Position labels* (Fig. 2a): offset (0, 0, 1) is label 1, (0, 1, 0) is label 2, so label = 4x + 2y + z.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product

from ..errors import CodecError

Point = tuple[int, int, int]
OFFSETS: list[Point] = list(product((0, 1), (0, 1), (0, 1)))
"""Offset of each position label from position 0 of its cell."""


def encode_cube(points: Iterable[Point], edge: int) -> list[int]:
    """The bits of a cube of ``edge`` (even) positions a side: (Cell_Filled){Pos0, …, Pos7} of each cell in turn."""
    held = set(points)
    bits = []
    for cell in _cells(edge):
        positions = [int(_add(cell, offset) in held) for offset in OFFSETS]
        bits += [1, *positions] if any(positions) else [0]
    return bits


def decode_cube(bits: Sequence[int], edge: int) -> tuple[list[Point], int]:
    """The points in coded order, and the number of bits read. Raises CodecError where the bits end too early, or a
    filled cell has no point.
    """
    points, at = [], 0
    for cell in _cells(edge):
        filled = bits[at : at + 1]
        at += 1
        if list(filled) == [1]:
            positions = bits[at : at + 8]
            at += 8
            points += [_add(cell, offset) for offset, there in zip(OFFSETS, positions, strict=False) if there]
            if not any(positions):
                raise CodecError("coded points: found a filled cell without a point")
        if at > len(bits):
            raise CodecError(f"coded points: found {len(bits)} bits, expected more")
    return points, at


def _cells(edge: int) -> Iterable[Point]:
    """Position 0 of each cell of a cube, in the paper's order."""
    return product(range(0, edge, 2), range(0, edge, 2), range(0, edge, 2))


def _add(a: Point, b: Point) -> Point:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
