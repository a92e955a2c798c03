"""Compiled construction of linear groups, partition by partition; ``group_search_reference`` is the readable twin.

Points within ε of each pair's segment are a bit mask, computed once: the search then takes and gives back whole sets.
Coordinates below 2**21 make every product and sum a whole number below 2**62, so both versions find the same groups.

Cost: m³ / 2 distances for m points of a partition, and m² / 2 masks of m bits.
"""

from __future__ import annotations

import numpy as np
from numba import njit

STEPS = 256
"""Parameters of a segment: 0 … 255, in 1/256."""

MOST_IN_PART = 1024
"""Points of a partition: at most 67 MB of masks."""


@njit(nogil=True, cache=True)
def partitions(keys, bits, most):
    """(q + 1,) int64: where the partitions of (n,) ascending Morton keys of ``bits`` bits an axis start, and n.

    The leaves of an octree whose cells are split while they hold more than ``most`` points, taken together in Morton
    order while they hold no more. Points that coincide are split where there are too many.
    """
    n = len(keys)
    starts, q, at, held = np.empty(n + 1, np.int64), 0, 0, most  # full: the first leaf opens a partition
    while at < n:
        level, stop = 0, n  # the largest cell that starts here and is not too full
        while stop - at > most or (at > 0 and keys[at - 1] >> 3 * (bits - level) == keys[at] >> 3 * (bits - level)):
            if level == bits:
                stop = min(stop, at + most)
                break
            level += 1
            last = keys[at] | (np.int64(1) << 3 * (bits - level)) - 1
            stop = at + np.searchsorted(keys[at:], last, side="right")
        if held + stop - at > most:
            starts[q] = at
            q += 1
            held = 0
        held += stop - at
        at = stop
    starts[q] = n
    return starts[: q + 1].copy()


@njit(nogil=True, cache=True)
def group_partitions(points, starts, reach, limit, most_ends):
    """The linear groups of (n, 3) int64 points, in partitions ``starts[i]`` … ``starts[i + 1]`` − 1.

    reach : (q,) int64, ⌊ε⌋ of each partition.  limit : (q,) int64, ⌊(256 ε)²⌋.  most_ends : branches searched to their
    end in each.
    Returns (n,) int64 group of each point, −1 for one that is kept; (n,) uint8 parameters; (g, 2) int64 indices of the
    points that define each group; (q + 1,) int64, where the groups of each partition start.
    """
    n, widest = len(points), 0
    for part in range(len(starts) - 1):
        widest = max(widest, starts[part + 1] - starts[part])
    group, parameter = np.full(n, -1, np.int64), np.zeros(n, np.uint8)
    ends, n_groups, first_group = np.empty((n, 2), np.int64), 0, np.zeros(len(starts), np.int64)
    most_pairs = widest * (widest - 1) // 2
    pairs, masks = np.empty((most_pairs, 2), np.int64), np.empty((most_pairs, (widest + 63) // 64), np.uint64)
    near = np.empty(most_pairs, np.int64)
    for part in range(len(starts) - 1):
        first, stop = starts[part], starts[part + 1]
        m = stop - first
        n_words = (m + 63) // 64
        n_pairs = _find_near(points[first:stop], reach[part], limit[part], pairs, masks[:, :n_words], near)
        order = _best_first(near[:n_pairs], m)
        for which in _search(pairs, masks[:, :n_words], order, m, most_ends):
            i, j = first + pairs[which, 0], first + pairs[which, 1]
            group[i] = group[j] = -2  # defines a line: no later group may take it
            for q in range(first, stop):
                if _has(masks[which], q - first) and group[q] == -1:
                    group[q] = n_groups
                    parameter[q] = _parameter(points, i, j, q, limit[part])
            ends[n_groups, 0], ends[n_groups, 1] = i, j
            n_groups += 1
        first_group[part + 1] = n_groups
    for i in range(n):
        group[i] = max(group[i], -1)
    return group, parameter, ends[:n_groups].copy(), first_group


@njit(nogil=True, cache=True)
def _parameter(points, i, j, q, limit):
    """Step of the segment from point i towards j at which point q is within ε; −1 if there is none."""
    x, y, z = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
    a, b, c = points[q, 0] - points[i, 0], points[q, 1] - points[i, 1], points[q, 2] - points[i, 2]
    length, along = x * x + y * y + z * z, a * x + b * y + c * z
    t = np.int64(0)
    if length > 0 and along > 0:
        t = min((2 * STEPS * along + length) // (2 * length), STEPS - 1)
    a, b, c = STEPS * a - t * x, STEPS * b - t * y, STEPS * c - t * z
    return t if a * a + b * b + c * c <= limit else np.int64(-1)


@njit(nogil=True, cache=True)
def _find_near(points, reach, limit, pairs, masks, near):
    """Fill in the pairs that have any point within ε, a mask and a number of those for each; return how many."""
    m, n_pairs = len(points), 0
    n_words = masks.shape[1]
    box = np.empty((2, 3), np.int64)
    for i in range(m):
        for j in range(i + 1, m):
            for axis in range(3):
                box[0, axis] = min(points[i, axis], points[j, axis]) - reach
                box[1, axis] = max(points[i, axis], points[j, axis]) + reach
            for w in range(n_words):
                masks[n_pairs, w] = 0
            count = 0
            for q in range(m):
                if (
                    (points[q, 0] >= box[0, 0])
                    & (points[q, 0] <= box[1, 0])
                    & (points[q, 1] >= box[0, 1])
                    & (points[q, 1] <= box[1, 1])
                    & (points[q, 2] >= box[0, 2])
                    & (points[q, 2] <= box[1, 2])
                    & (q != i)
                    & (q != j)
                ) and _parameter(points, i, j, q, limit) >= 0:
                    masks[n_pairs, q >> 6] |= np.uint64(1) << np.uint64(q & 63)
                    count += 1
            if count:
                pairs[n_pairs, 0], pairs[n_pairs, 1], near[n_pairs] = i, j, count
                n_pairs += 1
    return n_pairs


@njit(nogil=True, cache=True)
def _best_first(near, m):
    """(p,) int64: a stable order of descending (p,) numbers < m."""
    place = np.zeros(m + 1, np.int64)
    for count in near:
        place[m - count] += 1
    total = 0
    for i in range(m + 1):
        place[i], total = total, total + place[i]
    order = np.empty(len(near), np.int64)
    for i in range(len(near)):
        order[place[m - near[i]]] = i
        place[m - near[i]] += 1
    return order


@njit(nogil=True, cache=True)
def _has(mask, q):
    return mask[q >> 6] >> np.uint64(q & 63) & np.uint64(1) != 0


@njit(nogil=True, cache=True)
def _count(word):
    n = 0
    while word:
        word &= word - np.uint64(1)
        n += 1
    return n


@njit(nogil=True, cache=True)
def _search(pairs, masks, order, m, most_ends):
    """The pairs that define the best grouping among the first ends of branches, in the order they take points.

    A branch that finds nothing has one set of points a level: level k holds what was free and grouped when k groups
    were made, and the place in the order from which the search there goes on.
    """
    n_words = masks.shape[1]
    free, grouped = np.zeros((m + 1, n_words), np.uint64), np.zeros((m + 1, n_words), np.uint64)
    n_free, n_grouped = np.zeros(m + 1, np.int64), np.zeros(m + 1, np.int64)
    next_place, chosen = np.zeros(m + 1, np.int64), np.empty(m, np.int64)
    best, best_grouped = np.empty(m, np.int64), 0
    n_best, ends, level, constructed = 0, 0, 0, np.zeros(m + 1, np.bool_)
    n_free[0] = m
    for q in range(m):
        free[0, q >> 6] |= np.uint64(1) << np.uint64(q & 63)
    while True:
        found = False
        for place in range(next_place[level], len(order)):
            which = order[place]
            i, j = pairs[which, 0], pairs[which, 1]
            if _has(grouped[level], i) or _has(grouped[level], j):
                continue
            taken = 0
            for w in range(n_words):
                taken += _count(masks[which, w] & free[level, w])
            if taken == 0:  # no nonproductive groups
                continue
            p = n_grouped[level] + taken
            f = n_free[level] - taken - _has(free[level], i) - _has(free[level], j)
            if f + p <= best_grouped:  # cannot be the best solution
                continue
            if m * p < best_grouped * (m - f):  # average group size
                continue
            found, constructed[level], next_place[level], chosen[level] = True, True, place + 1, which
            level += 1
            for w in range(n_words):
                mask = masks[which, w] & free[level - 1, w]
                grouped[level, w] = grouped[level - 1, w] | mask
                free[level, w] = free[level - 1, w] & ~mask
            free[level, i >> 6] &= ~(np.uint64(1) << np.uint64(i & 63))
            free[level, j >> 6] &= ~(np.uint64(1) << np.uint64(j & 63))
            n_free[level], n_grouped[level], constructed[level] = f, p, False
            # A pair that made no group makes none with fewer points free; only a better solution can forbid one.
            next_place[level] = place + 1 if ends == 0 else 0
            break
        if found:
            continue
        if not constructed[level]:
            ends += 1
            if n_grouped[level] > best_grouped:
                best_grouped, n_best = n_grouped[level], level
                best[:n_best] = chosen[:n_best]
        if level == 0 or ends >= most_ends:
            return best[:n_best].copy()
        level -= 1
