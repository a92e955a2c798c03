"""Cell identification (CI): a bit for each cell of 2×2×2 positions, and eight more for each that is not empty.

The bit stream is the paper's (``ci_reference`` holds it in plain form, and the readings taken), cubes of 32³ positions
one after the other behind the bytes of ``container``. Coded order: by cube, cell, position label.

Cost: 4096 bits a cube, 8 a cell that holds points; about 5 bits a point where the grid is about as fine as the sampling
is dense, and many more where a cube holds few points.
Source: Mallón et al., "Algorithms and Hardware for Data Compression in Point Rendering", sections 3.1 and 4.1.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ..errors import CodecError
from . import Encoded
from .container import BLOCK_BITS, block_bits, read_blocks, read_head, write_blocks, write_head
from .grid import check_bits, check_points
from .order import distinct, sorted_order

name = "ci"


def encode(points: np.ndarray, bits: int) -> Encoded:
    """(n, 3) integers in [0, 2**bits), duplicates allowed. Raises CodecError for anything else."""
    points = check_points(points, bits)
    keys = ci_keys(points, bits)
    order = sorted_order(keys, 3 * bits)
    keys = keys[order]
    first, counts = distinct(keys)
    head = write_head(counts)
    if not len(keys):
        return Encoded(head, order)
    in_block = 3 * min(bits, BLOCK_BITS)
    keys = keys[first]
    blocks = keys >> in_block
    first_in_block = np.flatnonzero(np.diff(blocks, prepend=-1))
    blocks = write_blocks(blocks[first_in_block], bits)
    cells = keys >> 3
    n_bits = (len(first_in_block) << in_block - 3) + 8 * np.count_nonzero(np.diff(cells, prepend=-1))
    stream = np.zeros((n_bits + 7) // 8, np.uint8)
    _write(keys, in_block, stream)
    return Encoded(np.concatenate([head, blocks, stream]), order)


def decode(data: np.ndarray, bits: int, most_points: int) -> np.ndarray:
    """(n, 3) uint32 grid points, in coded order. Raises CodecError for damaged data or above ``most_points``."""
    check_bits(bits)
    head, at = read_head(data, most_points)
    lowest, at = (np.empty((0, 3), np.uint32), at) if head.n == 0 else read_blocks(data, at, bits, head.n)
    n_bits = 8 * (len(data) - at)
    if head.n > n_bits:  # a point takes more than one bit: nothing is allocated for data that is too short
        raise CodecError(f"coded points: found {n_bits} bits for {head.n} points")
    points = np.empty((head.n, 3), np.uint32)
    # The kernel looks two bytes ahead of a bit that is there.
    if not _read(np.append(data[at:], np.zeros(2, np.uint8)), n_bits, lowest, min(bits, BLOCK_BITS) - 1, points):
        raise CodecError(f"coded points: found a damaged bit stream of {n_bits} bits for {head.n} points")
    return head.repeat(points)


def ci_keys(points: np.ndarray, bits: int) -> np.ndarray:
    """(n,) int64 in [0, 8**bits) that ascend in coded order: block, cell and position label, each with z fastest."""
    keys = np.empty(len(points), np.int64)
    _keys(points, block_bits(bits), min(bits, BLOCK_BITS) - 1, keys)
    return keys


@njit(nogil=True, cache=True)
def _keys(points, block_bits, cell_bits, keys):
    for i in range(len(points)):
        block, cell, label = np.int64(0), np.int64(0), np.int64(0)
        for axis in range(3):
            value = np.int64(points[i, axis])
            block = block << block_bits | value >> cell_bits + 1
            cell = cell << cell_bits | value >> 1 & (1 << cell_bits) - 1
            label = label << 1 | value & 1
        keys[i] = (block << 3 * cell_bits | cell) << 3 | label


@njit(nogil=True, cache=True)
def _write(keys, in_block, stream):
    """Set the bits of strictly ascending keys in the zeros of ``stream``; the lowest ``in_block`` bits lie in a block.

    A cell's bit stands behind a bit of each cell before it and eight of each of those that is filled.
    """
    cells_bits = in_block - 3
    block, n_blocks, last_cell, filled, at = np.int64(-1), 0, np.int64(-1), 0, np.int64(0)
    for key in keys:
        cell = key >> 3
        if cell != last_cell:
            last_cell = cell
            if cell >> cells_bits != block:
                block = cell >> cells_bits
                n_blocks += 1
            at = (np.int64(n_blocks - 1) << cells_bits) + (cell & (1 << cells_bits) - 1) + 8 * filled
            filled += 1
            stream[at >> 3] |= 128 >> (at & 7)
        position = at + 1 + (key & 7)
        stream[position >> 3] |= 128 >> (position & 7)


@njit(nogil=True, cache=True)
def _read(stream, n_bits, lowest, cell_bits, points):
    """Fill (n, 3) ``points`` from the cubes at (k, 3) ``lowest``; False unless the stream is exactly theirs.

    stream : two bytes longer than ``n_bits`` bits, so that the sixteen bits from any bit on can be looked at.
    """
    at, n = np.int64(0), 0
    mask = (1 << cell_bits) - 1
    n_cells = 1 << 3 * cell_bits
    for block in range(len(lowest)):
        cell, before = 0, n
        while cell < n_cells:
            if at >= n_bits:
                return False
            shift = at & 7
            window = (np.int64(stream[at >> 3]) << 8 | np.int64(stream[(at >> 3) + 1])) << shift & 0xFFFF
            if window < 1 << 8 and cell + 8 <= n_cells and at + 8 <= n_bits:  # eight empty cells
                cell += 8
                at += 8
                continue
            if window >> 15:
                if at + 9 > n_bits:
                    return False
                positions = window >> 7 & 0xFF
                if positions == 0:
                    return False
                x = lowest[block, 0] + ((cell >> 2 * cell_bits) << 1)
                y = lowest[block, 1] + ((cell >> cell_bits & mask) << 1)
                z = lowest[block, 2] + ((cell & mask) << 1)
                for label in range(8):
                    if positions & 128 >> label:
                        if n == len(points):
                            return False
                        points[n, 0] = x + (label >> 2)
                        points[n, 1] = y + (label >> 1 & 1)
                        points[n, 2] = z + (label & 1)
                        n += 1
                at += 8
            cell += 1
            at += 1
        if n == before:
            return False
    return n == len(points) and n_bits - at < 8 and not stream[at >> 3] << (at & 7) & 0xFF
