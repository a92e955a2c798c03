"""Sampling: equal to a plain recursive twin, the cut property, merged entries that draw the same points, and cells drawn
from their pooled form."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers_octree import build_cloud, leaf_of_points, scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.nodes import sampling
from splatpipe.nodes.culling import CullingNode
from splatpipe.nodes.pooled_entries import PALETTE_BYTES, PooledForms
from splatpipe.nodes.sampling import POOLED_POINT_COST, SHARES_AN_OCTAVE, SamplingNode
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.errors import ConfigError, MessageError
from splatpipe.shared.messages import VisibilityBits, decode_render_points, encode

EXAMPLES = settings(max_examples=200, derandomize=True, deadline=None)
THRESHOLDS = st.sampled_from([0.0, 0.7, 3.0, 16.0, 200.0, 1e9])
DENSITY = 1.7  # points a pixel


def projected_pixels(octree, camera, cell):
    """Square of the cell's edge in pixels at the point of its cube nearest to the eye."""
    half = octree.half_edges[cell]
    nearest = np.clip(camera.eye, octree.centers[cell] - half, octree.centers[cell] + half)
    distance = max(np.linalg.norm(nearest - camera.eye), camera.near)
    return (2 * half * camera.focal_px / distance) ** 2


def cut_twin(octree, camera, visible, threshold, share=1.0):
    """{cell: points to draw}, by recursion from the root; ``share`` of the points a pixel."""
    drawn = {}
    stratified = octree.area is not None

    def needed(cell, n_pixels):
        if stratified:
            return max(1, math.floor(DENSITY * float(octree.area[cell]) * n_pixels))
        return max(1, math.floor(n_pixels * math.log(n_pixels)))

    def visit(cell):
        if not visible[cell]:
            return
        n_pixels = share * projected_pixels(octree, camera, cell)
        small = n_pixels <= threshold**2
        n_points = int(octree.n_points[cell])
        if octree.is_leaf[cell]:
            everything = threshold == 0 or not (small or stratified)
            drawn[cell] = n_points if everything else min(needed(cell, n_pixels), n_points)
        elif small and n_points >= min(needed(cell, n_pixels), octree.n_below[cell]):
            drawn[cell] = min(needed(cell, n_pixels), n_points)
        else:
            for child in range(octree.first_child[cell], octree.first_child[cell] + octree.n_children[cell]):
                visit(child)

    visit(0)
    return drawn


def points_of(octree, cell, n):
    """Stored indices that a cell of the cut draws."""
    first, n_points = octree.first_point[cell], octree.n_points[cell]
    if octree.point_order == "layered":
        return np.arange(first, first + n)
    return np.arange(first, first + n_points, n_points // n)


def expand(entries):
    """Stored indices that entries draw, in order."""
    ranges = [np.arange(e["offset"], e["offset"] + e["range"], e["stride"], dtype=np.int64) for e in entries]
    return np.concatenate([np.empty(0, np.int64), *ranges])


def with_areas(octree):
    """The octree as if the sets of a layered one stood in stratified order."""
    area = np.random.default_rng(len(octree)).uniform(0.01, 4, len(octree)).astype(np.float32)
    return replace(octree, area=area) if octree.point_order == "layered" else octree


@EXAMPLES
@given(scenes(), THRESHOLDS, st.booleans(), st.booleans())
def test_draws_exactly_the_points_of_its_twin(scene, threshold, stratified, whole):
    cloud, camera = scene
    octree = with_areas(cloud.octree) if stratified else cloud.octree
    bits = CullingNode(octree, backface=True).process(camera)
    node = SamplingNode(octree, pixel_threshold=threshold, points_per_pixel=DENSITY, whole_sets=whole)
    message = node.process(camera, bits)
    drawn = cut_twin(octree, camera, bits.unpack(), threshold)
    if whole:
        drawn = {cell: int(octree.n_points[cell]) for cell in drawn}
        assert (message.entries["stride"] == 1).all()
    unmerged = [points_of(octree, cell, n) for cell, n in drawn.items()]
    np.testing.assert_array_equal(expand(message.entries), np.sort(np.concatenate([np.empty(0, int), *unmerged])))
    assert message.frame == camera.frame
    assert message.n_points == sum(map(len, unmerged))


@EXAMPLES
@given(scenes(), THRESHOLDS, st.booleans())
def test_every_visible_leaf_has_exactly_one_drawn_ancestor_or_self(scene, threshold, stratified):
    cloud, camera = scene
    octree = with_areas(cloud.octree) if stratified else cloud.octree
    bits = CullingNode(octree, backface=False).process(camera)
    visible = bits.unpack()
    node = SamplingNode(octree, pixel_threshold=threshold, points_per_pixel=DENSITY)
    drawn_points = expand(node.process(camera, bits).entries)

    # Who owns a drawn point is read from the entries alone: the cut cell is the one cell of the twin's cut
    # whose range holds it; layered ranges are disjoint, depth-first ones are nested but a cut takes one of
    # each branch.
    drawn = cut_twin(octree, camera, visible, threshold)
    for cell, n in drawn.items():
        assert visible[cell]
        first, n_points = octree.first_point[cell], octree.n_points[cell]
        mine = drawn_points[(drawn_points >= first) & (drawn_points < first + n_points)]
        assert n <= len(np.unique(mine)) == len(mine) < 2 * n
    for leaf in np.flatnonzero(octree.is_leaf & (visible == 1)):
        line = [leaf]
        while octree.parent[line[-1]] >= 0:
            line.append(octree.parent[line[-1]])
        assert sum(cell in drawn for cell in line) == 1


@EXAMPLES
@given(scenes())
def test_threshold_zero_draws_every_point_of_every_visible_leaf(scene):
    cloud, camera = scene
    bits = CullingNode(cloud.octree, backface=False).process(camera)
    message = SamplingNode(cloud.octree, pixel_threshold=0.0).process(camera, bits)
    leaf = leaf_of_points(cloud)
    expected = np.flatnonzero((leaf >= 0) & (bits.unpack()[leaf] == 1))
    np.testing.assert_array_equal(expand(message.entries), expected)


@EXAMPLES
@given(scenes(), THRESHOLDS)
def test_no_two_entries_could_be_one(scene, threshold):
    cloud, camera = scene
    bits = CullingNode(cloud.octree, backface=False).process(camera)
    entries = SamplingNode(cloud.octree, pixel_threshold=threshold).process(camera, bits).entries
    offset, end = entries["offset"].astype(np.int64), (entries["offset"] + entries["range"]).astype(np.int64)
    single = entries["stride"] == 1
    assert (end[:-1] <= offset[1:]).all()
    assert not (single[:-1] & single[1:] & (end[:-1] == offset[1:])).any()


@settings(EXAMPLES, max_examples=60)
@given(scenes(), THRESHOLDS, st.integers(1, 40))
def test_ranges_beyond_an_entry_are_split_and_draw_the_same(scene, threshold, max_range):
    cloud, camera = scene
    bits = CullingNode(cloud.octree, backface=False).process(camera)
    whole = SamplingNode(cloud.octree, pixel_threshold=threshold).process(camera, bits)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampling, "MAX_RANGE", max(max_range, int(whole.entries["stride"].max(initial=1))))
        split = SamplingNode(cloud.octree, pixel_threshold=threshold).process(camera, bits)
        assert split.entries["range"].max(initial=0) <= sampling.MAX_RANGE
    np.testing.assert_array_equal(expand(split.entries), expand(whole.entries))


@pytest.fixture(scope="module")
def far_camera():
    """Sees the unit cube 15 pixels across, so that N ln N = 1215 points cover it."""
    pose = look_at([1000.0, 0.5, 0.5], [0.0, 0.5, 0.5], np.array([0.0, 0.0, 1.0]))
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.02, width=300, height=300, near=0.1)


@pytest.mark.parametrize("order", ["layered", "depth-first"])
def test_a_far_view_draws_few_points_spread_over_the_whole_cloud(far_camera, order):
    positions = np.random.default_rng(7).uniform(size=(4000, 3))
    cloud = build_cloud(positions, positions, point_order=order, set_points=2000)
    bits = CullingNode(cloud.octree, backface=False).process(far_camera)
    message = SamplingNode(cloud.octree, pixel_threshold=20).process(far_camera, bits)
    picked = cloud.positions[expand(message.entries)]
    assert 1000 <= len(picked) < 2400
    octants = np.unique((picked > 0.5) @ [1, 2, 4], return_counts=True)[1]
    assert len(octants) == 8
    assert octants.min() > 0.6 * octants.mean()


def test_a_strided_range_keeps_step_over_a_split(far_camera, monkeypatch):
    positions = np.random.default_rng(7).uniform(size=(4000, 3))
    cloud = build_cloud(positions, positions, point_order="depth-first")
    bits = CullingNode(cloud.octree, backface=False).process(far_camera)
    whole = SamplingNode(cloud.octree, pixel_threshold=20).process(far_camera, bits)
    assert whole.entries.tolist() == [(0, 4000, 3)]
    monkeypatch.setattr(sampling, "MAX_RANGE", 1000)
    split = SamplingNode(cloud.octree, pixel_threshold=20).process(far_camera, bits)
    assert len(split.entries) == 5
    np.testing.assert_array_equal(expand(split.entries), expand(whole.entries))


@pytest.fixture
def small():
    positions = np.random.default_rng(7).uniform(size=(50, 3))
    pose = look_at([3.0, 0.5, 0.5], [0.0, 0.5, 0.5], np.array([0.0, 0.0, 1.0]))
    camera = perspective_camera(frame=4, world_from_camera=pose, fov_y_rad=1.0, width=64, height=64, near=0.1)
    return build_cloud(positions, positions, point_order="layered").octree, camera


@pytest.mark.parametrize("threshold", [-1.0, math.nan, math.inf])
def test_a_threshold_out_of_range_is_refused(small, threshold):
    with pytest.raises(ConfigError, match="pixel_threshold"):
        SamplingNode(small[0], pixel_threshold=threshold)


@pytest.mark.parametrize("density", [0.0, -1.0, math.nan, math.inf])
def test_points_per_pixel_out_of_range_are_refused(small, density):
    with pytest.raises(ConfigError, match="points_per_pixel"):
        SamplingNode(small[0], pixel_threshold=1.0, points_per_pixel=density)


def test_more_pixels_than_an_integer_holds(small):
    octree, camera = small
    bits = CullingNode(octree, backface=False).process(camera)
    inside = replace(camera, eye=octree.centers[0], near=1e-12)
    message = SamplingNode(octree, pixel_threshold=1e300).process(inside, bits)
    assert message.n_points == sum(cut_twin(octree, inside, bits.unpack(), 1e150).values()) == 50


def test_bits_of_another_frame_or_octree_are_refused(small):
    octree, camera = small
    node = SamplingNode(octree, pixel_threshold=1.0)
    for frame, n_cells in [(5, len(octree)), (4, len(octree) + 8)]:
        with pytest.raises(MessageError, match=f"frame {frame} of {n_cells} cells"):
            node.process(camera, VisibilityBits.pack(frame, np.ones(n_cells, np.uint8)))


def test_messages_do_not_share_memory_with_later_frames(small):
    octree, camera = small
    node = SamplingNode(octree, pixel_threshold=0.0)
    bits = CullingNode(octree, backface=False).process(camera)
    first = node.process(camera, bits)
    kept = first.entries.copy()
    node.process(camera, VisibilityBits.pack(4, np.zeros(len(octree), np.uint8)))
    np.testing.assert_array_equal(first.entries, kept)


# --- pooled forms --------------------------------------------------------------------------------------------------


@st.composite
def pooled_scenes(draw):
    """A scene some of whose cells have a pooled form; a camera; bytes of a point, among which forms may be worth it."""
    cloud, camera = draw(scenes())
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    octree = with_areas(cloud.octree) if draw(st.booleans()) else cloud.octree
    has = octree.is_leaf if octree.point_order == "depth-first" else octree.n_points > 0
    has = has & (rng.random(len(octree)) < draw(st.sampled_from([0.3, 0.9, 1.0])))
    share = draw(st.sampled_from([0.05, 0.3, 1.0]))
    points = np.where(has, np.maximum(1, (share * rng.random(len(octree)) * octree.n_points).astype(int)), 0)
    pooled = replace(
        octree,
        pool_points=points.astype(np.uint32),
        pool_bytes=(points * rng.integers(1, 4, len(octree))).astype(np.uint32),
        pool_bits=draw(st.sampled_from([3, 7, 8])),
    )
    return pooled, camera, draw(st.sampled_from([300, 3000]))


def pooled_of_cut(octree, camera, cut, pools, point_bytes):
    """The cells of a cut that are drawn from their pooled form, plainly."""
    chosen = set()
    for cell, n in cut.items():
        points, n_bytes = int(octree.pool_points[cell]), int(octree.pool_bytes[cell])
        small = projected_pixels(octree, camera, cell) <= (2**octree.pool_bits) ** 2 / 2
        n_range = len(points_of(octree, cell, n))
        if pools == "bytes":
            less = n_bytes + points + PALETTE_BYTES < point_bytes * n_range
        else:
            less = POOLED_POINT_COST * points < n_range
        if points and small and less:
            chosen.add(cell)
    return chosen


def pooled_named(octree, entries):
    """The cells whose pooled points entries name, one by one, from the numbering as the message states it."""
    cells = sorted(np.flatnonzero(octree.pool_points), key=lambda cell: octree.first_point[cell])
    number = np.repeat(cells, octree.pool_points[cells])
    named = [number[e["offset"] : e["offset"] + e["range"]] for e in entries if e["stride"] == 0]
    named = np.concatenate([np.empty(0, int), *named])
    for cell in set(named.tolist()):
        assert (named == cell).sum() == octree.pool_points[cell], "whole cells, once"
    return set(named.tolist())


@EXAMPLES
@given(pooled_scenes(), THRESHOLDS, st.sampled_from(["bytes", "time"]))
def test_a_cell_of_the_cut_is_drawn_in_exactly_one_form(scene, threshold, pools):
    octree, camera, point_bytes = scene
    bits = CullingNode(octree, backface=False).process(camera)
    settings_ = {"pixel_threshold": threshold, "points_per_pixel": DENSITY}
    node = SamplingNode(octree, **settings_, pools=pools, point_bytes=point_bytes)
    entries = node.process(camera, bits).entries
    ranged, pooled = entries[entries["stride"] > 0], entries[entries["stride"] == 0]
    assert (np.diff(entries["stride"] == 0) >= 0).all(), "ranges first"

    cut = cut_twin(octree, camera, bits.unpack(), threshold)
    drawn_pooled = pooled_named(octree, pooled)
    assert drawn_pooled == pooled_of_cut(octree, camera, cut, pools, point_bytes)
    expected = [points_of(octree, cell, n) for cell, n in cut.items() if cell not in drawn_pooled]
    np.testing.assert_array_equal(expand(ranged), np.sort(np.concatenate([np.empty(0, int), *expected])))
    for leaf in np.flatnonzero(octree.is_leaf & (bits.unpack() == 1)):
        line = [leaf]
        while octree.parent[line[-1]] >= 0:
            line.append(octree.parent[line[-1]])
        assert sum((cell in drawn_pooled) + (cell in cut.keys() - drawn_pooled) for cell in line) == 1

    ends = pooled["offset"] + pooled["range"]
    assert (ends[:-1] < pooled["offset"][1:]).all(), "adjacent cells are one entry"
    off = SamplingNode(octree, **settings_).process(camera, bits).entries
    assert (off["stride"] > 0).all()
    assert not drawn_pooled or PooledForms.of(octree).read_bytes(off, point_bytes) > 0


@EXAMPLES
@given(pooled_scenes(), THRESHOLDS)
def test_a_message_with_pooled_points_comes_back_and_is_counted(scene, threshold):
    octree, camera, point_bytes = scene
    bits = CullingNode(octree, backface=False).process(camera)
    node = SamplingNode(octree, pixel_threshold=threshold, pools="bytes", point_bytes=point_bytes)
    message = node.process(camera, bits)
    back = decode_render_points(message.frame, bytes(encode(message)[1]))
    np.testing.assert_array_equal(back.entries, message.entries)
    cells = list(pooled_named(octree, message.entries))
    assert back.n_pooled == octree.pool_points[cells].sum()
    assert back.n_points == back.n_pooled + len(expand(message.entries[message.entries["stride"] > 0]))

    forms = PooledForms.of(octree)
    assert set(forms.cell[forms.drawn(message.entries)].tolist()) == set(cells)
    plain = SamplingNode(octree, pixel_threshold=threshold).process(camera, bits)
    assert forms.read_bytes(message.entries, point_bytes) <= plain.n_points * point_bytes, (
        "never more bytes than without"
    )
    stand_in = expand(forms.as_ranges(octree, message.entries))
    assert len(stand_in) == message.n_points
    for cell in cells:
        first = octree.first_point[cell]
        assert ((stand_in >= first) & (stand_in < first + octree.n_points[cell])).sum() == octree.pool_points[cell]


def test_pools_need_an_octree_that_has_them(small):
    with pytest.raises(ConfigError, match=r"sampling.pools = 'bytes': the octree was loaded without pooled forms"):
        SamplingNode(small[0], pixel_threshold=1.0, pools="bytes")


# --- a budget of points ------------------------------------------------------------------------------------------


def thinned_twin(octree, camera, visible, threshold, share):
    """Points that the cut draws at this share of the points a pixel."""
    drawn = cut_twin(octree, camera, visible, threshold, share)
    return sum(len(points_of(octree, cell, n)) for cell, n in drawn.items())


@EXAMPLES
@given(scenes(), THRESHOLDS.filter(bool), st.booleans(), st.integers(1, 400))
def test_a_budget_is_kept_by_a_share_whose_larger_neighbour_does_not(scene, threshold, stratified, budget):
    cloud, camera = scene
    octree = with_areas(cloud.octree) if stratified else cloud.octree
    bits = CullingNode(octree, backface=False).process(camera)
    free = SamplingNode(octree, pixel_threshold=threshold, points_per_pixel=DENSITY)
    node = SamplingNode(octree, pixel_threshold=threshold, points_per_pixel=DENSITY, point_budget=budget)
    unlimited, limited = free.process(camera, bits), node.process(camera, bits)
    assert limited.n_points <= budget
    np.testing.assert_array_equal(limited.entries, node.process(camera, bits).entries)
    if unlimited.n_points <= budget:
        np.testing.assert_array_equal(limited.entries, unlimited.entries)
        return

    def count(step):
        return thinned_twin(octree, camera, bits.unpack(), threshold, 2.0 ** (-step / SHARES_AN_OCTAVE))

    assert free.step == 0 < node.step
    assert limited.n_points == count(node.step)
    assert count(node.step - 1) > budget, "a larger share is above the budget"


def test_a_camera_decides_alone_whatever_was_drawn_before():
    positions = np.random.default_rng(5).uniform(0, 1, (3000, 3))
    octree = with_areas(build_cloud(positions, positions, point_order="layered").octree)
    node = SamplingNode(octree, pixel_threshold=30, points_per_pixel=8.0, point_budget=500)
    culling = CullingNode(octree, backface=False)
    poses = [look_at([x, 0.5, 0.5], [0.0, 0.5, 0.5], np.array([0.0, 0.0, 1.0])) for x in (1.5, 3.0, 9.0, 1.5)]
    cameras = [
        perspective_camera(frame=4, world_from_camera=pose, fov_y_rad=1.0, width=64, height=64, near=0.1)
        for pose in poses
    ]
    drawn = [node.process(camera, culling.process(camera)).entries for camera in cameras]
    np.testing.assert_array_equal(drawn[0], drawn[3])


@pytest.mark.parametrize(
    ("options", "found"),
    [({"whole_sets": True}, "sets drawn whole"), ({"pixel_threshold": 0.0}, "threshold 0")],
)
def test_a_budget_of_points_that_cannot_be_thinned_out_is_refused(options, found):
    positions = np.random.default_rng(1).uniform(0, 1, (300, 3))
    octree = build_cloud(positions, positions, point_order="layered").octree
    with pytest.raises(ConfigError, match=f"sampling.point_budget = 9: found {found}"):
        SamplingNode(octree, **{"pixel_threshold": 1.0, "point_budget": 9} | options)
