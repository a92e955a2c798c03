"""Frames drawn from linear groups: against their twin word by word, against drawing the decoded points, and clipping."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.nodes.raster import PointSize, ResidentPoints
from splatpipe.nodes.raster.blocks import frustum
from splatpipe.nodes.raster.groups import INSIDE_PX, NOT_INSIDE, OUTSIDE, draw_groups, group_cell, group_cells, outcodes
from splatpipe.nodes.raster.groups_reference import project_groups
from splatpipe.nodes.raster.kernels import BATCH, RUN, View, pitch_of
from splatpipe.nodes.raster.reference import reference_frame
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.codecs.group_search import MOST_IN_PART
from splatpipe.shared.codecs.linear_groups import LinearGroupCodec
from splatpipe.shared.errors import CodecError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT

WIDTH, HEIGHT = 211, 97
ONE_PIXEL = PointSize()


def camera(eye=(1.5, -2.5, 1.2), target=(0.5, 0.5, 0.5), near=0.1):
    pose = look_at(np.array(eye, float), np.array(target, float), np.array([0.0, 0.0, 1.0]))
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.9, width=WIDTH, height=HEIGHT, near=near)


def sheet(n, seed):
    u, v = np.random.default_rng(seed).uniform(0, 1, (2, n))
    return np.column_stack([u, v, 0.5 + 0.3 * np.sin(5 * u) * np.cos(4 * v)])


def scene(n=4000, bits=10, epsilon=6.0, shift=0.0):
    """Two cells of a sheet beside one another, and a third that is empty."""
    encoded = [
        LinearGroupCodec(epsilon, part_points=64).group((sheet(n, s) * 2**bits).astype(int), bits) for s in (1, 2)
    ]
    cells = [encoded[0][0], LinearGroupCodec(epsilon).group(np.empty((0, 3), int), bits)[0], encoded[1][0]]
    origin = np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0]]) + shift
    colour = np.random.default_rng(5).integers(0, 2**32, 2 * n, np.uint32)
    colours = np.split(colour, np.cumsum([len(cell) for cell in cells])[:-1])
    return cells, group_cells([group_cell(c, o, 2.0**-bits, k) for c, o, k in zip(cells, origin, colours, strict=True)])


def draw(groups, camera, size=ONE_PIXEL, cells=None, turns=1):
    """A frame; with more turns than one, drawn by several calls into one framebuffer."""
    pitch = pitch_of(WIDTH)
    words = np.full(HEIGHT * pitch + 1, FRAMEBUFFER_EMPTY)
    words[-1] = 0
    dirty = np.zeros(HEIGHT * pitch // RUN + 1, np.uint8)
    largest = max(size.pixels, size.maximum) if size.world else size.pixels
    near, columns, rows, smallest, sides = map(np.float32, (camera.near, WIDTH, HEIGHT, size.pixels, largest))
    view = View(near, columns, rows, smallest, sides, np.int32(pitch), size.pixels == largest == 1)
    cells = np.arange(len(groups.step)) if cells is None else cells
    for part in np.array_split(cells, turns):
        draw_groups(groups, part, frustum(camera, largest / 2 + 1), view, words, dirty, 1, np.zeros(1, np.int64))
    frame = words[:-1].reshape(HEIGHT, pitch)
    assert (frame[:, WIDTH:] == FRAMEBUFFER_EMPTY).all()
    assert words[-1] == 0
    assert not (frame.reshape(-1, RUN) != FRAMEBUFFER_EMPTY).any(axis=1)[dirty[:-1] == 0].any()
    return frame[:, :WIDTH]


def as_points(groups):
    """All points in the order of ``project_groups``, without positions."""
    colour = np.concatenate([groups.kept_colour, groups.inner_colour])
    none = np.zeros(len(colour), np.float32)
    return ResidentPoints(none, none, none, colour, np.zeros(1, np.int64), np.zeros((1, 3)))


def all_of(points):
    return np.array([(0, len(points), 1)], RENDER_POINT)


CAMERAS = {
    "all inside": camera(eye=(1.0, -4.0, 2.0)),
    "at an edge": camera(eye=(1.5, -1.0, 0.8), target=(0.0, 0.5, 0.5)),
    "among the points": camera(eye=(0.5, 0.5, 0.55), target=(0.9, 0.6, 0.5), near=1e-3),
    "turned away": camera(eye=(1.0, -4.0, 2.0), target=(1.0, -8.0, 2.0)),
}
each_camera = pytest.mark.parametrize("view", CAMERAS.values(), ids=CAMERAS.keys())


@each_camera
@pytest.mark.parametrize("size", [PointSize(), PointSize(3), PointSize(1, 0.02, 9)], ids=["1", "3", "attenuated"])
def test_words_of_the_twin(view, size):
    _, groups = scene()
    groups = groups._replace(world_side=np.full(3, size.world))
    points = as_points(groups)
    expected = reference_frame(points, view, all_of(points), size, project_groups(groups, np.float32))
    np.testing.assert_array_equal(draw(groups, view, size), expected)
    assert (expected != FRAMEBUFFER_EMPTY).any() == (view is not CAMERAS["turned away"])


@each_camera
def test_float32_is_close_to_float64(view):
    _, groups = scene()
    points = as_points(groups)
    index = np.arange(len(points))
    u, v, w = project_groups(groups)(points, view, index)
    seen = (w >= view.near) & (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
    rough = project_groups(groups, np.float32)(points, view, index)
    for exact, found in zip((u, v), rough, strict=False):
        assert (np.abs(found - exact)[seen] < 1e-3 * np.maximum(1, 1 / w[seen])).all()


@each_camera
def test_the_same_picture_as_of_the_decoded_points(view):
    """Interpolated in the grid in place of the image's frame; a pixel differs where a point lies next to its edge."""
    cells, groups = scene()
    x, y, z = (np.concatenate([c.positions() for c in cells]) + 0.5).T * groups.step[0]
    n_points = [len(cell) for cell in cells]
    first_point = np.array([0, n_points[0], n_points[0]])
    colour = np.random.default_rng(5).integers(0, 2**32, sum(n_points), np.uint32)
    decoded = ResidentPoints(x, y, z, colour, first_point[[0, 2]], groups.origin[[0, 2]])
    expected, found = reference_frame(decoded, view, all_of(decoded)), draw(groups, view)
    low = np.uint64(0xFFFFFFFF)
    assert (expected & low != found & low).mean() < 2e-3
    both = (expected & low == found & low) & (expected != FRAMEBUFFER_EMPTY)
    depths = [(frame[both] >> np.uint64(32)).astype(np.uint32).view(np.float32) for frame in (expected, found)]
    np.testing.assert_allclose(depths[1], depths[0], rtol=1e-4)


def test_chosen_cells_in_any_number_of_turns():
    _, groups = scene()
    view = CAMERAS["at an edge"]
    np.testing.assert_array_equal(draw(groups, view, turns=3), draw(groups, view))
    parts = [draw(groups, view, cells=np.array([c])) for c in range(3)]
    np.testing.assert_array_equal(np.minimum.reduce(parts), draw(groups, view))


def test_a_scene_far_from_the_origin():
    _, near = scene()
    _, far = scene(shift=2.0**22)
    away = camera(eye=np.array([1.0, -4.0, 2.0]) + 2.0**22, target=np.array([0.5, 0.5, 0.5]) + 2.0**22)
    home = camera(eye=(1.0, -4.0, 2.0), target=(0.5, 0.5, 0.5))
    np.testing.assert_array_equal(draw(far, away), draw(near, home))


def test_runs_hold_as_many_partitions_as_fit():
    _, groups = scene(n=9000)
    sizes = np.diff(groups.first_kept)
    assert sizes.sum() == len(groups.x)
    assert sizes.max() <= BATCH
    assert MOST_IN_PART <= BATCH
    assert (sizes > 900).sum() >= len(sizes) - 2


def test_grid_points_of_more_bits_than_are_drawn():
    cell = LinearGroupCodec(1.0).group(np.array([[0, 0, 1 << 16]]), 17)[0]
    with pytest.raises(CodecError, match="at most 16 bits"):
        group_cell(cell, np.zeros(3), 1.0, np.zeros(1, np.uint32))


finite = st.floats(-1e3, 1e3, width=32)
around = st.one_of(finite, st.sampled_from([0.0, -1.0, 1.0, 97.0, 211.0]), st.floats(-2, 213, width=32))


@given(ends=st.tuples(*[st.tuples(around, around, finite)] * 2), one_pixel=st.booleans(), projected=st.booleans())
@settings(deadline=None, max_examples=600)
def test_clipping_is_conservative(ends, one_pixel, projected):
    """Of a rejected segment no point is in the image, of an accepted one all are: exactly, and as they are rounded."""
    side = 1 if one_pixel else 5
    x, y, w = np.array(ends, np.float32).T
    if projected:  # positions in the image, so that many segments lie within it or just beside it
        x, y = x * w, y * w
    near, columns, rows, smallest, largest = map(np.float32, (0.5, WIDTH, HEIGHT, 1, side))
    view = View(near, columns, rows, smallest, largest, np.int32(pitch_of(WIDTH)), one_pixel)
    code = np.empty(2, np.uint32)
    outcodes(x, y, w, 2, view, code)
    for number in (np.float64, np.float32):
        t = np.arange(256).astype(number) * number(1 / 256)
        a, b, c = (p[0] + t * (p[1] - p[0]) for p in (x.astype(number), y.astype(number), w.astype(number)))
        with np.errstate(all="ignore"):
            u, v = a / c, b / c
        reach = (side - 1) / 2
        seen = (c >= near) & (u >= -reach) & (u < WIDTH + reach) & (v >= -reach) & (v < HEIGHT + reach)
        if code[0] & code[1] & OUTSIDE:
            assert not seen.any()
        if not (code[0] | code[1]) & NOT_INSIDE:
            assert ((c >= near) & (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)).all()
            assert u.min() > INSIDE_PX / 2


def test_most_segments_need_no_look_at_their_points():
    """Two points decide for all segments but those that cross an edge or have an end within the margin."""
    rng = np.random.default_rng(2)
    w = rng.uniform(1, 2, 4000).astype(np.float32)
    x, y = (rng.uniform(-side, 2 * side, 4000).astype(np.float32) * w for side in (WIDTH, HEIGHT))
    view = View(*map(np.float32, (0.5, WIDTH, HEIGHT, 1, 1)), np.int32(pitch_of(WIDTH)), True)
    code = np.empty(4000, np.uint32)
    outcodes(x, y, w, 4000, view, code)
    inside = (x / w >= 0) & (x / w < WIDTH) & (y / w >= 0) & (y / w < HEIGHT)
    assert ((code & NOT_INSIDE == 0) & ~inside).sum() == 0
    assert ((code & OUTSIDE > 0) & inside).sum() == 0
    assert ((code & NOT_INSIDE == 0) == inside).mean() > 0.99
    assert ((code & OUTSIDE == 0) == inside).mean() > 0.98
