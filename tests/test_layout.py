"""Layouts: every topology on any number of ranks gives the bits of one rank, whatever does not divide."""

from itertools import pairwise

import numpy as np
import pytest
from helpers_octree import clouds
from helpers_octree import scenes as octree_scenes
from helpers_ranks import World
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.cluster.drawn import STAGES
from splatpipe.cluster.job import Job
from splatpipe.cluster.layout import Plan, chains, hybrid, master_slave
from splatpipe.cluster.pipeline import run_layout, run_single
from splatpipe.cluster.topologies import check_world, layout_of, ranks_to_start
from splatpipe.nodes.culling import CullingNode
from splatpipe.nodes.sampling import SamplingNode
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import PipelineSection, load_config
from splatpipe.shared.errors import ConfigError, InputError
from splatpipe.shared.messages import points_of
from splatpipe.shared.octree_parts import Subtrees, balanced_borders, cells_of_range, part_of
from splatpipe.shared.synth import CityScan
from splatpipe.shared.windows import Window, tiles

TOPOLOGIES = ["pipelined", "master-slave", "hybrid", "sort-first", "sort-last", "sort-first-only", "sort-last-only"]
SIZES = [1, 2, 3, 4, 7]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A small city of a prime number of points in both orders."""
    folder = tmp_path_factory.mktemp("scenes")
    for order in ("layered", "depth-first"):
        build_scene(
            [CityScan(n_points=20_011)], folder / order, settings=BuildSettings(point_order=order, points_per_cell=300)
        )
    build_scene([CityScan(n_points=101)], folder / "one", settings=BuildSettings(points_per_cell=1000))
    return folder


@pytest.fixture
def config(scenes, tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(
        f'[scene]\npath = "{scenes}/layered"\n[camera]\nwidth = 163\nheight = 91\n'
        '[render]\npoint_size_px = 2\nrasterizer = "cpu"\nthreads = 1\n[output]\nframes = 3\n'
    )
    return path


def drawn(config, out, topology, ranks, *sets):
    """Files of the pictures, and the record of the run."""
    sets = [*sets, f"output.directory={out}", f"pipeline.topology={topology}", f"pipeline.ranks={ranks}"]
    out.mkdir()

    def job():
        return Job(load_config(config, sets))

    if topology == "single":
        record = run_single(job(), lambda *_: None)
    else:
        layout = layout_of(job().config.pipeline, ranks)
        record = World(ranks).run(lambda transport: run_layout(job(), layout, transport, lambda *_: None))[0]
    return {path.name: path.read_bytes() for path in out.iterdir()}, record


# --- whole runs --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("topology", TOPOLOGIES)
@pytest.mark.parametrize("order", ["layered", "depth-first"])
def test_every_topology_on_any_number_of_ranks_draws_the_bits_of_one_rank(config, scenes, tmp_path, topology, order):
    sets = [
        f"scene.path={scenes / order}",
        "render.colour=elevation",
        "camera.radius=150",
        "sampling.pixel_threshold=9",
    ]
    alone, single = drawn(config, tmp_path / "single", "single", 1, *sets)
    assert len(alone) == 3
    for n in SIZES[: 3 if topology == "pipelined" else None]:
        together, run = drawn(config, tmp_path / str(n), topology, n, *sets)
        assert together == alone, n
        assert len(run["ranks"]) == n
        assert set(run["stages"]) >= set(STAGES[:3])
        points = run["per_frame"]["points"]
        if "first" in topology and n > 3:
            assert sum(points) >= sum(single["per_frame"]["points"]), "cells on a border are drawn in both tiles"
        elif "first" not in topology:
            assert points == single["per_frame"]["points"]


@pytest.mark.parametrize(
    "sets",
    [
        ["render.positions=compact", "render.point_size_world=2.0"],
        ["render.point_size_adaptive=true", "sampling.pixel_threshold=0"],
        ["camera.view=stereo", "camera.stereo_base=2", "render.edl_strength=0.4"],
        ["render.supersampling=2", "output.depth=true", "output.normals=true"],
        ["filter.classes=[2, 6]", "render.colour=classification", "culling.backface=true"],
    ],
)
@pytest.mark.parametrize(
    ("topology", "n", "more"),
    [
        ("sort-first", 5, []),
        ("sort-last", 5, []),
        ("hybrid", 7, ["pipeline.culling_ranks=1", "pipeline.sampling_ranks=2"]),
        ("hybrid", 7, ["pipeline.culling_ranks=3", "pipeline.sampling_ranks=2", "pipeline.render_split=shares"]),
    ],
)
def test_what_else_a_run_asks_for_is_the_same_too(config, tmp_path, sets, topology, n, more):
    alone, _ = drawn(config, tmp_path / "single", "single", 1, *sets)
    assert drawn(config, tmp_path / "many", topology, n, *sets, *more)[0] == alone


@pytest.mark.parametrize("topology", TOPOLOGIES)
def test_more_ranks_than_cells_or_rows(config, scenes, tmp_path, topology):
    sets = [f"scene.path={scenes}/one", "camera.width=3", "camera.height=2", "output.frames=2"]
    alone, _ = drawn(config, tmp_path / "single", "single", 1, *sets)
    n = 3 if topology == "pipelined" else 9
    assert drawn(config, tmp_path / "many", topology, n, *sets)[0] == alone


def test_frames_that_are_left_out_are_not_drawn(config, tmp_path):
    alone, _ = drawn(config, tmp_path / "single", "single", 1)
    out = tmp_path / "some"
    sets = [f"output.directory={out}", "pipeline.topology=sort-last"]

    def work(transport):
        job = Job(load_config(config, sets))
        job.frames = [1]
        return run_layout(job, layout_of(job.config.pipeline, 4), transport, lambda *_: None)

    out.mkdir()
    record = World(4).run(work)[0]
    assert {path.name: path.read_bytes() for path in out.iterdir()} == {"frame_0001.png": alone["frame_0001.png"]}
    assert len(record["per_frame"]["points"]) == 1


# --- layouts -----------------------------------------------------------------------------------------------------


@given(st.sampled_from([t for t in TOPOLOGIES if t != "pipelined"]), st.integers(1, 40))
def test_every_rank_has_work_in_one_lane_and_at_most_one_part_of_a_stage(topology, size):
    layout = layout_of(PipelineSection(topology=topology), size)
    assert layout.workers == tuple(range(size))
    for stage in STAGES[:3]:
        ranks = [rank for lane in layout.lanes for rank in getattr(lane, stage)]
        assert len(set(ranks)) == len(ranks) > 0
    assert all(lane.culling and lane.sampling and lane.render for lane in layout.lanes)
    assert sum(len(layout.renders_of(i)) for i in range(len(layout.lanes))) == len(layout.render)
    assert len({layout.role_of(rank) for rank in range(size)}) == size, "roles tell ranks apart"


def test_layouts_are_those_of_the_thesis():
    assert master_slave(4).lanes[0].sampling == (1, 2, 3)
    assert master_slave(4).display == 0
    (lane,) = hybrid(7, 2, 2, 3, "tiles").lanes
    assert (lane.culling, lane.sampling, lane.render) == ((0, 1), (2, 3), (4, 5, 6))
    assert [len(getattr(hybrid(7, 0, 0, 0, "tiles").lanes[0], s)) for s in STAGES[:3]] == [2, 2, 3]
    assert [len({*lane.culling, *lane.sampling, *lane.render}) for lane in chains(7, 3)] == [2, 2, 3]
    assert layout_of(PipelineSection(topology="pipelined"), 7).workers == (0, 1, 2)


@given(st.integers(0, 9), st.integers(0, 9), st.integers(0, 9), st.integers(3, 40))
def test_hybrid_takes_the_ranks_that_are_asked_for(k, m, n, size):
    if sum(max(c, 1) for c in (k, m, n)) > size or (all((k, m, n)) and k + m + n != size):
        return
    (lane,) = hybrid(size, k, m, n, "tiles").lanes
    found = [len(ranks) for ranks in (lane.culling, lane.sampling, lane.render)]
    assert sum(found) == size
    assert all(f == c or c == 0 for f, c in zip(found, (k, m, n), strict=True))


def test_a_plan_survives_its_note():
    plan = Plan(3, ((0, 4, 9),), ((0, 9),), (Window(0, 0, 5, 7), Window(5, 0, 9, 7)))
    assert Plan.from_note(plan.to_note()) == plan


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        (["pipeline.topology=single", "pipeline.ranks=2"], "'single' has one"),
        (["pipeline.ranks=4"], "'auto' has three at most"),
        (["pipeline.topology=sort-first", "pipeline.render_ranks=2"], "render_ranks = 2: .*expected 'hybrid'"),
        (["pipeline.topology=sort-first", "render.style=splats"], "render.style = 'splats'"),
        (["pipeline.topology=hybrid", "sampling.pools=bytes"], "sampling.pools = 'bytes'"),
        (["pipeline.topology=master-slave", "scene.delivery=messages"], "every rank opens the scene"),
        (["pipeline.ranks=2", "scene.delivery=messages"], "takes three"),
        (
            [*(f"pipeline.{s}_ranks=2" for s in STAGES[:3]), "pipeline.topology=hybrid", "pipeline.ranks=5"],
            r"expected 2 \+ 2 \+ 2 = 6",
        ),
    ],
)
def test_what_does_not_fit_is_refused(config, sets, said):
    with pytest.raises(ConfigError, match=said):
        Job(load_config(config, sets))


def test_ranks_that_are_started_and_those_that_are_found():
    of = PipelineSection(topology="hybrid", culling_ranks=2, render_ranks=3)
    assert ranks_to_start(of, "hybrid") >= 6
    with pytest.raises(InputError, match="found 5 ranks, expected at least 6"):
        check_world(of, 5)
    check_world(of, 9)
    with pytest.raises(InputError, match="found 9 ranks, expected 4: mpirun -n 4"):
        check_world(PipelineSection(topology="sort-last", ranks=4), 9)
    check_world(PipelineSection(topology="pipelined"), 9)
    assert ranks_to_start(PipelineSection(), "pipelined") == 3


# --- parts of an octree ------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(octree_scenes(), st.integers(1, 6), st.integers(1, 9))
def test_parts_decide_what_the_whole_does(scene, n, at_least):
    cloud, camera = scene
    octree = cloud.octree
    bits = CullingNode(octree, backface=False).process(camera)
    whole = SamplingNode(octree, pixel_threshold=8).process(camera, bits)
    visible = bits.unpack()
    subtrees = Subtrees.of(octree, at_least)
    assert (subtrees.cells > 0).all()
    assert len(subtrees) >= min(at_least, int(octree.is_leaf.sum()))
    borders = balanced_borders(subtrees.cells, n)
    drawn, answered = [], np.zeros(len(octree), int)
    for i in range(n):
        cells, part, own = subtrees.part(*borders[i : i + 2])
        answered[cells] += own
        of_part = CullingNode(part, backface=False).process(camera)
        assert np.array_equal(of_part.unpack(), visible[cells])
        drawn.append(SamplingNode(part, pixel_threshold=8, own=own).process(camera, of_part).entries)
    assert (answered == 1).all(), "each cell has one part that answers for it"
    assert points_named(np.concatenate(drawn)) == points_named(whole.entries)


@settings(max_examples=40, deadline=None)
@given(clouds(), st.data())
def test_the_part_of_a_range_holds_its_cells_and_their_ancestors(cloud, data):
    octree = cloud.octree
    n = int((octree.first_point + octree.n_points).max())
    first = data.draw(st.integers(0, n))
    stop = data.draw(st.integers(first, n))
    keep = cells_of_range(octree, first, stop)
    part = part_of(octree, keep)
    assert keep[0]
    inside = (octree.first_point[octree.owners] < stop) & (
        octree.first_point[octree.owners] + octree.n_points[octree.owners] > first
    )
    assert keep[octree.owners[inside]].all()
    assert (np.flatnonzero(keep)[part.parent[1:]] == octree.parent[keep][1:]).all()
    assert np.array_equal(part.is_leaf, octree.is_leaf[keep]), "who lost its children is no leaf"
    for cell in range(len(part)):
        children = np.flatnonzero(part.parent == cell)
        assert part.n_children[cell] == len(children)
        if len(children):
            assert part.first_child[cell] == children[0]


@settings(max_examples=40, deadline=None)
@given(octree_scenes(), st.integers(1, 7))
def test_windows_see_together_what_the_picture_sees(scene, n):
    cloud, camera = scene
    node = SamplingNode(cloud.octree, pixel_threshold=8)
    culling = CullingNode(cloud.octree, backface=False)
    bits = culling.process(camera)
    whole = points_named(node.process(camera, bits).entries)
    windows = tiles(camera.width, camera.height, [1.0] * n)
    seen = [points_named(part.entries) for part in node.within(camera, windows)]
    assert set().union(*seen) == whole
    for window, points in zip(windows, seen, strict=True):
        alone = SamplingNode(cloud.octree, pixel_threshold=8).process(camera, culling.process(camera, window))
        # behind the eye a window's planes may leave what one of the picture's rejects
        assert points_named(alone.entries) & whole == points, "culled to a window or split afterwards"


def points_named(entries) -> set[int]:
    named = [p for o, n, s in entries.tolist() for p in range(o, o + n, s)]
    assert len(set(named)) == len(named) == points_of(entries).sum()
    return set(named)


# --- windows -----------------------------------------------------------------------------------------------------


@given(st.integers(1, 60), st.integers(1, 60), st.lists(st.floats(0, 1e6), min_size=1, max_size=20))
def test_tiles_fill_the_picture_without_overlap(width, height, weights):
    seen = np.zeros((height, width), int)
    found = tiles(width, height, weights)
    for window in found:
        window.of(seen)[:] += 1
        assert window.n_pixels == window.of(seen).size
    assert len(found) == len(weights)
    assert (seen == 1).all()


@given(st.lists(st.floats(0, 1e6), max_size=30), st.integers(1, 9))
def test_borders_are_as_even_as_whole_weights_allow(weights, n):
    borders = balanced_borders(np.array(weights), n)
    assert (borders[0], borders[-1], len(borders)) == (0, len(weights), n + 1)
    assert (np.diff(borders) >= 0).all()
    sums = [sum(weights[a:b]) for a, b in pairwise(borders)]
    assert max(sums, default=0) <= sum(weights) / n + 2 * max(weights, default=0) + 1e-6
