"""Drawn from transformation-stream pools: vertices and translations go through the matrix, their sums are the points.

A cell's points are vertex + translation wherever a bit of the vertex's tag is set. The matrix of the cell takes its
vertices to the image, its linear part takes its translations there, once each; a point then costs three additions in
place of the matrix product and of the bytes it would be read from. Nothing is expanded in memory but ``kernels.BATCH``
points at a time in the first-level cache. A point's colour is a byte into the palette of its cell, and bytes stand in
the order in which the tags name the points, so that they are read from front to back.

Rounding: a sum of transformed parts is rounded where they lie, and not where the point does. In a cell that is no
nearer than it is large, points fall within ``ROUNDING`` of the image's longer side (a thousandth of a pixel at 1000) of
where float64 has them, about as near as transformed points do; one that close to the edge of a pixel may take the next.
Frames are word by word those of ``pools_reference``, the readable twin.

Source: Kim, Lee, Varshney, "Vertex Transformation Streams", section 3 and figure 5: the tensor product, and its test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from ...shared.codecs.pools import TAG_BITS
from ...shared.codecs.streams import MOST_TRANSLATIONS, PooledPoints
from . import PointSize
from .atomic import fetch_add
from .kernels import BATCH, _pack, _project, _take_pixels, _take_squares

ROUNDING = 2.0**-20
"""Of the image's longer side, by which a point may lie beside its place."""

_STEPS = 4
"""Bits that are taken from a tag without asking whether one is left: a branch a point would be mispredicted too often
(measured: 1.2 times the time of drawing)."""

_ONE = np.uint32(1)
_UNIT_ROWS = np.eye(3, 4, dtype=np.float32)


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


def _lowest_bit_intrinsic(_context: Any, word: Any) -> Any:
    """Index of the lowest bit that is set in a uint32, 32 for none."""

    def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.zext(builder.cttz(arguments[0], cgutils.false_bit), ir.IntType(64))

    return types.uint64(types.uint32), codegen


_lowest_bit: Any = intrinsic(_lowest_bit_intrinsic)


def _count_bits_intrinsic(_context: Any, word: Any) -> Any:
    """How many bits are set in a uint32."""

    def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.zext(builder.ctpop(arguments[0]), ir.IntType(64))

    return types.int64(types.uint32), codegen


_count_bits: Any = intrinsic(_count_bits_intrinsic)


class _Batch(NamedTuple):
    """Points on their way to the framebuffer: image position times depth, depth, colour words; then as of ``kernels``.

    moved : (3, 256 + 32) float32, the translations of a pool in the image, and some that are read where no bit is left.
    """

    x: np.ndarray
    y: np.ndarray
    w: np.ndarray
    colour: np.ndarray
    place: np.ndarray
    depth: np.ndarray
    packed: np.ndarray
    moved: np.ndarray


@njit(nogil=True, cache=True)
def draw_pools(pools, cells, frustum, view, words, dirty, turn, counter):
    """Draw cells into one framebuffer until none is left.

    pools : PoolCells.  cells : (k,) int64, those to draw.  The rest as of ``kernels.draw``.
    """
    n = BATCH + _STEPS
    batch = _Batch(
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(BATCH, np.uint32),
        np.empty(3 * BATCH, np.int32),
        np.empty(BATCH, np.float32),
        np.empty(BATCH, np.uint64),
        np.zeros((3, MOST_TRANSLATIONS + TAG_BITS), np.float32),
    )
    rows = np.empty((3, 4), np.float32)
    begin = fetch_add(counter, turn)
    while begin < len(cells):
        for k in range(begin, min(begin + turn, len(cells))):
            c = cells[k]
            _cell_rows(pools.origin, pools.step, c, frustum, rows)
            side_at_one = np.float32(pools.world_side[c] * frustum.focal_px)
            _draw_pools_of(pools, c, rows, side_at_one, view, words, dirty, batch)
            _draw_loose(pools, c, rows, side_at_one, view, words, dirty, batch)
        begin = fetch_add(counter, turn)


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
def _draw_pools_of(pools, c, rows, side_at_one, view, words, dirty, batch):
    vertices, translations, tags = pools.vertices, pools.translations, pools.tags
    xs, ys, ws, moved = batch.x, batch.y, batch.w, batch.moved
    n, drawn = 0, pools.first_point[c]
    for p in range(pools.first_pool[c], pools.first_pool[c + 1]):
        first, word = pools.first_translation[p], pools.first_word[p]
        m = pools.first_translation[p + 1] - first
        for t in range(m):
            j = first + t
            dx, dy, dw = _linear(rows, translations[j, 0], translations[j, 1], translations[j, 2])
            moved[0, t], moved[1, t], moved[2, t] = dx, dy, dw
        for v in range(pools.first_vertex[p], pools.first_vertex[p + 1]):
            if n + m > BATCH:
                _take(pools, c, drawn, n, _UNIT_ROWS, side_at_one, view, words, dirty, batch)
                n, drawn = 0, drawn + n
            x, y, w = _linear(rows, vertices[v, 0], vertices[v, 1], vertices[v, 2])
            x, y, w = x + rows[0, 3], y + rows[1, 3], w + rows[2, 3]
            for base in range(0, m, TAG_BITS):
                bits = tags[word]
                word += 1
                end = n + _count_bits(bits)
                while n < end:
                    for k in range(_STEPS):  # where no bit is left a sum is written that the next one overwrites
                        t = np.uintp(base) + _lowest_bit(bits)
                        bits &= np.uint32(bits - _ONE)
                        i = np.uintp(n) + np.uintp(k)
                        xs[i], ys[i], ws[i] = x + moved[0, t], y + moved[1, t], w + moved[2, t]
                    n += _STEPS
                n = end
    _take(pools, c, drawn, n, _UNIT_ROWS, side_at_one, view, words, dirty, batch)


@njit(nogil=True, cache=True)
def _draw_loose(pools, c, rows, side_at_one, view, words, dirty, batch):
    loose, xs, ys, ws = pools.loose, batch.x, batch.y, batch.w
    first, last = pools.first_loose[c], pools.first_loose[c + 1]
    drawn = pools.first_point[c + 1] - (last - first)
    for begin in range(first, last, BATCH):
        n = min(BATCH, last - begin)
        for i in range(n):
            k = np.uintp(begin) + np.uintp(i)
            xs[i], ys[i], ws[i] = np.float32(loose[0, k]), np.float32(loose[1, k]), np.float32(loose[2, k])
        _take(pools, c, drawn + begin - first, n, rows, side_at_one, view, words, dirty, batch)


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
def _take(pools, c, first, n, rows, side_at_one, view, words, dirty, batch):
    """Take the ``n`` points of the batch, whose colours begin at ``first``. Points in the image have unit rows."""
    index, palette, colour = pools.colour, pools.palette, batch.colour
    _project(batch.x, batch.y, batch.w, 0, n, rows, side_at_one, view, len(words), batch.place, batch.depth)
    for i in range(n):
        colour[i] = palette[c, index[np.uintp(first) + np.uintp(i)]]
    _pack(batch.depth, colour, 0, n, batch.packed)
    if view.one_pixel:
        _take_pixels(batch.place, batch.packed, n, words, dirty)
    else:
        _take_squares(batch.place, batch.packed, n, view, words, dirty)
