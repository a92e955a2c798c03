"""What a run leaves out, the choice of topology, and that leaving out changes no bit."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from build_sources import ArraySource, columns_for
from splatpipe.cluster.job import Job
from splatpipe.cluster.launch import mpi_available
from splatpipe.cluster.plan import part as named
from splatpipe.cluster.plan import topology
from splatpipe.cluster.plan.ablation import ablate, same, trials
from splatpipe.cluster.plan.command import plan_command, report_plan
from splatpipe.cluster.plan.costs import COSTS
from splatpipe.cluster.plan.needs import left_out, parts
from splatpipe.cluster.plan.topology import Decision, choose_topology, decide, estimate
from splatpipe.cluster.plan.whole_runs import same_pictures
from splatpipe.cluster.plan.workload import Workload
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config
from splatpipe.shared.synth import CityScan

needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """``bare``: positions and intensity only; ``city``: everything; ``one``: a single cell."""
    folder = tmp_path_factory.mktemp("scenes")
    cloud = np.random.default_rng(3).normal(size=(5000, 3))
    bare = ArraySource(cloud, columns_for(len(cloud), ["intensity"]))
    build_scene([bare], folder / "bare", settings=BuildSettings(points_per_cell=60))
    build_scene([bare], folder / "one", settings=BuildSettings(points_per_cell=5000))
    build_scene([CityScan(n_points=20_000)], folder / "city", settings=BuildSettings(points_per_cell=300))
    return folder


@pytest.fixture
def config(scenes, tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(
        f'[scene]\npath = "{scenes}/bare"\n[camera]\nwidth = 96\nheight = 64\n[render]\nrasterizer = "cpu"\n'
        f'[output]\nframes = 3\npng = false\ndirectory = "{tmp_path}/out"\n'
    )
    return path


def job_of(config, *sets) -> Job:
    return Job(load_config(config, [*sets]))


def names(job: Job, held: bool = True) -> set[str]:
    work, decision = Workload.of_look(job), Decision("single", "so")
    return {part.what for part in parts(job, work, decision) if part.left_out is held}


# --- what is left out --------------------------------------------------------------------------------------------


def test_a_bare_scene_leaves_out_what_it_has_no_use_for(config):
    found = names(job_of(config, "render.colour=#ff8000", "sampling.pixel_threshold=0"))
    assert found == {
        named.MPI,
        named.COMPRESSION,
        "delivery of the scene by messages",
        "compositing",
        named.NO_NORMALS,
        named.LEVEL_OF_DETAIL,
        named.CLASSES,
        named.BOXES,
        named.SPLAT_LOOP,
        named.ADAPTIVE,
        "compact positions",
        "pools",
        named.PAGING,
        "splat passes, normals and radii",
        "quads of flat cells",
        named.COLOUR,
        "attributes intensity",
        "codecs",
        "flatness analysis",
        named.LAYERS,
        named.OPENGL,
        named.COLOUR_MAPS,
        "second eye, panorama",
        "supersampling",
        named.LIGHTING,
        named.PNG,
        named.FILM,
        named.DEPTHS,
        named.NORMALS,
        "16-bit colours",
    }


def test_what_is_asked_for_is_kept(config, scenes):
    job = job_of(
        config,
        f"scene.path={scenes}/city",
        "culling.backface=true",
        "render.point_size_px=3",
        "render.colour=elevation",
        "output.png=true",
        "output.mp4=true",
    )
    kept = names(job, held=False)
    assert kept >= {named.BACK_FACE, named.LEVEL_OF_DETAIL, named.SPLAT_LOOP, named.COLOUR, named.COLOUR_MAPS}
    assert kept >= {named.CHECKSUMS, named.PNG, named.FILM, "stride of render-points entries"}


def test_compact_positions_are_left_out_where_nothing_is_drawn_from_them(config, scenes):
    job = job_of(config, f"scene.path={scenes}/city", "render.positions=compact", "render.rasterizer=gl")
    found = {part.what: part for part in parts(job, Workload.of_look(job), Decision("single", "so"))}
    assert found["compact positions"].left_out
    assert found["compact positions"].why.startswith("rasterizer gl")


def test_what_a_picture_asks_for_is_kept_and_what_it_costs_is_said(config, scenes):
    job = job_of(
        config,
        f"scene.path={scenes}/city",
        "filter.classes=[2, 6]",
        "filter.boxes=[{ lower = [0, 0, 0], upper = [50, 50, 50] }]",
        "render.point_size_adaptive=true",
        "render.positions=compact",
        "render.supersampling=2",
        "render.edl_strength=0.5",
        "camera.view=stereo",
        "output.png_bits=16",
        "output.depth=true",
        "output.normals=true",
    )
    kept = {
        part.what: part for part in parts(job, Workload.of_look(job), Decision("single", "so")) if not part.left_out
    }
    assert kept.keys() >= {named.CLASSES, named.BOXES, named.ADAPTIVE, named.LIGHTING, named.DEPTHS, named.NORMALS}
    assert kept.keys() >= {"compact positions", "supersampling", "second eye, panorama", "16-bit colours"}
    assert "2, 6" in kept[named.CLASSES].why
    assert all(part.gain > 0 for part in kept.values() if part.gain is not None)
    drawn, composed = 4 * 96 * 64, 96 * 64
    assert kept["16-bit colours"].gain == 4 * composed
    assert kept["supersampling"].gain == pytest.approx((COSTS.pixel_s + COSTS.average_s) * drawn * 1e3)
    unlit = estimate(job_of(config), WORK, cores=2)
    lit = estimate(job_of(config, "render.edl_strength=0.5", "output.png=true"), WORK, cores=2)
    assert lit.render_s - unlit.render_s == pytest.approx(WORK.pixels * (COSTS.edl_s / 2 + COSTS.picture_s))


def test_a_scene_is_delivered_by_messages_where_there_is_another_rank_and_it_is_asked_for(config):
    def delivery(job, topology):
        found = {part.what: part for part in parts(job, Workload.of_look(job), Decision(topology, "so"))}
        return found["delivery of the scene by messages"]

    job = job_of(config, "scene.delivery=messages", "render.colour=#ff8000")
    kept = delivery(job, "pipelined")
    assert not kept.left_out
    info = job.scene.info
    assert kept.gain == pytest.approx(1e-6 * (12 * info.n_stored + 32 * info.n_blocks))
    assert delivery(job, "single").left_out
    assert "no effect" in delivery(job, "single").why
    assert delivery(job_of(config), "pipelined").left_out


def test_a_scene_of_one_cell_has_no_level_of_detail(config, scenes):
    assert named.LEVEL_OF_DETAIL in names(job_of(config, f"scene.path={scenes}/one"))


def test_gains_are_counts_times_unit_costs(config):
    job = job_of(config, "render.colour=#ff8000")
    work = Workload.of_look(job)
    found = {item["what"]: item for item in left_out(job, work, Decision("single", "so"))}
    assert found["compositing"]["gain"] == pytest.approx(1e-6 * 96 * 64 * 8)
    assert found[named.COLOUR]["gain"] == pytest.approx(4e-6 * job.scene.info.n_stored)
    assert found["attributes intensity"]["gain"] == pytest.approx(4e-6 * job.scene.info.n_stored)
    assert all(item["gain"] is None or item["gain"] > 0 for item in found.values())
    assert all(item["why"] and item["unit"] and item["basis"] for item in found.values())


# --- the choice of topology --------------------------------------------------------------------------------------


WORK = Workload(cells=1000, cells_visible=1000, entries=100, points=1e6, pixels=10**6, culling_s=1e-4, sampling_s=1e-4)


def test_little_selection_runs_on_one_rank_and_says_what_three_would_cost(config, monkeypatch):
    monkeypatch.setattr(topology.os, "sched_getaffinity", lambda _: {0, 1})
    chosen = choose_topology(job_of(config, "output.frames=1000000"), WORK)
    assert chosen.topology == "single"
    assert "0.2 ms of" in chosen.reason
    assert "spend 0.5 ms on messages" in chosen.reason


def test_much_selection_runs_on_three_ranks_unless_the_run_is_short(config, monkeypatch):
    monkeypatch.setattr(topology.os, "sched_getaffinity", lambda _: {0, 1})
    work = replace(WORK, culling_s=3e-3, sampling_s=3e-3)
    assert choose_topology(job_of(config, "output.frames=10000"), work).topology == "pipelined"
    short = choose_topology(job_of(config, "output.frames=20"), work)
    assert (short.topology, "longer to start" in short.reason) == ("single", True)


def test_one_core_never_gains_by_ranks(config):
    for seconds in (1e-4, 1e-2, 1.0):
        found = estimate(job_of(config), replace(WORK, culling_s=seconds, sampling_s=seconds), cores=1)
        assert found.pipelined_s > found.single_s


def test_more_cores_gain_more_until_the_slowest_stage_is_left(config):
    job = job_of(config, "render.threads=1")
    work = replace(WORK, culling_s=3e-3, sampling_s=3e-3)
    found = [estimate(job, work, cores) for cores in (1, 2, 3, 16)]
    times = [e.pipelined_s for e in found]
    assert times == sorted(times, reverse=True)
    assert times[-1] == pytest.approx(max(3e-3, found[-1].render_s) + found[-1].message_s)


def test_encoders_that_fill_the_cores_leave_nothing_to_gain(config):
    work = replace(WORK, culling_s=1e-3, sampling_s=1e-3)
    found = estimate(job_of(config, "output.png=true", "output.mp4=true"), work, cores=2)
    assert found.single_s == pytest.approx(found.busy_s / 2)
    assert found.pipelined_s > found.single_s


def test_the_configuration_has_the_last_word_and_nothing_is_looked_at(config, monkeypatch):
    monkeypatch.setattr(topology.Workload, "of_look", lambda _: pytest.fail("not needed"))
    for wanted in ("single", "pipelined"):
        decision = decide(job_of(config, f"pipeline.topology={wanted}"))
        assert (decision.topology, decision.estimate) == (wanted, None)
    monkeypatch.setattr(topology, "mpi_available", lambda: False)
    assert decide(job_of(config)).topology == "single"


def test_a_decision_survives_the_way_to_the_ranks(config):
    decision = choose_topology(job_of(config), WORK)
    assert Decision.from_json(decision.to_json()) == decision
    assert Decision.from_json(Decision("single", "so").to_json()) == Decision("single", "so")


def test_a_look_counts_what_a_run_counts(config, scenes):
    config.write_text(config.read_text().replace("frames = 3", "frames = 5"))
    sets = [f"scene.path={scenes}/city", "sampling.pixel_threshold=4"]
    run = run_of(config, *sets)
    job = job_of(config, *sets)
    look, ran = Workload.of_look(job), Workload.of_run(job, run["per_frame"])
    for name in ("cells", "cells_visible", "entries", "points", "pixels"):
        assert getattr(look, name) == getattr(ran, name)


# --- the record of a run -----------------------------------------------------------------------------------------


def run_of(config, *sets) -> dict:
    command = [sys.executable, "-m", "splatpipe.cluster", "run", str(config)]
    command += [part for item in sets for part in ("--set", item)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads((config.parent / "out" / "run.json").read_text())


@needs_mpi
@pytest.mark.mpi
def test_auto_puts_a_small_scene_on_one_rank_and_the_record_says_why(config):
    run = run_of(config)
    assert run["topology"] == run["plan"]["topology"] == "single"
    assert "culling and sampling take" in run["plan"]["reason"]
    assert run["plan"]["estimate"]["single_s"] < run["plan"]["estimate"]["pipelined_s"]
    assert next(item for item in run["left_out"] if item["what"] == "MPI")["why"] == run["plan"]["reason"]


@needs_mpi
@pytest.mark.mpi
def test_a_forced_topology_reaches_the_ranks_with_its_reason(config):
    run = run_of(config, "pipeline.topology=pipelined")
    assert run["plan"] == {"topology": "pipelined", "reason": "pipeline.topology = 'pipelined'", "estimate": None}


# --- ablation: error added = 0 -----------------------------------------------------------------------------------

ONE_PIXEL = named.SPLAT_LOOP, named.ADAPTIVE
ALWAYS = {named.CHECKSUMS, named.BOXES, named.LIGHTING, named.PNG, named.DEPTHS, named.NORMALS}


@pytest.mark.parametrize(
    ("scene", "sets", "expected"),
    [
        ("bare", ["render.colour=#ff8000"], {named.NO_NORMALS, *ONE_PIXEL, named.COLOUR}),
        ("bare", ["sampling.pixel_threshold=0"], {named.NO_NORMALS, *ONE_PIXEL, named.LEVEL_OF_DETAIL}),
        ("bare", ["render.point_size_px=3", "render.colour=#ff8000"], {named.NO_NORMALS, named.COLOUR}),
        ("city", ["sampling.pixel_threshold=0"], {named.LEVEL_OF_DETAIL, *ONE_PIXEL, named.CLASSES}),
        ("city", ["filter.classes=[2, 6]", "render.supersampling=2"], set()),
        ("one", ["render.threads=1", "render.colour=#ff8000"], {named.NO_NORMALS, *ONE_PIXEL, named.COLOUR}),
    ],
)
def test_leaving_out_adds_no_error(config, scenes, scene, sets, expected):
    job = job_of(config, f"scene.path={scenes}/{scene}", *sets)
    with trials(job) as found:
        assert {trial.part for trial in found} == expected | ALWAYS
        for trial in found:
            for frame in range(job.n_frames):
                assert same(trial, job.camera(frame)), trial.part


def test_a_trial_that_changes_a_bit_is_found_out(config):
    job = job_of(config)
    with trials(job) as found:
        trial = next(trial for trial in found if trial.part == named.SPLAT_LOOP)
        changed = replace(trial, with_part=lambda camera: trial.without(camera) ^ np.uint64(1))
        assert not same(changed, job.camera(0))


def test_every_ablation_says_what_it_saved_and_that_nothing_changed(config):
    found = ablate(job_of(config, "render.colour=#ff8000"), n_frames=2)
    assert {a.part for a in found} == {named.NO_NORMALS, *ONE_PIXEL, named.COLOUR} | ALWAYS
    assert all(a.identical and a.repeats >= 5 for a in found)
    assert all(a.without_ms["median"] > 0 and a.with_ms["median"] > 0 for a in found)


@needs_mpi
@pytest.mark.mpi
def test_one_rank_draws_what_three_draw_and_a_film_changes_no_picture(config):
    base = ["pipeline.topology=single"]
    assert same_pictures(config, base, ["pipeline.topology=pipelined"])
    pytest.importorskip("av")
    assert same_pictures(config, base, ["output.mp4=true"])


def test_the_command_reports_what_it_planned(config, tmp_path):
    results = plan_command(config, ["pipeline.topology=single"])
    json.dumps(results)
    html, markdown = report_plan(results, tmp_path / "plan")
    for part in results["parts"]:
        assert part["what"] in markdown.read_text()
    assert "pipeline.topology" in html.read_text()
