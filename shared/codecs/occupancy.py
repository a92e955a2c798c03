"""Octree occupancy, entropy coded: which of its eight children each node has, level by level, as few bits as they need.

Beyond the papers. Each child is a yes or no whose probability is learnt from what is known around it (``mixing``), in
three contexts (``occupancy_kernels``), and written by a ``range_coder``. The branch of a single point that has no
neighbours ends there, and the point's other bits stand as they are. How often points repeat follows, only where some
do. Coded order: by Morton key, x in the lowest bit. Stream: the first number of ``container``, then the range coder's
bytes.

Nothing is learnt from one call to the next: a cell decodes on its own. Damage to the coded bytes mostly gives other
points rather than an error, as with any entropy coder; checksums are for where the bytes are kept.

Cost: about three answers a point where the grid is dense, 8·bits where it is empty but for a few points; 110 bytes of
memory a node while coding.
"""

from __future__ import annotations

import numpy as np

from ..errors import CodecError
from . import Encoded
from .container import read_number, write_number
from .grid import check_bits, check_points
from .occupancy_kernels import (
    child_codes,
    child_neighbours,
    count_children,
    level_occupancy,
    morton_keys,
    morton_points,
    new_model,
    read_counts,
    read_level,
    root_neighbours,
    without_direct,
    write_counts,
    write_level,
)
from .order import distinct, sorted_order
from .range_coder import check_end, finish_writing, start_reading, start_writing

name = "occupancy"


def encode(points: np.ndarray, bits: int) -> Encoded:
    """(n, 3) integers in [0, 2**bits), duplicates allowed. Raises CodecError for anything else."""
    points = check_points(points, bits)
    keys = morton_keys(points, bits)
    order = sorted_order(keys, 3 * bits)
    keys = keys[order]
    first, counts = distinct(keys)
    head = write_number(counts)
    if not len(keys):
        return Encoded(head, order)
    keys, model, state = keys[first], new_model(), start_writing()
    out, neighbours = np.empty(0, np.uint8), root_neighbours()
    for level in range(bits):
        occupancy, first = level_occupancy(keys, 3 * (bits - 1 - level), len(neighbours))
        out = write_level(occupancy, first, keys, bits - level, neighbours, model, state, out)
        if level < bits - 1:
            keys = without_direct(keys, occupancy, first)
            neighbours = child_neighbours(occupancy, neighbours, count_children(occupancy))
    if (counts > 1).any():
        out = write_counts(counts, model, state, out)
    return Encoded(np.concatenate([head, finish_writing(state, out)]), order)


def decode(data: np.ndarray, bits: int, most_points: int) -> np.ndarray:
    """(n, 3) uint32 grid points, in coded order. Raises CodecError for damaged data or above ``most_points``."""
    check_bits(bits)
    n, repeats, at = read_number(data, most_points)
    data = np.ascontiguousarray(data[at:])
    if n == 0:
        if len(data) or repeats:
            raise CodecError(f"coded points: found {len(data)} bytes behind no points")
        return np.empty((0, 3), np.uint32)
    model, state = new_model(), start_reading(data)
    codes, neighbours = np.zeros(1, np.int64), root_neighbours()
    keys, n_keys = np.empty(n, np.int64), 0
    for level in range(bits):
        occupancy, n_keys = read_level(codes, bits - level, neighbours, model, state, data, keys, n_keys)
        if n_keys < 0:
            raise CodecError(f"coded points: found {len(data)} bytes for {n} points, expected more")
        n_children = count_children(occupancy)
        found = n_keys + n_children
        if found > n or (level == bits - 1 and found != n):
            raise CodecError(f"coded points: found {found} nodes at level {level + 1} for {n} points")
        codes = child_codes(codes, occupancy, n_children)
        if level < bits - 1:
            neighbours = child_neighbours(occupancy, neighbours, n_children)
    keys[n_keys:] = codes
    points = morton_points(np.sort(keys), bits)
    if repeats:
        counts = read_counts(n, most_points, model, state, data)
        if counts is None or counts.max() == 1:
            raise CodecError(f"coded points: found repeats of no point, or more than {most_points} points")
        points = np.repeat(points, counts, axis=0)
    check_end(state, data)
    return points
