"""Points that stay on disk: the same bits as resident ones where a frame is complete, the resident part where not."""

import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatpipe.cluster.cli import parse_bytes
from splatpipe.cluster.job import Job
from splatpipe.cluster.launch import mpi_available
from splatpipe.cluster.paging import check_paging, told_ahead
from splatpipe.cluster.pipeline import run_single
from splatpipe.nodes.page_reader import load_paged
from splatpipe.nodes.point_filter import ClipBox, PointFilter
from splatpipe.nodes.raster import PointSize
from splatpipe.nodes.raster.cpu import CpuRasterizer
from splatpipe.nodes.raster.paged import PagedCpuRasterizer
from splatpipe.nodes.raster.paged_points import Paging
from splatpipe.nodes.render import Wanted, load_points
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.colour import Colouring
from splatpipe.shared.config import parse_config
from splatpipe.shared.errors import ConfigError, InputError, SplatpipeError, StoreError
from splatpipe.shared.messages import RENDER_POINT
from splatpipe.shared.scene_share import SceneShare
from splatpipe.shared.store import Scene
from splatpipe.shared.synth import CityScan

from .test_run import SPLATPIPE, call, pictures

PAGE = 256
PAGE_BYTES = 16 * PAGE
WIDTH, HEIGHT = 160, 90


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A small city in both point orders."""
    folder = tmp_path_factory.mktemp("paged")
    for order in ("layered", "depth-first"):
        settings = BuildSettings(point_order=order, points_per_cell=200, up="z")
        build_scene([CityScan(n_points=30_000)], folder / order, settings=settings)
    return folder


def job_of(scene: Path, out: Path | None = None, **settings):
    tables = {
        "scene": {"path": str(scene)},
        "camera": {"width": WIDTH, "height": HEIGHT},
        "render": {"rasterizer": "cpu", "threads": 2},
        "pipeline": {"topology": "single"},
        "output": {"frames": 4, "png": False, "directory": str(out or scene.parent / "out")},
    }
    for name, value in settings.items():
        section, key = name.split("__")
        tables.setdefault(section, {})[key] = value
    return Job(parse_config(tables))


def frames_of(job):
    """(camera, entries) of every frame."""
    octree = job.load_octree()
    culling, sampling = job.culling_node(octree), job.sampling_node(octree)
    cameras = [job.camera(frame) for frame in range(job.n_frames)]
    return [(camera, sampling.process(camera, culling.process(camera)).entries) for camera in cameras]


def resident_frames(job):
    points = load_points(Scene.open(job.scene.path), job.colouring, Wanted(point_filter=job.point_filter), verify=True)
    with CpuRasterizer(points, WIDTH, HEIGHT, job.point_size, 2) as rasterizer:
        return [rasterizer.draw(*frame).copy() for frame in frames_of(job)]


def paged(job, n_pages, *, complete=False, n_bytes=PAGE_BYTES):
    paging = Paging(n_pages * n_bytes, complete, PAGE)
    points = load_paged(Scene.open(job.scene.path, mapped=False), job.colouring, job.point_filter, paging)
    return PagedCpuRasterizer(points, WIDTH, HEIGHT, job.point_size, 2)


def loaders():
    return [thread for thread in threading.enumerate() if thread.name.startswith("page-")]


# --- complete frames ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["layered", "depth-first"])
@pytest.mark.parametrize("n_pages", [1, 2, 17, 10_000])
def test_complete_frames_have_the_bits_of_resident_points_in_any_budget(scenes, order, n_pages):
    job = job_of(scenes / order, sampling__pixel_threshold=12, render__point_size_px=2)
    expected = resident_frames(job)
    with paged(job, n_pages, complete=True) as rasterizer:
        for frame, words in zip(frames_of(job), expected, strict=True):
            np.testing.assert_array_equal(rasterizer.draw(*frame), words)
            assert rasterizer.residency.missing == 0
            assert (rasterizer.pool.slot_of_page >= 0).sum() <= n_pages
    assert len(np.unique(expected[0])) > 500, "the picture shows something"
    assert not loaders()


@pytest.mark.parametrize(
    "settings",
    [
        {"render__colour": "intensity"},
        {"render__colour": "elevation"},
        {"render__colour": "elevation", "render__colour_range": [0.0, 20.0]},
        {"render__colour": "classification"},
        {"render__colour": "level"},
        {"render__colour": "normal"},
        {"render__colour": "#ff8000"},
        {"filter__classes": [2, 6]},
        {"filter__boxes": [{"lower": [40, 40, -1], "upper": [180, 180, 500], "keep": "outside"}]},
        {"render__point_size_world": 0.8},
    ],
    ids=lambda settings: ", ".join(f"{key}={value}" for key, value in settings.items()),
)
def test_every_colour_filter_and_size_is_that_of_resident_points(scenes, settings):
    job = job_of(scenes / "layered", sampling__pixel_threshold=12, output__frames=2, **settings)
    one_colour = str(settings.get("render__colour", "")).startswith("#")
    with paged(job, 23, complete=True, n_bytes=12 * PAGE if one_colour else PAGE_BYTES) as rasterizer:
        assert rasterizer.pool.n_slots == 23
        for frame, words in zip(frames_of(job), resident_frames(job), strict=True):
            np.testing.assert_array_equal(rasterizer.draw(*frame), words)


def test_a_share_of_a_scene_is_paged_as_it_is_resident(scenes):
    job = job_of(scenes / "layered")
    octree = job.load_octree()
    borders = octree.first_point[octree.owners]
    first, stop = int(borders[len(borders) // 3]), int(borders[2 * len(borders) // 3])
    entries = np.array([(0, stop - first, 1)], RENDER_POINT)
    words = []
    for mapped in (True, False):
        share = SceneShare(Scene.open(job.scene.path, mapped=mapped), first, stop)
        if mapped:
            points = load_points(share, job.colouring, verify=False)
            rasterizer = CpuRasterizer(points, WIDTH, HEIGHT, job.point_size, 2)
        else:
            points = load_paged(share, job.colouring, PointFilter(), Paging(9 * PAGE_BYTES, True, PAGE))
            rasterizer = PagedCpuRasterizer(points, WIDTH, HEIGHT, job.point_size, 2)
        with rasterizer:
            words.append(rasterizer.draw(job.camera(0), entries).copy())
    np.testing.assert_array_equal(*words)
    assert len(np.unique(words[0])) > 500


# --- frames drawn at once ----------------------------------------------------------------------------------------


def test_what_is_drawn_at_once_is_the_resident_part_and_ancestors_of_the_rest(scenes):
    """The pages that were there when the frame was cut decide; they are read from the pool before and after."""
    job = job_of(scenes / "layered", sampling__pixel_threshold=8, output__frames=6)
    points = load_points(job.scene, job.colouring, verify=False)
    shares = []
    with (
        paged(job, 40) as rasterizer,
        CpuRasterizer(points, WIDTH, HEIGHT, job.point_size, 1) as resident,
    ):
        sets, pool = load_paged(job.scene, job.colouring, PointFilter(), Paging(PAGE_BYTES)).sets, rasterizer.pool
        for camera, entries in frames_of(job):
            there = pool.slot_of_page >= 0
            words = rasterizer.draw(camera, entries).copy()
            shares.append(rasterizer.residency.missing)
            wanted = np.concatenate([np.arange(e["offset"], e["offset"] + e["range"]) for e in entries]).astype(int)
            lost = wanted[~there[wanted // PAGE]]
            assert (rasterizer.residency.missing_points, rasterizer.residency.wanted_points) == (len(lost), len(wanted))
            drawn = np.zeros(len(points), bool)
            drawn[wanted[there[wanted // PAGE]]] = True
            for cell in np.unique(np.searchsorted(sets.first, lost, side="right") - 1):
                up = sets.parent[cell]
                while up >= 0:
                    begin, end = sets.first[up], sets.first[up + 1]
                    if there[begin // PAGE : (end - 1) // PAGE + 1].all():
                        drawn[begin:end] = True
                        break
                    up = sets.parent[up]
            expected = np.array([(point, 1, 1) for point in np.flatnonzero(drawn)], RENDER_POINT)
            np.testing.assert_array_equal(words, resident.draw(camera, expected))
            pool.settle()  # so that nothing is loaded while the next frame looks what is there
            assert there.sum() <= pool.n_slots == 40
    assert shares[0] > 0.5, "the first frame finds the pinned pages alone"
    assert min(shares) < shares[0]


def test_a_camera_at_rest_misses_nothing_after_a_while(scenes):
    job = job_of(scenes / "layered", sampling__pixel_threshold=12)
    camera, entries = frames_of(job)[0]
    expected = resident_frames(job)[0]
    with paged(job, 1000) as rasterizer:
        rasterizer.draw(camera, entries)
        assert rasterizer.residency.missing > 0
        rasterizer.pool.settle()
        np.testing.assert_array_equal(rasterizer.draw(camera, entries), expected)
        assert rasterizer.residency.missing == 0
        rasterizer.draw(camera, entries)
        assert (rasterizer.residency.missing, rasterizer.residency.loaded_bytes) == (0, 0)


def test_frames_that_were_expected_miss_nothing(scenes):
    job = job_of(scenes / "layered", sampling__pixel_threshold=12)
    with paged(job, 1000) as rasterizer:
        frames = frames_of(job)
        for camera, entries in frames[:2]:
            rasterizer.expect(camera.frame, entries)
        rasterizer.pool.settle()
        for i, (frame, words) in enumerate(zip(frames, resident_frames(job), strict=True)):
            drawn = rasterizer.draw(*frame)
            if i == 0:  # the second was expected behind it
                rasterizer.pool.settle()
            if i < 2:
                assert rasterizer.residency.missing == 0
                np.testing.assert_array_equal(drawn, words)
    with paged(job, 1000) as rasterizer:
        rasterizer.draw(*frames[0])
        assert rasterizer.residency.missing > 0, "it had to be expected"


def test_frames_are_told_ahead_in_order():
    said = []
    taken = told_ahead((said.append(("made", i)) or i for i in range(4)), 2, lambda i: said.append(("told", i)))
    for i in taken:
        said.append(("taken", i))
    assert [what for what in said if what[0] == "taken"] == [("taken", i) for i in range(4)]
    assert said.index(("told", 2)) < said.index(("taken", 0)) < said.index(("told", 3)) < said.index(("taken", 1))
    said.clear()
    assert list(told_ahead(range(3), 0, said.append)) == [0, 1, 2]
    assert said == []


# --- runs --------------------------------------------------------------------------------------------------------


def test_a_run_says_what_was_missing_and_how_much_was_read(scenes, tmp_path):
    memory = {"memory__residency": "paged", "memory__budget": "3MB"}
    found = run_single(job_of(scenes / "layered", tmp_path, **memory, output__frames=8), lambda *_: None)
    per_frame = found["per_frame"]
    assert [len(per_frame[name]) for name in ("missing", "loaded_bytes", "evicted_pages", "points")] == [8] * 4
    assert per_frame["wanted_points"] == per_frame["points"]
    assert all(0 <= share <= 1 for share in per_frame["missing"])
    assert sum(per_frame["loaded_bytes"]) > 0
    complete = run_single(
        job_of(scenes / "layered", tmp_path, **memory, memory__complete=True, output__frames=8), lambda *_: None
    )
    assert complete["per_frame"]["missing"] == [0.0] * 8
    assert complete["per_frame"]["points"] == per_frame["points"]
    assert "missing" not in run_single(job_of(scenes / "layered", tmp_path), lambda *_: None)["per_frame"]
    assert not loaders()


@pytest.mark.mpi
@pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
def test_pictures_of_three_ranks_are_complete_where_they_are_to_be(scenes, tmp_path):
    (tmp_path / "mapped").mkdir()
    run_single(job_of(scenes / "layered", tmp_path / "mapped", output__png=True), lambda *_: None)
    config = tmp_path / "run.toml"
    config.write_text(
        f'[scene]\npath = "{scenes}/layered"\n[camera]\nwidth = {WIDTH}\nheight = {HEIGHT}\n[render]\n'
        'rasterizer = "cpu"\n[pipeline]\ntopology = "pipelined"\n[memory]\nresidency = "paged"\nbudget = "600KB"\n'
        f'[output]\nframes = 4\ndirectory = "{tmp_path}/paged"\n'
    )
    done = call(*SPLATPIPE, "run", str(config), "--complete")
    assert done.returncode == 0, done.stderr
    assert "paged: 0.0% of a frame's points missing, at most 0.0%, none in 4 frames" in done.stdout
    np.testing.assert_array_equal(pictures(tmp_path / "mapped"), pictures(tmp_path / "paged"))
    run = json.loads((tmp_path / "paged" / "run.json").read_text())
    assert run["per_frame"]["missing"] == [0.0] * 4
    assert "paging of points" not in [part["what"] for part in run["left_out"]]


# --- what is refused ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"render": {"rasterizer": "gl"}}, "render.rasterizer = 'gl'"),
        ({"render": {"rasterizer": "gl-points"}}, "render.rasterizer = 'gl-points'"),
        ({"render": {"style": "splats"}}, "render.style = 'splats'"),
        ({"render": {"positions": "compact"}}, "render.positions = 'compact'"),
        ({"render": {"point_size_adaptive": True}}, "render.point_size_adaptive = true"),
        ({"sampling": {"pools": "bytes"}}, "sampling.pools = 'bytes'"),
        ({"scene": {"path": "a.scene", "delivery": "messages"}}, "scene.delivery = 'messages'"),
        ({"scene": {"path": ""}}, "scene.path: none"),
        ({}, "scene.path: positions are ci"),
    ],
)
def test_what_paged_points_are_not_drawn_by_is_refused_in_one_line(scenes, settings, said):
    config = parse_config({"scene": {"path": "a.scene"}, "memory": {"residency": "paged"}} | settings)
    info = Scene.open(scenes / "layered").info
    check_paging(parse_config({"scene": {"path": "a.scene"}}), info)
    with pytest.raises(ConfigError, match=r"memory.residency = 'paged' draws float32 points") as refused:
        check_paging(config, info if settings else replace(info, positions="ci"))
    assert str(refused.value).startswith(said)
    assert "\n" not in str(refused.value)


def test_a_run_refuses_before_it_starts(scenes):
    with pytest.raises(ConfigError, match=r"memory.residency = 'paged' draws float32 points"):
        job_of(scenes / "layered", memory__residency="paged", render__positions="compact")
    scene = Scene.open(scenes / "layered")
    scene.info = replace(scene.info, positions="ci")
    with pytest.raises(StoreError, match="positions are ci, expected float32"):
        load_paged(scene, Colouring.choose(scene, "rgb"), PointFilter(), Paging(1 << 20))


def test_a_budget_below_a_page_is_refused_in_one_line(scenes, tmp_path):
    job = job_of(scenes / "layered", tmp_path, memory__residency="paged", memory__budget="200KB")
    with pytest.raises(
        InputError, match=r"memory.budget: found 200000 bytes, expected at least 262144, a page of 16384"
    ):
        run_single(job, lambda *_: None)
    assert not loaders()


def test_a_file_that_is_cut_short_is_named(scenes, tmp_path):
    """Before the run by its size, during it by the read that ends early; the threads end either way."""
    path = tmp_path / "cut"
    path.mkdir()
    for file in (scenes / "layered").iterdir():
        (path / file.name).write_bytes(file.read_bytes())
    job = job_of(path, memory__residency="paged", sampling__pixel_threshold=0)
    with paged(job, 10_000, complete=True) as rasterizer:
        with (path / "y.npy").open("r+b") as file:
            file.truncate(5000)
        with pytest.raises(StoreError, match=r"y.npy: ended early, at byte") as ended:
            rasterizer.draw(*frames_of(job)[0])
    assert "\n" not in str(ended.value)
    assert not loaders()
    with pytest.raises(SplatpipeError, match=r"y.npy: found 5000 bytes, expected"):
        job_of(path, memory__residency="paged")


def test_columns_that_are_read_are_those_that_are_mapped(scenes):
    mapped, read = (Scene.open(scenes / "layered", mapped=mapped) for mapped in (True, False))
    index = np.random.default_rng(0).integers(0, mapped.info.n_stored, 50)
    for name in ("x", "attr_rgb", "attr_classification"):
        column = read.column(name)
        assert len(column) == mapped.info.n_stored
        np.testing.assert_array_equal(column[100:4000], mapped.column(name)[100:4000])
        np.testing.assert_array_equal(column[index], mapped.column(name)[index])
    box = PointFilter(boxes=(ClipBox((40, 40, -1), (180, 180, 500)),), classes=(2, 6))
    x, y, z = mapped.positions()
    whole = box.filtered_x(mapped, x, y, z)
    for part in (slice(0, 1), slice(77, 9000), slice(len(x) - 5, len(x))):
        np.testing.assert_array_equal(box.reader(read)(part.start, x[part], y[part], z[part]), whole[part])
    colouring = replace(Colouring.choose(read, "elevation"), colormap="magma")
    assert colouring.settled(read) == colouring.settled(mapped)


@pytest.mark.parametrize(("text", "n"), [("1GB", 10**9), ("1.5 GiB", 3 << 29), ("700000", 700_000)])
def test_sizes_are_read_as_people_write_them(scenes, text, n):
    assert parse_bytes(text, "--memory") == n
    assert job_of(scenes / "layered", memory__budget=text).config.memory.budget_bytes == n


def test_point_sizes_are_those_of_the_run(scenes):
    job = job_of(scenes / "layered", render__point_size_px=3, output__frames=1)
    assert job.point_size == PointSize(3)
    with paged(job, 300, complete=True) as rasterizer:
        np.testing.assert_array_equal(rasterizer.draw(*frames_of(job)[0]), resident_frames(job)[0])
