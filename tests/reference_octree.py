"""The octree build in short: recursive, float64, Python integers, one point list a cell. Twin of ``shared/build``."""

from __future__ import annotations

import math

import numpy as np

BUCKET_LEVEL = 6
SORTED_LEVELS = 6
_U64 = (1 << 64) - 1


def reference_root(positions):
    """Origin and edge of the root cube."""
    lower, upper = positions.min(axis=0), positions.max(axis=0)
    extent = float((upper - lower).max())
    if extent == 0:
        extent = max(1.0, float(np.spacing(np.abs(positions).max())) * 2**21)
    mantissa, exponent = math.frexp(extent)
    return lower, math.ldexp(math.floor(mantissa * 4096) + 1, exponent - 12)


def reference_keys(positions, origin, edge):
    """Morton keys as Python integers, bit by bit."""
    grid = np.clip((positions - origin) * (2.0**21 / edge), 0, 2**21 - 1).astype(int)
    return [sum((int(g[axis]) >> bit & 1) << (3 * bit + axis) for bit in range(21) for axis in range(3)) for g in grid]


def reference_flatness(keys, level):
    """Smallest eigenvalue of the covariance of key coordinates over the sum of eigenvalues."""
    grid = np.array(
        [[sum((key >> (3 * bit + axis) & 1) << bit for bit in range(21)) for axis in range(3)] for key in keys]
    )
    central = (grid - grid[0]) - (grid - grid[0]).mean(axis=0)
    values = np.linalg.eigvalsh(central.T @ central)
    return max(values[0], 0.0) / values.sum() if values.sum() > 0 else 0.0


def _mixed(x):
    x = (x ^ x >> 30) * 0xBF58476D1CE4E5B9 & _U64
    x = (x ^ x >> 27) * 0x94D049BB133111EB & _U64
    return x ^ x >> 31


def reference_permutation(level, code, n):
    """Where each of n members of a cell is stored."""
    golden = 0x9E3779B97F4A7C15
    bits = max(1, (n - 1).bit_length())
    mask, half = (1 << bits) - 1, (bits + 1) // 2
    state = _mixed(code + (level + 1) * golden & _U64)
    a, b, c, d = (_mixed(state + k * golden & _U64) for k in range(1, 5))
    places = []
    for i in range(n):
        x = i
        while n > 1:
            x = x * (a | 1) + d & mask
            x ^= x >> half
            x = x * (b | 1) & mask
            x ^= x >> half
            x = x * (c | 1) & mask
            x ^= x >> half
            if x < n:
                break
        places.append(x)
    return places


def _shuffled(level, code, members):
    out = [None] * len(members)
    for place, member in zip(reference_permutation(level, code, len(members)), members, strict=True):
        out[place] = member
    return out


def reference_strata(level, code, n):
    """Ranks along the curve in stratified order: bits read backwards, from a start of the cell's own."""
    bits = max(n - 1, 0).bit_length()
    mask = _mixed(code + (level + 1) * 0x9E3779B97F4A7C15 & _U64) & ((1 << bits) - 1)
    reversed_ = (int(f"{i:0{bits}b}"[::-1], 2) if bits else 0 for i in range(1 << bits))
    return [r ^ mask for r in reversed_ if r ^ mask < n]


def _stratified(level, code, members):
    """(members in stratified order, the rank of each)."""
    ranks = reference_strata(level, code, len(members))
    return [members[rank] for rank in ranks], ranks


def reference_build(positions, *, points_per_cell, max_depth=21, flatness=0.0):
    """(level, code) → (points below, indices of the points the cell owns in stored order, its children), layered."""
    keys = reference_keys(positions, *reference_root(positions))
    cells = {}

    def build(level, code, members):
        split = len(members) > points_per_cell and level < max_depth
        if split and flatness > 0:
            split = reference_flatness([keys[i] for i in members], level) >= flatness
        if not split:
            if len(members) > points_per_cell:
                by_bucket = sorted(members, key=lambda i: keys[i] >> 3 * (21 - BUCKET_LEVEL))  # stable
                own, ranks = _shuffled(level, code, by_bucket), range(len(members))
            else:
                shift = max(0, 3 * (21 - level - SORTED_LEVELS))
                own, ranks = _stratified(level, code, sorted(members, key=lambda i: keys[i] >> shift))  # stable
            cells[level, code] = (len(members), own, [])
            return list(zip(ranks, own, strict=True))
        children, sets = [], []
        for octant in range(8):
            child = code << 3 | octant
            inside = [i for i in members if keys[i] >> 3 * (20 - level) == child]
            if inside:
                children.append((level + 1, child))
                sets.append(build(level + 1, child, inside)[:points_per_cell])
        available = sum(map(len, sets))
        n = min(points_per_cell, available)
        quota = [n * len(s) // available for s in sets]
        by_remainder = sorted(range(len(sets)), key=lambda c: -(n * len(sets[c]) % available))  # stable
        for c in by_remainder[: n - sum(quota)]:
            quota[c] += 1
        along_curve = [i for s, q in zip(sets, quota, strict=True) for _, i in sorted(s[:q])]
        own, ranks = _stratified(level, code, along_curve)
        cells[level, code] = (len(members), own, children)
        return list(zip(ranks, own, strict=True))

    build(0, 0, list(range(len(positions))))
    return cells
