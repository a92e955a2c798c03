"""The sampling node: visibility bits in, render-points array out (thesis 4.3.2 and 5.2.1, node 2).

The cut through the octree: a visible cell whose parent was expanded is drawn if it is a leaf or small enough
on the screen, else it is expanded. Cells are visited in stored (breadth-first) order and the walk ends with
the last child of an expanded cell, which is the end of the thesis's level-of-detail window.

The projected size of a cell is its edge, in pixels, at the distance from the eye to the nearest point of its cube, or
at the near plane if that is farther. (The thesis divides the diagonal by the distance of the centre, which underrates
a large cell that the eye is in or close to.) It does not change when the camera only turns, and at least halves from
a cell to its child. Stretch off the view axis is not counted.

A cut cell that has a pooled form (``shared.codecs.streams``) may be drawn from it, whole, in place of its range: where
its grid is so fine that a bin is at most 1/√2 pixel wide, that is where the cell is at most 2**bits / √2 pixels across
(Kim, Lee, Varshney, "Vertex Transformation Streams", section 6), and where that reads fewer bytes or takes less time.
The form has every bin that holds a point of the set, so it is never sparser than a part of the set seen on that grid.

A frame may have a budget of points. One that would need more is cut with a share of the points a pixel, and a threshold
that is larger by as much: a share of the ladder 2**(−k / ``SHARES_AN_OCTAVE``) that keeps to the budget while the next
larger one does not, found by galloping and bisection. It follows from the camera alone, so any rank, at any time, finds
the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numba import njit

from ..shared.camera import Camera
from ..shared.errors import ConfigError, MessageError
from ..shared.messages import RENDER_POINT, RenderPoints, VisibilityBits
from ..shared.octree import CORNER, EDGE, MAX_LEVEL, Octree
from ..shared.windows import Window
from .frustum import cubes_within, frustum_planes, padded_half_edges
from .pooled_entries import POINT_BYTES, PooledForms

Pools = Literal["off", "bytes", "time"]

MAX_RANGE = 2**32 - 1
"""Longest range of one entry; a longer one is split."""
SHARP_DENSITY = 2.0
"""Points of cells with an edge or a corner, in points of other cells of the same area (thesis 4.4.3)."""
POOLED_POINT_COST = 1.15
"""Time of drawing a pooled point on the CPU, in points of a range: 0.97 … 1.27 measured, larger cells less."""
SHARES_AN_OCTAVE = 8
"""Steps of the share of points in which a frame with a budget is thinned out: 9 % each."""
_MOST_STEPS = 1000 * SHARES_AN_OCTAVE
"""By then the root alone is drawn, with one point, however near the camera is."""
_EXPANDED = -1
_POOLED = -2


class SamplingNode:
    """Tells which points to draw.

    octree : cells in breadth-first order, either point order.
    pixel_threshold : a cell that projects to at most this many pixels across is drawn from its own points, if
        those suffice; 0 draws every visible point.
    points_per_pixel : points of a set in stratified order, for each pixel that the surface in its cell covers where it
        is seen face on (``Octree.area``); ``SHARP_DENSITY`` times as many where the octree tells edges and corners.
    whole_sets : draw a cut cell with all its points, where a head of them has no meaning (linear groups).
    pools : whether cells are drawn from their pooled form: never; where that reads fewer ``bytes``, or where it takes
        less ``time`` (``POOLED_POINT_COST``). The octree needs their sizes.
    point_bytes : what drawing a point of a range reads.
    point_budget : most points of a frame; 0: no limit. Ranges only, and of thresholds above 0.
    step : of the ladder of shares, of the last frame; 0: it was not thinned out.
    own : (n,) bool, cells that this node answers for, where others draw the rest; None: all.
    margin_px : as of the culling node, for windows.
    Raises ConfigError for a threshold that is not a finite number ≥ 0, points per pixel that are not one > 0, or an
    octree without pooled forms where they are to be drawn.
    """

    def __init__(
        self,
        octree: Octree,
        *,
        pixel_threshold: float,
        points_per_pixel: float = 2.0,
        whole_sets: bool = False,
        pools: Pools = "off",
        point_bytes: float = POINT_BYTES,
        point_budget: int = 0,
        own: np.ndarray | None = None,
        margin_px: float = 1.0,
    ):
        if not (pixel_threshold >= 0 and math.isfinite(pixel_threshold)):
            raise ConfigError(f"sampling.pixel_threshold = {pixel_threshold}, expected a number ≥ 0")
        if not (points_per_pixel > 0 and math.isfinite(points_per_pixel)):
            raise ConfigError(f"sampling.points_per_pixel = {points_per_pixel}, expected a number > 0")
        if pools != "off" and octree.pool_points is None:
            raise ConfigError(f"sampling.pools = {pools!r}: the octree was loaded without pooled forms")
        check_point_budget(point_budget, pixel_threshold, whole_sets, pools)
        self.point_budget = point_budget
        self.step = 0
        self.pixel_threshold = float(pixel_threshold)
        self.points_per_pixel = float(points_per_pixel)
        self.whole_sets = whole_sets
        self.margin_px = margin_px
        self._others = None if own is None or own.all() else ~own
        self._half_edges = padded_half_edges(octree)[octree.level]
        self._octree = octree
        self._edge = np.ldexp(octree.edge, -np.arange(MAX_LEVEL + 1))
        self._stored_order = np.argsort(octree.first_point, kind="stable").astype(np.int32)
        self._area = np.empty(0, np.float32) if octree.area is None else octree.area
        if octree.area is not None and octree.feature is not None:
            sharp = np.isin(octree.feature, (EDGE, CORNER))
            self._area = np.where(sharp, np.float32(SHARP_DENSITY) * octree.area, octree.area)
        self._n_drawn = np.empty(len(octree), np.int64)
        self._leaf_points = np.where(octree.is_leaf, octree.n_points, 0)
        n_stored = int((octree.first_point + octree.n_points).max())
        self._n_splits = 2 * n_stored // MAX_RANGE  # a piece fills at least half an entry
        self._forms = None if pools == "off" else PooledForms.of(octree)
        if self._forms is not None:
            costs = self._forms.n_bytes / point_bytes, POOLED_POINT_COST * np.diff(self._forms.first)
            self._worth = costs[pools == "time"]
        self._pooled_entries = np.empty(0 if self._forms is None else len(self._forms), RENDER_POINT)

    def process(self, camera: Camera, bits: VisibilityBits) -> RenderPoints:
        """The render-points array of one frame: ranges, ascending in offset, then pooled points, ascending; adjacent
        ones merged.

        Every visible leaf has exactly one drawn ancestor-or-self, and nothing invisible is drawn. N being the
        square of its projected size and A its area, a cell whose points stand in stratified order yields the first
        max(1, ⌊``points_per_pixel`` A N⌋) of them, or all. Any other cell below the threshold yields at least
        min(its points, max(1, ⌊N ln N⌋)): the head of its range in layered order, every stride-th of the range in
        depth-first order; and a leaf above the threshold all its points. With ``whole_sets`` the same cells yield all
        the points of their range, in entries of stride 1.

        With a ``point_budget`` there are at most so many points, and N is counted and the threshold raised as it takes.

        A cell is drawn in one form: pooled where it is small enough and that is less than those points would be.

        Raises MessageError if the bits belong to another frame or another octree.
        Cost: O(cells in the level-of-detail window) plus a scan of one word per cell. With a threshold of 0 no
        projected size is computed. A frame above its budget is cut some six times over. Pools add a look at each cell
        that has a form, and nothing where they are off.
        """
        tree = self._octree
        if bits.frame != camera.frame or bits.n_cells != len(tree):
            raise MessageError(
                f"visibility bits: found frame {bits.frame} of {bits.n_cells} cells,"
                f" expected frame {camera.frame} of {len(tree)}"
            )
        n_cut = self._cut_to_budget(camera, bits) if self.pixel_threshold else self._all_leaves(bits)
        if self.whole_sets:
            np.copyto(self._n_drawn, tree.n_points, where=self._n_drawn > 0)
        if self._others is not None:
            self._n_drawn[self._others] = 0
        n_pooled = self._take_pools(camera) if self._forms else 0
        entries = self._ranges(n_cut)
        if n_pooled:
            entries = np.concatenate([entries, self._pooled_entries[:n_pooled]])
        return RenderPoints(camera.frame, entries)

    def within(self, camera: Camera, windows: Sequence[Window]) -> list[RenderPoints]:
        """Of the frame processed last, what may be seen in each of several windows: the cells whose cubes reach in.

        For ranges, not for pooled points.  Cost: a look at each cell of the cut for each window, and its entries.
        """
        tree = self._octree
        cells = np.flatnonzero(self._n_drawn > 0)
        n_drawn = self._n_drawn[cells]
        seen = np.empty(len(cells), bool)
        found = []
        for window in windows:
            planes = frustum_planes(camera, self.margin_px, window)
            cubes_within(tree.centers, self._half_edges, cells, camera.eye, planes, seen)
            self._n_drawn[cells] = np.where(seen, n_drawn, 0)
            found.append(RenderPoints(camera.frame, self._ranges(len(cells))))
        self._n_drawn[cells] = n_drawn
        return found

    def _ranges(self, n_cut: int) -> np.ndarray:
        """(m,) RENDER_POINT of the ranges that ``_n_drawn`` says of at most ``n_cut`` cells."""
        tree = self._octree
        entries = np.empty(n_cut + self._n_splits, RENDER_POINT)
        strided = tree.point_order == "depth-first"
        return entries[
            : _merge(tree.first_point, tree.n_points, self._n_drawn, self._stored_order, strided, MAX_RANGE, entries)
        ]

    def _cut_to_budget(self, camera: Camera, bits: VisibilityBits) -> int:
        """Fill ``_n_drawn``; the size of the cut."""
        self.step = 0
        n_cut, n_points = self._cut(camera, bits, 0)
        if not self.point_budget or n_points <= self.point_budget:
            return n_cut

        def fits(step: int) -> bool:
            return self._cut(camera, bits, step)[1] <= self.point_budget

        # from where it would be if points were in proportion to the share
        guess = min(math.ceil(SHARES_AN_OCTAVE * math.log2(n_points / self.point_budget)), _MOST_STEPS)
        too_many, enough, stride = 0, guess, 1
        if fits(guess):
            while enough - stride > 0 and fits(enough - stride):
                enough, stride = enough - stride, 2 * stride
            too_many = max(enough - stride, 0)
        else:
            while not fits(min(enough + stride, _MOST_STEPS)) and enough + stride < _MOST_STEPS:
                enough, stride = enough + stride, 2 * stride
            too_many, enough = enough, min(enough + stride, _MOST_STEPS)
        while enough - too_many > 1:
            middle = (too_many + enough) // 2
            too_many, enough = (too_many, middle) if fits(middle) else (middle, enough)
        self.step = enough
        return self._cut(camera, bits, enough)[0]

    def _cut(self, camera: Camera, bits: VisibilityBits, step: int) -> tuple[int, int]:
        """Fill ``_n_drawn``, thinned by so many steps of the ladder; the size of the cut, and the points it draws."""
        tree = self._octree
        visible = bits.bits.view()
        visible.flags.writeable = False  # received or fresh, one type to the compiler
        return _cut(
            tree.centers,
            tree.level,
            tree.parent,
            tree.first_child,
            tree.n_children,
            tree.n_points,
            tree.n_below,
            self._edge,
            visible,
            camera.eye,
            camera.near,
            camera.focal_px,
            self.pixel_threshold,
            self.points_per_pixel,
            2.0 ** (-step / SHARES_AN_OCTAVE),
            tree.point_order == "depth-first",
            self._area,
            self._n_drawn,
        )

    def _take_pools(self, camera: Camera) -> int:
        """Mark cells of the cut that are drawn from their pooled form, and fill ``_pooled_entries``; how many."""
        tree, forms = self._octree, self._forms
        assert forms
        return _take_pools(
            forms.cell,
            forms.first,
            self._worth,
            0.5 * 4.0**tree.pool_bits,
            tree.centers,
            tree.level,
            tree.n_points,
            self._edge,
            camera.eye,
            camera.near,
            camera.focal_px,
            tree.point_order == "depth-first",
            MAX_RANGE,
            self._n_drawn,
            self._pooled_entries,
        )

    def _all_leaves(self, bits: VisibilityBits) -> int:
        """The same without level of detail: every visible leaf, whatever its size on the screen."""
        np.multiply(self._leaf_points, bits.unpack(), out=self._n_drawn)
        return int(np.count_nonzero(self._n_drawn))


def check_point_budget(point_budget: int, pixel_threshold: float, whole_sets: bool, pools: Pools) -> None:
    """Raise ConfigError if frames cannot be thinned out to a budget, as of ``SamplingNode``."""
    if point_budget and (whole_sets or pools != "off" or not pixel_threshold):
        found = "sets drawn whole" if whole_sets else f"sampling.pools = {pools!r}" if pools != "off" else "threshold 0"
        raise ConfigError(f"sampling.point_budget = {point_budget}: found {found}, which takes all points of a cell")


@njit(nogil=True, cache=True)
def points_needed(n_pixels):
    """max(1, ⌊N ln N⌋) as float64: points that, picked at random, cover N pixels (thesis 4.3.2)."""
    return max(1.0, np.floor(n_pixels * np.log(n_pixels))) if n_pixels > 1.0 else 1.0


@njit(nogil=True, cache=True)
def _projected_pixels(centers, cell, edge, eye, near, focal_px):
    """Square of a cell's projected size, float64."""
    edge_px = edge * focal_px
    half = 0.5 * edge
    distance_2 = 0.0
    for axis in range(3):
        gap = max(0.0, abs(centers[cell, axis] - eye[axis]) - half)
        distance_2 += gap * gap
    return edge_px * edge_px / max(distance_2, near * near)  # nothing is drawn in front of near


@njit(nogil=True, cache=True)
def _cut(
    centers,
    level,
    parent,
    first_child,
    n_children,
    n_points,
    n_below,
    edge,
    bits,
    eye,
    near,
    focal_px,
    pixel_threshold,
    points_per_pixel,
    share,
    strided,
    area,
    n_drawn,
):
    """Fill ``n_drawn``: points to draw of a cut cell, else 0 or ``_EXPANDED``.

    share : of the points a pixel; the threshold is for the pixels that are left.
    Returns the size of the cut, and the points that it draws.
    """
    stratified = len(area) > 0
    n_cut = n_taken = 0
    window_end = 1
    cell = 0
    while cell < window_end:
        n_drawn[cell] = 0
        visible = bits[cell >> 3] >> (cell & 7) & 1
        if visible and (cell == 0 or n_drawn[parent[cell]] == _EXPANDED):
            n_pixels = share * _projected_pixels(centers, cell, edge[level[cell]], eye, near, focal_px)
            is_leaf = first_child[cell] < 0
            is_small = n_pixels <= pixel_threshold * pixel_threshold
            if stratified:
                needed = max(1.0, np.floor(points_per_pixel * area[cell] * n_pixels))
            else:
                needed = points_needed(n_pixels)
            if is_leaf and not (is_small or stratified):
                n_drawn[cell] = n_points[cell]
            elif is_leaf or (is_small and n_points[cell] >= min(needed, n_below[cell])):
                n_drawn[cell] = np.int64(min(needed, n_points[cell]))
            if n_drawn[cell] > 0:
                n_cut += 1
                stride = n_points[cell] // n_drawn[cell] if strided else 1
                n_taken += (n_points[cell] + stride - 1) // stride if strided else n_drawn[cell]
            elif not is_leaf:
                n_drawn[cell] = _EXPANDED
                window_end = first_child[cell] + n_children[cell]
        cell += 1
    n_drawn[window_end:] = 0
    return n_cut, n_taken


@njit(nogil=True, cache=True)
def _take_pools(
    pooled,
    first,
    worth,
    most_pixels,
    centers,
    level,
    n_points,
    edge,
    eye,
    near,
    focal_px,
    strided,
    max_range,
    n_drawn,
    entries,
):
    """Set ``n_drawn`` to ``_POOLED`` and fill ``entries`` for cells that are drawn in that form; number of entries.

    pooled, first : as of ``PooledForms``.  worth : points of a range above which the form is drawn.
    """
    last, end = -1, -1
    for i in range(len(pooled)):
        cell = pooled[i]
        n = n_drawn[cell]
        if n <= 0:
            continue
        if strided:
            stride = n_points[cell] // n
            n = (n_points[cell] + stride - 1) // stride
        if n <= worth[i] or _projected_pixels(centers, cell, edge[level[cell]], eye, near, focal_px) > most_pixels:
            continue
        n_drawn[cell] = _POOLED
        n = first[i + 1] - first[i]
        if first[i] == end and entries[last].range + n <= max_range:
            entries[last].range += n
        else:
            last += 1
            entries[last].offset, entries[last].range, entries[last].stride = first[i], n, 0
        end = first[i + 1]
    return last + 1


@njit(nogil=True, cache=True)
def _merge(first_point, n_points, n_drawn, stored_order, strided, max_range, entries):
    """Fill ``entries`` from the cut, in stored order. Number of entries."""
    last = -1
    end = -1  # where a merged range may go on
    for cell in stored_order:
        n = n_drawn[cell]
        if n <= 0:
            continue
        offset = first_point[cell]
        stride = min(n_points[cell] // n, max_range) if strided else 1
        left = n_points[cell] if strided else n
        if stride == 1 and offset == end and entries[last].range + left <= max_range:
            entries[last].range += left
            end += left
            continue
        while left > 0:
            piece = min(left, max_range - max_range % stride)  # whole strides, so that the next piece keeps step
            last += 1
            entries[last].offset = offset
            entries[last].range = piece
            entries[last].stride = stride
            offset += piece
            left -= piece
        end = offset if stride == 1 else -1
    return last + 1
