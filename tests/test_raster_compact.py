"""Positions in fixed point: the stated bounds, and frames equal to the NumPy twin's."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.nodes.raster import PointSize, ResidentPoints
from splatpipe.nodes.raster.blocks import (
    BITS,
    FULL,
    HIGH,
    HIGH_BITS_ERROR_PX,
    OUTSIDE,
    Blocks,
    frustum,
)
from splatpipe.nodes.raster.compact import CompactPositions, compact_positions
from splatpipe.nodes.raster.cpu import CpuRasterizer
from splatpipe.nodes.raster.kernels import FILTERED, block_rows
from splatpipe.nodes.raster.reference import (
    compact_rows,
    fixed_point_bins,
    project,
    project_compact,
    reference_frame,
    unpack_bins,
)
from splatpipe.shared.camera import Camera, look_at, perspective_camera
from splatpipe.shared.errors import InputError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT

SIZES = [PointSize(), PointSize(3), PointSize(1, world=0.02, maximum=9), PointSize(1, maximum=9, adaptive=True)]


def cells(n, blocks=40, seed=0, extent=1.0, offset=0.0):
    """Points in boxes of any shape, in blocks of uneven length, some of one point; a point's colour is its number."""
    rng = np.random.default_rng(seed)
    first = np.unique(np.r_[0, 1, rng.integers(0, n, blocks - 2)])[: max(n, 1)]
    block = np.searchsorted(first, np.arange(n), side="right") - 1
    size = extent * rng.uniform(0, 1, (len(first), 3)) ** 3
    x, y, z = (rng.uniform(-0.5, 0.5, (n, 3)) * size[block]).astype(np.float32).T
    return ResidentPoints(
        *map(np.ascontiguousarray, (x, y, z)),
        np.arange(n, dtype=np.uint32),
        first,
        rng.uniform(-1, 1, (len(first), 3)) + offset,
        block_spacing=rng.uniform(0, 0.05, len(first)).astype(np.float32),
    )


def camera(width=211, height=97, eye=(1.5, -2.5, 1.2), target=(0.0, 0.0, 0.0), near=0.1) -> Camera:
    pose = look_at(np.array(eye), np.array(target), np.array([0.0, 0.0, 1.0]))
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.9, width=width, height=height, near=near)


def draw(points, view, entries, size=SIZES[0], threads=1, compact=True):
    with CpuRasterizer(points, view.width, view.height, size, threads, compact=compact) as rasterizer:
        return rasterizer.draw(view, entries).copy()


def everything(points):
    return np.array([(0, len(points), 1)], RENDER_POINT)


def precision_of(points, compact, view, margin_px=1.5):
    blocks = Blocks(points.block_origin, np.zeros(len(points.block_origin)), compact.lower, compact.step)
    rows = np.empty((len(compact.step), 3, 4), np.float32)
    seen = frustum(view, margin_px)
    return rows, np.array([block_rows(blocks, s, seen, rows[s]) for s in range(len(rows))])


@pytest.mark.parametrize("threads", [1, 3])
def test_encoding_equals_the_twin(threads):
    points = cells(20_000)
    found = compact_positions(points, threads)
    bins, lower, step = fixed_point_bins(points, BITS)
    np.testing.assert_array_equal(unpack_bins(found.high, found.low), bins)
    np.testing.assert_array_equal(found.lower, lower)
    np.testing.assert_array_equal(found.step, step)
    assert (step > 0).mean() > 0.8
    assert (np.diff(points.block_first_point) == 1).any()


def test_what_is_filtered_out_is_marked_and_moves_no_grid():
    points = cells(3000)
    gone = np.random.default_rng(1).random(len(points)) < 0.4
    first = points.block_first_point
    gone[first[3] : first[5]] = True  # two whole blocks
    gone[first[7]] = True  # the first point of a block
    x = np.where(gone, np.float32(np.nan), points.x)
    filtered = replace(points, x=x)
    found = compact_positions(filtered, 2)
    bins, lower, step = fixed_point_bins(filtered, BITS)
    np.testing.assert_array_equal(found.high & FILTERED != 0, gone)
    np.testing.assert_array_equal(unpack_bins(found.high, found.low), bins)
    np.testing.assert_array_equal(found.lower, lower)
    np.testing.assert_array_equal(found.step, step)
    left = replace(points, x=np.where(gone, 1e30, points.x).astype(np.float32))  # a grid that counted them shows it
    assert (compact_positions(left, 1).step[:, 0] > step[:, 0]).any()


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    extent=st.sampled_from([0.0, 1e-40, 1e-9, 1.0, 1e6, 1e12]),
    seed=st.integers(0, 99),
    n=st.integers(1, 300),
    coincident=st.booleans(),
)
def test_a_point_moves_by_half_a_bin_at_most(extent, seed, n, coincident):
    points = cells(n, blocks=5, seed=seed, extent=extent)
    if coincident:
        points = replace(points, x=np.full(n, points.x[0]))
    found = compact_positions(points, 2)
    block = np.searchsorted(points.block_first_point, np.arange(n), side="right") - 1
    bins = unpack_bins(found.high, found.low)
    exact = np.column_stack([points.x, points.y, points.z]).astype(np.float64)
    for bits in (BITS, BITS // 2):
        size = found.step[block] * 2.0 ** (BITS - bits)
        moved = np.abs(found.lower[block] + ((bins >> (BITS - bits)) + 0.5) * size - exact)
        assert (moved <= size / 2 * (1 + 1e-6) + np.spacing(np.abs(exact))).all()


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_equals_the_twin_word_by_word(size, threads):
    points = cells(40_000)
    view = camera(1600, 900)
    compact = compact_positions(points, 2)
    assert {HIGH, FULL} <= set(precision_of(points, compact, view)[1])
    entries = np.array([(0, 40_000, 1), (7, 20_001, 3), (30_000, 10_000, 17)], RENDER_POINT)
    expected = reference_frame(points, view, entries, size, project_compact(compact))
    assert (expected != FRAMEBUFFER_EMPTY).sum() > 2000
    np.testing.assert_array_equal(draw(points, view, entries, size, threads), expected)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10**6),
    eye=st.tuples(*[st.floats(-1.2, 1.2)] * 3),
    width=st.sampled_from([1, 61, 2000, 16384]),
    offset=st.sampled_from([0.0, 6.4e6]),
    scale=st.sampled_from([1e-9, 1e-3, 1.0, 1e12]),
)
def test_rows_precision_and_culling_hold_their_bounds(seed, eye, width, offset, scale):
    """Where a camera stands among the boxes, w → 0 included: no drawn point is culled, and none moves too far."""
    offset *= scale >= 1e-3  # no float64 eye stands beside boxes of 1e-9 there
    points = cells(2000, seed=seed)
    points = replace(
        points,
        **{axis: (getattr(points, axis) * np.float32(scale)).astype(np.float32) for axis in "xyz"},
        block_origin=points.block_origin * scale + offset,
    )
    view = camera(
        width, 64, np.array(eye) * scale + offset, np.array([1.5, -1.7, 1.3]) * scale + offset, near=1e-3 * scale
    )
    compact = compact_positions(points, 1)
    rows, precision = precision_of(points, compact, view)
    twin_rows, twin_precision = compact_rows(points.block_origin, compact, view)
    kept = precision != OUTSIDE
    np.testing.assert_array_equal(precision[kept], twin_precision[kept])
    np.testing.assert_array_equal(rows[kept], twin_rows[kept])

    index = np.arange(len(points))
    block = np.searchsorted(points.block_first_point, index, side="right") - 1
    u, v, w = project_compact(compact)(points, view, index)
    drawn = (w >= view.near) & (u >= -0.5) & (u < width + 0.5) & (v >= -0.5) & (v < 64.5)
    assert (precision[block[drawn]] != OUTSIDE).all()

    # exact arithmetic on the bins, so that rounding to float32 is not in the figure
    bins = unpack_bins(compact.high, compact.low)
    high = (precision[block] == HIGH)[:, None]
    size = compact.step[block] * np.where(high, 1024, 1)
    bins = np.where(high, bins >> 10, bins)
    moved = compact.lower[block] + (bins + 0.5) * size
    m = view.pixel_from_world[:, :3]
    relative = (points.block_origin - view.eye)[block]
    exact = np.column_stack([points.x, points.y, points.z]).astype(np.float64)
    (x, y, depth), (moved_x, moved_y, moved_depth) = (m @ (relative + p).T for p in (exact, moved))
    with np.errstate(all="ignore"):
        du, dv = np.abs(moved_x / moved_depth - x / depth), np.abs(moved_y / moved_depth - y / depth)
        inside = (x / depth >= 0) & (x / depth <= width) & (y / depth >= 0) & (y / depth <= 64)
    of_interest = inside & (depth >= view.near) & (moved_depth >= view.near) & high[:, 0]
    assert (np.maximum(du, dv)[of_interest] <= HIGH_BITS_ERROR_PX * (1 + 1e-6)).all()


def test_far_cells_take_four_bytes_and_near_ones_eight():
    points = cells(5000)
    compact = compact_positions(points, 1)
    far = precision_of(points, compact, camera(400, 300, (0.0, -60.0, 0.0)))[1]
    assert (far == HIGH).all()
    near = precision_of(points, compact, camera(4000, 3000, (0.0, -1.5, 0.0)))[1]
    assert (near == FULL).any()


@pytest.mark.parametrize("offset", [0.0, 6.4e6])
def test_full_precision_moves_no_point_visibly(offset):
    points = cells(20_000, offset=offset)
    view = camera(1920, 1080, np.array([1.5, -2.5, 1.2]) + offset, np.full(3, offset))
    compact = compact_positions(points, 2)
    index = np.arange(20_000)
    u, v, w = project(points, view, index)
    found_u, found_v, _ = project_compact(compact)(points, view, index)
    seen = (u >= 0) & (u < 1920) & (v >= 0) & (v < 1080) & (w > 0.1)
    moved = np.hypot(found_u - u, found_v - v)
    block = np.searchsorted(points.block_first_point, index, side="right") - 1
    full = (precision_of(points, compact, view)[1] == FULL)[block]
    assert (seen & full).any()
    assert moved[seen & full].max() < 0.02
    assert moved[seen].max() < HIGH_BITS_ERROR_PX * 2**0.5 + 0.02


def test_one_point_and_none():
    one = np.zeros(1, np.float32)
    points = ResidentPoints(one, one, one, np.array([7], np.uint32), np.zeros(1, np.int64), np.zeros((1, 3)))
    frame = draw(points, camera(9, 9), everything(points))
    assert (frame != FRAMEBUFFER_EMPTY).sum() == 1
    assert frame.astype(np.uint32)[4, 4] == 7
    none = np.empty(0, np.float32)
    points = ResidentPoints(none, none, none, np.empty(0, np.uint32), np.zeros(1, np.int64), np.zeros((1, 3)))
    assert (draw(points, camera(9, 9), everything(points)) == FRAMEBUFFER_EMPTY).all()
    assert isinstance(compact_positions(points, 1), CompactPositions)


def test_blocks_outside_the_image_are_not_drawn():
    points, view = cells(5000, extent=0.05), camera(64, 64, (0.0, -0.2, 0.0), (0.0, 1.0, 0.0))
    compact = compact_positions(points, 1)
    outside = precision_of(points, compact, view)[1] == OUTSIDE
    assert 0.2 < outside.mean() < 1
    expected = reference_frame(points, view, everything(points), projection=project_compact(compact))
    np.testing.assert_array_equal(draw(points, view, everything(points)), expected)


def test_adaptive_sides_follow_the_spacing_of_the_block():
    points, view = cells(3000), camera(300, 200)
    size = PointSize(1, maximum=20, adaptive=True)
    covered = [
        (draw(replace(points, block_spacing=spacing), view, everything(points), size, compact=False) != FRAMEBUFFER_EMPTY)
        .sum()
        for spacing in (np.full(len(points.block_origin), s, np.float32) for s in (0.0, 0.03, 0.06))
    ]  # fmt: skip
    assert covered[0] * 2 < covered[1]
    assert covered[1] * 1.5 < covered[2]
    with pytest.raises(InputError, match="point size: found no spacing"):
        CpuRasterizer(replace(points, block_spacing=None), 5, 5, size)
