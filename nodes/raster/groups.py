"""Drawn from linear groups: end points go through the matrix, inner points are interpolated between them.

Kept points are transformed a *run* at a time, as many partitions as fit the scratch; then each group's inner points are
V1' + t (V2' − V1') in homogeneous coordinates: four operations a coordinate less than a matrix, one byte read in place
of six or twelve, and the perspective divide still done for each point. Nothing is expanded in memory but
``kernels.BATCH`` points at a time, and a frame has the words that ``kernels`` would take for the same points:
``groups_reference`` is the readable twin.

Groups are clipped by their ends, after Cohen and Sutherland: in homogeneous coordinates every side of the image is a
linear function, so a segment lies beyond a side where both its ends do. Such a group is not interpolated at all; one
whose ends are both inside is drawn without looking at its points. The margins are wider than what is rounded, so that
clipping changes no pixel: points up to the largest side of a point's square outside are still looked at, and those
less than ``INSIDE_PX`` from the edge too.

Rounding: as of ``pools``, at most ``pools.ROUNDING`` of the sizes of what is added.

Source: Dinerstein, Egbert, Flann, "Linear Grouping", section 2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from ...shared.codecs.group_search import STEPS
from ...shared.codecs.linear_groups import LinearGroups
from ...shared.codecs.order import gather_runs
from ...shared.errors import CodecError
from .atomic import fetch_add
from .kernels import BATCH, _pack, _project, _take_pixels, _take_squares
from .pools import _cell_rows

INSIDE_PX = 1 / 64
"""An accepted group's ends are this far inside the image; interpolating rounds by at most a quarter of it, in an image
of 32768 pixels."""

OUTSIDE, NOT_INSIDE = np.uint32(0b11111), np.uint32(0b100000)
"""Bits of outcodes: beyond the near plane, left, right, top, bottom side; not certainly within all of them."""

_BELOW, _ABOVE = np.float32(1 - 2.0**-20), np.float32(1 + 2.0**-20)
_INSIDE = np.float32(INSIDE_PX)
_FAR = np.float32(np.finfo(np.float32).max / 2**16)
_STEP = np.float32(1 / STEPS)
_IDENTITY = np.eye(3, 4, dtype=np.float32)


class GroupCells(NamedTuple):
    """Cells in the form they are drawn from; their arrays stand one after the other.

    origin : (c, 3) float64, world frame, lower corner of each cell's cube.  step : (c,) float64, size of a grid step,
    world units; a point is the middle of its bin.  world_side : (c,) float64, side of a point's square, world units.
    first_run : (c + 1,) int64.  first_kept, first_group, first_inner : (r + 1,) int64, of each run of partitions.
    x, y, z : (k,) uint16, grid points of the kept points.  kept_colour : (k,) uint32 colour words.
    v1, v2 : (g,) uint16, among the kept points of the run.  n_inner : (g,) uint16.
    parameter : (m,) uint8, in 1/256.  inner_colour : (m,) uint32 colour words.
    One colour may be held as one word that is repeated with stride 0; kernels are compiled for that apart.
    """

    origin: np.ndarray
    step: np.ndarray
    world_side: np.ndarray
    first_run: np.ndarray
    first_kept: np.ndarray
    first_group: np.ndarray
    first_inner: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    kept_colour: np.ndarray
    v1: np.ndarray
    v2: np.ndarray
    n_inner: np.ndarray
    parameter: np.ndarray
    inner_colour: np.ndarray

    @property
    def position_bytes(self) -> int:
        """Bytes that positions take; colours are four a point beside."""
        arrays = (self.x, self.y, self.z, self.v1, self.v2, self.n_inner, self.parameter)
        return sum(array.nbytes for array in arrays)


@dataclass(frozen=True)
class GroupCell:
    """A cell in this form; arrays as of ``GroupCells``.

    origin : (3,) float64.  first : (r + 1, 3) int64, first kept point, group and inner point of each run.
    kept : (3, k) uint16.  ends : (2, g) uint16.
    """

    origin: np.ndarray
    step: float
    first: np.ndarray
    kept: np.ndarray
    kept_colour: np.ndarray
    ends: np.ndarray
    n_inner: np.ndarray
    parameter: np.ndarray
    inner_colour: np.ndarray


def group_cell(points: LinearGroups, origin: np.ndarray, step: float, colour: np.ndarray) -> GroupCell:
    """A cell of linear groups.  colour : (n,) uint32 words in coded order.

    The groups of a run stand by size: loops of the same length one after the other are predicted (measured: half the
    time of interpolating).
    Raises CodecError for grid points of more than 16 bits an axis.
    """
    if points.kept.max(initial=0) >> 16:
        raise CodecError(
            f"linear groups: found grid points up to {points.kept.max()}, expected at most 16 bits an axis to draw"
        )
    starts = _runs(points.first_kept)
    first_kept, first_group = points.first_kept[starts], points.first_group[starts]
    n_groups, n_inner = np.diff(first_group), np.diff(points.first_inner)
    by_size = np.lexsort((n_inner, np.repeat(np.arange(len(n_groups)), n_groups)))
    ends = points.ends - np.repeat(first_kept[:-1], n_groups)[:, None]
    kept_colour, inner_colour = np.split(np.asarray(colour, np.uint32), [len(points.kept)])
    return GroupCell(
        origin,
        step,
        np.column_stack([first_kept, first_group, points.first_inner[first_group]]),
        points.kept.T.astype(np.uint16),
        kept_colour,
        ends[by_size].T.astype(np.uint16),
        n_inner[by_size].astype(np.uint16),
        gather_runs(points.parameter, points.first_inner, n_inner, by_size),
        gather_runs(inner_colour, points.first_inner, n_inner, by_size),
    )


def group_cells(cells: Sequence[GroupCell]) -> GroupCells:
    """Cells put together, with a ``world_side`` of 0. Cost: a copy of their arrays."""

    def joined(dtype: type, arrays: Iterable[np.ndarray]) -> np.ndarray:
        return np.concatenate([np.empty(0, dtype), *arrays])

    sizes = np.array([cell.first[-1] for cell in cells], np.int64).reshape(-1, 3)
    ends = np.cumsum(sizes, axis=0)
    tables = [cell.first[:-1] + before for cell, before in zip(cells, ends - sizes, strict=True)]
    first_kept, first_group, first_inner = np.concatenate([*tables, sizes.sum(axis=0)[None]]).T
    x, y, z = (joined(np.uint16, (cell.kept[axis] for cell in cells)) for axis in range(3))
    v1, v2 = (joined(np.uint16, (cell.ends[end] for cell in cells)) for end in range(2))
    return GroupCells(
        origin=np.array([cell.origin for cell in cells], np.float64).reshape(-1, 3),
        step=np.array([cell.step for cell in cells], np.float64),
        world_side=np.zeros(len(cells)),
        first_run=np.cumsum([0, *(len(cell.first) - 1 for cell in cells)], dtype=np.int64),
        first_kept=np.ascontiguousarray(first_kept),
        first_group=np.ascontiguousarray(first_group),
        first_inner=np.ascontiguousarray(first_inner),
        x=x,
        y=y,
        z=z,
        kept_colour=joined(np.uint32, (cell.kept_colour for cell in cells)),
        v1=v1,
        v2=v2,
        n_inner=joined(np.uint16, (cell.n_inner for cell in cells)),
        parameter=joined(np.uint8, (cell.parameter for cell in cells)),
        inner_colour=joined(np.uint32, (cell.inner_colour for cell in cells)),
    )


def _runs(first_kept: np.ndarray) -> np.ndarray:
    """Partitions at which runs start, and the number of partitions: as many in turn as have ``BATCH`` kept points."""
    starts = [0]
    while starts[-1] < len(first_kept) - 1:
        starts.append(int(np.searchsorted(first_kept, first_kept[starts[-1]] + BATCH, side="right")) - 1)
    return np.array(starts)


class _Scratch(NamedTuple):
    """Kept points of a run, X, Y, W and outcodes; then points on their way to the framebuffer."""

    kept_x: np.ndarray
    kept_y: np.ndarray
    kept_w: np.ndarray
    code: np.ndarray
    x: np.ndarray
    y: np.ndarray
    w: np.ndarray
    colour: np.ndarray
    place: np.ndarray
    depth: np.ndarray
    packed: np.ndarray


@njit(nogil=True, cache=True)
def draw_groups(groups, cells, frustum, view, words, dirty, turn, counter):
    """Draw cells into one framebuffer until none is left.

    groups : GroupCells.  cells : (k,) int64, those to draw.  The rest as of ``kernels.draw``.
    """
    floats = np.empty((7, BATCH), np.float32)
    scratch = _Scratch(
        floats[0],
        floats[1],
        floats[2],
        np.empty(BATCH, np.uint32),
        floats[3],
        floats[4],
        floats[5],
        np.empty(BATCH, np.uint32),
        np.empty(3 * BATCH, np.int32),
        floats[6],
        np.empty(BATCH, np.uint64),
    )
    rows = np.empty((3, 4), np.float32)
    begin = fetch_add(counter, turn)
    while begin < len(cells):
        for k in range(begin, min(begin + turn, len(cells))):
            c = cells[k]
            _cell_rows(groups.origin, groups.step, c, frustum, rows)
            side_at_one = np.float32(groups.world_side[c] * frustum.focal_px)
            for run in range(groups.first_run[c], groups.first_run[c + 1]):
                _draw_run(groups, run, rows, side_at_one, view, words, dirty, scratch)
        begin = fetch_add(counter, turn)


@njit(nogil=True, cache=True)
def _draw_run(groups, run, rows, side_at_one, view, words, dirty, scratch):
    """Draw the kept points of a run, then the inner points of those of its groups that are not rejected."""
    first, count = groups.first_kept[run], groups.first_kept[run + 1] - groups.first_kept[run]
    kept_x, kept_y, kept_w, code = scratch.kept_x, scratch.kept_y, scratch.kept_w, scratch.code
    x, y, w, colour = scratch.x, scratch.y, scratch.w, scratch.colour
    _transform(groups.x, groups.y, groups.z, first, count, rows, kept_x, kept_y, kept_w)
    any_code, common_code = outcodes(kept_x, kept_y, kept_w, count, view, code)
    if common_code:
        return
    _take(kept_x, kept_y, kept_w, count, groups.kept_colour, first, any_code, side_at_one, view, words, dirty, scratch)
    gaps = any_code & OUTSIDE != 0  # some groups may be rejected: colours of the others are put together
    n, q, any_code = 0, groups.first_inner[run], np.uint32(0)
    for g in range(groups.first_group[run], groups.first_group[run + 1]):
        a, b, m = np.uintp(groups.v1[g]), np.uintp(groups.v2[g]), np.int64(groups.n_inner[g])
        if code[a] & code[b] & OUTSIDE:
            q += m
            continue
        if n + m > BATCH:
            colours, first = (colour, 0) if gaps else (groups.inner_colour, q - n)
            _take(x, y, w, n, colours, first, any_code, side_at_one, view, words, dirty, scratch)
            n, any_code = 0, np.uint32(0)
        any_code |= code[a] | code[b]
        dx, dy, dw = kept_x[b] - kept_x[a], kept_y[b] - kept_y[a], kept_w[b] - kept_w[a]
        ax, ay, aw = kept_x[a], kept_y[a], kept_w[a]
        for i in range(m):
            t = np.float32(groups.parameter[np.uintp(q) + np.uintp(i)]) * _STEP
            k = np.uintp(n) + np.uintp(i)
            x[k], y[k], w[k] = ax + t * dx, ay + t * dy, aw + t * dw
        if gaps:
            for i in range(m):
                colour[n + i] = groups.inner_colour[q + i]
        n += m
        q += m
    colours, first = (colour, 0) if gaps else (groups.inner_colour, q - n)
    _take(x, y, w, n, colours, first, any_code, side_at_one, view, words, dirty, scratch)


@njit(nogil=True, cache=True)
def _transform(x, y, z, first, n, rows, out_x, out_y, out_w):
    """X, Y and W of ``n`` grid points from ``first`` on."""
    for i in range(n):
        j = np.uintp(first) + np.uintp(i)
        a, b, c = np.float32(x[j]), np.float32(y[j]), np.float32(z[j])
        out_x[i] = rows[0, 0] * a + rows[0, 1] * b + rows[0, 2] * c + rows[0, 3]
        out_y[i] = rows[1, 0] * a + rows[1, 1] * b + rows[1, 2] * c + rows[1, 3]
        out_w[i] = rows[2, 0] * a + rows[2, 1] * b + rows[2, 2] * c + rows[2, 3]


@njit(nogil=True, cache=True)
def outcodes(x, y, w, n, view, code):
    """Fill in the outcodes of ``n`` points; return their union and what all have in common.

    A segment is rejected where its ends share a bit of ``OUTSIDE``, accepted where neither has one of ``NOT_INSIDE``. A
    value that is not a number is neither beyond a side nor within it.
    """
    margin, below, above = view.largest, view.near * _BELOW, view.near * _ABOVE
    right, bottom = view.width + margin, view.height + margin
    inner_right, inner_bottom = view.width - _INSIDE, view.height - _INSIDE
    for i in range(n):
        a, b, c = x[i], y[i], w[i]
        bits = np.uint32(1) if c < below else np.uint32(0)
        bits |= np.uint32(2) if a < -margin * c else np.uint32(0)
        bits |= np.uint32(4) if a > right * c else np.uint32(0)
        bits |= np.uint32(8) if b < -margin * c else np.uint32(0)
        bits |= np.uint32(16) if b > bottom * c else np.uint32(0)
        inside = (c >= above) & (c <= _FAR)
        inside &= (a >= _INSIDE * c) & (a <= inner_right * c) & (b >= _INSIDE * c) & (b <= inner_bottom * c)
        code[i] = bits if inside else bits | NOT_INSIDE
    any_code, common_code = np.uint32(0), OUTSIDE
    for i in range(n):
        any_code |= code[i]
        common_code &= code[i]
    return any_code, common_code


@njit(nogil=True, cache=True)
def _take(x, y, w, n, colours, first, any_code, side_at_one, view, words, dirty, scratch):
    """Take ``n`` points in the image's frame with the colours from ``first`` on; ``any_code``: of all their ends."""
    if view.one_pixel and not any_code & NOT_INSIDE:
        _place_inside(x, y, w, n, view, scratch.place)
        _pack(w, colours, first, n, scratch.packed)
    else:
        _project(x, y, w, 0, n, _IDENTITY, side_at_one, view, len(words), scratch.place, scratch.depth)
        _pack(scratch.depth, colours, first, n, scratch.packed)
    if view.one_pixel:
        _take_pixels(scratch.place, scratch.packed, n, words, dirty)
    else:
        _take_squares(scratch.place, scratch.packed, n, view, words, dirty)


@njit(nogil=True, cache=True, error_model="numpy")
def _place_inside(x, y, w, n, view, place):
    """As ``kernels._project_pixels``, of points that are known to be in the image."""
    for i in range(n):
        place[i] = np.int32(y[i] / w[i]) * view.pitch + np.int32(x[i] / w[i])
