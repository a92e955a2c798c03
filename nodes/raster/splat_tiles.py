"""Compiled kernels of the ``cpu`` splat rasterizer, second part: splats → tiles of the image → words.

The image is cut into tiles of 64 × 64 pixels, whose sums fit the second-level cache. Each tile gets the list of what
may cover it, in the order of the frame's entries, and is drawn by one thread from that list alone: no word is shared,
and floats are summed in one order whatever the number of threads.

In a tile, pixels are taken eight columns at a time, at aligned places: one vector operation a step.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ...shared.messages import FRAMEBUFFER_EMPTY
from .atomic import fetch_add
from .splat_geometry import MAX_SPLAT_PX, SCREEN_RADIUS_PX

TILE = 64
"""Side of a tile, pixels."""

PLANES = 6
"""float32 values a pixel of a tile: depth in front, depth of the nearest accepted fragment, and four sums."""

WEIGHT = (0.99998095, -1.99862203, 1.98355765, -1.25985046, 0.5119149, -0.10166005)
"""Polynomial in ρ² for exp(−2 ρ²) on 0…1: interpolation at Chebyshev points, at most 1.1e-4 off (relative)."""

LANES = 8
"""Columns of a vector operation: float32 of AVX. The kernels get it as an argument, for with a constant the compiler
unrolls these loops before it could vectorise them."""

BLOCK = 8
"""Side of a block, pixels: hidden splats are found by the blocks they reach into."""

LOOK_BACK = 512
"""Splats of a tile between two looks at what is hidden by those before, in the visibility pass."""

_PIXELS = TILE * TILE
_BLOCKS = TILE // BLOCK
_FRONT, _NEAREST, _WEIGHT, _RED, _GREEN, _BLUE = (np.uintp(k * _PIXELS) for k in range(PLANES))
_EMPTY = np.uint64(FRAMEBUFFER_EMPTY)
_ALPHA = np.uint32(0xFF00_0000)
_ZERO, _HALF, _ONE, _TWO, _INF = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2), np.float32(np.inf)
_MAX = np.float32(MAX_SPLAT_PX)
_PER_SCREEN_2 = np.float32(1 / SCREEN_RADIUS_PX**2)
_W0, _W1, _W2, _W3, _W4, _W5 = (np.float32(c) for c in WEIGHT)


@njit(nogil=True, cache=True)
def count_tiles(bounds, chunks, totals, n_across, counts, counter):
    """Fill (c, tiles) int64 ``counts``: how many splats of each chunk reach into each tile; others as ``project``."""
    chunk = fetch_add(counter, 1)
    while chunk < len(counts):
        for tile in range(counts.shape[1]):
            counts[chunk, tile] = 0
        for i in range(chunks[chunk, 1], chunks[chunk, 1] + totals[chunk, 0]):
            b = bounds[i]
            for row in range(b.top // TILE, (b.bottom - 1) // TILE + 1):
                for column in range(b.left // TILE, (b.right - 1) // TILE + 1):
                    counts[chunk, np.uintp(row * n_across + column)] += 1
        chunk = fetch_add(counter, 1)


@njit(nogil=True, cache=True)
def place_lists(places, first):
    """Turn counts into places: where in the lists each chunk begins in each tile; (tiles + 1,) int64 ``first``."""
    n = 0
    for tile in range(places.shape[1]):
        first[tile] = n
        for chunk in range(len(places)):
            n, places[chunk, tile] = n + places[chunk, tile], n
    first[len(first) - 1] = n


@njit(nogil=True, cache=True)
def fill_lists(bounds, chunks, totals, n_across, places, lists, counter):
    """Write the index of each splat into the list of each tile it reaches; ``places`` move on."""
    chunk = fetch_add(counter, 1)
    while chunk < len(places):
        for i in range(chunks[chunk, 1], chunks[chunk, 1] + totals[chunk, 0]):
            b = bounds[i]
            for row in range(b.top // TILE, (b.bottom - 1) // TILE + 1):
                for column in range(b.left // TILE, (b.right - 1) // TILE + 1):
                    tile = np.uintp(row * n_across + column)
                    lists[np.uintp(places[chunk, tile])] = i
                    places[chunk, tile] += 1
        chunk = fetch_add(counter, 1)


@njit(nogil=True, cache=True)
def draw_tiles(splats, quads, near, n_across, lanes, planes, frame, counter):
    """Draw tiles until none is left.

    splats, quads : (records, bounds, (l,) uint32 lists, (tiles + 1,) int64 first place of each tile's list).
    near : float32.  planes : (PLANES · TILE²,) float32, scratch.  frame : (height, width) uint64, filled.
    counter : (1,) int64, shared by the threads of a frame, 0 at its start.
    """
    records, bounds, lists, first = splats
    farthest = np.empty(_BLOCKS * _BLOCKS, np.float32)
    quad_records, quad_bounds, quad_lists, quad_first = quads
    tile = fetch_add(counter, 1)
    while tile < len(first) - 1:
        left, top = tile % n_across * TILE, tile // n_across * TILE
        begin, end = first[tile], first[tile + 1]
        if begin < end:
            for i in range(PLANES * _PIXELS):
                planes[i] = _INF if i < 2 * _PIXELS else _ZERO
            has_quads = quad_first[tile] < quad_first[tile + 1]
            for k in range(quad_first[tile], quad_first[tile + 1]):
                i = np.uintp(quad_lists[k])
                _cover_quad(quad_records[i], quad_bounds[i], left, top, near, planes)
            _see(records, bounds, lists, begin, end, left, top, near, lanes, planes, farthest, False)
            _add(records, bounds, lists, begin, end, left, top, near, lanes, planes, farthest)
            if has_quads and _reopen(planes):
                _see(records, bounds, lists, begin, end, left, top, near, lanes, planes, farthest, True)
                _add(records, bounds, lists, begin, end, left, top, near, lanes, planes, farthest)
        _normalise(planes, begin == end, left, top, frame)
        tile = fetch_add(counter, 1)


@njit(nogil=True, cache=True)
def _see(records, bounds, lists, begin, end, left, top, near, lanes, planes, farthest, everything):
    """Visibility pass of a tile: of ``everything``, or of what no quad stands for."""
    for k in range(begin, end):
        if (k - begin) % LOOK_BACK == 0:
            _find_farthest(planes, farthest)
        i = np.uintp(lists[k])
        if not (everything or records[i].visible) or _hidden(records[i].nearest, bounds[i], left, top, farthest):
            continue
        if records[i].is_disc:
            _cover_disc(records[i], bounds[i], left, top, lanes, near, planes)
        else:
            _cover_dot(records[i], bounds[i], left, top, lanes, planes)


@njit(nogil=True, cache=True)
def _add(records, bounds, lists, begin, end, left, top, near, lanes, planes, farthest):
    """Colour pass of a tile."""
    _find_farthest(planes, farthest)
    for k in range(begin, end):
        i = np.uintp(lists[k])
        if _hidden(records[i].nearest - records[i].behind, bounds[i], left, top, farthest):
            continue
        if records[i].is_disc:
            _add_disc(records[i], bounds[i], left, top, lanes, near, planes)
        else:
            _add_dot(records[i], bounds[i], left, top, lanes, planes)


@njit(nogil=True, cache=True)
def _reopen(planes):
    """Whether there are pixels where a quad hides every splat: it reaches a little beyond its own ones.

    They are opened for both passes once more, the others closed.
    """
    found = False
    for k in range(_PIXELS):
        i = np.uintp(k)
        reopened = planes[i + _WEIGHT] == _ZERO and planes[i] < _INF
        planes[i] = _INF if reopened else -_INF
        found |= reopened
    return found


@njit(nogil=True, cache=True)
def _find_farthest(planes, farthest):
    """Of each block of a tile, the largest depth in front: what is farther everywhere is hidden there."""
    for row in range(TILE):
        for column in range(_BLOCKS):
            largest = planes[np.uintp(row * TILE + column * BLOCK)]
            for i in range(1, BLOCK):
                largest = max(largest, planes[np.uintp(row * TILE + column * BLOCK + i)])
            block = np.uintp(row // BLOCK * _BLOCKS + column)
            farthest[block] = largest if row % BLOCK == 0 else max(largest, farthest[block])


@njit(nogil=True, cache=True)
def _hidden(nearest, bounds, left, top, farthest):
    """Whether every pixel that a splat may cover in a tile is nearer than ``nearest``."""
    begin, end, first_row, end_row = _in_tile(bounds, left, top)
    for row in range(first_row // BLOCK, (end_row - 1) // BLOCK + 1):
        for column in range(begin // BLOCK, (end - 1) // BLOCK + 1):
            if nearest <= farthest[np.uintp(row * _BLOCKS + column)]:
                return False
    return True


@njit(nogil=True, cache=True)
def _in_tile(bounds, left, top):
    """Bounds relative to a tile, cut to it: first and end column, first and end row."""
    a, b = max(np.int64(bounds.left) - left, 0), min(np.int64(bounds.right) - left, TILE)
    return a, b, max(np.int64(bounds.top) - top, 0), min(np.int64(bounds.bottom) - top, TILE)


@njit(nogil=True, cache=True)
def _cover_dot(s, bounds, left, top, lanes, planes):
    """Visibility pass of a splat that only its screen term covers."""
    begin, end, first_row, end_row = _in_tile(bounds, left, top)
    u, v, w = s.u - np.float32(left) - _HALF, s.v - np.float32(top) - _HALF, s.w
    for row in range(first_row, end_row):
        y = np.float32(row) - v
        for block in range(begin & -lanes, end, lanes):
            at, first = np.uintp(row * TILE + block), np.float32(block) - u
            for lane in range(lanes):
                x = first + np.float32(np.int32(lane))
                depth = w if (x * x + y * y) * _PER_SCREEN_2 <= _ONE else _INF
                planes[at + np.uintp(lane)] = min(depth, planes[at + np.uintp(lane)])


@njit(nogil=True, cache=True)
def _add_dot(s, bounds, left, top, lanes, planes):
    """Colour pass of a splat that only its screen term covers."""
    begin, end, first_row, end_row = _in_tile(bounds, left, top)
    u, v, w, behind = s.u - np.float32(left) - _HALF, s.v - np.float32(top) - _HALF, s.w, s.behind
    red, green, blue = s.red, s.green, s.blue
    for row in range(first_row, end_row):
        y = np.float32(row) - v
        for block in range(begin & -lanes, end, lanes):
            at, first = np.uintp(row * TILE + block), np.float32(block) - u
            for lane in range(lanes):
                x = first + np.float32(np.int32(lane))
                rho = (x * x + y * y) * _PER_SCREEN_2
                i = at + np.uintp(lane)
                accepted = (rho <= _ONE) & (w - behind <= planes[i + _FRONT])
                weight = _weight(rho) if accepted else _ZERO
                planes[i + _NEAREST] = min(w if accepted else _INF, planes[i + _NEAREST])
                planes[i + _WEIGHT] += weight
                planes[i + _RED] += weight * red
                planes[i + _GREEN] += weight * green
                planes[i + _BLUE] += weight * blue


@njit(nogil=True, cache=True, error_model="numpy")
def _cover_disc(s, bounds, left, top, lanes, near, planes):
    """Visibility pass of a splat."""
    begin, end, first_row, end_row = _in_tile(bounds, left, top)
    u, v, w = s.u - np.float32(left) - _HALF, s.v - np.float32(top) - _HALF, s.w
    kx, ky, qxx, qxy, qyy = s.kx, s.ky, s.qxx, s.qxy, s.qyy
    for row in range(first_row, end_row):
        y = np.float32(row) - v
        k_row, q_row, linear = _ONE + ky * y, qyy * y * y, _TWO * qxy * y
        for block in range(begin & -lanes, end, lanes):
            at, first = np.uintp(row * TILE + block), np.float32(block) - u
            for lane in range(lanes):
                x = first + np.float32(np.int32(lane))
                inverse = _ONE / (k_row + kx * x)
                depth = w * inverse
                disc = (q_row + linear * x + qxx * x * x) * inverse * inverse
                screen = (x * x + y * y) * _PER_SCREEN_2
                is_disc = (disc < screen) & (depth >= near)
                rho = disc if is_disc else screen
                depth = depth if is_disc else w
                depth = depth if (rho <= _ONE) & (abs(x) <= _MAX) else _INF
                planes[at + np.uintp(lane)] = min(depth, planes[at + np.uintp(lane)])


@njit(nogil=True, cache=True, error_model="numpy")
def _add_disc(s, bounds, left, top, lanes, near, planes):
    """Colour pass of a splat."""
    begin, end, first_row, end_row = _in_tile(bounds, left, top)
    u, v, w, behind = s.u - np.float32(left) - _HALF, s.v - np.float32(top) - _HALF, s.w, s.behind
    kx, ky, qxx, qxy, qyy = s.kx, s.ky, s.qxx, s.qxy, s.qyy
    red, green, blue = s.red, s.green, s.blue
    for row in range(first_row, end_row):
        y = np.float32(row) - v
        k_row, q_row, linear = _ONE + ky * y, qyy * y * y, _TWO * qxy * y
        for block in range(begin & -lanes, end, lanes):
            at, first = np.uintp(row * TILE + block), np.float32(block) - u
            for lane in range(lanes):
                x = first + np.float32(np.int32(lane))
                inverse = _ONE / (k_row + kx * x)
                depth = w * inverse
                disc = (q_row + linear * x + qxx * x * x) * inverse * inverse
                screen = (x * x + y * y) * _PER_SCREEN_2
                is_disc = (disc < screen) & (depth >= near)
                rho = disc if is_disc else screen
                depth = depth if is_disc else w
                i = at + np.uintp(lane)
                accepted = (rho <= _ONE) & (abs(x) <= _MAX) & (depth - behind <= planes[i + _FRONT])
                weight = _weight(rho) if accepted else _ZERO
                planes[i + _NEAREST] = min(depth if accepted else _INF, planes[i + _NEAREST])
                planes[i + _WEIGHT] += weight
                planes[i + _RED] += weight * red
                planes[i + _GREEN] += weight * green
                planes[i + _BLUE] += weight * blue


@njit(nogil=True, cache=True, inline="always")
def _weight(rho):
    """exp(−2 rho) for rho in 0…1."""
    return _W0 + rho * (_W1 + rho * (_W2 + rho * (_W3 + rho * (_W4 + rho * _W5))))


@njit(nogil=True, cache=True, error_model="numpy")
def _cover_quad(quad, bounds, left, top, near, planes):
    """Visibility pass of the rectangle of a flat cell; float64, for its centre may be anywhere."""
    begin, end, first_row, end_row = _in_tile(bounds, left, top)
    for row in range(first_row, end_row):
        y = np.float64(top + row) + 0.5
        z_row, a_row, b_row = quad.z0 + quad.zy * y, quad.a0 + quad.ay * y, quad.b0 + quad.by * y
        for column in range(begin, end):
            x = np.float64(left + column) + 0.5
            z = z_row + quad.zx * x
            depth = np.float32(1.0 / z)
            inside = (abs(a_row + quad.ax * x) <= z) & (abs(b_row + quad.bx * x) <= z)
            i = np.uintp(row * TILE + column)
            if inside & (depth >= near) & (depth < planes[i]):
                planes[i] = depth


@njit(nogil=True, cache=True, error_model="numpy")
def _normalise(planes, empty, left, top, frame):
    """Mean colours and depths of a tile → its words."""
    height, width = frame.shape
    rows, columns = min(TILE, height - top), min(TILE, width - left)
    if empty:
        for row in range(rows):
            for column in range(columns):
                frame[top + row, left + column] = _EMPTY
        return
    depth_bits = planes.view(np.uint32)
    for row in range(rows):
        for column in range(columns):
            i = np.uintp(row * TILE + column)
            weight = planes[i + _WEIGHT]
            scale = _ONE / weight
            red = np.uint32(np.int32(planes[i + _RED] * scale + _HALF))
            green = np.uint32(np.int32(planes[i + _GREEN] * scale + _HALF))
            blue = np.uint32(np.int32(planes[i + _BLUE] * scale + _HALF))
            colour = red | green << np.uint32(8) | blue << np.uint32(16) | _ALPHA
            word = np.uint64(depth_bits[i + _NEAREST]) << np.uint64(32) | np.uint64(colour)
            frame[top + row, left + column] = word if weight > _ZERO else _EMPTY
