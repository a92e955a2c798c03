"""What the model expects of a frame: by hand, on every topology, and from costs that were measured here."""

import math

import numpy as np
import pytest
from splatpipe.cluster.job import Job
from splatpipe.cluster.live.board import Board
from splatpipe.cluster.live.expected import LiveCosts, expected, measure_costs, setting_of
from splatpipe.cluster.live.protocol import to_json
from splatpipe.cluster.predict.costs import Costs, StageCost
from splatpipe.cluster.predict.machine import Machine
from splatpipe.cluster.predict.setting import Setting
from splatpipe.cluster.topologies import FRAME_PARALLEL
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config, parse_config
from splatpipe.shared.messages import HEADER, RENDER_POINT
from splatpipe.shared.synth import CityScan

FEATURES = {
    "culling": ("frame", "cell", "visible cell"),
    "sampling": ("frame", "cell", "visible cell", "entry"),
    "render": ("frame", "entry", "point", "cold point", "covered pixel", "merged pixel"),
}
COUNTS = {"cells": 500.0, "entries": 200.0, "points": 1e6, "pixels": 1e5}


def costs(contention=0.0, **seconds):
    """1 ms a frame of culling, 2 ms of sampling, 10 ns a point and 20 ns a pixel of the picture."""
    of = {"culling": {"frame": 1e-3}, "sampling": {"frame": 2e-3}, "render": {"point": 10e-9}} | seconds
    stages = {stage: StageCost(dict.fromkeys(names, 0.0) | of[stage], 0.0) for stage, names in FEATURES.items()}
    return LiveCosts(Costs(stages, 0.0, 0.0, contention), 20e-9, 8000, 400_000, 4.0, True, 1)


def on(topology, ranks, **settings):
    return Setting(topology, 1, 4, ranks, **settings)


def test_three_ranks_by_hand():
    found = expected(costs(), on("pipelined", 3), COUNTS, Machine(cores=4))
    assert [(of["rank"], of["role"]) for of in found] == [(0, "culling"), (1, "sampling"), (2, "render")]
    culling, sampling, render = (of["values"] for of in found)
    assert culling["culling.work_ms"] == pytest.approx(1)
    assert sampling["sampling.work_ms"] == pytest.approx(2)
    assert render["render.work_ms"] == pytest.approx(10 + 2), "points, and the picture of them"
    rate = culling["frames_per_s"]
    assert rate == pytest.approx(1 / 0.010, rel=0.02), "the slowest stage; making the picture is no part of predict's"
    entries = HEADER.size + RENDER_POINT.itemsize * 200
    assert sampling["sent_bytes_per_s"] == pytest.approx(entries * rate)
    assert render["received_bytes_per_s"] > sampling["sent_bytes_per_s"], "and a camera"
    assert sampling["received_bytes_per_s"] > (HEADER.size + 1000) * rate


def test_what_ranks_take_from_each_other_depends_on_how_busy_they_are():
    def render_ms(cores, **counts):
        found = expected(costs(contention=0.5), on("pipelined", 3), COUNTS | counts, Machine(cores=cores))
        return found[2]["values"]["render.work_ms"]

    assert render_ms(4, frames_per_s=0.001) == pytest.approx(12, rel=1e-3), "alone"
    assert render_ms(4) == render_ms(4, frames_per_s=1e9) > render_ms(4, frames_per_s=30) > 12
    assert render_ms(1) > render_ms(4, frames_per_s=0)


def test_points_grow_with_the_picture_where_they_have_a_size_in_the_world():
    by_coverage = costs(render={"covered pixel": 10e-9})
    full, half = (by_coverage.load(COUNTS | {"pixels": pixels}) for pixels in (400_000, 100_000))
    assert full.covered == 4e6
    assert half.covered == 1e6
    assert by_coverage.load({name: COUNTS[name] for name in ("cells", "entries", "points")}).pixels == 400_000


@pytest.mark.parametrize(
    ("setting", "stages"),
    [
        (on("single", 1), [["culling", "render", "sampling"]]),
        (on("master-slave", 3), [["render"], *[["culling", "sampling"]] * 2]),
        (
            on("hybrid", 4, culling_ranks=1, sampling_ranks=1, render_ranks=2),
            [["culling"], ["sampling"], ["picture", "render"], ["render"]],
        ),
        (
            on("hybrid", 4, culling_ranks=1, sampling_ranks=1, render_ranks=2, render_split="shares"),
            [["culling"], ["sampling"], ["picture", "render"], ["render"]],
        ),
        (
            on("sort-last-only", 2),
            [["culling", "picture", "render", "sampling"], ["culling", "render", "sampling"]],
        ),
    ],
)
def test_every_topology(setting, stages):
    found = expected(costs(), setting, COUNTS, Machine(cores=8))
    assert [sorted(n.removesuffix(".work_ms") for n in of["values"] if n.endswith("work_ms")) for of in found] == stages
    assert all(math.isfinite(value) and value >= 0 for of in found for value in of["values"].values())
    work_ms = sum(of["values"].get("render.work_ms", 0) for of in found)
    assert work_ms == pytest.approx(12 if len(setting.layout().render) == 1 else 10, rel=0.01)
    sent, received = (sum(of["values"][f"{way}_bytes_per_s"] for of in found) for way in ("sent", "received"))
    assert sent == pytest.approx(received)
    assert (sent > 0) == (setting.size > 1)
    board = Board()
    board.hear({"kind": "prediction", "ranks": found})
    assert to_json({"kind": "prediction", "ranks": found})


def test_nothing_is_made_up():
    assert expected(costs(), on("pipelined", 3), {"points": 1e6, "pixels": 1e5}) == []
    assert expected(costs(), on(FRAME_PARALLEL, 3), COUNTS) == []
    nothing = expected(costs(), on("pipelined", 3), dict.fromkeys(COUNTS, 0.0), Machine(cores=2))
    assert nothing[2]["values"]["render.work_ms"] < 1e-3


def test_render_ranks_share_the_cores():
    def threads(ranks, **pipeline):
        render = {"threads": pipeline.pop("threads", 0)}
        run = parse_config({"scene": {"path": "x"}, "render": render, "pipeline": pipeline})
        return setting_of(run, ranks).threads

    alone = threads(3, topology="pipelined")
    assert threads(4, topology="hybrid", render_ranks=2) == max(1, alone // 2)
    assert threads(4, topology="hybrid", render_ranks=2, threads=7) == 7


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("expected")
    build_scene([CityScan(n_points=60_000)], folder / "city.scene", settings=BuildSettings(points_per_cell=300))
    (folder / "run.toml").write_text('[scene]\npath = "city.scene"\n[render]\npoint_size_world = 0.4\n')
    return folder


def test_costs_of_points_that_stay_on_disk(folder):
    paged = ["memory.residency=paged", "memory.budget=1MB", "camera.width=64", "camera.height=36"]
    assert measure_costs(Job(load_config(folder / "run.toml", paged)), 0.1) is not None


def test_costs_measured_here(folder, monkeypatch):
    from splatpipe.cluster.live import expected as module

    job = Job(load_config(folder / "run.toml", ["camera.width=320", "camera.height=180", "render.rasterizer=cpu"]))
    whole = measure_costs(job, 0.2)
    monkeypatch.setattr(module, "MOST_POINTS", 20_000)
    part = measure_costs(job, 0.2)
    for found in (whole, part):
        assert found.cells == job.scene.info.n_cells
        assert found.pixels == 320 * 180
        assert found.by_distance
        assert found.pixels_per_point >= 1
        culled = job.culling_node(job.load_octree()).process(job.camera(0))
        chosen = job.sampling_node(job.load_octree()).process(job.camera(0), culled)
        counts = {
            "cells": float(np.bitwise_count(culled.bits).sum()),
            "entries": len(chosen.entries),
            "points": chosen.n_points,
        }
        of = expected(found, setting_of(job.config, 3), counts)
        work = [v for rank in of for name, v in rank["values"].items() if name.endswith("work_ms")]
        assert len(work) == 3
        assert all(0 < value < 10_000 for value in work)


def test_no_model_of_what_the_gpu_draws(folder, monkeypatch):
    job = Job(load_config(folder / "run.toml", ["render.rasterizer=cpu"]))
    monkeypatch.setattr(Job, "rasterizer", "gl")
    assert measure_costs(job) is None
