"""Compiled kernels of the ``cpu`` rasterizer: project points, take the minimum into a framebuffer, merge framebuffers.

Points go through two loops, ``BATCH`` at a time. The first projects into small arrays that stay in the first-level
cache; it has no branch and no shared state, so the compiler vectorises it. The second takes the minimum into the
framebuffer, and stores it always instead of only where a point is nearer: that branch is mispredicted so often that
skipping the store costs more than it saves (measured: 1.3 to 2 times the frame time on a closed surface).

Every step is one float32 operation in a fixed order (no fast-math), so a point has the same pixel and depth wherever
it stands in an array and whichever thread draws it. In the loops arrays are indexed, not sliced or viewed: numba
counts references to slices and views atomically, in a cache line that all threads share.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from ...shared.messages import FRAMEBUFFER_EMPTY

BATCH = 256
"""Points projected at a time: few enough for the first-level cache, enough to amortise the calls."""

MERGE_RUN = 4096
"""Framebuffer words a thread merges at a time: 32 KiB."""

_EMPTY = np.uint64(FRAMEBUFFER_EMPTY)
_FLOAT_MAX = np.float32(np.finfo(np.float32).max)
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)


def _fetch_add_intrinsic(_context: Any, counter: Any, amount: Any) -> Any:
    """Atomically add ``amount`` to ``counter[0]`` ((1,) int64) and return what it was."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = cgutils.create_struct_proxy(signature.args[0])(context, builder, arguments[0])
        return builder.atomic_rmw("add", array.data, arguments[1], "monotonic")

    return types.int64(counter, types.int64), codegen


_fetch_add: Any = intrinsic(_fetch_add_intrinsic)


@njit(nogil=True, cache=True)
def draw(x, y, z, colour, pieces, rows, view, size, words, turn, counter):
    """Draw pieces into one framebuffer until none is left.

    x, y, z : (n,) float32.  colour : (n,) uint32.
    pieces : (p,) PIECE.  rows : (s, 3, 4) float32, pixel from block, by segment.
    view : near, width, height as float32.
    size : smallest side, side at depth 1, largest side of a point's square as float32, px.
    words : (width · height + 1,) uint64. The last word is 0: points outside the image go there, and never win.
    turn : pieces taken at a time.  counter : (1,) int64, shared by the threads of a frame, 0 at its start.
    """
    one_pixel = size[0] == _ONE and size[1] == _ZERO
    place, depth = np.empty(3 * BATCH, np.int32), np.empty(BATCH, np.float32)
    gx, gy, gz = np.empty(BATCH, np.float32), np.empty(BATCH, np.float32), np.empty(BATCH, np.float32)
    gcolour = np.empty(BATCH, np.uint32)
    begin = _fetch_add(counter, turn)
    while begin < len(pieces):
        for k in range(begin, min(begin + turn, len(pieces))):
            s, stride = np.uintp(pieces[k].segment), np.int64(pieces[k].stride)
            for done in range(0, pieces[k].count, BATCH):
                n = min(BATCH, pieces[k].count - done)
                first = pieces[k].first + done * stride
                if stride == 1:
                    if one_pixel:
                        _draw_pixels(x, y, z, colour, first, n, rows, s, view, words, place, depth)
                    else:
                        _draw_squares(x, y, z, colour, first, n, rows, s, view, size, words, place, depth)
                else:  # gathered first, so that every stride is projected by the same loop
                    for i in range(n):
                        j = first + i * stride
                        gx[i], gy[i], gz[i], gcolour[i] = x[j], y[j], z[j], colour[j]
                    if one_pixel:
                        _draw_pixels(gx, gy, gz, gcolour, 0, n, rows, s, view, words, place, depth)
                    else:
                        _draw_squares(gx, gy, gz, gcolour, 0, n, rows, s, view, size, words, place, depth)
        begin = _fetch_add(counter, turn)


@njit(nogil=True, cache=True, error_model="numpy")
def _project(rows, s, x, y, z):
    """Image position and depth of one point: (u, v) in pixels, w."""
    w = rows[s, 2, 0] * x + rows[s, 2, 1] * y + rows[s, 2, 2] * z + rows[s, 2, 3]
    u = (rows[s, 0, 0] * x + rows[s, 0, 1] * y + rows[s, 0, 2] * z + rows[s, 0, 3]) / w
    v = (rows[s, 1, 0] * x + rows[s, 1, 1] * y + rows[s, 1, 2] * z + rows[s, 1, 3]) / w
    return u, v, w


@njit(nogil=True, cache=True, error_model="numpy")
def _draw_pixels(x, y, z, colour, first, n, rows, s, view, words, place, depth):
    """Draw ``n`` ≤ BATCH points from ``first`` on as one pixel each; ``place`` and ``depth`` are scratch."""
    near, width, height = view
    outside = np.int32(len(words) - 1)
    for i in range(n):
        j = np.uintp(first) + np.uintp(i)
        u, v, w = _project(rows, s, x[j], y[j], z[j])
        inside = (w >= near) & (w <= _FLOAT_MAX) & (u >= _ZERO) & (u < width) & (v >= _ZERO) & (v < height)
        # a NaN or a value beyond int32 must not reach the conversions
        column, row = np.int32(u if inside else _ZERO), np.int32(v if inside else _ZERO)
        place[i] = row * np.int32(width) + column if inside else outside
        depth[i] = w
    depth_bits = depth.view(np.uint32)
    for i in range(n):
        p = np.uintp(place[i])
        words[p] = min(words[p], _word(depth_bits[i], colour[np.uintp(first) + np.uintp(i)]))


@njit(nogil=True, cache=True, error_model="numpy")
def _draw_squares(x, y, z, colour, first, n, rows, s, view, size, words, place, depth):
    """Draw ``n`` ≤ BATCH points from ``first`` on as squares; ``place`` and ``depth`` are scratch.

    ``place`` holds first columns, then first rows, then sides (0 for a point outside the image).
    """
    near, width, height = view
    smallest, side_at_one, largest = size
    for i in range(n):
        j = np.uintp(first) + np.uintp(i)
        u, v, w = _project(rows, s, x[j], y[j], z[j])
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
    depth_bits = depth.view(np.uint32)
    stride = np.int64(width)
    for i in range(n):
        word = _word(depth_bits[i], colour[np.uintp(first) + np.uintp(i)])
        side = place[2 * BATCH + i]
        for row in range(max(place[BATCH + i], 0), min(place[BATCH + i] + side, np.int64(height))):
            for column in range(max(place[i], 0), min(place[i] + side, stride)):
                p = np.uintp(row * stride + column)
                words[p] = min(words[p], word)


@njit(nogil=True, cache=True)
def _floor(x):
    """Floor of a float32 within int32, as int32: ``np.floor`` calls a library function and is not vectorised."""
    whole = np.int32(x)
    return np.int32(whole - (np.float32(whole) > x))


@njit(nogil=True, cache=True)
def _word(depth_bits, colour):
    """Framebuffer word of two uint32."""
    return np.uint64(depth_bits) << np.uint64(32) | np.uint64(colour)


@njit(nogil=True, cache=True)
def merge(framebuffers, out, counter):
    """Minimum over framebuffers, which are left empty for the next frame, until no run of words is left.

    framebuffers : (t, n + 1) uint64.  out : (n,) uint64.  counter : as in ``draw``.
    """
    begin = _fetch_add(counter, MERGE_RUN)
    while begin < len(out):
        end = min(begin + MERGE_RUN, len(out))
        for i in range(begin, end):
            out[i] = framebuffers[0, i]
            framebuffers[0, i] = _EMPTY
        for t in range(1, len(framebuffers)):
            for i in range(begin, end):
                out[i] = min(out[i], framebuffers[t, i])
                framebuffers[t, i] = _EMPTY
        begin = _fetch_add(counter, MERGE_RUN)
