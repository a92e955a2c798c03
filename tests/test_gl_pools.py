"""Pooled points by OpenGL: frames against the NumPy twin of ``pools``, mixed with ranges, in chunks; units of work."""

from dataclasses import replace

import numpy as np
import pytest
from splatpipe.nodes.raster import PointSize, ResidentPoints, gl, gl_pools, gl_resident
from splatpipe.nodes.raster.cpu import CpuRasterizer
from splatpipe.nodes.raster.gl import GlComputeRasterizer, GlPointsRasterizer
from splatpipe.nodes.raster.gl_context import gl_available, is_software
from splatpipe.nodes.raster.gl_pools import PoolUnits
from splatpipe.nodes.raster.pools import PoolCells, pool_cells
from splatpipe.nodes.raster.pools_reference import decoded, project_pools
from splatpipe.nodes.raster.reference import reference_frame
from splatpipe.shared.errors import DeviceError, MessageError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from test_raster_gl import depths
from test_raster_pools import camera, some_cells

AVAILABLE, REASON = gl_available()

SIZES = [PointSize(), PointSize(3), PointSize(1, world=0.08, maximum=9), PointSize(2, maximum=9, adaptive=True)]
VIEW = camera()
N_POINTS = 3000
RANGES = [(2000, 900, 7), (0, 1500, 1)]
BOTH = pytest.mark.parametrize("rasterizer", [GlComputeRasterizer, GlPointsRasterizer])


def with_ranges(pools: PoolCells) -> ResidentPoints:
    """Some thousand points in two blocks, and pooled cells, each with a spacing of its own."""
    rng = np.random.default_rng(3)
    x, y, z = rng.uniform(-0.5, 0.5, (3, N_POINTS)).astype(np.float32)
    pools = pools._replace(world_side=np.linspace(0.03, 0.06, len(pools.step)))
    return ResidentPoints(
        x, y, z, rng.integers(0, 2**32, N_POINTS, np.uint32), np.array([0, 1234]), rng.uniform(-0.3, 0.3, (2, 3)),
        block_spacing=np.array([0.02, 0.05], np.float32), pools=pools,
    )  # fmt: skip


@pytest.fixture(scope="module")
def points() -> ResidentPoints:
    return with_ranges(pool_cells(some_cells()))


def entries_of(points: ResidentPoints, cells: list[int], *ranges: tuple[int, int, int]) -> np.ndarray:
    assert points.pools
    first = points.pools.first_point
    return np.array([*ranges, *((first[c], first[c + 1] - first[c], 0) for c in cells)], RENDER_POINT)


def expected_frame(points: ResidentPoints, cells: list[int], size: PointSize) -> np.ndarray:
    """Of pooled cells, by the NumPy twin."""
    assert points.pools
    chosen = [some_cells()[c] for c in cells]
    alone = replace(decoded(chosen), block_spacing=points.pools.world_side[cells])
    everything = np.array([(0, len(alone), 1)], RENDER_POINT)
    return reference_frame(alone, VIEW, everything, size, project_pools(chosen))


@pytest.mark.parametrize("limit", [1 << 30, 20_000])
def test_units_hold_every_point_with_its_colour(limit, monkeypatch):
    """Read back as the shaders read them, by a loop over bits."""
    monkeypatch.setattr(gl_pools, "UNIT_VERTICES", 50)
    monkeypatch.setattr(gl_pools, "UNIT_LOOSE", 500)
    cells, found = some_cells(), []
    pools = pool_cells(cells)
    chunks = list(PoolUnits(pools, limit).chunks(pools))
    assert (len(chunks) > 1) == (limit == 20_000)
    for units, records, translations, colours, palette in chunks:
        place, moved = (np.stack([words >> k & 255 for k in (0, 8, 16)], axis=1) for words in (records, translations))
        for unit in units:
            at = unit["first"] + np.arange(unit["count"]) * (unit["tag_words"] + 2 if unit["tag_words"] else 1)
            if not unit["tag_words"]:
                index = colours[unit["colour"] + np.arange(unit["count"])]
                found += zip(map(tuple, place[at].tolist()), palette[unit["cell"], index].tolist(), strict=True)
                continue
            for record in at:
                tag = records[record + 2 : record + 2 + unit["tag_words"]].astype("<u4").view(np.uint8)
                t = np.flatnonzero(np.unpackbits(tag, bitorder="little"))
                points = (place[record] + moved[unit["translation"] + t].astype(np.int8)).astype(np.uint8)
                index = colours[records[record + 1] + np.arange(len(t))]
                found += zip(map(tuple, points.tolist()), palette[unit["cell"], index].tolist(), strict=True)
    expected = []
    for cell in cells:
        points = decoded([cell])
        grid = np.floor(np.stack([points.x, points.y, points.z], axis=1) / cell.step).astype(int)
        expected += zip(map(tuple, grid.tolist()), points.colour.tolist(), strict=True)
    assert sorted(found) == sorted(expected)


@pytest.mark.gl
@pytest.mark.skipif(not AVAILABLE, reason=REASON)
class TestOnDevice:
    @pytest.mark.parametrize("size", SIZES, ids=str)
    @pytest.mark.parametrize(("cells", "ranges"), [([0, 1, 2, 3, 4], []), ([3, 1], RANGES)], ids=["pools", "mixed"])
    def test_compute_frames_equal_the_twins_but_for_rounding(self, points, size, cells, ranges):
        expected = expected_frame(points, cells, size)
        with CpuRasterizer(points, VIEW.width, VIEW.height, size) as cpu:
            expected = np.minimum(expected, cpu.draw(VIEW, entries_of(points, [], *ranges)))
        with GlComputeRasterizer(points, VIEW.width, VIEW.height, size) as ours:
            differing = (ours.draw(VIEW, entries_of(points, cells, *ranges)) != expected).sum()
        assert (expected != FRAMEBUFFER_EMPTY).mean() > 0.03
        # llvmpipe rounds every operation as NumPy does; a GPU's division may be off by some units in the last place
        assert differing <= (0 if is_software(ours.device) else 0.002 * expected.size)

    @pytest.mark.parametrize("size", SIZES, ids=str)
    def test_all_pairs_of_vertices_and_translations_give_the_points_of_compute(self, points, size):
        entries = entries_of(points, [4, 0, 1, 3, 2], *RANGES)
        with GlComputeRasterizer(points, VIEW.width, VIEW.height, size) as compute:
            best = compute.draw(VIEW, entries).copy()
        with GlPointsRasterizer(points, VIEW.width, VIEW.height, size) as baseline:
            frame = baseline.draw(VIEW, entries)
        np.testing.assert_array_equal(frame == FRAMEBUFFER_EMPTY, best == FRAMEBUFFER_EMPTY)
        np.testing.assert_allclose(depths(frame), depths(best), rtol=4e-6)  # of its depth test
        assert (frame != best).sum() <= 0.01 * best.size

    @BOTH
    def test_chunks_units_and_batches_do_not_show(self, points, rasterizer, monkeypatch):
        entries = entries_of(points, [4, 0, 1, 3, 2, 3], *RANGES)
        with rasterizer(points, VIEW.width, VIEW.height) as whole:
            expected = whole.draw(VIEW, entries).copy()
        limit = VIEW.width * VIEW.height * 8
        many = with_ranges(pool_cells(some_cells() * 40))  # 200 palettes of a KiB
        monkeypatch.setattr(gl_resident, "storage_limit", lambda _: limit)
        for module, name, value in [
            (gl, "_BATCH_PIECES", 10), (gl, "_PIECE_POINTS", 100),
            (gl_pools, "UNIT_VERTICES", 7), (gl_pools, "UNIT_LOOSE", 50),
        ]:  # fmt: skip
            monkeypatch.setattr(module, name, value)
        with rasterizer(many, VIEW.width, VIEW.height) as split:
            sizes = [[buffer.size for buffer in chunk] for chunk in split._pools.resident.chunks]
            assert len(sizes) > 1
            assert np.max(sizes) <= limit
            for first in (0, 5, 195):
                again = entries_of(many, [first + c for c in (4, 0, 1, 3, 2, 3)], *RANGES)
                np.testing.assert_array_equal(split.draw(VIEW, again), expected)
            loose = many.pools.loose.shape[1]
            for kept in (0, loose // 3, loose):
                sent = split.loose_sent(kept)
                assert sent.n_bytes == 5 * (loose - kept)
                sent.send()
                np.testing.assert_array_equal(split.draw(VIEW, again), expected)

    @BOTH
    def test_what_a_frame_does_not_name_is_not_drawn(self, points, rasterizer):
        with rasterizer(points, VIEW.width, VIEW.height) as ours:
            assert (ours.draw(VIEW, entries_of(points, [])) == FRAMEBUFFER_EMPTY).all()
            both = ours.draw(VIEW, entries_of(points, [0, 2], *RANGES)).copy()
            pools = ours.draw(VIEW, entries_of(points, [0, 2])).copy()
            ranges = ours.draw(VIEW, entries_of(points, [], *RANGES)).copy()
        np.testing.assert_array_equal(depths(both), np.fmin(depths(pools), depths(ranges)))

    @BOTH
    def test_pools_and_no_other_point(self, points, rasterizer):
        nothing = np.empty(0, np.float32)
        alone = replace(points, x=nothing, y=nothing, z=nothing, colour=np.empty(0, np.uint32))
        entries = entries_of(points, [3, 2])
        with rasterizer(points, VIEW.width, VIEW.height) as ours, rasterizer(alone, VIEW.width, VIEW.height) as other:
            np.testing.assert_array_equal(ours.draw(VIEW, entries), other.draw(VIEW, entries))
            assert other.resident_bytes == ours.resident_bytes - 16 * N_POINTS

    @BOTH
    def test_bad_messages_are_refused(self, points, rasterizer):
        first = points.pools.first_point
        with rasterizer(points, VIEW.width, VIEW.height) as ours:
            for offset, n in [(0, 5), (1, first[1]), (0, first[-1] + 1), (2**63, 1)]:
                with pytest.raises(MessageError, match="entry 1: found offset"):
                    ours.draw(VIEW, np.array([(0, 5, 1), (offset, n, 0)], RENDER_POINT))
            assert (ours.draw(VIEW, entries_of(points, [0])) != FRAMEBUFFER_EMPTY).any()

    def test_a_cell_above_the_storage_limit_is_refused(self, points, monkeypatch):
        view = camera(16, 16)
        monkeypatch.setattr(gl_resident, "storage_limit", lambda _: 4 << 10)
        monkeypatch.setattr(gl, "_BATCH_PIECES", 10)
        with pytest.raises(DeviceError, match=r"expected at most 4096 \(storage-block limit\)"):
            GlComputeRasterizer(points, view.width, view.height)

    def test_two_passes_equal_one_pass_of_64_bit_atomics(self, points):
        entries = entries_of(points, [0, 1], *RANGES)
        with GlComputeRasterizer(points, VIEW.width, VIEW.height) as whatever_the_driver_has:
            expected = whatever_the_driver_has.draw(VIEW, entries).copy()
        with GlComputeRasterizer(points, VIEW.width, VIEW.height, two_passes=True) as two_passes:
            np.testing.assert_array_equal(two_passes.draw(VIEW, entries), expected)
