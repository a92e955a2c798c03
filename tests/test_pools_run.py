"""Runs that draw cells from their pooled form: frames are those of the twins, for any threads and ranks; when they do not."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from build_sources import ArraySource, columns_for
from splatpipe.cluster.error.config import load_error_config
from splatpipe.cluster.error.sweep import run_sweep
from splatpipe.cluster.job import Job
from splatpipe.cluster.launch import mpi_available
from splatpipe.cluster.plan.needs import parts
from splatpipe.cluster.plan.topology import Decision
from splatpipe.cluster.plan.workload import Workload
from splatpipe.cluster.predict.workload import count_workload
from splatpipe.cluster.progress import FrameProgress
from splatpipe.nodes.cell_blocks import cell_blocks, cell_spacing
from splatpipe.nodes.pooled_entries import PooledForms
from splatpipe.nodes.raster import PointSize, ResidentPoints
from splatpipe.nodes.raster.compact import compact_positions
from splatpipe.nodes.raster.cpu import CpuRasterizer
from splatpipe.nodes.raster.pools import pool_cells
from splatpipe.nodes.raster.pools_reference import decoded, project_pools
from splatpipe.nodes.raster.reference import project_compact, project_float32, reference_frame
from splatpipe.nodes.sampling import POOLED_POINT_COST
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config
from splatpipe.shared.errors import MessageError, StoreError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from splatpipe.shared.store import Scene
from test_raster_pools import camera, some_cells

needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
SIZES = [PointSize(), PointSize(3), PointSize(1, world=0.08, maximum=9)]
N_POINTS = 60_000


# --- frames of entries of both forms -------------------------------------------------------------------------------


def scattered() -> ResidentPoints:
    """Points in two blocks, about where ``some_cells`` are."""
    rng = np.random.default_rng(3)
    x, y, z = rng.uniform(-1.5, 1.5, (3, 4000)).astype(np.float32)
    colour = rng.integers(0, 2**32, 4000, dtype=np.uint32)
    return ResidentPoints(x, y, z, colour, np.array([0, 1500]), np.array([[0.0, 0, 0], [0.3, -0.2, 0.1]]))


def first_pooled(cells) -> np.ndarray:
    return np.cumsum([0, *(len(cell.points) for cell in cells)])


def mixed(cells) -> np.ndarray:
    """Entries of both forms, strided ones too, out of order; cells 1, 2 in one, and 4."""
    first = first_pooled(cells)
    rows = [(100, 900, 1), (first[1], first[3] - first[1], 0), (1200, 2500, 3), (first[4], first[5] - first[4], 0)]
    return np.array(rows, RENDER_POINT)


def expected_frame(points, cells, entries, view, size, projection):
    """The minimum of the two references; a pooled point of the numbering is that of the decoded cells."""
    pooled = entries[entries["stride"] == 0].copy()
    pooled["stride"] = 1
    return np.minimum(
        reference_frame(points, view, entries[entries["stride"] > 0], size, projection),
        reference_frame(decoded(cells), view, pooled, size, project_pools(cells)),
    )


@pytest.mark.parametrize("compact", [False, True], ids=["float32", "compact"])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_mixed_frames_are_those_of_the_references_for_any_threads(size, compact):
    cells, points, view = some_cells(), scattered(), camera()
    entries = mixed(cells)
    projection = project_compact(compact_positions(points, 1)) if compact else project_float32
    expected = expected_frame(points, cells, entries, view, size, projection)
    with_pools = replace(points, pools=pool_cells(cells))
    for threads in (1, 2, 3, 5):
        with CpuRasterizer(with_pools, view.width, view.height, size, threads, compact=compact) as rasterizer:
            for _ in range(2):
                np.testing.assert_array_equal(rasterizer.draw(view, entries), expected)
            alone = rasterizer.draw(view, entries[entries["stride"] > 0]).copy()
            assert (rasterizer.draw(view, entries[:0]) == FRAMEBUFFER_EMPTY).all()
    with CpuRasterizer(points, view.width, view.height, size, 1, compact=compact) as rasterizer:
        np.testing.assert_array_equal(alone, rasterizer.draw(view, entries[entries["stride"] > 0]))
    assert (alone != expected).mean() > 0.01


def test_points_of_pools_grow_with_the_spacing_of_their_cell():
    cells = some_cells()
    spacing = np.linspace(0.02, 0.06, len(cells))
    points = replace(
        scattered(),
        block_spacing=np.array([0.03, 0.05], np.float32),
        pools=pool_cells(cells)._replace(world_side=spacing),
    )
    size, view = PointSize(1, world=0.03, maximum=12, adaptive=True), camera()
    entries = mixed(cells)
    with CpuRasterizer(points, view.width, view.height, size, 2) as rasterizer:
        found = rasterizer.draw(view, entries[1:2]).copy()
    frames = []
    for i in (1, 2):
        sized = PointSize(1, world=max(0.03, spacing[i]), maximum=12)
        first = first_pooled(cells)
        own = np.array([(first[i], first[i + 1] - first[i], 1)], RENDER_POINT)
        frames.append(reference_frame(decoded(cells), view, own, sized, project_pools(cells)))
    np.testing.assert_array_equal(found, np.minimum(*frames))


@pytest.mark.parametrize("bad", [(1, 5, 0), (0, 2**32 - 1, 0), (2**63, 0, 0), (4001, 1, 1), (3990, 11, 1)])
def test_entries_beyond_either_form_are_refused_and_the_next_frame_is_whole(bad):
    cells, points, view = some_cells(), scattered(), camera()
    entries = mixed(cells)
    with CpuRasterizer(replace(points, pools=pool_cells(cells)), view.width, view.height, threads=2) as rasterizer:
        with pytest.raises(MessageError, match="render-points entry"):
            rasterizer.draw(view, np.append(entries, np.array([bad], RENDER_POINT)))
        expected = expected_frame(points, cells, entries, view, PointSize(), project_float32)
        np.testing.assert_array_equal(rasterizer.draw(view, entries), expected)
    with (
        CpuRasterizer(points, view.width, view.height, threads=1) as rasterizer,
        pytest.raises(MessageError, match=r"entry 1: .* within 0 pooled points"),
    ):
        rasterizer.draw(view, entries)


# --- runs of scenes -------------------------------------------------------------------------------------------------


def sheet():
    """A curved sheet in rows, dense enough for pools."""
    u, v = np.indices((300, 200)).reshape(2, -1) / 300
    return np.column_stack([u, v, 0.1 * np.sin(4 * u) * np.cos(3 * v)])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "sheet"
    source = ArraySource(sheet(), columns_for(N_POINTS, ("rgb", "classification")))
    build_scene([source], path, settings=BuildSettings(points_per_cell=6000, pools=True, pool_bits=6))
    return path


@pytest.fixture
def config(scene, tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(
        f'[scene]\npath = "{scene}"\n[camera]\nwidth = 96\nheight = 64\n[output]\nframes = 2\ndirectory = "out"\n'
        '[sampling]\npools = "bytes"\npixel_threshold = 0\n[render]\nrasterizer = "cpu"\n'
    )
    return path


def job_of(config, *overrides) -> Job:
    return Job(load_config(config, list(overrides)))


def draw(job, frame=0):
    """Entries of a frame, and its words."""
    octree, view = job.load_octree(), job.camera(frame)
    chosen = job.sampling_node(octree).process(view, job.culling_node(octree).process(view))
    with job.make_rasterizer(job.load_points(verify=True)) as rasterizer:
        return chosen, rasterizer.draw(view, chosen.entries).copy()


@pytest.mark.parametrize("how", ["bytes", "time"])
def test_a_scene_from_pools_shows_what_its_points_show(config, how):
    chosen, found = draw(job_of(config, f"sampling.pools={how}"))
    every, expected = draw(job_of(config, "sampling.pools=off"))
    assert every.n_points == N_POINTS
    assert chosen.n_pooled > 0.5 * chosen.n_points > 0
    assert chosen.n_points + (POOLED_POINT_COST - 1) * chosen.n_pooled < N_POINTS
    shown, all_shown = found != FRAMEBUFFER_EMPTY, expected != FRAMEBUFFER_EMPTY
    assert all_shown.sum() > 500
    assert (shown != all_shown).sum() < 0.02 * all_shown.sum(), "no hole, and nothing elsewhere: moved by half a pixel"
    depth, all_depth = ((words >> np.uint64(32)).astype(np.uint32).view(np.float32) for words in (found, expected))
    both = shown & all_shown
    assert np.abs(depth - all_depth)[both].max() < 0.1


@needs_mpi
@pytest.mark.mpi
def test_three_ranks_draw_from_pools_as_one_does(config):
    drawn = {}
    for topology in ("single", "pipelined"):
        out = config.with_name(topology)
        command = [sys.executable, "-m", "splatpipe.cluster", "run", str(config)]
        for item in (f"pipeline.topology={topology}", f"output.directory={out}", "render.threads=2"):
            command += ["--set", item]
        done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
        assert done.returncode == 0, done.stderr
        run = json.loads((out / "run.json").read_text())["per_frame"]
        drawn[topology] = [path.read_bytes() for path in sorted(out.glob("frame_*.png"))], run["pooled_points"]
    assert drawn["single"] == drawn["pipelined"]
    pictures, pooled = drawn["single"]
    assert len(pictures) == 2
    assert min(pooled) > 1000


def test_spacing_of_pooled_cells_is_that_of_their_points(config):
    job = job_of(config, "render.point_size_adaptive=true")
    pools = job.load_points(verify=False).pools
    octree = job.load_octree()
    _, _, cells = cell_blocks(job.scene, octree)
    spacing = dict(zip(cells.tolist(), cell_spacing(job.scene, octree, cells).tolist(), strict=True))
    assert pools.world_side.tolist() == [spacing[cell] for cell in PooledForms.of(octree).cell.tolist()]
    chosen, words = draw(job)
    assert chosen.n_pooled > 0
    assert (words != FRAMEBUFFER_EMPTY).any()


@pytest.mark.parametrize(
    ("override", "why"),
    [
        ("sampling.pools=off", "sampling.pools is off"),
        ("filter.classes=[2]", "points are filtered"),
        ("filter.boxes=[{ lower = [0, 0, 0], upper = [1, 1, 1] }]", "points are filtered"),
        ("render.positions=compact", ""),
    ],
)
def test_a_run_that_cannot_draws_nothing_from_pools_and_the_plan_says_why(config, override, why):
    job = job_of(config, override)
    assert (job.pools == "off") == bool(why)
    look = Workload.of_look(job)
    found = {part.what: part for part in parts(job, look, Decision("single", "so"))}["pools"]
    assert found.left_out == bool(why)
    assert found.why.startswith(why)
    assert found.gain == job.scene.info.pool_bytes / 1e6
    assert (look.pooled_points > 0) == (not why)
    assert (job.load_points(verify=False).pools is None) == bool(why)
    octree = job.scene.octree(pools=True)
    told = f"{len(PooledForms.of(octree))} of {len(octree.owners)} cells with points have a pooled form, too few points"
    assert told in found.why


def test_a_prediction_counts_pooled_points_by_what_they_cost(config):
    plain, pooled = (count_workload(job_of(config, f"sampling.pools={how}")) for how in ("off", "bytes"))
    chosen, _ = draw(job_of(config))
    expected = chosen.n_points + (POOLED_POINT_COST - 1) * chosen.n_pooled
    assert pooled.points[0] == pytest.approx(expected)
    assert (pooled.covered == pooled.points).all()
    assert (plain.points == N_POINTS).all()
    sized = count_workload(job_of(config, "render.point_size_world=0.01"))
    assert (sized.covered >= sized.points).all()


def test_a_scene_without_pools_is_refused(config, tmp_path):
    build_scene([ArraySource(sheet()[:500])], tmp_path / "plain", settings=BuildSettings())
    with pytest.raises(StoreError, match=r"plain: no pooled cells: build it with --pools"):
        job_of(config, f"scene.path={tmp_path / 'plain'}")


def test_a_sweep_shows_bytes_against_error(config, tmp_path):
    path = tmp_path / "error.toml"
    sweeps = "".join(
        f'[[sweep]]\nmethod = "{how}"\nkey = "sampling.pixel_threshold"\nvalues = [0, 400]\n'
        f'set = {{ sampling.pools = "{how}" }}\n'
        for how in ("off", "bytes")
    )
    scene = Scene.open(job_of(config).scene.path).path
    path.write_text(
        f'repeats = 1\n[run.camera]\nwidth = 96\nheight = 64\n[run.render]\nrasterizer = "cpu"\n[run.output]\n'
        f'directory = "out"\n[[scene]]\nname = "sheet"\npath = "{scene}"\n{sweeps}'
    )
    with FrameProgress(None) as progress:
        rows = run_sweep(load_error_config(path), str(path), progress).rows
    off, coarse, pools, both = rows
    assert off["read_bytes"] == 16 * N_POINTS
    assert coarse["read_bytes"] == 16 * coarse["points"] < off["read_bytes"]
    assert off["pooled_points"] == coarse["pooled_points"] == 0
    assert pools["pooled_points"] > 1000
    assert pools["read_bytes"] < off["read_bytes"] / 3
    assert both["read_bytes"] <= coarse["read_bytes"]
    assert pools["coverage_error"] < 0.02
