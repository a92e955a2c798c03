"""Compiled kernels of the ``cpu`` rasterizer: project points, take the minimum into a framebuffer, merge framebuffers.

Points go through short loops, ``BATCH`` at a time, over small arrays that stay in the first-level cache: decode (of
fixed point only), project, pack words, take minima. All but the last have no branch and no shared state, so the
compiler vectorises them; the last has nothing in it but the load, minimum and store of a word, so that as many cache
misses as the core can have are under way at once. It stores always instead of only where a point is nearer: that
branch is mispredicted so often that skipping the store costs more than it saves (measured: 1.3 to 2 times the frame
time on a closed surface).

A framebuffer notes which runs of ``RUN`` words were drawn to. Only those are merged and emptied, so a frame costs what
its picture covers and not what the image holds.

Every step is one float32 operation in a fixed order (no fast-math), so a point has the same pixel and depth wherever
it stands in an array and whichever thread draws it. In the loops arrays are indexed, not sliced or viewed: numba
counts references to slices and views atomically, in a cache line that all threads share.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from ...shared.messages import FRAMEBUFFER_EMPTY
from .atomic import fetch_add
from .blocks import BITS, FLOAT32, FULL, HIGH, OUTSIDE

BATCH = 1024
"""Points drawn at a time: their 28 KiB of scratch fit the first-level cache; long loops keep more misses under way."""

PREFETCHED = 512
"""Points of the next piece that are asked for while one is drawn: pieces are short and far apart where a scene is drawn
from many cells, and the hardware's own prefetching needs some lines and stops at a page."""

_RUN_BITS = 6
RUN = 1 << _RUN_BITS
"""Framebuffer words that are drawn to, or not, as one: 512 bytes of a row."""

RUN_SHIFT = np.uintp(_RUN_BITS)
_EMPTY = np.uint64(FRAMEBUFFER_EMPTY)
_FLOAT_MAX = np.float32(np.finfo(np.float32).max)
_ROUNDING = 2.0**-20  # of the sum of the terms' sizes: more than what float32 rounds in a row times a position
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_TEN_BITS = np.uint32(1023)
_NAN = np.float32(np.nan)

FILTERED = np.uint32(1 << 30)
"""Bit of a high word: the point is not drawn."""


class Points(NamedTuple):
    """Columns of the point-array; those that no segment is read from are empty.

    x, y, z : (n,) float32.  high, low : (n,) uint32, see ``compact``.  colour : (n,) uint32.
    filtered : whether ``FILTERED`` is set anywhere in ``high``.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    high: np.ndarray
    low: np.ndarray
    colour: np.ndarray
    filtered: bool


class View(NamedTuple):
    """near, width, height, smallest and largest side of a point's square (px) as float32; words of a framebuffer row.

    one_pixel : every square is one pixel.
    """

    near: np.float32
    width: np.float32
    height: np.float32
    smallest: np.float32
    largest: np.float32
    pitch: np.int32
    one_pixel: bool


def pitch_of(width: int) -> int:
    """Words from one framebuffer row to the next: whole runs, and an odd number of them.

    Rows a multiple of 4 KiB apart would share sets of the first-level cache and look alike to the store buffer
    (measured at 1024 columns: 1.2 to 1.5 times the time of drawing).
    """
    return (-(-width // RUN) | 1) * RUN


def _prefetch_intrinsic(_context: Any, column: Any, index: Any) -> Any:
    """Ask for the cache line of ``column[index]``, which may lie beyond the end."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = cgutils.create_struct_proxy(signature.args[0])(context, builder, arguments[0])
        pointer = builder.bitcast(builder.gep(array.data, [arguments[1]]), cgutils.voidptr_t)
        kind = ir.IntType(32)
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, kind, kind, kind]), "llvm.prefetch.p0i8"
        )
        builder.call(function, [pointer, kind(0), kind(3), kind(1)])
        return context.get_dummy_value()

    return types.void(column, types.int64), codegen


_prefetch: Any = intrinsic(_prefetch_intrinsic)


@njit(nogil=True, cache=True)
def draw(points, blocks, pieces, frustum, view, words, dirty, turn, counter):
    """Draw pieces into one framebuffer until none is left.

    points : Points.  blocks : Blocks.  pieces : (p,) PIECE, segments being blocks.  frustum : Frustum.  view : View.
    words : (height · pitch + 1,) uint64. The last word is 0: points outside the image go there, and never win.
    dirty : (height · pitch / RUN + 1,) uint8, set to 1 for runs that are drawn to.
    turn : pieces taken at a time.  counter : (1,) int64, shared by the threads of a frame, 0 at its start.
    """
    place, depth, packed = np.empty(3 * BATCH, np.int32), np.empty(BATCH, np.float32), np.empty(BATCH, np.uint64)
    x, y, z = np.empty(BATCH, np.float32), np.empty(BATCH, np.float32), np.empty(BATCH, np.float32)
    high, low = np.empty(BATCH, np.uint32), np.empty(BATCH, np.uint32)
    colour = np.empty(BATCH, np.uint32)
    rows = np.empty((3, 4), np.float32)
    begin = fetch_add(counter, turn)
    while begin < len(pieces):
        for k in range(begin, min(begin + turn, len(pieces))):
            s, stride = np.uintp(pieces[k].segment), np.int64(pieces[k].stride)
            precision = block_rows(blocks, s, frustum, rows)
            if precision == OUTSIDE:
                continue
            side_at_one = np.float32(blocks.world_side[s] * frustum.focal_px)
            if k + 1 < len(pieces):
                _prefetch_points(points, pieces[k + 1].first, min(pieces[k + 1].count, PREFETCHED))
            for done in range(0, pieces[k].count, BATCH):
                n = min(BATCH, pieces[k].count - done)
                first = pieces[k].first + done * stride
                if stride == 1 and precision == FLOAT32:
                    _project(points.x, points.y, points.z, first, n, rows, side_at_one, view, len(words), place, depth)
                elif stride == 1:
                    _decode(points.high, points.low, first, n, precision, points.filtered, x, y, z)
                    _project(x, y, z, 0, n, rows, side_at_one, view, len(words), place, depth)
                else:  # gathered first, so that every stride goes through the same loops
                    for i in range(n):
                        j = first + i * stride
                        colour[i] = points.colour[j]
                        if precision == FLOAT32:
                            x[i], y[i], z[i] = points.x[j], points.y[j], points.z[j]
                        else:
                            high[i] = points.high[j]
                            low[i] = points.low[j] if precision == FULL else np.uint32(0)
                    if precision != FLOAT32:
                        _decode(high, low, 0, n, precision, points.filtered, x, y, z)
                    _project(x, y, z, 0, n, rows, side_at_one, view, len(words), place, depth)
                if stride == 1:
                    _pack(depth, points.colour, first, n, packed)
                else:
                    _pack(depth, colour, 0, n, packed)
                if view.one_pixel:
                    _take_pixels(place, packed, n, words, dirty)
                else:
                    _take_squares(place, packed, n, view, words, dirty)
        begin = fetch_add(counter, turn)


@njit(nogil=True, cache=True, error_model="numpy")
def block_rows(blocks, s, frustum, out):
    """Fill ``out`` (3, 4) float32: rows X, Y, W over the positions of block ``s``; return how those are read.

    The eye is subtracted first, so a scene far from the world's origin loses nothing. It costs about 0.1 µs, so each
    thread does it for the pieces it draws, and no pass over the blocks stands before a frame.
    Readable twins, the same steps in the same order: ``pixel_from_blocks`` and ``reference.compact_rows``.
    """
    m = frustum.rows
    x, y, z = (
        blocks.origin[s, 0] - frustum.eye[0],
        blocks.origin[s, 1] - frustum.eye[1],
        blocks.origin[s, 2] - frustum.eye[2],
    )
    if len(blocks.step) == 0:
        for i in range(3):
            out[i, 0], out[i, 1], out[i, 2] = m[i, 0], m[i, 1], m[i, 2]
            out[i, 3] = x * m[i, 0] + y * m[i, 1] + z * m[i, 2]
        return FLOAT32

    x, y, z = x + blocks.lower[s, 0], y + blocks.lower[s, 1], z + blocks.lower[s, 2]
    a, b, c = blocks.step[s, 0], blocks.step[s, 1], blocks.step[s, 2]
    nearest, precision = _nearest(x, y, z, a, b, c, frustum), HIGH
    if nearest < 0:
        return OUTSIDE
    for i in range(2):
        p = frustum.px_at_one[i]
        if not 2.0 ** (BITS // 2 - 1) * (p[0] * a + p[1] * b + p[2] * c) <= frustum.high_bits_error_px * nearest:
            precision = FULL
    if precision == HIGH:
        a, b, c = a * 2.0 ** (BITS // 2), b * 2.0 ** (BITS // 2), c * 2.0 ** (BITS // 2)
    x, y, z = x + 0.5 * a, y + 0.5 * b, z + 0.5 * c
    for i in range(3):
        out[i, 0], out[i, 1], out[i, 2] = m[i, 0] * a, m[i, 1] * b, m[i, 2] * c
        out[i, 3] = x * m[i, 0] + y * m[i, 1] + z * m[i, 2]
    return precision


@njit(nogil=True, cache=True, error_model="numpy")
def _nearest(x, y, z, a, b, c, frustum):
    """Depth of the nearest point that a box can have in the image; −1 if it can have none there, rounding considered.

    x, y, z : lower corner relative to the eye.  a, b, c : size of a bin.
    """
    a, b, c = a * 2.0 ** (BITS - 1), b * 2.0 ** (BITS - 1), c * 2.0 ** (BITS - 1)
    x, y, z = x + a, y + b, z + c  # middle of the box, and half its size
    nearest = 0.0
    for i in range(5):
        p = frustum.planes[i]
        middle = p[0] * x + p[1] * y + p[2] * z
        reach = abs(p[0]) * a + abs(p[1]) * b + abs(p[2]) * c
        slack = _ROUNDING * (abs(p[0] * x) + abs(p[1] * y) + abs(p[2] * z) + reach)
        if middle + reach + slack < (frustum.near if i == 0 else 0.0):
            return -1.0
        if i == 0:
            nearest = max(middle - reach - slack, frustum.near)
    return nearest


@njit(nogil=True, cache=True)
def _prefetch_points(points, first, count):
    """Ask for ``count`` points from ``first`` on, 16 a cache line."""
    for j in range(first, first + count, 16):
        if len(points.high):
            _prefetch(points.high, j)
        else:
            _prefetch(points.x, j)
            _prefetch(points.y, j)
            _prefetch(points.z, j)
        _prefetch(points.colour, j)


@njit(nogil=True, cache=True)
def _decode(high, low, first, n, precision, filtered, x, y, z):
    """Bins of ``n`` points from ``first`` on, as float32: exact, at most 20 bits."""
    if precision == HIGH:
        for i in range(n):
            h = high[np.uintp(first) + np.uintp(i)]
            x[i] = np.float32(np.int32(h & _TEN_BITS))
            y[i] = np.float32(np.int32((h >> np.uint32(10)) & _TEN_BITS))
            z[i] = np.float32(np.int32((h >> np.uint32(20)) & _TEN_BITS))
    else:
        for i in range(n):
            h, w = high[np.uintp(first) + np.uintp(i)], low[np.uintp(first) + np.uintp(i)]
            x[i] = np.float32(np.int32((h & _TEN_BITS) << np.uint32(10) | (w & _TEN_BITS)))
            h, w = h >> np.uint32(10), w >> np.uint32(10)
            y[i] = np.float32(np.int32((h & _TEN_BITS) << np.uint32(10) | (w & _TEN_BITS)))
            h, w = h >> np.uint32(10), w >> np.uint32(10)
            z[i] = np.float32(np.int32((h & _TEN_BITS) << np.uint32(10) | (w & _TEN_BITS)))
    if filtered:
        for i in range(n):
            if high[np.uintp(first) + np.uintp(i)] >= FILTERED:
                x[i] = _NAN


@njit(nogil=True, cache=True)
def _project(x, y, z, first, n, rows, side_at_one, view, n_words, place, depth):
    """Places and depths of ``n`` ≤ BATCH points from ``first`` on."""
    if view.one_pixel:
        _project_pixels(x, y, z, first, n, rows, view, np.int32(n_words - 1), place, depth)
    else:
        _project_squares(x, y, z, first, n, rows, side_at_one, view, place, depth)


@njit(nogil=True, cache=True, error_model="numpy")
def _image_position(rows, x, y, z):
    """Image position and depth of one point: (u, v) in pixels, w."""
    w = rows[2, 0] * x + rows[2, 1] * y + rows[2, 2] * z + rows[2, 3]
    u = (rows[0, 0] * x + rows[0, 1] * y + rows[0, 2] * z + rows[0, 3]) / w
    v = (rows[1, 0] * x + rows[1, 1] * y + rows[1, 2] * z + rows[1, 3]) / w
    return u, v, w


@njit(nogil=True, cache=True, error_model="numpy")
def _project_pixels(x, y, z, first, n, rows, view, outside, place, depth):
    """``place``: index of the word of each point's pixel; ``outside`` for a point that has none."""
    near, width, height, pitch = view.near, view.width, view.height, view.pitch
    for i in range(n):
        j = np.uintp(first) + np.uintp(i)
        u, v, w = _image_position(rows, x[j], y[j], z[j])
        inside = (w >= near) & (w <= _FLOAT_MAX) & (u >= _ZERO) & (u < width) & (v >= _ZERO) & (v < height)
        # a NaN or a value beyond int32 must not reach the conversions
        column, row = np.int32(u if inside else _ZERO), np.int32(v if inside else _ZERO)
        place[i] = row * pitch + column if inside else outside
        depth[i] = w


@njit(nogil=True, cache=True, error_model="numpy")
def _project_squares(x, y, z, first, n, rows, side_at_one, view, place, depth):
    """``place``: first columns, then first rows, then sides (0 for a point outside the image)."""
    near, width, height, smallest, largest = view.near, view.width, view.height, view.smallest, view.largest
    for i in range(n):
        j = np.uintp(first) + np.uintp(i)
        u, v, w = _image_position(rows, x[j], y[j], z[j])
        side = side_at_one / w
        side = side if side > smallest else smallest  # also for NaN
        side = side if side < largest else largest
        whole_side = np.int32(side + _HALF)
        side = np.float32(whole_side)
        u -= _HALF * (side - _ONE)
        v -= _HALF * (side - _ONE)
        inside = (w >= near) & (w <= _FLOAT_MAX)
        inside &= (u >= _ONE - side) & (u < width) & (v >= _ONE - side) & (v < height)
        place[i] = _floor(u if inside else _ZERO)
        place[BATCH + i] = _floor(v if inside else _ZERO)
        place[2 * BATCH + i] = whole_side if inside else np.int32(0)
        depth[i] = w


@njit(nogil=True, cache=True)
def _floor(x):
    """Floor of a float32 within int32, as int32: ``np.floor`` calls a library function and is not vectorised."""
    whole = np.int32(x)
    return np.int32(whole - (np.float32(whole) > x))


@njit(nogil=True, cache=True)
def _pack(depth, colour, first, n, packed):
    """Framebuffer words of ``n`` depths and of the colours from ``first`` on."""
    bits = depth.view(np.uint32)
    for i in range(n):
        packed[i] = np.uint64(bits[i]) << np.uint64(32) | np.uint64(colour[np.uintp(first) + np.uintp(i)])


@njit(nogil=True, cache=True)
def _take_pixels(place, packed, n, words, dirty):
    for i in range(n):
        p = np.uintp(place[i])
        words[p] = min(words[p], packed[i])
        dirty[p >> RUN_SHIFT] = 1


@njit(nogil=True, cache=True)
def _take_squares(place, packed, n, view, words, dirty):
    width, height, pitch = np.int64(view.width), np.int64(view.height), np.int64(view.pitch)
    for i in range(n):
        word, side = packed[i], np.int64(place[2 * BATCH + i])
        left, top = np.int64(place[i]), np.int64(place[BATCH + i])
        whole = (left >= 0) & (top >= 0) & (left + side <= width) & (top + side <= height)
        first = top * pitch + left
        # loops of a known length are unrolled: two thirds of the time of the general one
        if whole & (side == 2):
            _take_square(first, 2, pitch, word, words, dirty)
        elif whole & (side == 3):
            _take_square(first, 3, pitch, word, words, dirty)
        elif whole & (side == 1):
            _take_square(first, 1, pitch, word, words, dirty)
        elif whole & (side == 4):
            _take_square(first, 4, pitch, word, words, dirty)
        elif whole & (side == 5):
            _take_square(first, 5, pitch, word, words, dirty)
        else:
            rows, columns = (max(top, 0), min(top + side, height)), (max(left, 0), min(left + side, width))
            _take_rectangle(rows, columns, pitch, word, words)
            _mark_rectangle(rows, columns, pitch, dirty)


@njit(nogil=True, cache=True)
def _take_rectangle(rows, columns, pitch, word, words):
    for row in range(rows[0], rows[1]):
        for column in range(columns[0], columns[1]):
            p = np.uintp(row * pitch + column)
            words[p] = min(words[p], word)


@njit(nogil=True, cache=True)
def _mark_rectangle(rows, columns, pitch, dirty):
    first, last = columns[0] >> _RUN_BITS, (columns[1] - 1) >> _RUN_BITS
    for row in range(rows[0], rows[1]):
        run = row * (pitch >> _RUN_BITS)
        dirty[np.uintp(run + first)] = 1
        for column in range(first + 1, last + 1):
            dirty[np.uintp(run + column)] = 1


@njit(nogil=True, cache=True)
def _take_square(first, side, pitch, word, words, dirty):
    """A whole square, at most ``RUN`` words wide."""
    for row in range(side):
        for column in range(side):
            p = np.uintp(first + row * pitch + column)
            words[p] = min(words[p], word)
        dirty[np.uintp(first + row * pitch) >> RUN_SHIFT] = 1
        dirty[np.uintp(first + row * pitch + side - 1) >> RUN_SHIFT] = 1


@njit(nogil=True, cache=True)
def merge(framebuffers, dirty, frame, filled, counter):
    """Minimum over framebuffers, which are left empty and clean for the next frame, until no row of the frame is left.

    framebuffers : (t, height · pitch + 1) uint64.  dirty : (t, height · pitch / RUN + 1) uint8, as ``draw`` left it.
    frame : (height, width) uint64.  filled : (height · pitch / RUN,) uint8, runs of the frame that are not empty; both
    as the last frame left them.  counter : as in ``draw``.
    """
    height, width = frame.shape
    pitch = (framebuffers.shape[1] - 1) // height
    row = fetch_add(counter, 1)
    while row < height:
        for begin in range(0, width, RUN):
            end = min(begin + RUN, width)
            run, shift = (row * pitch + begin) // RUN, row * pitch
            drawn = False
            for t in range(len(framebuffers)):
                if dirty[t, run]:
                    dirty[t, run] = 0
                    for c in range(begin, end):
                        word = framebuffers[t, shift + c]
                        framebuffers[t, shift + c] = _EMPTY
                        frame[row, c] = min(frame[row, c], word) if drawn else word
                    drawn = True
            if filled[run] and not drawn:
                for c in range(begin, end):
                    frame[row, c] = _EMPTY
            filled[run] = drawn
        row = fetch_add(counter, 1)
