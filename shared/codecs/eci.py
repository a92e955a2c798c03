"""Extended cell identification (ECI): points in layers of neighbours, each placed relative to a seed, a point of the
layer before.

The stream of a component, a set of points that hang together by 26 neighbours, is the paper's (``eci_reference`` holds
it in plain form, and the readings taken). The rest is not in the paper: a cube of 32³ positions is its components one
after the other, each followed by a bit that says whether there is another, and starts a component at the first point
left in the order of ``ci``; cubes stand one after the other behind the bytes of ``container``. Coded order: that of the
stream.

Cost: 3 to 6 bits for a point, up to 10 more for a seed, 21 for a point on its own.
Source: Mallón et al., "Algorithms and Hardware for Data Compression in Point Rendering", sections 2.2, 3.2 and 4.2.
"""

from __future__ import annotations

import numpy as np

from ..errors import CodecError
from . import Encoded
from .ci import ci_keys
from .container import BLOCK_BITS, read_blocks, read_head, write_blocks, write_head
from .eci_kernels import layer_blocks, read_blocks_of_layers, write_blocks_of_layers
from .grid import check_bits, check_points
from .order import distinct, gather_runs, sorted_order

name = "eci"

_MOST_BYTES = 4
"""Of a point at most: three coordinates, connectivity, number of seeds, and the bit after a component."""


def encode(points: np.ndarray, bits: int) -> Encoded:
    """(n, 3) integers in [0, 2**bits), duplicates allowed. Raises CodecError for anything else."""
    points = check_points(points, bits)
    keys = ci_keys(points, bits)
    order = sorted_order(keys, 3 * bits)
    keys = keys[order]
    first, counts = distinct(keys)
    if not len(keys):
        return Encoded(write_head(counts), order)
    points, blocks = points[order[first]], keys[first] >> 3 * min(bits, BLOCK_BITS)
    first_in_block = np.flatnonzero(np.diff(blocks, prepend=-1))
    in_block = points & np.uint32((1 << BLOCK_BITS) - 1)
    layers = layer_blocks(in_block, np.append(first_in_block, len(points)))
    stream = np.zeros(_MOST_BYTES * len(points), np.uint8)
    n_bits = write_blocks_of_layers(in_block, *layers, min(bits, BLOCK_BITS), stream)
    sequence = layers[0]
    parts = [
        write_head(counts[sequence]),
        write_blocks(blocks[first_in_block], bits),
        stream[: (n_bits + 7) // 8],
    ]
    return Encoded(np.concatenate(parts), gather_runs(order, first, counts, sequence))


def decode(data: np.ndarray, bits: int, most_points: int) -> np.ndarray:
    """(n, 3) uint32 grid points, in coded order. Raises CodecError for damaged data or above ``most_points``."""
    check_bits(bits)
    head, at = read_head(data, most_points)
    lowest, at = (np.empty((0, 3), np.uint32), at) if head.n == 0 else read_blocks(data, at, bits, head.n)
    n_bits = 8 * (len(data) - at)
    if 3 * head.n > n_bits:  # a point takes three bits at least: nothing is allocated for data that is too short
        raise CodecError(f"coded points: found {n_bits} bits for {head.n} points")
    points = np.empty((head.n, 3), np.uint32)
    if not read_blocks_of_layers(data[at:], n_bits, lowest, min(bits, BLOCK_BITS), points):
        raise CodecError(f"coded points: found a damaged bit stream of {n_bits} bits for {head.n} points")
    return head.repeat(points)
