"""The model of every topology: limits in which it is one rank or one link, what it never does, parts that are counted."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.cluster.job import Job
from splatpipe.cluster.launch import mpi_available
from splatpipe.cluster.measured import measured_run
from splatpipe.cluster.predict.costs import Costs, StageCost
from splatpipe.cluster.predict.forecast import forecast
from splatpipe.cluster.predict.machine import Machine, measured_machine
from splatpipe.cluster.predict.parts import COUNTED, MOST_COUNTED, CountedParts, EvenParts
from splatpipe.cluster.predict.recurrence import Stage, run_schedule
from splatpipe.cluster.predict.scaling import TOPOLOGIES, MeanParts, on_paper, scaling_table
from splatpipe.cluster.predict.setting import Setting
from splatpipe.cluster.predict.steps import INEQUALITIES
from splatpipe.cluster.predict.workload import Workload, count_workload
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import load_config
from splatpipe.shared.errors import InputError
from splatpipe.shared.synth import CityScan

needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")

COSTS = Costs(
    {
        "culling": StageCost({"frame": 2e-5, "cell": 3e-9, "visible cell": 1e-9}, 0.0),
        "sampling": StageCost({"frame": 1e-5, "cell": 1e-9, "visible cell": 2e-9, "entry": 1e-8}, 0.0),
        "render": StageCost(
            {
                "frame": 1e-4,
                "entry": 5e-8,
                "point": 6e-9,
                "cold point": 2e-9,
                "covered pixel": 1e-9,
                "merged pixel": 0.0,
            },
            0.0,
        ),
    },
    loop_s=1e-4,
    message_s=3e-5,
    contention=0.1,
)
FREE = Costs(
    {stage: StageCost(dict.fromkeys(of.seconds, 0.0), 0.0) for stage, of in COSTS.stages.items()},
    0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
)  # fmt: skip
ANY_RANKS = [name for name in TOPOLOGIES if name not in ("single", "pipelined")]


def load_of(points=1e6, n_frames=20):
    counts = points * np.linspace(0.5, 1.5, n_frames)
    visible, entries = counts / 100, counts / 700
    return Workload(points / 33, 1280 * 720, visible, entries, counts, entries * 150, counts * 4, 4000, entries * 9)


# --- the recurrence over ranks and links -----------------------------------------------------------------------------


def test_stages_of_one_rank_take_turns_and_two_branches_meet():
    cost = np.ones(3)
    stages = [
        Stage("a", cost),
        Stage("left", 2 * cost, after=(0,), on="one"),
        Stage("right", 3 * cost, after=(0,), on="one"),
        Stage("far", 4 * cost, after=(0,), link_s=0.5),
        Stage("all", cost, after=(2, 3)),
    ]
    schedule = run_schedule(stages, in_flight=3)
    assert schedule.start_s[:, 0].tolist() == [0, 1, 3, 1, 6]
    assert schedule.finish_s[4].tolist() == [7, 12, 17], "five seconds a frame on the rank of two stages"
    assert schedule.bottleneck == "one"
    assert schedule.utilisation["one"] == pytest.approx(15 / 17)
    with pytest.raises(InputError, match="stage b: found it after"):
        run_schedule([Stage("a", cost), Stage("b", cost, after=(1,))], in_flight=1)


# --- limits ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("topology", ANY_RANKS)
def test_one_rank_of_any_topology_is_one_rank(topology):
    load, machine = load_of(), Machine(4)
    alone = forecast(COSTS, load, Setting("single", 2, 4), machine)
    one = forecast(COSTS, load, Setting(topology, 2, 4, 1), machine)
    assert one.frames_per_s == pytest.approx(alone.frames_per_s, rel=1e-9)
    assert one.latency_ms == pytest.approx(alone.latency_ms, rel=1e-9)
    assert one.limit[1] == alone.limit[1] == "(3) vertices"


@pytest.mark.parametrize("topology", ANY_RANKS)
def test_links_that_cost_nothing_are_as_if_there_were_none(topology):
    here = forecast(COSTS, load_of(), Setting(topology, 1, 4, 4), Machine(64, bandwidth_bytes_per_s=math.inf))
    there = forecast(COSTS, load_of(), Setting(topology, 1, 4, 4), Machine(64, hosts=4, shared_cores=True))
    assert there.frames_per_s == pytest.approx(here.frames_per_s, rel=1e-6)


@pytest.mark.parametrize(("topology", "split"), [("sort-last-only", "shares"), ("sort-first-only", "tiles")])
@pytest.mark.parametrize("n", [2, 3, 7])
def test_where_only_links_cost_framebuffers_arrive_at_the_rate_of_one_link(topology, split, n):
    load, link = load_of(n_frames=400), 12.5e6
    setting = Setting(topology, 1, 4, n, compositing="direct")
    found = forecast(FREE, load, setting, Machine(64, hosts=n, link_bytes_per_s=link))
    arriving = (n - 1) * EvenParts(load).of(split, n)[0].filled_bytes.mean()
    assert found.frames_per_s == pytest.approx(link / arriving, rel=0.02)
    assert found.limit[1] == "(2) external bandwidth"
    assert found.schedule.utilisation["link into host 1"] == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("policy", ["direct-reduce", "binary-swap", "radix-k"])
def test_compositing_in_rounds_is_never_slower_than_the_link_of_the_display_allows_nor_than_direct(policy):
    load, link = load_of(n_frames=100), 12.5e6
    machine = Machine(64, hosts=8, link_bytes_per_s=link)
    rates = {
        name: forecast(FREE, load, Setting("sort-last-only", 1, 4, 8, compositing=name), machine).frames_per_s
        for name in ("direct", policy)
    }
    assert rates["direct"] < rates[policy] < link / (load.pixels * 8 * 0.5), "half of the picture's words must arrive"


def test_the_message_of_the_thesis_over_its_link():
    """Table 6-4 and 6.2.3: 117.19 KB of render-points a frame over 10.75 MB/s: 93.93 frames/s, were it all."""
    n_bytes, link = 117.19 * 1024, 10.75 * 1024 * 1024
    load = replace(load_of(n_frames=500), render_points_bytes=np.full(500, n_bytes), visibility_bytes=63.68 * 1024)
    found = forecast(FREE, load, Setting("pipelined", 1, 4), Machine(1, hosts=3, link_bytes_per_s=link))
    assert found.frames_per_s == pytest.approx(93.93, rel=0.01)
    assert found.limit == ("link out of host 2", "(2) external bandwidth")


def test_two_hosts_of_a_thousand_cores_share_nothing_but_names_of_one_machine_share_its_cores():
    setting = Setting("frame-parallel", 1, 4, 4)
    apart = forecast(COSTS, load_of(), setting, Machine(2, hosts=2)).frames_per_s
    together = forecast(COSTS, load_of(), setting, Machine(2, hosts=2, shared_cores=True)).frames_per_s
    assert apart == pytest.approx(2 * together, rel=0.01)


# --- what it never does ----------------------------------------------------------------------------------------------


@settings(max_examples=60, derandomize=True, deadline=None)
@given(
    st.sampled_from(ANY_RANKS),
    st.integers(1, 9),
    st.integers(1, 4),
    st.sampled_from(["tiles", "shares"]),
    st.floats(1e5, 1e9),
    st.floats(1.0, 100.0),
)
def test_more_bandwidth_less_latency_and_faster_cores_never_slow_a_run_down(topology, ranks, hosts, split, link, times):
    costs, load = replace(COSTS, contention=0.0), load_of(n_frames=8)
    setting = Setting(topology, 1, 4, ranks, render_split=split)
    machine = Machine(64, hosts=hosts, link_bytes_per_s=link)
    base = forecast(costs, load, setting, machine)
    better = [
        forecast(costs, load, setting, replace(machine, link_bytes_per_s=link * times)),
        forecast(replace(costs, message_s=costs.message_s / times), load, setting, machine),
        forecast(costs, load, setting, replace(machine, speed=times)),
        forecast(costs, load.scaled(1 / times), setting, machine),
    ]
    assert min(found.frames_per_s for found in better) >= base.frames_per_s * (1 - 1e-9)
    busiest = max(
        sum(float(step.seconds(8).sum()) for step in base.steps if step.on == on) for on in {s.on for s in base.steps}
    )
    if topology != "frame-parallel":
        assert base.schedule.total_s >= busiest * (1 - 1e-9), "no rank or link works faster than it can"
    assert base.limit[1] in INEQUALITIES.values()


# --- on paper --------------------------------------------------------------------------------------------------------


def test_every_topology_goes_on_to_many_ranks_and_says_what_limits_it():
    found = scaling_table(COSTS, load_of(1e6), Machine(1, link_bytes_per_s=1.25e9), 512)
    assert list(found) == list(TOPOLOGIES)
    for topology, of in found.items():
        assert list(of) == {"single": [1], "pipelined": [3]}.get(topology, [4, 16, 64, 256, 512])
        assert all(at.limit[1] in INEQUALITIES.values() for at in of.values())
        assert all(0 < at.frames_per_s < math.inf and at.latency_s > 0 for at in of.values())
    assert found["frame-parallel"][512].limit[1] == "(2) external latency", "notes of 511 ranks to one"
    assert found["master-slave"][4].limit == ("rank 0, render", "(3) vertices"), "one rank draws everything"
    assert found["sort-first"][512].limit == ("rank 0, culling+sampling of tile 0", "(2) external latency"), "cameras"
    rates = [of.frames_per_s for of in found["hybrid"].values()]
    assert rates == sorted(rates), "no more ranks are used than pay"


def test_shares_that_cost_nothing_to_join_scale_with_the_ranks():
    free = replace(COSTS, message_s=0.0, loop_s=0.0, encode_pixel_s=0.0, encode_word_s=0.0, merge_word_s=0.0)
    parts = MeanParts(EvenParts(load_of(1e9)))
    rates = [
        on_paper(free, parts, Setting("sort-last-only", 1, 4, n), Machine(1, bandwidth_bytes_per_s=1e18)).frames_per_s
        for n in (1, 4, 16)
    ]
    assert rates[1] == pytest.approx(4 * rates[0], rel=0.01)
    assert rates[2] == pytest.approx(16 * rates[0], rel=0.01)


# --- counted ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parts")
    build_scene([CityScan(n_points=20_011)], folder / "city", settings=BuildSettings(points_per_cell=300))
    path = folder / "run.toml"
    path.write_text(
        '[scene]\npath = "city"\n[camera]\nwidth = 160\nheight = 90\n[output]\nframes = 4\n'
        '[render]\nrasterizer = "cpu"\nthreads = 1\n[sampling]\npixel_threshold = 8.0\n'
    )
    return path


@pytest.fixture(scope="module")
def parts(config):
    job = Job(load_config(config))
    return CountedParts(job, count_workload(job))


def test_counting_writes_nothing(config, tmp_path):
    job = Job(load_config(config, [f"output.directory={tmp_path}/film", "output.mp4=true", "output.depth=true"]))
    assert len(CountedParts(job, count_workload(job)).of("shares", 2)) == 2
    assert not (tmp_path / "film").exists()


@pytest.mark.parametrize("kind", ["tiles", "shares", "subtrees"])
def test_parts_hold_everything_and_shares_nothing_twice(parts, kind):
    whole = parts.whole
    for n in (1, 2, 5):
        of = parts.of(kind, n)
        assert len(of) == n
        for name in COUNTED[1:]:
            total = sum(getattr(part.load, name) for part in of)
            assert (total >= getattr(whole, name) - 1e-6).all(), name
        points = sum(part.load.points for part in of)
        if kind != "tiles":
            assert points == pytest.approx(whole.points)
            assert sum(part.load.cells for part in of) < whole.cells * 1.5, "a few shared ancestors"
        elif n > 1:
            assert (points > whole.points).all(), "cells on borders are drawn twice"
            assert sum(part.pixels for part in of) == whole.pixels


def test_more_parts_than_are_counted_go_on_as_the_last_ones(parts):
    for kind in ("tiles", "shares", "subtrees"):
        last, more = parts.of(kind, MOST_COUNTED), parts.of(kind, 8 * MOST_COUNTED)
        assert len(more) == 8 * MOST_COUNTED
        fullest = [max(part.load.points.mean() for part in of) for of in (last, more)]
        assert fullest[1] < fullest[0]
        assert sum(p.load.points.mean() for p in more) >= sum(p.load.points.mean() for p in last) * (1 - 1e-9)


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize(("topology", "kind"), [("sort-last-only", "shares"), ("sort-first-only", "tiles")])
def test_the_framebuffers_of_a_run_have_the_bytes_that_were_counted(config, parts, topology, kind):
    record = measured_run(config, [f"pipeline.topology={topology}", "pipeline.ranks=3"])
    counted = sum(part.filled_bytes.sum() for part in parts.of(kind, 3)[1:])
    assert record["messages"]["FRAMEBUFFER"]["bytes"] == counted


@needs_mpi
@pytest.mark.mpi
def test_ranks_of_one_host_find_no_link():
    machine = measured_machine(2)
    assert (machine.hosts, machine.link_bytes_per_s, machine.shared_cores) == (1, math.inf, False)
    assert machine.cores >= 1
