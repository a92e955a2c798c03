"""Scenes stored as linear groups, drawn from them: which points, where, in which colours; whole runs; refusals."""

import itertools
import json
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from build_sources import ArraySource, columns_for
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from splatpipe.cluster.error.config import load_error_config
from splatpipe.cluster.error.scene import SweptScene
from splatpipe.cluster.job import Job
from splatpipe.cluster.launch import mpi_available
from splatpipe.cluster.plan.ablation import same, trials
from splatpipe.cluster.plan.needs import parts
from splatpipe.cluster.plan.part import ADAPTIVE, CHECKSUMS, COLOUR, SPLAT_LOOP, Part
from splatpipe.cluster.plan.topology import Decision
from splatpipe.cluster.plan.workload import Workload
from splatpipe.cluster.progress import FrameProgress
from splatpipe.nodes.culling import CullingNode
from splatpipe.nodes.grouped_cells import load_groups
from splatpipe.nodes.raster import PointSize, ResidentPoints
from splatpipe.nodes.raster.choose import make_rasterizer
from splatpipe.nodes.raster.group_raster import CpuGroupRasterizer, ResidentGroups
from splatpipe.nodes.raster.reference import reference_frame
from splatpipe.nodes.render import Wanted, load_points
from splatpipe.nodes.sampling import SamplingNode
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.colour import Colouring
from splatpipe.shared.config import load_config
from splatpipe.shared.errors import ConfigError, InputError, MessageError, StoreError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from splatpipe.shared.scene_info import POINT_ORDERS
from splatpipe.shared.store import Scene

N_POINTS = 12_000
EPSILON = 0.004
SHIFT = np.array([6.4e5, -2.0, 30.0])
GROUPS = Wanted(groups=True)
LOW = np.uint64(0xFFFFFFFF)
needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
each_order = pytest.mark.parametrize("order", POINT_ORDERS)


def cloud():
    """A curved sheet in rows, far from the origin, some of its points twice."""
    u, v = (np.indices((110, 110)).reshape(2, -1) / 110)[:, :N_POINTS]
    points = np.column_stack([u, v, 0.2 * np.sin(4 * u) * np.cos(3 * v)])
    points[-50:] = points[:50]
    return points + SHIFT


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """{order: scene} in groups. Points have their number as colour."""
    folder = tmp_path_factory.mktemp("scenes")
    found = {}
    for order in POINT_ORDERS:
        chosen = BuildSettings(
            point_order=order, points_per_cell=500, positions="groups", position_bits=10, group_epsilon=EPSILON
        )
        source = ArraySource(cloud(), columns_for(N_POINTS, ("rgb", "classification")))
        build_scene([source], folder / order, settings=chosen)
        found[order] = Scene.open(folder / order)
    return found


def loaded(scene, wanted=GROUPS, mode="rgb"):
    return load_groups(scene, Colouring.choose(scene, mode), wanted, verify=True)


def as_points(groups: ResidentGroups) -> ResidentPoints:
    """Cell by cell the kept points and then the inner ones, where drawing has them, not rounded."""
    cells = groups.cells
    kept = np.column_stack([cells.x, cells.y, cells.z]).astype(np.float64)
    run = np.repeat(cells.first_kept[:-1], np.diff(cells.first_group))
    v1, v2 = (np.repeat(run + v, cells.n_inner) for v in (cells.v1, cells.v2))
    inner = kept[v1] + (cells.parameter / 256)[:, None] * (kept[v2] - kept[v1])
    cell_of_run = np.repeat(np.arange(len(cells.step)), np.diff(cells.first_run))
    cell = np.concatenate([np.repeat(cell_of_run, np.diff(first)) for first in (cells.first_kept, cells.first_inner)])
    order = np.argsort(cell, kind="stable")
    x, y, z = ((np.concatenate([kept, inner]) + 0.5)[order] * cells.step[cell[order], None]).T
    colour = np.concatenate([cells.kept_colour, cells.inner_colour])[order]
    return ResidentPoints(x, y, z, colour, groups.first_point[:-1], cells.origin)


def world(points: ResidentPoints) -> np.ndarray:
    block = np.searchsorted(points.block_first_point, np.arange(len(points)), side="right") - 1
    return points.block_origin[block] + np.column_stack([points.x, points.y, points.z]).astype(np.float64)


def camera(eye, target, size=(160, 120), near=0.01):
    pose = look_at(np.array(eye) + SHIFT, np.array(target) + SHIFT, np.array([0.0, 0.0, 1.0]))
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.9, width=size[0], height=size[1], near=near)


CAMERAS = {
    "whole": camera((0.5, -1.0, 1.2), (0.5, 0.5, 0.0)),
    "far": camera((0.5, -8.0, 6.0), (0.5, 0.5, 0.0)),
    "at an edge": camera((0.2, 0.1, 0.4), (0.0, 0.5, 0.0)),
    "inside": camera((0.5, 0.5, 0.05), (1.0, 0.6, 0.0), near=1e-3),
}
each_camera = pytest.mark.parametrize("view", CAMERAS.values(), ids=CAMERAS.keys())


def chosen(scene, view, threshold=16.0):
    octree = scene.octree()
    sampling = SamplingNode(octree, pixel_threshold=threshold, whole_sets=True)
    return sampling.process(view, CullingNode(octree, backface=False).process(view)).entries


@each_order
def test_points_are_within_the_bound_of_those_that_were_built(scenes, order):
    scene = scenes[order]
    groups = loaded(scene)
    points, step = as_points(groups), np.repeat(groups.cells.step, np.diff(groups.first_point))
    extent = np.ptp(cloud(), axis=0).max()
    off = np.linalg.norm(world(points) - cloud()[points.colour], axis=1)
    assert (off <= EPSILON * extent + np.sqrt(3) / 2 * step + 1e-9).all()
    assert off.max() > 0.3 * EPSILON * extent
    columns = scene.positions()
    decoded = world(ResidentPoints(*columns, scene.attribute("rgb"), *scene.blocks()))
    stored = scene.attribute("rgb")
    for first, last in itertools.pairwise(groups.first_point):
        own, theirs = np.argsort(points.colour[first:last]), np.argsort(stored[first:last])
        np.testing.assert_array_equal(points.colour[first:last][own], stored[first:last][theirs])
        rounded = np.linalg.norm(world(points)[first:last][own] - decoded[first:last][theirs], axis=1)
        assert (rounded <= np.sqrt(3) / 2 * step[first:last] + 1e-7).all()


@each_order
@each_camera
def test_frames_are_those_of_the_decoded_points(scenes, order, view):
    """A pixel differs where a point lies next to its edge (``groups``); and the same bits for any threads."""
    scene = scenes[order]
    groups, entries = loaded(scene), chosen(scene, view)
    expected = reference_frame(as_points(groups), view, entries)
    frames = []
    for threads in (1, 2, 3, 5):
        with make_rasterizer("cpu", groups, view.width, view.height, PointSize(), threads) as rasterizer:
            frames += [rasterizer.draw(view, entries).copy() for _ in range(2)]
    assert all(np.array_equal(frame, frames[0]) for frame in frames)
    assert (frames[0] != FRAMEBUFFER_EMPTY).any()
    assert (expected & LOW != frames[0] & LOW).mean() < 5e-3
    both = (expected & LOW == frames[0] & LOW) & (expected != FRAMEBUFFER_EMPTY)
    depths = [(frame[both] >> np.uint64(32)).astype(np.uint32).view(np.float32) for frame in (expected, frames[0])]
    np.testing.assert_allclose(depths[1], depths[0], rtol=1e-4)


@each_order
def test_colours_by_position_and_of_one_kind(scenes, order):
    scene = scenes[order]
    colouring = Colouring.choose(scene, "elevation")
    groups = load_groups(scene, colouring, GROUPS, verify=False)
    points, decoded = as_points(groups), load_points(scene, colouring, verify=False)
    for i, (first, last) in enumerate(itertools.pairwise(groups.first_point)):
        height = np.floor(points.z[first:last] / groups.cells.step[i])  # rounded to the grid as decoding does
        along, theirs = np.argsort(height), np.argsort(decoded.z[first:last])
        np.testing.assert_array_equal(points.colour[first:last][along], decoded.colour[first:last][theirs])
    assert len(np.unique(points.colour)) > 50
    assert set(as_points(loaded(scene, mode="#102030")).colour.tolist()) == {0xFF302010}


@each_order
def test_sides_follow_the_spacing_of_the_decoded_points(scenes, order):
    scene, colouring = scenes[order], Colouring.choose(scenes[order], "rgb")
    groups = loaded(scene, Wanted(groups=True, spacing=True))
    decoded = load_points(scene, colouring, Wanted(cells=True, spacing=True), verify=False)
    np.testing.assert_allclose(groups.block_spacing, decoded.block_spacing, rtol=1e-3)
    view, size = CAMERAS["at an edge"], PointSize(1, 0.0, 9, adaptive=True)
    entries = chosen(scene, view)
    points = replace(as_points(groups), block_spacing=groups.block_spacing)
    expected = reference_frame(points, view, entries, size)
    with CpuGroupRasterizer(groups, view.width, view.height, size, 2) as rasterizer:
        frame = rasterizer.draw(view, entries)
        assert (frame & LOW != expected & LOW).mean() < 0.01
    assert (expected != reference_frame(points, view, entries)).mean() > 0.3, "sides are more than a pixel"
    with pytest.raises(InputError, match="no spacing"):
        CpuGroupRasterizer(loaded(scene), 8, 8, size)


@each_order
def test_epsilon_follows_local_detail(tmp_path, order):
    """The rows of the sheet are straight over a cell and bent over the scene."""
    off, n_bytes = [], []
    for detail in (0.0, 0.01):
        path = tmp_path / f"{detail}.scene"
        chosen = BuildSettings(
            point_order=order, points_per_cell=500, positions="groups", group_epsilon=0.05, group_detail=detail
        )
        build_scene([ArraySource(cloud(), columns_for(N_POINTS))], path, settings=chosen)
        groups = loaded(Scene.open(path))
        points = as_points(groups)
        off.append(np.linalg.norm(world(points) - cloud()[points.colour], axis=1).max())
        n_bytes.append(groups.cells.position_bytes)
    assert off[1] < 0.3 * off[0]
    assert n_bytes[0] < n_bytes[1] < 6 * N_POINTS * 2


# --- entries and cells ------------------------------------------------------------------------------------------

FIRST = np.array([0, 3, 4, 9, 15, 16])
BARE = ResidentGroups(SimpleNamespace(origin=np.zeros((5, 3))), FIRST)  # pyright: ignore[reportArgumentType]


def entries_of(*rows):
    return np.array([*rows], RENDER_POINT)


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5), st.lists(st.integers(1, 15), max_size=3))))
@settings(deadline=None, max_examples=300)
def test_whole_cells_in_any_split(ranges):
    """Entries of cells first … last − 1, split somewhere into some that go on where the one before ends."""
    rows, expected = [], []
    for first, last, cuts in ranges:
        first, last = sorted((first, last))
        begin, end = int(FIRST[first]), int(FIRST[last])
        places = sorted({begin, end, *(c for c in cuts if begin < c < end)}) if begin < end else [begin, end]
        rows += [(a, b - a, 1) for a, b in itertools.pairwise(places)]
        expected += range(first, last)
    np.testing.assert_array_equal(BARE.cells_of(entries_of(*rows)), expected)


@pytest.mark.parametrize(
    ("rows", "bad"),
    [
        ([(0, 3, 1), (4, 4, 1)], 1),
        ([(1, 2, 1)], 0),
        ([(0, 2, 1), (2, 1, 1), (9, 5, 1), (15, 1, 1)], 2),
        ([(0, 4, 2)], 0),
        ([(0, 3, 1), (9, 7, 0)], 1),
        ([(15, 2, 1)], 0),
        ([(2**63, 1, 1)], 0),
    ],
)
def test_anything_else_than_whole_cells_is_refused(rows, bad):
    with pytest.raises(MessageError, match=f"render-points entry {bad}: found offset {rows[bad][0]}"):
        BARE.cells_of(entries_of(*rows))


# --- loading ----------------------------------------------------------------------------------------------------


def test_no_positions_are_decoded(scenes, monkeypatch):
    monkeypatch.setattr(Scene, "positions", lambda *_: pytest.fail("decoded"))
    monkeypatch.setattr(Scene, "position_reader", lambda *_: pytest.fail("decoded"))
    groups = loaded(scenes["layered"])
    assert len(groups) == scenes["layered"].info.n_stored
    assert groups.cells.position_bytes < 8 * len(groups)


@each_order
def test_a_damaged_code_is_named(scenes, order, monkeypatch):
    scene = scenes[order]
    coded = scene.coded_positions()
    damaged = coded.codes.copy()
    damaged[coded.first_byte[2]] ^= 0x7F
    monkeypatch.setattr(type(coded), "code", lambda self, i: damaged[self.first_byte[i] : self.first_byte[i + 1]])
    cell = coded.cells.cell[2]
    with pytest.raises(StoreError, match=rf"position_codes.npy: cell {cell}: .*found"):
        loaded(scene)


# --- whole runs -------------------------------------------------------------------------------------------------


@pytest.fixture
def config(scenes, tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(
        f'[scene]\npath = "{scenes["layered"].path}"\n[camera]\nwidth = 160\nheight = 90\n'
        '[render]\nrasterizer = "cpu"\npositions = "coded"\ncolour = "classification"\n[output]\nframes = 2\n'
    )
    return path


def call(config, out, **overrides):
    overrides = {"output.directory": out, **overrides}
    arguments = [part for key, value in overrides.items() for part in ("--set", f"{key}={value}")]
    return subprocess.run(
        [sys.executable, "-m", "splatpipe.cluster", "run", str(config), *arguments],
        capture_output=True,
        text=True,
        timeout=100,
    )


def pictures(folder):
    return np.stack([np.asarray(Image.open(path)) for path in sorted(folder.glob("frame_*.png"))])


@needs_mpi
@pytest.mark.mpi
@each_order
def test_three_ranks_draw_the_same_bits_as_one(scenes, config, tmp_path, order):
    drawn = {}
    for topology in ("single", "pipelined"):
        settings = {"pipeline.topology": topology, "scene.path": scenes[order].path, "render.threads": 2}
        done = call(config, tmp_path / topology, **settings)
        assert done.returncode == 0, done.stderr
        drawn[topology] = pictures(tmp_path / topology)
    assert np.array_equal(drawn["single"], drawn["pipelined"])
    assert len(np.unique(drawn["single"][0].reshape(-1, 3), axis=0)) > 5
    run = json.loads((tmp_path / "single" / "run.json").read_text())
    assert "linear groups" not in {part["what"] for part in run["left_out"]}


def test_what_cannot_be_drawn_from_groups_is_refused(scenes, config, tmp_path):
    plain = tmp_path / "plain.scene"
    build_scene([ArraySource(cloud()[:300])], plain, settings=BuildSettings())
    for override, error, message in (
        (f"scene.path={plain}", StoreError, "positions are float32: build it with --positions groups"),
        ("render.rasterizer=gl", ConfigError, "'coded': found render.rasterizer = 'gl', expected auto or cpu"),
        ("render.rasterizer=gl-points", ConfigError, "'coded': found render.rasterizer = 'gl-points'"),
        ("filter.classes=[2]", ConfigError, "'coded': found a filter"),
    ):
        with pytest.raises(error, match=message):
            Job(load_config(config, [override]))
    done = call(config, tmp_path / "out", **{"scene.path": plain})
    assert done.returncode == 2
    assert [line for line in done.stderr.splitlines() if line] == [
        f"splatpipe: {plain}: positions are float32: build it with --positions groups"
    ]
    job = Job(load_config(config, ["render.rasterizer=auto"]))
    with job.make_rasterizer(job.load_drawn(verify=False)) as rasterizer:
        assert isinstance(rasterizer, CpuGroupRasterizer)


def test_plan_says_so_and_its_ablation_changes_no_bit(config):
    job = Job(load_config(config, ["render.colour=#ffffff"]))

    def codecs(job: Job) -> Part:
        found = parts(job, Workload.of_look(job), Decision("single", "so"))
        return next(part for part in found if part.what == "codecs")

    assert not codecs(job).left_out
    assert codecs(job).why.startswith("render.positions is coded: whole sets are drawn from linear groups")
    assert "decoded when they are loaded" in codecs(Job(load_config(config, ["render.positions=float32"]))).why
    with trials(job) as found:
        assert {trial.part for trial in found} >= {COLOUR, SPLAT_LOOP, ADAPTIVE, CHECKSUMS}
        assert all(same(trial, job.camera(0)) for trial in found)


def test_sweeps_draw_from_groups_but_round_nothing_more(scenes, tmp_path):
    path = tmp_path / "error.toml"
    text = (
        '[run]\n[run.camera]\nwidth = 64\nheight = 48\n[run.render]\nrasterizer = "cpu"\ncolour = "rgb"\n'
        f'[run.output]\nframes = 1\ndirectory = "{tmp_path}/out"\n'
        f'[[scene]]\nname = "sheet"\npath = "{scenes["layered"].path}"\n'
        '[[sweep]]\nmethod = "positions"\nkey = "render.positions"\nvalues = ["float32", "coded"]\n'
    )
    path.write_text(text)
    config = load_error_config(path)
    swept = SweptScene(config, config.scene[0], str(path))
    with FrameProgress(None) as progress:
        swept.prepare(progress)
    found = []
    for point in swept.points:
        with swept.open(point) as pipeline:
            found.append((pipeline.position_bytes, pipeline.draw(swept.cameras[0])[2].copy()))
    assert found[0][0] == 12
    assert 1 < found[1][0] < 8
    covered = [frame != FRAMEBUFFER_EMPTY for _, frame in found]
    assert covered[0].any()
    assert (covered[0] != covered[1]).mean() < 0.02
    path.write_text(text + "set = { positions.bits_per_axis = 9 }\n")
    with pytest.raises(ConfigError, match=r"bits_per_axis = 9: found render.positions = 'coded', expected 0"):
        load_error_config(path)


def test_splats_are_refused(tmp_path, config):
    path = tmp_path / "splats.scene"
    build_scene([ArraySource(cloud()[:800])], path, settings=BuildSettings(positions="groups", splats=True))
    overrides = [f"scene.path={path}", "render.style=splats", "render.colour=auto"]
    with pytest.raises(ConfigError, match=r"'coded': found render.style = 'splats', expected points"):
        Job(load_config(config, overrides))
