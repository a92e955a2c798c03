"""Compiled layers and bit streams of ``eci``. ``eci_reference`` is the readable twin.

Layers as arrays, over all points in the order of the stream: ``sequence``, which point stands there; ``connectivity``,
how many points are connected to it (0: no seed); ``n_seeds``, how many of these are seeds; ``is_first``, 1 where a
component starts a block, 2 where it follows another of the same block, else 0.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_EDGE = 34  # a cube of 32³ positions with an empty one on each side, so that every point has 26 neighbours to look at
_CONNECTIVITY_BITS = 5
_MOST_CONNECTED = 26


@njit(nogil=True, cache=True)
def _neighbour_steps():
    """(26,) distances in the grid with its rim, ascending."""
    steps, n = np.empty(26, np.int64), 0
    for x in range(-1, 2):
        for y in range(-1, 2):
            for z in range(-1, 2):
                if x or y or z:
                    steps[n] = (x * _EDGE + y) * _EDGE + z
                    n += 1
    return steps


@njit(nogil=True, cache=True)
def _place(point):
    return ((np.int64(point[0]) + 1) * _EDGE + point[1] + 1) * _EDGE + point[2] + 1


@njit(nogil=True, cache=True)
def _count_left(left, place, steps):
    count = 0
    for step in steps:
        count += left[place + step] > 0
    return count


@njit(nogil=True, cache=True)
def _take_neighbours(left, place, steps, sequence, end):
    """Move the points left around ``place`` to ``sequence[end:]``, in ascending order; return the new end."""
    start = end
    for step in steps:
        point = left[place + step] - 1
        if point < 0:
            continue
        left[place + step] = 0
        at = end
        while at > start and sequence[at - 1] > point:
            sequence[at] = sequence[at - 1]
            at -= 1
        sequence[at] = point
        end += 1
    return end


@njit(nogil=True, cache=True)
def _choose_seeds(points, left, steps, sequence, connectivity, begin, stop, end):
    """Choose seeds among ``sequence[begin:stop]``, most points left around first, and bring them to the front.

    Their points go to ``sequence[end:]``. Returns the number of seeds and the new end.
    """
    count = np.full(stop - begin, _MOST_CONNECTED)  # never too low: what is left around a point only falls
    for front in range(begin, stop):
        best, most = front, 0
        for i in range(front, stop):
            if count[i - begin] > most:
                count[i - begin] = _count_left(left, _place(points[sequence[i]]), steps)
                if count[i - begin] > most:
                    best, most = i, count[i - begin]
        if most == 0:
            return front - begin, end
        seed = sequence[best]
        for i in range(best, front, -1):
            sequence[i] = sequence[i - 1]
            count[i - begin] = count[i - begin - 1]
        sequence[front] = seed
        new_end = _take_neighbours(left, _place(points[seed]), steps, sequence, end)
        connectivity[front] = new_end - end
        end = new_end
    return stop - begin, end


@njit(nogil=True, cache=True)
def layer_blocks(points, first):
    """(sequence, connectivity, n_seeds, is_first) of (n, 3) distinct points in their blocks, below 32.

    first : (k + 1,) int64, the blocks' ranges of points. A component starts from the first point left of its block, and
    equal points stand in ascending order.
    """
    n = len(points)
    sequence, connectivity = np.empty(n, np.int64), np.zeros(n, np.uint8)
    n_seeds, is_first = np.zeros(n, np.uint8), np.zeros(n, np.uint8)
    left = np.zeros(_EDGE**3, np.int64)  # index + 1 of the point that stands there and is in no layer yet
    steps = _neighbour_steps()
    for block in range(len(first) - 1):
        for i in range(first[block], first[block + 1]):
            left[_place(points[i])] = i + 1
        end = first[block]
        for i in range(first[block], first[block + 1]):
            place = _place(points[i])
            if left[place] == 0:
                continue
            left[place] = 0
            root = end
            is_first[root] = 1 if root == first[block] else 2
            sequence[root] = i
            end = _take_neighbours(left, place, steps, sequence, root + 1)
            connectivity[root] = end - root - 1
            # Seeds one after the other; what is connected to them stands in the same order, without gaps.
            seed, begin = root, root + 1
            while begin < end:
                if connectivity[seed]:
                    stop = begin + connectivity[seed]
                    seeds, end = _choose_seeds(points, left, steps, sequence, connectivity, begin, stop, end)
                    n_seeds[seed] = seeds
                    begin = stop
                seed += 1
    return sequence, connectivity, n_seeds, is_first


@njit(nogil=True, cache=True)
def _put(stream, at, value, width):
    """Write the low ``width`` bits of ``value``, highest first, into zeros; return the next bit."""
    for i in range(width - 1, -1, -1):
        if value >> i & 1:
            stream[at >> 3] |= 128 >> (at & 7)
        at += 1
    return at


@njit(nogil=True, cache=True)
def _width(value):
    """Number of bits of a number in 0 … 31."""
    return (value > 0) + (value > 1) + (value > 3) + (value > 7) + (value > 15)


@njit(nogil=True, cache=True)
def _put_seed_fields(stream, at, connectivity, n_seeds):
    at = _put(stream, at, connectivity, _CONNECTIVITY_BITS)
    return _put(stream, at, n_seeds, _width(connectivity))


@njit(nogil=True, cache=True)
def write_blocks_of_layers(points, sequence, connectivity, n_seeds, is_first, root_bits, stream):
    """Write the layers of (n, 3) points to zeros; return the number of bits."""
    at, i = np.int64(0), 0
    while i < len(sequence):  # a component
        if is_first[i] == 1 and i > 0:
            at += 1  # 0: the last component of its block
        elif is_first[i] == 2:
            at = _put(stream, at, 1, 1)
        for axis in range(3):
            at = _put(stream, at, points[sequence[i], axis], root_bits)
        at = _put_seed_fields(stream, at, connectivity[i], n_seeds[i])
        seed = i
        i += 1
        stop = i + connectivity[seed]
        while i < len(sequence) and not is_first[i]:
            while i == stop:
                seed += 1
                stop += connectivity[seed]
            for axis in range(3):
                offset = np.int64(points[sequence[i], axis]) - np.int64(points[sequence[seed], axis])
                at = _put(stream, at, 0, 1) if offset < 0 else _put(stream, at, 2 + offset, 2)
            if connectivity[i]:
                at = _put_seed_fields(stream, at, connectivity[i], n_seeds[i])
            i += 1
    return at + 1  # 0: the last component of the last block


@njit(nogil=True, cache=True)
def _get(stream, at, n_bits, width):
    """(value, next bit) of ``width`` bits from ``at`` on; (−1, n_bits) where they are not there."""
    if at + width > n_bits:
        return np.int64(-1), n_bits
    value = np.int64(0)
    for i in range(at, at + width):
        value = value << 1 | (stream[i >> 3] >> (7 - (i & 7)) & 1)
    return value, at + width


@njit(nogil=True, cache=True)
def _get_offset(stream, at, n_bits):
    """(−1, 0 or 1, next bit); an offset out of every cube where the bits end."""
    value, at = _get(stream, at, n_bits, 1)
    if value == 0:
        return np.int64(-1), at
    if value == 1:
        value, at = _get(stream, at, n_bits, 1)
    return value if value >= 0 else np.int64(_EDGE), at


@njit(nogil=True, cache=True)
def _get_seed_fields(stream, at, n_bits):
    """(connectivity, number of seeds, next bit); connectivity −1 where no encoder writes such fields."""
    connectivity, at = _get(stream, at, n_bits, _CONNECTIVITY_BITS)
    if connectivity < 0 or connectivity > _MOST_CONNECTED:
        return np.int64(-1), np.int64(0), at
    n_seeds, at = _get(stream, at, n_bits, _width(connectivity))
    if n_seeds < 0 or n_seeds > connectivity:
        return np.int64(-1), np.int64(0), at
    return connectivity, n_seeds, at


@njit(nogil=True, cache=True)
def _read_component(stream, at, n_bits, root_bits, taken, points, n, connectivity, n_seeds):
    """Read a component to ``points[n:]``, in its block; return (next point, next bit), −1 for a damaged stream."""
    edge = np.int64(1) << root_bits
    failed = np.int64(-1), at
    if n == len(points):
        return failed
    for axis in range(3):
        value, at = _get(stream, at, n_bits, root_bits)
        if value < 0:
            return failed
        points[n, axis] = value
    connected, seeds, at = _get_seed_fields(stream, at, n_bits)
    place = _place(points[n])
    if connected < 0 or taken[place]:
        return failed
    taken[place] = 1
    connectivity[n], n_seeds[n] = connected, seeds
    seed = n
    n += 1
    begin = n
    while seed < begin:  # a point is looked at as a seed only when it has been read
        stop = begin + connectivity[seed]
        if stop > len(points):
            return failed
        for i in range(begin, stop):
            for axis in range(3):
                offset, at = _get_offset(stream, at, n_bits)
                coordinate = np.int64(points[seed, axis]) + offset
                if coordinate < 0 or coordinate >= edge:
                    return failed
                points[i, axis] = coordinate
            place = _place(points[i])
            if taken[place]:
                return failed
            taken[place] = 1
            connectivity[i], n_seeds[i] = 0, 0
            if i - begin < n_seeds[seed]:
                connected, seeds, at = _get_seed_fields(stream, at, n_bits)
                if connected < 1:
                    return failed
                connectivity[i], n_seeds[i] = connected, seeds
        begin = stop
        seed += 1
    return begin, at


@njit(nogil=True, cache=True)
def read_blocks_of_layers(stream, n_bits, lowest, root_bits, points):
    """Fill (n, 3) ``points`` from the cubes at (k, 3) ``lowest``; False unless the stream is exactly theirs."""
    connectivity, n_seeds = np.zeros(len(points), np.uint8), np.zeros(len(points), np.uint8)
    taken = np.zeros(_EDGE**3, np.uint8)
    at, n = np.int64(0), np.int64(0)
    for block in range(len(lowest)):
        first, another = n, np.int64(1)
        while another == 1:
            n, at = _read_component(stream, at, n_bits, root_bits, taken, points, n, connectivity, n_seeds)
            if n < 0:
                return False
            another, at = _get(stream, at, n_bits, 1)
            if another < 0:
                return False
        for i in range(first, n):
            taken[_place(points[i])] = 0
            for axis in range(3):
                points[i, axis] += lowest[block, axis]
    return n == len(points) and n_bits - at < 8 and (at == n_bits or not stream[at >> 3] << (at & 7) & 0xFF)
