"""Compiled octree levels of ``occupancy``: nodes, their neighbours, and the contexts in which children are coded.

Nodes of a level stand in Morton order, x in the lowest bit; child ``c`` has bit 0 set on the upper half in x, bit 1 in
y, bit 2 in z. ``occupancy`` is (m,) uint8, bit c set where child c is there. ``neighbours`` is (m, 27) int32: the node
at (dx, dy, dz), each −1, 0 or 1, stands in column (dx + 1) + 3·(dy + 1) + 9·(dz + 1); −1 where there is none.

While a node's children are coded, those of the nodes before it are known. All that is known lies in a window of 4×4×4
voxels of the children's size, the node's own in the middle; voxel (x, y, z) is bit x + 4y + 16z of a uint64. ``there``
holds the voxels known to be occupied, ``perhaps`` those in nodes that exist and come later.

A node without neighbours may hold a single point, which then is *direct*: its remaining bits stand there as they are,
and the node has no occupancy (0). Nothing below it can touch another node, so no context misses it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from . import MAX_BITS
from .mixing import N_INPUTS, learn, learn_one, new_counters, new_weights, predict, predict_one, tables
from .range_coder import PROBABILITY_BITS, ran_out, read_bit, with_room, write_bit


class Model(NamedTuple):
    """What is learnt while a stream is coded, and the tables that this needs: see ``mixing``, ``neighbour_voxels``."""

    counters: np.ndarray
    weights: np.ndarray
    stretch: np.ndarray
    squash: np.ndarray
    rate: np.ndarray
    voxels: np.ndarray


N_WEIGHT_SETS = 64  # by child, and by how many children came before it
_OWN, _COUNTS, _PATTERN = 0, 255 * 64, 255 * 64 + 8 * 16 * 16 * 8
_DIRECT = _PATTERN + 8 * 2**13  # by the number of levels left
_AGAIN = _DIRECT + MAX_BITS + 1  # by how often the point has stood there
_MOST_AGAIN = 31
N_CONTEXTS = _AGAIN + _MOST_AGAIN + 1

_HALF = 1 << PROBABILITY_BITS - 1

_SELF = 13


@njit(nogil=True, cache=True)
def morton_keys(points, bits):
    """(n,) int64 of (n, 3) uint32."""
    keys = np.zeros(len(points), np.int64)
    for i in range(len(points)):
        for axis in range(3):
            value = np.int64(points[i, axis])
            for bit in range(bits):
                keys[i] |= (value >> bit & 1) << 3 * bit + axis
    return keys


@njit(nogil=True, cache=True)
def morton_points(keys, bits):
    """(n, 3) uint32 of (n,) int64."""
    points = np.zeros((len(keys), 3), np.uint32)
    for i in range(len(keys)):
        for axis in range(3):
            value = np.int64(0)
            for bit in range(bits):
                value |= (keys[i] >> 3 * bit + axis & 1) << bit
            points[i, axis] = value
    return points


@njit(nogil=True, cache=True)
def level_occupancy(keys, shift, n_nodes):
    """(occupancy, first) of the level whose children are the ascending ``keys >> shift``: (n_nodes,) uint8, and
    (n_nodes + 1,) int64, the nodes' ranges of keys.
    """
    occupancy, first = np.zeros(n_nodes, np.uint8), np.empty(n_nodes + 1, np.int64)
    node, last = -1, np.int64(-1)
    for k in range(len(keys)):
        code = keys[k] >> shift + 3
        if code != last:
            node, last = node + 1, code
            first[node] = k
        occupancy[node] |= 1 << (keys[k] >> shift & 7)
    first[n_nodes] = len(keys)
    return occupancy, first


@njit(nogil=True, cache=True)
def without_direct(keys, occupancy, first):
    """The keys of nodes that have an occupancy."""
    rest, at = np.empty(len(keys), np.int64), 0
    for i in range(len(occupancy)):
        if occupancy[i]:
            for k in range(first[i], first[i + 1]):
                rest[at] = keys[k]
                at += 1
    return rest[:at]


@njit(nogil=True, cache=True)
def _popcount(word):
    """Number of bits of a uint64 that are set."""
    word -= word >> np.uint64(1) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + (word >> np.uint64(2) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64(word * np.uint64(0x0101010101010101) >> np.uint64(56))


@njit(nogil=True, cache=True)
def count_children(occupancy):
    """Number of children of all nodes."""
    count = 0
    for byte in occupancy:
        count += _popcount(np.uint64(byte))
    return count


@njit(nogil=True, cache=True)
def child_codes(codes, occupancy, n_children):
    """(n_children,) int64 Morton codes of the children of nodes with (m,) codes."""
    children, at = np.empty(n_children, np.int64), 0
    for i in range(len(codes)):
        for c in range(8):
            if occupancy[i] >> c & 1:
                children[at] = codes[i] << 3 | c
                at += 1
    return children


def root_neighbours() -> np.ndarray:
    """``neighbours`` of the root alone."""
    neighbours = np.full((1, 27), -1, np.int32)
    neighbours[0, _SELF] = 0
    return neighbours


@njit(nogil=True, cache=True)
def child_neighbours(occupancy, neighbours, n_children):
    """``neighbours`` of the children: each is a child of the node itself or of one of its neighbours."""
    n_nodes = len(occupancy)
    first = np.empty(n_nodes, np.int32)
    total = 0
    for i in range(n_nodes):
        first[i] = total
        total += _popcount(np.uint64(occupancy[i]))
    # Where child c has its neighbour d: in which column of the node, and which child there.
    column, child = np.empty((8, 27), np.int64), np.empty((8, 27), np.int64)
    for c in range(8):
        for d in range(27):
            column[c, d], child[c, d] = 0, 0
            step = d
            for axis in range(3):
                place = (c >> axis & 1) + step % 3 + 1  # 1 … 4: twice the node before, itself and behind, from 0 on
                step //= 3
                column[c, d] += place // 2 * 3**axis
                child[c, d] |= (place & 1) << axis
    out, at = np.empty((n_children, 27), np.int32), 0
    for i in range(n_nodes):
        for c in range(8):
            if not occupancy[i] >> c & 1:
                continue
            for d in range(27):
                j = neighbours[i, column[c, d]]
                there = j >= 0 and occupancy[j] >> child[c, d] & 1
                before = (1 << child[c, d]) - 1
                out[at, d] = first[j] + _popcount(np.uint64(occupancy[j] & before)) if there else -1
            at += 1
    return out


@njit(nogil=True, cache=True)
def neighbour_voxels():
    """(27, 256) uint64: the voxels of the window that the neighbour in a column covers with an occupancy."""
    voxels = np.zeros((27, 256), np.uint64)
    for d in range(27):
        for c in range(8):
            x = 2 * (d % 3) - 1 + (c & 1)
            y = 2 * (d // 3 % 3) - 1 + (c >> 1 & 1)
            z = 2 * (d // 9) - 1 + (c >> 2)
            if 0 <= x < 4 and 0 <= y < 4 and 0 <= z < 4:
                for byte in range(256):
                    if byte >> c & 1:
                        voxels[d, byte] |= np.uint64(1) << np.uint64(x + 4 * y + 16 * z)
    return voxels


def new_model() -> Model:
    """Nothing learnt yet."""
    return Model(new_counters(N_CONTEXTS), new_weights(N_WEIGHT_SETS), *tables(), neighbour_voxels())


# Around voxel (1, 1, 1): the 26 neighbours that share a face, an edge, a corner. The window of child c is shifted.
_FACES = np.uint64(1 << 5 | 1 << 17 | 1 << 20 | 1 << 22 | 1 << 25 | 1 << 37)
_EDGES = np.uint64(1 << 1 | 1 << 4 | 1 << 6 | 1 << 9 | 1 << 16 | 1 << 18 | 1 << 24 | 1 << 26)
_EDGES |= np.uint64(1 << 33 | 1 << 36 | 1 << 38 | 1 << 41)
_CORNERS = np.uint64(1 << 0 | 1 << 2 | 1 << 8 | 1 << 10 | 1 << 32 | 1 << 34 | 1 << 40 | 1 << 42)


@njit(nogil=True, cache=True, inline="always")
def _look_around(neighbours, i, occupancy, voxels):
    """(there, perhaps, faces, alone) of node i: its window, a bit for each node across a face, no neighbour at all."""
    there, perhaps, faces, alone = np.uint64(0), np.uint64(0), 0, True
    for d in range(27):
        j = neighbours[i, d]
        if j < 0 or d == _SELF:
            continue
        alone = False
        if j < i:
            there |= voxels[d, occupancy[j]]
        else:
            perhaps |= voxels[d, 255]
    for d in (4, 10, 12, 14, 16, 22):
        faces = faces << 1 | (neighbours[i, d] >= 0)
    return there, perhaps, faces, alone


@njit(nogil=True, cache=True, inline="always")
def _set_contexts(contexts, child, own, n_own, there, perhaps, faces):
    """The three contexts of a child, when children ``own`` (bits; ``n_own`` of them) of those before it are there.

    - own: which of the children before it are there, and which nodes across the faces exist;
    - counts: how much around it is known to be occupied, how much may be, and how many children came before;
    - pattern: what is known of the 13 voxels before it in z, y, x.
    """
    shift = np.uint64((child & 1) + 4 * (child >> 1 & 1) + 16 * (child >> 2))
    there, perhaps = there >> shift, perhaps >> shift
    near = 2 * _popcount(there & _FACES) + _popcount(there & _EDGES) + (_popcount(there & _CORNERS) + 1 >> 1)
    later = 2 * _popcount(perhaps & _FACES) + _popcount(perhaps & (_EDGES | _CORNERS))
    pattern = np.int64(there & np.uint64(0x1FFFFF))
    pattern = pattern & 7 | pattern >> 1 & 0x38 | pattern >> 2 & 0x1C0 | pattern >> 7 & 0xE00 | pattern >> 8 & 0x1000
    contexts[0] = _OWN + ((1 << child) - 1 + own) * 64 + faces
    contexts[1] = _COUNTS + ((child * 16 + min(near, 15)) * 16 + min(later, 15)) * 8 + n_own
    contexts[2] = _PATTERN + child * 2**13 + pattern


@njit(nogil=True, cache=True)
def write_level(occupancy, first, keys, n_left, neighbours, model, state, out):
    """Write the children of all nodes, ``n_left`` levels above the points, or their direct points.

    Sets the occupancy of direct ones to 0. Returns ``out``, made longer where it was too short.
    """
    counters, weights, stretch, squash, rate, voxels = model
    contexts, logits = np.empty(N_INPUTS, np.int64), np.empty(N_INPUTS, np.int64)
    for i in range(len(occupancy)):
        out = with_room(state, out, 1 + 3 * MAX_BITS)
        there, perhaps, faces, alone = _look_around(neighbours, i, occupancy, voxels)
        if alone:
            direct = np.int64(first[i + 1] - first[i] == 1)
            write_bit(state, out, direct, predict_one(counters[_DIRECT + n_left]))
            counters[_DIRECT + n_left] = learn_one(counters[_DIRECT + n_left], rate, direct)
            if direct:
                for bit in range(3 * n_left - 1, -1, -1):
                    write_bit(state, out, keys[first[i]] >> bit & 1, _HALF)
                occupancy[i] = 0
                continue
        own, n_own = 0, 0
        for child in range(8):
            if child == 7 and own == 0:
                break  # a node has a child
            _set_contexts(contexts, child, own, n_own, there, perhaps, faces)
            mixed = weights[child * 8 + n_own]
            probability = predict(counters, contexts, mixed, stretch, squash, logits)
            bit = np.int64(occupancy[i] >> child & 1)
            write_bit(state, out, bit, probability)
            learn(counters, contexts, mixed, rate, logits, probability, bit)
            if bit:
                own |= 1 << child
                n_own += 1
                there |= voxels[_SELF, 1 << child]
    return out


@njit(nogil=True, cache=True)
def read_level(codes, n_left, neighbours, model, state, data, keys, n_keys):
    """(occupancy, n_keys) of nodes with (m,) Morton codes, as ``write_level`` wrote them; n_keys −1 where data run out.

    Direct points are added to ``keys[n_keys:]``, which has room for one of each node.
    """
    occupancy = np.zeros(len(neighbours), np.uint8)
    counters, weights, stretch, squash, rate, voxels = model
    contexts, logits = np.empty(N_INPUTS, np.int64), np.empty(N_INPUTS, np.int64)
    for i in range(len(occupancy)):
        there, perhaps, faces, alone = _look_around(neighbours, i, occupancy, voxels)
        if alone:
            direct = read_bit(state, data, predict_one(counters[_DIRECT + n_left]))
            counters[_DIRECT + n_left] = learn_one(counters[_DIRECT + n_left], rate, direct)
            if direct:
                key = codes[i]
                for _ in range(3 * n_left):
                    key = key << 1 | read_bit(state, data, _HALF)
                keys[n_keys] = key
                n_keys += 1
                continue
        own, n_own = 0, 0
        for child in range(8):
            if child == 7 and own == 0:
                own = 1 << 7
                break  # a node has a child
            _set_contexts(contexts, child, own, n_own, there, perhaps, faces)
            mixed = weights[child * 8 + n_own]
            probability = predict(counters, contexts, mixed, stretch, squash, logits)
            bit = read_bit(state, data, probability)
            learn(counters, contexts, mixed, rate, logits, probability, bit)
            if bit:
                own |= 1 << child
                n_own += 1
                there |= voxels[_SELF, 1 << child]
        occupancy[i] = own
        if ran_out(state, data):
            return occupancy, -1
    return occupancy, n_keys


@njit(nogil=True, cache=True)
def write_counts(counts, model, state, out):
    """Write how often each point stands there: again, again, no more. Returns ``out``, made longer if too short."""
    for count in counts:
        for k in range(1, count + 1):
            out = with_room(state, out, 1)
            context = _AGAIN + min(k, _MOST_AGAIN)
            again = np.int64(k < count)
            write_bit(state, out, again, predict_one(model.counters[context]))
            model.counters[context] = learn_one(model.counters[context], model.rate, again)
    return out


@njit(nogil=True, cache=True)
def read_counts(n, most_points, model, state, data):
    """(n,) int64, as ``write_counts`` wrote them; None where data run out or add up to more than ``most_points``."""
    counts, total = np.ones(n, np.int64), n
    for i in range(n):
        while total <= most_points:
            context = _AGAIN + min(counts[i], _MOST_AGAIN)
            again = read_bit(state, data, predict_one(model.counters[context]))
            model.counters[context] = learn_one(model.counters[context], model.rate, again)
            if not again:
                break
            counts[i] += 1
            total += 1
        if ran_out(state, data):
            return None
    return counts if total <= most_points else None
