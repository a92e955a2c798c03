"""Drawn from transformation-stream pools: vertices and translations go through the matrix, their sums are the points.

A cell's points are vertex + translation wherever a bit of the vertex's tag is set. The matrix of the cell takes its
vertices to the image, its linear part takes its translations there, once each; a point then costs three additions in
place of the matrix product and of the bytes it would be read from. Nothing is expanded in memory but ``kernels.BATCH``
points at a time in the first-level cache (``tags``). A point's colour is a byte into the palette of its cell, and bytes
stand in the order in which the tags name the points, so that they are read from front to back.

Rounding: a sum of transformed parts is rounded where they lie, and not where the point does. In a cell that is no
nearer than it is large, points fall within ``ROUNDING`` of the image's longer side (a thousandth of a pixel at 1000) of
where float64 has them, about as near as transformed points do; one that close to the edge of a pixel may take the next.
Frames are word by word those of ``pools_reference``, the readable twin.

Source: Kim, Lee, Varshney, "Vertex Transformation Streams", section 3 and figure 5: the tensor product, and its test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from ...shared.codecs.pools import TAG_BITS
from ...shared.codecs.streams import MOST_TRANSLATIONS, PooledPoints
from . import PointSize
from .atomic import fetch_add
from .blocks import BITS
from .kernels import BATCH, RUN_SHIFT, _nearest, _pack, _project, _take_squares
from .tags import SLACK, expand_tag

ROUNDING = 2.0**-20
"""Of the image's longer side, by which a point may lie beside its place."""

_MOST_BINS = 256
"""Of a cell's grid, along an axis."""

_WALKS = 4
_UNIT_ROWS = np.eye(3, 4, dtype=np.float32)
_FLOAT_MAX = np.float32(np.finfo(np.float32).max)
_ZERO = np.float32(0)


class PoolCells(NamedTuple):
    """Cells in the form they are drawn from; their arrays stand one after the other.

    origin : (c, 3) float64, world frame, lower corner of each cell's cube.  step : (c,) float64, size of a bin, world
    units; a point is the middle of its bin.  world_side : (c,) float64, side of a point's square, world units.
    palette : (c, 256) uint32 colour words.  colour : (n,) uint8, of each cell in coded order.
    first_pool, first_loose, first_point : (c + 1,) int64, of each cell's pools, of its points among ``loose`` and in
    ``colour``.
    first_vertex, first_translation, first_word : (p + 1,) int64 of each pool, the last one in ``tags``.
    vertices : (v, 3) uint8.  translations : (t, 3) int8.  tags : (w,) uint32, ⌈m / 32⌉ words a vertex.
    loose : (3, l) uint8.
    """

    origin: np.ndarray
    step: np.ndarray
    world_side: np.ndarray
    palette: np.ndarray
    colour: np.ndarray
    first_pool: np.ndarray
    first_loose: np.ndarray
    first_point: np.ndarray
    first_vertex: np.ndarray
    first_translation: np.ndarray
    first_word: np.ndarray
    vertices: np.ndarray
    translations: np.ndarray
    tags: np.ndarray
    loose: np.ndarray


@dataclass(frozen=True)
class PoolCell:
    """A cell: its points; where its cube lies and how large a bin is; its colours as of ``codecs.palette``.

    origin : (3,) float64, world frame.  step, world_side : world units.  palette : (k ≤ 256,) uint32.
    colour : (n,) uint8 in coded order.
    """

    points: PooledPoints
    origin: np.ndarray
    step: float
    palette: np.ndarray
    colour: np.ndarray
    world_side: float = 0.0


def pool_cells(cells: Sequence[PoolCell]) -> PoolCells:
    """Cells put together. Cost: a copy of their arrays."""
    held = [cell.points for cell in cells]
    pools = [pool for points in held for pool in points.pools]

    def first(counts: list[int]) -> np.ndarray:
        return np.cumsum([0, *counts], dtype=np.int64)

    def joined(arrays: list[np.ndarray], dtype: type, *shape: int) -> np.ndarray:
        return np.concatenate([np.empty((0, *shape), dtype), *arrays])

    return PoolCells(
        np.array([cell.origin for cell in cells], np.float64).reshape(-1, 3),
        np.array([cell.step for cell in cells], np.float64),
        np.array([cell.world_side for cell in cells], np.float64),
        np.array([np.resize(cell.palette, 256) for cell in cells], np.uint32).reshape(-1, 256),
        joined([cell.colour for cell in cells], np.uint8),
        first([len(points.pools) for points in held]),
        first([len(points.loose) for points in held]),
        first([len(points) for points in held]),
        first([len(pool.vertices) for pool in pools]),
        first([len(pool.translations) for pool in pools]),
        first([pool.tags.size for pool in pools]),
        joined([pool.vertices for pool in pools], np.uint8, 3),
        joined([pool.translations for pool in pools], np.int8, 3),
        joined([pool.tags.ravel() for pool in pools], np.uint32),
        np.ascontiguousarray(joined([points.loose for points in held], np.uint8, 3).T),
    )


def sized(pools: PoolCells, size: PointSize) -> PoolCells:
    """The cells with the sides of their points' squares; they come with the spacing of their points, or 0."""
    side = np.maximum(pools.world_side, size.world) if size.adaptive else np.full(len(pools.step), float(size.world))
    return pools._replace(world_side=side)


class _Batch(NamedTuple):
    """Points on their way to the framebuffer: image position times depth, depth; then as of ``kernels``.

    dx, dy, dw : (256 + 32,) float32, the translations of a pool in the image, and some that no bit names.
    """

    x: np.ndarray
    y: np.ndarray
    w: np.ndarray
    place: np.ndarray
    depth: np.ndarray
    colour: np.ndarray
    packed: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    dw: np.ndarray


@njit(nogil=True, cache=True)
def draw_pools(pools, cells, frustum, view, words, dirty, turn, counter):
    """Draw cells into one framebuffer until none is left.

    pools : PoolCells.  cells : (k,) int64, those to draw.  The rest as of ``kernels.draw``.
    """
    n, m = BATCH + SLACK, MOST_TRANSLATIONS + TAG_BITS
    batch = _Batch(
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(3 * BATCH, np.int32),
        np.empty(BATCH, np.float32),
        np.empty(BATCH, np.uint32),
        np.empty(BATCH, np.uint64),
        np.zeros(m, np.float32),
        np.zeros(m, np.float32),
        np.zeros(m, np.float32),
    )
    rows, palette = np.empty((3, 4), np.float32), np.empty(256, np.uint32)
    begin = fetch_add(counter, turn)
    while begin < len(cells):
        for k in range(begin, min(begin + turn, len(cells))):
            c = cells[k]
            if _may_be_seen(pools.origin, pools.step, c, frustum):
                _cell_rows(pools.origin, pools.step, c, frustum, rows)
                palette[:] = pools.palette[c]
                side_at_one = np.float32(pools.world_side[c] * frustum.focal_px)
                _draw_cell(pools, c, rows, palette, side_at_one, view, words, dirty, batch)
        begin = fetch_add(counter, turn)


@njit(nogil=True, cache=True, error_model="numpy")
def _may_be_seen(origin, step, c, frustum):
    """Whether the largest grid that cell ``c`` can have reaches into the image."""
    eye, size = frustum.eye, step[c] * (_MOST_BINS / 2.0**BITS)
    x, y, z = origin[c, 0] - eye[0], origin[c, 1] - eye[1], origin[c, 2] - eye[2]
    return _nearest(x, y, z, size, size, size, frustum) >= 0


@njit(nogil=True, cache=True)
def _cell_rows(origin, step, c, frustum, out):
    """Fill ``out`` (3, 4) float32: rows X, Y, W over grid points of cell ``c``; the eye is subtracted first."""
    m, size = frustum.rows, step[c]
    x = origin[c, 0] - frustum.eye[0] + 0.5 * size
    y = origin[c, 1] - frustum.eye[1] + 0.5 * size
    z = origin[c, 2] - frustum.eye[2] + 0.5 * size
    for i in range(3):
        out[i, 0], out[i, 1], out[i, 2] = m[i, 0] * size, m[i, 1] * size, m[i, 2] * size
        out[i, 3] = x * m[i, 0] + y * m[i, 1] + z * m[i, 2]


@njit(nogil=True, cache=True)
def _draw_cell(pools, c, rows, palette, side_at_one, view, words, dirty, batch):
    """Draw the points of a cell in coded order: those of its pools, then those left over."""
    vertices, translations, loose, tags = pools.vertices, pools.translations, pools.loose, pools.tags
    xs, ys, ws, dx, dy, dw = batch.x, batch.y, batch.w, batch.dx, batch.dy, batch.dw
    n, drawn = 0, pools.first_point[c]
    for p in range(pools.first_pool[c], pools.first_pool[c + 1]):
        first, word = pools.first_translation[p], pools.first_word[p]
        m = pools.first_translation[p + 1] - first
        for t in range(m):
            j = first + t
            dx[t], dy[t], dw[t] = _linear(rows, translations[j, 0], translations[j, 1], translations[j, 2])
        for v in range(pools.first_vertex[p], pools.first_vertex[p + 1]):
            if n + m > BATCH:
                _take(pools.colour, palette, drawn, n, side_at_one, view, words, dirty, batch)
                n, drawn = 0, drawn + n
            x, y, w = _linear(rows, vertices[v, 0], vertices[v, 1], vertices[v, 2])
            x, y, w = x + rows[0, 3], y + rows[1, 3], w + rows[2, 3]
            for base in range(0, m, TAG_BITS):
                n = expand_tag(tags[word], x, y, w, dx, dy, dw, base, xs, ys, ws, n)
                word += 1
    begin = pools.first_loose[c]
    while begin < pools.first_loose[c + 1]:
        if n == BATCH:
            _take(pools.colour, palette, drawn, n, side_at_one, view, words, dirty, batch)
            n, drawn = 0, drawn + n
        count = min(BATCH - n, pools.first_loose[c + 1] - begin)
        for i in range(count):
            j, k = np.uintp(begin) + np.uintp(i), np.uintp(n) + np.uintp(i)
            x, y, w = _linear(rows, loose[0, j], loose[1, j], loose[2, j])
            xs[k], ys[k], ws[k] = x + rows[0, 3], y + rows[1, 3], w + rows[2, 3]
        n, begin = n + count, begin + count
    _take(pools.colour, palette, drawn, n, side_at_one, view, words, dirty, batch)


@njit(nogil=True, cache=True)
def _linear(rows, x, y, z):
    """(x, y, z) times the matrix without its last column."""
    x, y, z = np.float32(x), np.float32(y), np.float32(z)
    return (
        rows[0, 0] * x + rows[0, 1] * y + rows[0, 2] * z,
        rows[1, 0] * x + rows[1, 1] * y + rows[1, 2] * z,
        rows[2, 0] * x + rows[2, 1] * y + rows[2, 2] * z,
    )


@njit(nogil=True, cache=True)
def _take(index, palette, first, n, side_at_one, view, words, dirty, batch):
    """Take the ``n`` points of the batch, whose colours begin at ``first``."""
    if view.one_pixel:
        _place(batch.x, batch.y, batch.w, n, view, np.int32(len(words) - 1), batch.place)
        _take_pixels(batch.place, batch.w, index, palette, first, n, words, dirty)
        return
    _project(batch.x, batch.y, batch.w, 0, n, _UNIT_ROWS, side_at_one, view, len(words), batch.place, batch.depth)
    for i in range(n):
        batch.colour[i] = palette[index[np.uintp(first) + np.uintp(i)]]
    _pack(batch.depth, batch.colour, 0, n, batch.packed)
    _take_squares(batch.place, batch.packed, n, view, words, dirty)


@njit(nogil=True, cache=True, error_model="numpy")
def _place(x, y, w, n, view, outside, place):
    """``kernels._project_pixels`` without the product with unit rows."""
    near, width, height, pitch = view.near, view.width, view.height, view.pitch
    for i in range(n):
        u, v, depth = x[i] / w[i], y[i] / w[i], w[i]
        inside = (depth >= near) & (depth <= _FLOAT_MAX)
        inside &= (u >= _ZERO) & (u < width) & (v >= _ZERO) & (v < height)
        # a NaN or a value beyond int32 must not reach the conversions
        column, row = np.int32(u if inside else _ZERO), np.int32(v if inside else _ZERO)
        place[i] = row * pitch + column if inside else outside


@njit(nogil=True, cache=True)
def _take_pixels(place, w, index, palette, first, n, words, dirty):
    """As of ``kernels``; each word is put together where it is taken (measured: 0.9 times the time of drawing).

    The batch is walked in ``_WALKS`` places at a time. Points of one vertex often share a pixel, and one by one each
    would wait for the word that the one before has stored (measured with cells of 20 px: 1.2 times the time).
    """
    depth, part = w.view(np.uint32), n // _WALKS
    for i in range(part):
        for walk in range(_WALKS):
            k = np.uintp(i) + np.uintp(walk * part)
            _take_pixel(place, depth, index, palette, np.uintp(first) + k, k, words, dirty)
    for i in range(_WALKS * part, n):
        k = np.uintp(i)
        _take_pixel(place, depth, index, palette, np.uintp(first) + k, k, words, dirty)


@njit(nogil=True, cache=True)
def _take_pixel(place, depth, index, palette, of_colour, i, words, dirty):
    p = np.uintp(place[i])
    word = np.uint64(depth[i]) << np.uint64(32) | np.uint64(palette[index[of_colour]])
    words[p] = min(words[p], word)
    dirty[p >> RUN_SHIFT] = 1
