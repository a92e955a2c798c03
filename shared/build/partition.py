"""Keys of points → cells of an octree, and the point indices in the order of its leaves.

A point-array is not sorted further than its cells need: one stable counting sort into the buckets of level 6, then
octant by octant in cache, only where a bucket holds too many points. Inside a leaf the points stand in the order of
(bucket, input), whatever the number of threads, and however the input was cut into runs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from ..octree import MAX_LEVEL
from .flatness import (
    N_MOMENTS,
    add_moments,
    bucket_moments,
    central_moments,
    central_of,
    flatness,
    moments_pyramid_step,
)
from .morton import count_buckets, scatter_buckets
from .parallel import Workers

BUCKET_LEVEL = 6
"""Level of the counting sort: 262 144 buckets, whose counters stay in the second-level cache."""


@dataclass(frozen=True)
class Subdivision:
    """When a cell is subdivided (thesis 4.2): more points than ``points_per_cell``, above ``max_depth``, not flat.

    flatness : cells whose flatness is below this stay leaves, whatever they hold; 0 turns the test off.
    """

    points_per_cell: int
    max_depth: int
    flatness: float

    def counts_allow(self, count: np.ndarray | int, level: int):
        """Whether the number of points and the level let a cell be subdivided."""
        return (count > self.points_per_cell) & (level < self.max_depth)


@dataclass
class Cells:
    """Cells in no particular order: the ones of a subtree and the range of its leaves in ``ids``.

    level : (n,) uint8.  code : (n,) int64.  start, count : (n,) int64, range in the sorted ids.
    split : (n,) bool, the cell has children.
    """

    level: np.ndarray
    code: np.ndarray
    start: np.ndarray
    count: np.ndarray
    split: np.ndarray

    def __len__(self) -> int:
        return len(self.level)

    def take(self, order: np.ndarray) -> Cells:
        """The cells picked by an index array or a mask."""
        return Cells(*(getattr(self, f)[order] for f in ("level", "code", "start", "count", "split")))

    @staticmethod
    def concatenate(parts: list[Cells]) -> Cells:
        """All cells of several lists."""
        fields = ("level", "code", "start", "count", "split")
        return Cells(*(np.concatenate([getattr(p, f) for p in parts]) for f in fields))


def sort_into_buckets(
    keys: np.ndarray, level: int, base: int, n_buckets: int, workers: Workers
) -> tuple[np.ndarray, np.ndarray]:
    """(ids, first): the indices of keys in stable bucket order, and where each bucket starts, (n_buckets + 1,) int64.

    keys : (n,) int64, n < 2**32, all inside the buckets ``base …`` of ``level``.  ids : (n,) uint32.
    Cost: two passes over the keys, one counter array a thread.
    """
    shift = 3 * (MAX_LEVEL - level)
    pieces = workers.ranges(len(keys))
    counts = np.zeros((len(pieces), n_buckets), np.int64)
    workers.map(count_buckets, [(keys, a, b, shift, base, counts[i]) for i, (a, b) in enumerate(pieces)])
    first = np.zeros(n_buckets + 1, np.int64)
    np.cumsum(counts.sum(axis=0), out=first[1:])
    cursors = np.cumsum(counts, axis=0) - counts + first[:-1]
    ids = np.empty(len(keys), np.uint32)
    workers.map(scatter_buckets, [(keys, a, b, shift, base, cursors[i], ids) for i, (a, b) in enumerate(pieces)])
    return ids, first


def upper_cells(level: int, code: int, first: np.ndarray, moments: np.ndarray | None, rule: Subdivision) -> Cells:
    """Cells from (level, code) down to the bucket level, from the buckets alone.

    first : (n_buckets + 1,) int64, start of each bucket below the cell.
    moments : (n_buckets, 10) exact moments of the buckets, where the rule tests flatness.
    """
    parts = []
    flat: dict[int, np.ndarray] = {}
    if moments is not None:
        central = central_of(moments)
        for below in range(BUCKET_LEVEL, level - 1, -1):
            pad = np.zeros((-len(central) % 8, N_MOMENTS))
            parents, f = moments_pyramid_step(np.concatenate([central, pad]), float(1 << (MAX_LEVEL - below)))
            flat[below], central = f[: len(central)], parents
    alive = np.ones(1, bool)
    for at in range(level, BUCKET_LEVEL + 1):
        width = 8 ** (BUCKET_LEVEL - at)
        start, stop = first[:-1:width], first[width::width]
        count = stop - start
        present = alive & (count > 0)
        split = present & rule.counts_allow(count, at)
        if moments is not None:
            split &= flat[at] >= rule.flatness
        codes = (code << 3 * (at - level)) + np.flatnonzero(present)
        parts.append(Cells(np.full(len(codes), at, np.uint8), codes, start[present], count[present], split[present]))
        alive = np.repeat(split, 8)
    return Cells.concatenate(parts)


@njit(nogil=True, cache=True)
def _grown(a):
    b = np.empty(2 * len(a), a.dtype)
    b[: len(a)] = a
    return b


@njit(nogil=True, cache=True)
def refine(keys, ids, scratch, codes, starts, stops, level, points_per_cell, max_depth, min_flatness):
    """Subdivide the given cells of one level until the rule stops; sort their ids by leaf, in place and stably.

    scratch : like ids.  Returns level, code, start, count, split of every cell *below* the given ones.
    """
    out_level = np.empty(64, np.uint8)
    out_code = np.empty(64, np.int64)
    out_start = np.empty(64, np.int64)
    out_count = np.empty(64, np.int64)
    out_split = np.empty(64, np.bool_)
    n_out = 0
    stack = np.empty((8 * 22, 4), np.int64)  # level, code, start, stop
    first = np.empty(9, np.int64)
    cursor = np.empty(8, np.int64)
    moments = np.empty(10, np.int64)
    central = np.empty(10, np.float64)
    for given in range(len(codes)):
        stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = level, codes[given], starts[given], stops[given]
        depth = 1
        while depth > 0:
            depth -= 1
            at, code, start, stop = stack[depth, 0], stack[depth, 1], stack[depth, 2], stack[depth, 3]
            split = at == level
            if not split:
                split = stop - start > points_per_cell and at < max_depth
                if split and min_flatness > 0.0:
                    moments[:] = 0
                    add_moments(keys, ids, start, stop, at, moments)
                    central_moments(moments, central)
                    split = flatness(central) >= min_flatness
                if n_out == len(out_level):
                    out_level, out_code, out_start = _grown(out_level), _grown(out_code), _grown(out_start)
                    out_count, out_split = _grown(out_count), _grown(out_split)
                out_level[n_out], out_code[n_out], out_start[n_out] = at, code, start
                out_count[n_out], out_split[n_out] = stop - start, split
                n_out += 1
            if not split:
                continue
            shift = 3 * (20 - at)
            first[:] = 0
            for j in range(start, stop):
                first[((keys[ids[j]] >> shift) & 7) + 1] += 1
            first[0] = start
            for o in range(8):
                first[o + 1] += first[o]
                cursor[o] = first[o]
            for j in range(start, stop):
                o = (keys[ids[j]] >> shift) & 7
                scratch[cursor[o]] = ids[j]
                cursor[o] += 1
            ids[start:stop] = scratch[start:stop]
            for o in range(7, -1, -1):
                if first[o + 1] > first[o]:
                    stack[depth, 0], stack[depth, 1] = at + 1, code << 3 | o
                    stack[depth, 2], stack[depth, 3] = first[o], first[o + 1]
                    depth += 1
    return out_level[:n_out], out_code[:n_out], out_start[:n_out], out_count[:n_out], out_split[:n_out]


def subtree_cells(
    keys: np.ndarray, level: int, code: int, rule: Subdivision, workers: Workers
) -> tuple[Cells, np.ndarray]:
    """(cells, ids) of the octree below and including the cell (level, code) that holds all the given keys.

    keys : (n,) int64, 0 < n < 2**32.  ids : (n,) uint32, indices of keys in the order of the leaves.
    """
    tests_flatness = rule.flatness > 0
    if level < BUCKET_LEVEL:
        n_buckets = 8 ** (BUCKET_LEVEL - level)
        ids, first = sort_into_buckets(keys, BUCKET_LEVEL, code << 3 * (BUCKET_LEVEL - level), n_buckets, workers)
        moments = None
        if tests_flatness:
            moments = np.zeros((n_buckets, N_MOMENTS), np.int64)
            pieces = workers.ranges(n_buckets, pieces=8 * workers.n_threads)
            workers.map(bucket_moments, [(keys, ids, first, a, b, BUCKET_LEVEL, moments) for a, b in pieces])
        upper = upper_cells(level, code, first, moments, rule)
        lowest = BUCKET_LEVEL
    else:
        ids = np.arange(len(keys), dtype=np.uint32)
        split = bool(rule.counts_allow(len(keys), level))
        if split and tests_flatness:
            moments = np.zeros(N_MOMENTS, np.int64)
            central = np.empty(N_MOMENTS)
            add_moments(keys, ids, 0, len(ids), level, moments)
            central_moments(moments, central)
            split = flatness(central) >= rule.flatness
        upper = Cells(
            np.array([level], np.uint8),
            np.array([code]),
            np.zeros(1, np.int64),
            np.array([len(keys)]),
            np.array([split]),
        )
        lowest = level
    todo = upper.take(np.flatnonzero(upper.split & (upper.level == lowest)))
    scratch = np.empty_like(ids)
    parts = [upper]
    limits = (rule.points_per_cell, rule.max_depth, rule.flatness)
    tasks = [
        (keys, ids, scratch, part.code, part.start, part.start + part.count, lowest, *limits)
        for part in _balanced(todo, 8 * workers.n_threads)
    ]
    parts += [Cells(*below) for below in workers.map(refine, tasks)]
    return Cells.concatenate(parts), ids


def _balanced(cells: Cells, pieces: int) -> list[Cells]:
    """Consecutive cells in at most ``pieces`` lists of nearly equal numbers of points."""
    if not len(cells):
        return []
    ends = np.cumsum(cells.count)
    cuts = np.unique(np.searchsorted(ends, ends[-1] * np.arange(1, pieces) / pieces, side="right"))
    return [cells.take(part) for part in np.split(np.arange(len(cells)), cuts) if len(part)]
