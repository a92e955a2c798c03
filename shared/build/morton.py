"""Root cube and Morton keys: the 63-bit position of a point in the deepest grid of the octree.

Keys are held as int64 (63 bits never reach the sign), ``x`` in bit 0, ``y`` in bit 1, ``z`` in bit 2 of each group of
three, the root's octant in the highest group: the key of a point shifted right by ``3 * (21 - level)`` is the code
of the cell of that level that holds it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ..errors import InputError
from ..octree import MAX_LEVEL
from .parallel import Workers

_EDGE_BITS = 12
_LAST = (1 << MAX_LEVEL) - 1
_MAX_EXTENT = 1e30
"""World units: stored offsets and their products with a focal length stay within float32."""


def root_cube(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, float]:
    """(origin, edge) of the cube that holds finite bounds: ``lower`` exactly, and the largest extent grown by a hair.

    The edge has 12 significant bits (it grows by less than 0.05 %), so that cell centres of a scene moved by an exact
    translation are exact too, and float32 offsets from them do not change.
    Raises InputError for an extent above 1e30.
    """
    with np.errstate(over="ignore"):
        extent = float(np.max(upper - lower))
    if not extent <= _MAX_EXTENT:
        raise InputError(f"bounds: found an extent of {extent:g}, expected at most {_MAX_EXTENT:g}")
    largest = float(np.max(np.abs([lower, upper])))
    if extent == 0.0:
        extent = max(1.0, float(np.spacing(largest)) * 2**MAX_LEVEL)
    mantissa, exponent = math.frexp(max(extent, 1e-290))
    return lower.astype(np.float64), math.ldexp(math.floor(math.ldexp(mantissa, _EDGE_BITS)) + 1, exponent - _EDGE_BITS)


@njit(nogil=True, cache=True)
def spread_bits(x):
    """The low 21 bits of an int64, two zero bits between each."""
    x &= 0x1FFFFF
    x = (x | (x << 32)) & 0x001F00000000FFFF
    x = (x | (x << 16)) & 0x001F0000FF0000FF
    x = (x | (x << 8)) & 0x100F00F00F00F00F
    x = (x | (x << 4)) & 0x10C30C30C30C30C3
    return (x | (x << 2)) & 0x1249249249249249


@njit(nogil=True, cache=True)
def compact_bits(x):
    """Inverse of ``spread_bits``: every third bit."""
    x &= 0x1249249249249249
    x = (x ^ (x >> 2)) & 0x10C30C30C30C30C3
    x = (x ^ (x >> 4)) & 0x100F00F00F00F00F
    x = (x ^ (x >> 8)) & 0x001F0000FF0000FF
    x = (x ^ (x >> 16)) & 0x001F00000000FFFF
    return (x ^ (x >> 32)) & 0x1FFFFF


@njit(nogil=True, cache=True)
def morton_keys(positions, origin, scale, start, stop, keys):
    """Write the keys of (n, 3) float64 ``positions[start:stop]`` to int64 ``keys[start:stop]``.

    scale : cells an axis per world unit, ``2**21 / edge``. Positions outside the cube go to its nearest cell.
    """
    for i in range(start, stop):
        key = 0
        for axis in range(3):
            cell = np.int64(min(max((positions[i, axis] - origin[axis]) * scale, 0.0), float(_LAST)))
            key |= spread_bits(cell) << axis
        keys[i] = key


def keys_of(positions: np.ndarray, origin: np.ndarray, edge: float, workers: Workers) -> np.ndarray:
    """(n,) int64 Morton keys of (n, 3) finite positions."""
    keys = np.empty(len(positions), np.int64)
    scale = 2.0**MAX_LEVEL / edge
    workers.map(morton_keys, [(positions, origin, scale, a, b, keys) for a, b in workers.ranges(len(keys))])
    return keys


@njit(nogil=True, cache=True)
def bounds(positions, lower, upper):
    """Widen (3,) ``lower`` and ``upper`` by the finite rows of (n, 3) positions; return the number of other rows."""
    n_bad = 0
    x0, y0, z0 = lower[0], lower[1], lower[2]
    x1, y1, z1 = upper[0], upper[1], upper[2]
    for i in range(len(positions)):
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            n_bad += 1
            continue
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    lower[0], lower[1], lower[2] = x0, y0, z0
    upper[0], upper[1], upper[2] = x1, y1, z1
    return n_bad


@njit(nogil=True, cache=True)
def count_buckets(keys, start, stop, shift, base, counts):
    """Add to int64 ``counts`` the number of ``keys[start:stop]`` in each bucket ``(key >> shift) - base``."""
    for i in range(start, stop):
        counts[(keys[i] >> shift) - base] += 1


@njit(nogil=True, cache=True)
def scatter_buckets(keys, start, stop, shift, base, cursor, ids):
    """Write each index of ``keys[start:stop]`` to uint32 ``ids`` at its bucket's cursor, and advance the cursor."""
    for i in range(start, stop):
        bucket = (keys[i] >> shift) - base
        ids[cursor[bucket]] = i
        cursor[bucket] += 1
