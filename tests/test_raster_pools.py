"""Points drawn from pools: frames equal to the NumPy twin's, points where float64 has them, threads, filled palettes."""

import numpy as np
import pytest
import stream_example as example
from splatpipe.nodes.raster import PointSize, kernels, tags
from splatpipe.nodes.raster.blocks import frustum
from splatpipe.nodes.raster.cpu import CpuRasterizer
from splatpipe.nodes.raster.pools import ROUNDING, PoolCell, draw_pools, pool_cells
from splatpipe.nodes.raster.pools_reference import decoded, project_pools
from splatpipe.nodes.raster.reference import project, reference_frame
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.codecs import streams
from splatpipe.shared.codecs.palette import to_palette
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from splatpipe.shared.points import pack_rgb, unpack_rgb
from test_codec_pools import surface
from test_codec_streams import data_of

SIZES = [PointSize(), PointSize(3), PointSize(1, world=0.08, maximum=9)]


def cell(points, origin=(0.0, 0.0, 0.0), step=1 / 64, seed=0, world_side=0.0, **settings) -> PoolCell:
    data = streams.encode(points, 7, **settings).data
    held = streams.read_pools(data, 7, len(points))
    rng = np.random.default_rng(seed)
    palette = rng.integers(0, 2**32, 200, dtype=np.uint32)
    return PoolCell(held, np.array(origin), step, palette, rng.integers(0, 200, len(held), dtype=np.uint8), world_side)


def some_cells(offset=0.0, world_side=0.0) -> list[PoolCell]:
    """Two pools, many, none at all, one of wide tags, one point, in cubes of unlike sizes."""
    kinds = [
        (surface(64), 1 / 64, {}),
        (surface(80, 1), 1 / 96, {"n_pools": 6}),
        (surface(40, 2), 1 / 32, {"n_pools": 0}),
        (surface(64, 3), 1 / 100, {"n_pools": 1, "width": 128}),
        (np.array([(5, 6, 7)]), 0.1, {}),
    ]
    places = np.random.default_rng(7).uniform(-1, 1, (len(kinds), 3)) + offset
    return [
        cell(points, place, step, seed, world_side, **settings)
        for seed, ((points, step, settings), place) in enumerate(zip(kinds, places, strict=True))
    ]


def camera(width=211, height=97, eye=(1.0, -2.6, 1.0), target=(0.2, 0.2, 0.2), offset=0.0):
    pose = look_at(np.array(eye) + offset, np.array(target) + offset, np.array([0.0, 0.0, 1.0]))
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.9, width=width, height=height, near=0.1)


def draw(cells, view, size=SIZES[0], which=None, framebuffers=1) -> np.ndarray:
    """(height, width) words; cells are shared among framebuffers in turn."""
    pools = pool_cells(cells)
    which = np.arange(len(cells)) if which is None else which
    pitch = kernels.pitch_of(view.width)
    words = np.full((framebuffers, view.height * pitch + 1), FRAMEBUFFER_EMPTY, np.uint64)
    words[:, -1] = 0
    dirty = np.zeros((framebuffers, view.height * pitch // kernels.RUN + 1), np.uint8)
    largest = max(size.pixels, size.maximum) if size.world else size.pixels
    sides = map(np.float32, (view.near, view.width, view.height, size.pixels, largest))
    kernel_view = kernels.View(*sides, np.int32(pitch), (size.pixels, largest) == (1, 1))
    for i in range(framebuffers):
        counter = np.zeros(1, np.int64)
        draw_pools(pools, which[i::framebuffers], frustum(view, 1.5), kernel_view, words[i], dirty[i], 2, counter)
        runs = words[i, :-1].reshape(-1, kernels.RUN)
        assert (dirty[i, :-1] >= (runs != FRAMEBUFFER_EMPTY).any(axis=1)).all()
    return words.min(axis=0)[:-1].reshape(view.height, pitch)[:, : view.width]


def everything(points):
    return np.array([(0, len(points), 1)], RENDER_POINT)


@pytest.mark.parametrize("offset", [0.0, 6.4e6])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_frames_equal_the_twin(size, offset):
    cells = some_cells(offset, size.world)
    view = camera(offset=offset)
    points = decoded(cells)
    expected = reference_frame(points, view, everything(points), size, project_pools(cells))
    found = draw(cells, view, size)
    np.testing.assert_array_equal(found, expected)
    assert (found != FRAMEBUFFER_EMPTY).mean() > 0.05
    assert sum(len(c.points.pools) for c in cells) > 6


def test_points_lie_where_float64_has_them():
    """The bound stated for cells no nearer than they are large; transformed points are as near."""
    cells = some_cells()
    points, index = decoded(cells), np.arange(sum(len(c.points) for c in cells))
    view = camera(1024, 1024)
    u, v, w = project(points, view, index)
    inside = (u >= 0) & (u < 1024) & (v >= 0) & (v < 1024)
    found = project_pools(cells)(points, view, index)
    off = np.hypot(found[0] - u, found[1] - v)[inside]
    assert inside.mean() > 0.5
    assert 0 < off.max() <= ROUNDING * 1024
    assert (np.abs(found[2] - w) / w).max() < 1e-6


def test_frames_are_those_of_the_decoded_points_but_at_edges_of_pixels():
    cells = some_cells()
    points, view = decoded(cells), camera(400, 300)
    with CpuRasterizer(points, 400, 300, threads=1) as rasterizer:
        expected = rasterizer.draw(view, everything(points))
        found = draw(cells, view)
        colours = [frame.astype(np.uint32) for frame in (found, expected)]  # the low half of a word
        assert ((found == FRAMEBUFFER_EMPTY) != (expected == FRAMEBUFFER_EMPTY)).sum() <= 4
        assert np.count_nonzero(colours[0] != colours[1]) <= 8
    assert np.count_nonzero(found != FRAMEBUFFER_EMPTY) > 5000


def test_any_sharing_of_cells_among_threads_gives_the_same_bits():
    cells, view = some_cells(), camera()
    expected = draw(cells, view)
    for n in (2, 5):
        np.testing.assert_array_equal(draw(cells, view, framebuffers=n), expected)
    np.testing.assert_array_equal(draw(cells, view, which=np.array([4, 2, 0, 3, 1])), expected)


def test_only_the_cells_asked_for_are_drawn():
    cells, view = some_cells(), camera()
    np.testing.assert_array_equal(draw(cells, view, which=np.array([1, 3])), draw([cells[1], cells[3]], view))


def test_the_points_of_figure_4_are_drawn_from_its_pool():
    held = streams.read_pools(data_of(example.TABLE_B, example.TAGS_B), 3, 12)
    n = len(held)
    view = camera(512, 512, eye=(2.0, -9.0, 3.0), target=(2.0, 0.5, 0.5))
    words = draw([PoolCell(held, np.zeros(3), 1.0, np.arange(n, dtype=np.uint32), np.arange(n, dtype=np.uint8))], view)
    m = view.pixel_from_world
    u, v, w = ((example.points(example.TABLE_B) + 0.5) @ m[:, :3].T + m[:, 3]).T
    colours = words.astype(np.uint32)
    assert colours[(v / w).astype(int), (u / w).astype(int)].tolist() == list(range(n))
    assert (words != FRAMEBUFFER_EMPTY).sum() == n == 12


def test_few_colours_are_kept_as_they_are():
    words = np.random.default_rng(1).integers(0, 2**32, 256, dtype=np.uint32)
    chosen = words[np.random.default_rng(2).integers(0, 256, 5000)]
    palette, index = to_palette(chosen)
    assert index.dtype == np.uint8
    np.testing.assert_array_equal(palette[index], chosen)


def test_many_colours_become_256_that_are_alike():
    x, y = np.meshgrid(np.arange(128), np.arange(128))
    words = pack_rgb(*(c.astype(np.uint8).ravel() for c in (2 * x, 2 * y, x + y)))
    palette, index = to_palette(words)
    assert len(palette) <= 256
    off = unpack_rgb(palette[index]).astype(int) - unpack_rgb(words)
    assert (off[:, 3] == 0).all()
    assert np.sqrt((off**2).mean()) < 6


@pytest.mark.parametrize(
    "expand",
    [
        tags.expand_tag_plain,
        pytest.param(
            tags.expand_tag_by_bytes, marks=pytest.mark.skipif(not tags.has_avx2(), reason="a processor without AVX2")
        ),
    ],
    ids=["plain", "by bytes"],
)
def test_tags_name_their_sums_in_order(expand):
    """Every byte at every place of a tag, few bits and many: the same sums, one after the other."""
    rng = np.random.default_rng(5)
    by_byte = [byte << shift for byte in range(256) for shift in (0, 8, 16, 24)]
    words = np.array([*by_byte, *rng.integers(0, 2**32, 300), 0xFFFFFFFF], np.uint32)
    vertices, offsets = rng.normal(size=(len(words), 3)).astype(np.float32), rng.normal(size=(3, 64)).astype(np.float32)
    out = np.zeros((3, 32 * len(words) + tags.SLACK), np.float32)
    n, expected = 0, []
    for i, (word, vertex) in enumerate(zip(words, vertices, strict=True)):
        at = 32 * (i % 2)
        n = expand(word, *vertex, *offsets, at, *out, n)
        expected += [vertex + offsets[:, at + bit] for bit in range(32) if int(word) >> bit & 1]
    assert n == len(expected)
    np.testing.assert_array_equal(out[:, :n].T, expected)


def test_cells_beside_the_image_change_nothing():
    """A cell on each side, behind the eye, and one that only just reaches in: as if none were left out."""
    around = [(-40, 0, 0), (40, 0, 0), (0, -40, 0), (0, 40, 0), (0, 0, -40), (0, 0, 40), (0.9, -1.6, 0.4)]
    cells = [cell(surface(64), place, 1 / 64, seed) for seed, place in enumerate(around)]
    for view in (camera(), camera(target=(3.0, 0.2, 0.2)), camera(eye=(0.5, 0.4, 0.5), target=(0.6, 3.0, 0.5))):
        points = decoded(cells)
        expected = reference_frame(points, view, everything(points), SIZES[0], project_pools(cells))
        np.testing.assert_array_equal(draw(cells, view), expected)
