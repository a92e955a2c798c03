"""The holistic model: the recurrence by hand and by property, the fit, the forecast, ranks on paper."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.cluster.experiment.grid import load_experiment
from splatpipe.cluster.job import Job
from splatpipe.cluster.measured import measured_run
from splatpipe.cluster.predict.calibrate import calibration_points, extended, with_point
from splatpipe.cluster.predict.command import predict_command, validate_command
from splatpipe.cluster.predict.costs import Costs, Measured, StageCost, fit_costs, fit_stage, stage_columns
from splatpipe.cluster.predict.forecast import fit_messages, forecast
from splatpipe.cluster.predict.hybrid import best_split, split_costs
from splatpipe.cluster.predict.machine import Machine
from splatpipe.cluster.predict.recurrence import Stage, run_schedule
from splatpipe.cluster.predict.scaling import TOPOLOGIES
from splatpipe.cluster.predict.setting import Setting
from splatpipe.cluster.predict.whatif import Case, changed
from splatpipe.cluster.predict.workload import COLD_POINTS, Workload, count_workload, threads_of
from splatpipe.cluster.topologies import check_topology
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import RunConfig, load_config, parse_config
from splatpipe.shared.errors import ConfigError, InputError
from splatpipe.shared.rebuild import leaf_ranges
from splatpipe.shared.synth import CityScan


def chain(*costs, n_frames=50, links=None, workers=None):
    """Stages of constant cost."""
    return [
        Stage(f"s{i}", np.full(n_frames, float(cost)), (workers or {}).get(i, 1), (links or {}).get(i, 0.0))
        for i, cost in enumerate(costs)
    ]


def test_three_stages_by_hand():
    schedule = run_schedule(chain(1, 3, 2, n_frames=4), in_flight=2)
    # frame 2 waits for frame 0 to be done (6), frame 3 for frame 1 (9)
    assert schedule.start_s.tolist() == [[0, 1, 6, 9], [1, 4, 7, 10], [4, 7, 10, 13]]
    assert schedule.finish_s.tolist() == [[1, 2, 7, 10], [4, 7, 10, 13], [6, 9, 12, 15]]
    assert schedule.total_s == 15
    assert schedule.latency_s.tolist() == [6, 8, 6, 6]
    assert schedule.bottleneck == "s1"
    assert schedule.utilisation == {"s0": 4 / 15, "s1": 12 / 15, "s2": 8 / 15}


def test_throughput_is_the_slowest_stage_s_and_latency_grows_with_the_frames_in_flight():
    for in_flight in (3, 4, 8):
        schedule = run_schedule(chain(1, 4, 2), in_flight=in_flight)
        assert schedule.steady_frames_per_s == pytest.approx(1 / 4)
        assert schedule.latency_s[-1] == pytest.approx(4 * in_flight), "Little: frames in flight over throughput"
    one = run_schedule(chain(1, 4, 2), in_flight=1)
    assert one.steady_frames_per_s == pytest.approx(1 / 7)
    assert (one.latency_s == 7).all()


def test_links_delay_frames_but_do_not_slow_them_down_while_enough_are_in_flight():
    schedule = run_schedule(chain(1, 2, links={0: 10}), in_flight=8)
    assert schedule.steady_frames_per_s == pytest.approx(1 / 2)
    assert schedule.latency_s[0] == 13
    assert run_schedule(chain(1, 2, links={0: 10}), in_flight=1).steady_frames_per_s == pytest.approx(1 / 13)


def test_workers_take_frames_in_turn():
    schedule = run_schedule(chain(1, 6, workers={1: 3}), in_flight=16)
    assert schedule.steady_frames_per_s == pytest.approx(1 / 2, rel=0.05), "three frames end at once"
    assert schedule.bottleneck == "s1"


def test_rates_a_million_apart_zero_stages_and_one_frame():
    schedule = run_schedule(chain(1e-6, 1.0, 1e-6, n_frames=100), in_flight=4)
    assert schedule.steady_frames_per_s == pytest.approx(1.0, rel=1e-9)
    assert schedule.bottleneck == "s1"
    nothing = run_schedule(chain(0, 0, 0), in_flight=4)
    assert nothing.frames_per_s == nothing.steady_frames_per_s == np.inf
    assert set(nothing.utilisation.values()) == {0.0}
    assert run_schedule(chain(0, 2, 0), in_flight=4).steady_frames_per_s == pytest.approx(0.5)
    single = run_schedule(chain(1, 2, 3, n_frames=1), in_flight=4)
    assert (single.total_s, single.latency_s.tolist()) == (6, [6])


@pytest.mark.parametrize(
    ("stages", "in_flight", "said"),
    [
        (chain(1), 0, "frames in flight: found 0"),
        ([], 1, "no stage"),
        (chain(1, n_frames=0), 1, "no frame"),
        (chain(1, -1), 1, "stage s1: expected finite costs"),
        (chain(np.nan), 1, "stage s0: expected finite costs"),
        (chain(1, np.inf), 1, "stage s1: expected finite costs"),
        ([*chain(1, n_frames=3), *chain(1, n_frames=4)], 1, "found 4 costs, expected 3"),
    ],
)
def test_what_no_schedule_can_be_made_of(stages, in_flight, said):
    with pytest.raises(InputError, match=said):
        run_schedule(stages, in_flight=in_flight)


costs = st.lists(
    st.lists(st.floats(0, 10), min_size=6, max_size=6), min_size=1, max_size=4
)  # stages × frames  # fmt: skip


@settings(max_examples=60, derandomize=True)
@given(costs, st.integers(1, 5), st.lists(st.integers(1, 3), min_size=4, max_size=4), st.floats(0, 3))
def test_no_faster_than_any_stage_and_frames_in_order(costs, in_flight, workers, link):
    stages = [Stage(str(i), np.array(c), workers[i], link) for i, c in enumerate(costs)]
    schedule = run_schedule(stages, in_flight=in_flight)
    for i, stage in enumerate(stages):
        assert schedule.total_s >= stage.cost_s.sum() / stage.workers - 1e-9
        assert (np.diff(schedule.start_s[i]) >= 0).all()
        assert schedule.finish_s[i] == pytest.approx(schedule.start_s[i] + stage.cost_s)
        if i:
            assert (schedule.start_s[i] >= schedule.finish_s[i - 1] + link).all()
    open_frames = [(schedule.start_s[0] <= t).sum() - (schedule.finish_s[-1] <= t).sum() for t in schedule.start_s[0]]
    assert max(open_frames) <= in_flight or 0 in np.array(costs).sum(axis=0)


@settings(max_examples=60, derandomize=True)
@given(costs, st.integers(1, 5), st.data())
def test_every_time_is_monotone_in_every_cost_and_in_the_frames_in_flight(costs, in_flight, data):
    stages = [Stage(str(i), np.array(c)) for i, c in enumerate(costs)]
    before = run_schedule(stages, in_flight=in_flight)
    i, f = data.draw(st.integers(0, len(costs) - 1)), data.draw(st.integers(0, 5))
    dearer = stages[i].cost_s.copy()
    dearer[f] += data.draw(st.floats(0, 5))
    after = run_schedule([*stages[:i], replace(stages[i], cost_s=dearer), *stages[i + 1 :]], in_flight=in_flight)
    assert (after.finish_s >= before.finish_s).all()
    assert (run_schedule(stages, in_flight=in_flight + 1).finish_s <= before.finish_s).all()


# --- the fit ---------------------------------------------------------------------------------------------------------

TRUE = Costs(
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
                "merged pixel": 1e-9,
            },
            0.0,
        ),
    },
    loop_s=1e-4,
    message_s=3e-5,
    contention=0.1,
    late_s=1e-3,
)


def load_of(seed=0, points=1e6, pixels=1280 * 720, n_frames=30, square=4):
    rng = np.random.default_rng(seed)
    counts = points * rng.uniform(0.5, 1.5, n_frames)
    visible, entries = counts / rng.uniform(50, 150, n_frames), counts / rng.uniform(500, 900, n_frames)
    cold, covered = entries * rng.uniform(100, 200, n_frames), counts * square
    return Workload(30_000 * points / 1e6, pixels, visible, entries, counts, cold, covered, 4000, entries * 9)


def run_of(load, topology, threads, machine=Machine(cores=8), noise=0.0):  # noqa: B008
    """What would have been measured if the costs were ``TRUE``."""
    rng = np.random.default_rng(7)
    setting = Setting(topology, threads, 4)
    rate = forecast(TRUE, load, setting, machine).frames_per_s
    slower = 1 + TRUE.contention * (threads - 1)
    columns = stage_columns(load, threads)
    lists = {}
    for stage in TRUE.stages:
        factor = slower if stage == "render" else 1.0
        lists[f"{stage}_s"] = (
            TRUE.stages[stage].of(columns[stage]) * factor * (1 + noise * rng.normal(size=30))
        ).tolist()
    config = parse_config({"pipeline": {"topology": topology, "frames_in_flight": 4}, "render": {"threads": threads}})
    return Measured(config, load, [{"topology": topology, "frames_per_s": rate, "per_frame": lists}])


def test_the_fit_finds_the_costs_that_made_the_runs_and_predicts_others():
    loads = [load_of(1, 2e5), load_of(2, 2e6), load_of(3, 1e6, pixels=640 * 360, square=9)]
    runs = [run_of(load, "single", 1) for load in loads] + [run_of(loads[1], "single", 4)]
    runs += [run_of(loads[0], "pipelined", 1), run_of(loads[1], "pipelined", 8)]
    machine = Machine(cores=8)
    fitted = fit_messages(fit_costs(runs), runs, machine)
    for stage, cost in fitted.stages.items():
        assert cost.residual < 1e-6
        for name in ("point", "cold point", "merged pixel", "entry"):
            if name in cost.seconds:
                assert cost.seconds[name] == pytest.approx(TRUE.stages[stage].seconds[name], rel=0.01)
    assert fitted.contention == pytest.approx(0.1, rel=0.05)
    assert fitted.loop_s == pytest.approx(1e-4, rel=0.01)
    assert fitted.message_s == pytest.approx(3e-5, rel=0.1)
    assert fitted.late_s == pytest.approx(1e-3, rel=0.1)
    for setting in (Setting("single", 2, 4), Setting("pipelined", 2, 4), Setting("pipelined", 1, 1)):
        other = load_of(9, 5e6)
        found = forecast(fitted, other, setting, machine).frames_per_s
        assert found == pytest.approx(forecast(TRUE, other, setting, machine).frames_per_s, rel=0.01)


def test_residuals_are_the_noise_and_no_cost_is_negative():
    runs = [run_of(load_of(i, 10.0**i), "single", 1, noise=0.05) for i in (5, 6, 7)]
    fitted = fit_costs(runs)
    for cost in fitted.stages.values():
        assert 0.02 < cost.residual < 0.08
        assert min(cost.seconds.values()) >= 0
    falling = fit_stage([{"frame": np.ones(3), "x": np.arange(3.0)}], [np.array([3.0, 2.0, 1.0])])
    assert falling.seconds["x"] == 0


def test_costs_need_a_run_on_one_rank_and_one_thread():
    with pytest.raises(InputError, match="found no run of topology single with one thread"):
        fit_costs([run_of(load_of(), "pipelined", 1)])


# --- the forecast ----------------------------------------------------------------------------------------------------


def test_fewer_cores_never_help_and_many_do_not_hurt():
    for setting in (Setting("single", 4, 4), Setting("pipelined", 4, 4)):
        rates = [forecast(TRUE, load_of(), setting, Machine(cores)).frames_per_s for cores in (1, 2, 4, 8, 64)]
        assert rates == pytest.approx(sorted(rates), rel=1e-3), "to within the fixed point"
        assert rates[0] < 0.5 * rates[-1]
    one_core = forecast(TRUE, load_of(), Setting("pipelined", 1, 4), Machine(1))
    assert one_core.inflation["render"] > 1


def test_one_core_shared_by_three_equal_stages_is_no_faster_than_one_rank():
    stage = {"frame": 1e-2}
    even = Costs(
        {s: StageCost(stage | {n: 0.0 for n in TRUE.stages[s].seconds if n != "frame"}, 0.0) for s in TRUE.stages},
        0,
        0,
        0,
    )
    rates = {
        cores: forecast(even, load_of(), Setting("pipelined", 1, 4), Machine(cores)).frames_per_s for cores in (1, 3)
    }
    assert rates[3] == pytest.approx(100, rel=0.1)
    assert 30 <= rates[1] <= 50, "mean-value: the share of a core that each gets is not exact"


def test_a_late_thread_costs_no_more_than_drawing_with_one():
    load, machine = load_of(points=1e5), Machine(2)
    rates = {
        late_s: forecast(replace(TRUE, late_s=late_s), load, Setting("pipelined", 2, 4), machine).frames_per_s
        for late_s in (0.0, 1e-4, 1.0)
    }
    assert rates[0.0] > rates[1e-4] > rates[1.0]
    one = forecast(TRUE, load, Setting("pipelined", 1, 4), machine).frames_per_s
    assert rates[1.0] == pytest.approx(one, rel=0.25), "as much work; the other thread still contends for memory"
    alone = [forecast(replace(TRUE, late_s=s), load, Setting("single", 2, 4), machine).frames_per_s for s in (0.0, 1.0)]
    assert alone[0] == alone[1], "nobody else wakes"


def test_bandwidth_latency_and_speed_work_as_they_should():
    setting = Setting("pipelined", 1, 4)
    machine = Machine(8)
    base = forecast(TRUE, load_of(), setting, machine)
    slow_link = forecast(TRUE, load_of(), setting, replace(machine, bandwidth_bytes_per_s=1e5))
    assert slow_link.latency_ms > base.latency_ms
    assert forecast(replace(TRUE, message_s=5e-3), load_of(), setting, machine).frames_per_s < base.frames_per_s
    fast = forecast(TRUE, load_of(), setting, replace(machine, speed=2.0))
    assert fast.frames_per_s == pytest.approx(2 * base.frames_per_s, rel=0.01)


# --- ranks on paper --------------------------------------------------------------------------------------------------


def test_the_best_split_uses_the_ranks_that_pay():
    big = load_of(points=1e9)
    found = [best_split(TRUE, big, Machine(1), 2**i) for i in range(2, 13)]
    rates = [split.frames_per_s for split in found]
    assert rates[0] < rates[3] < max(rates)
    assert found[0].limit == ("render", "(3) vertices")
    assert max(found, key=lambda of: of.frames_per_s).limit[1] in (
        "(2) external latency",
        "(6) fragments",
        "(2) external bandwidth",
    )
    alone = split_costs(TRUE, big, Machine(1), 1, 1, 1)
    assert rates[-1] < 4096 * alone.frames_per_s
    small = best_split(TRUE, load_of(points=1e4), Machine(1), 4096)
    assert small.ranks < 100, "a small scene does not use ranks that do not pay"


def test_no_selection_latency_means_no_message_limit():
    split = best_split(replace(TRUE, message_s=0.0), load_of(points=1e9), Machine(1, bandwidth_bytes_per_s=1e15), 4096)
    assert split.limit[1] in ("(3) vertices", "(6) fragments", "(7) processor")


# --- counted and run -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("predict")
    build_scene([CityScan(n_points=20_000)], folder / "city", settings=BuildSettings(points_per_cell=300))
    path = folder / "run.toml"
    path.write_text(
        '[scene]\npath = "city"\n[camera]\nwidth = 160\nheight = 90\n[output]\nframes = 5\n'
        '[render]\nrasterizer = "cpu"\n[sampling]\npixel_threshold = 8.0\n'
    )
    return path


def test_the_workload_is_what_a_run_counts(config):
    load = count_workload(Job(load_config(config)))
    record = measured_run(config, ["pipeline.topology=single"])
    for name in ("cells_visible", "entries", "points"):
        assert getattr(load, name).tolist() == record["per_frame"][name]
    assert (load.cold <= load.points).all()
    assert (load.cold >= np.minimum(load.points, COLD_POINTS)).all(), "the first entry's first points are cold"
    assert load.cells == record["scene"]["cells"]


def test_covered_pixels_are_what_the_points_write(config):
    fixed = count_workload(Job(load_config(config, ["render.point_size_px=3"])))
    assert (fixed.covered == 9 * fixed.points).all()
    sizes = ["render.point_size_world=0.5", "render.point_size_px=2", "render.point_size_max_px=2"]
    load = count_workload(Job(load_config(config, sizes)))
    assert load.covered == pytest.approx(4 * load.points, rel=0.01)
    near = count_workload(Job(load_config(config, ["render.point_size_world=5.0"])))
    wide = count_workload(Job(load_config(config, ["render.point_size_world=20.0"])))
    assert (wide.covered > near.covered).all()


def test_adaptive_points_cover_what_the_spacing_of_their_cells_says(config):
    job = Job(load_config(config, ["render.point_size_adaptive=true", "sampling.pixel_threshold=0"]))
    load, points, camera = count_workload(job), job.load_points(verify=False), job.camera(0)
    index = np.concatenate([np.arange(first, end) for first, end in leaf_ranges(job.scene)])
    block = np.searchsorted(points.block_first_point, index, side="right") - 1
    relative = np.column_stack([column[index] for column in (points.x, points.y, points.z)])
    depth = (points.block_origin[block] + relative - camera.eye) @ camera.pixel_from_world[2, :3]
    side = np.rint(np.clip(points.block_spacing[block] * camera.focal_px / depth, 1, 64))
    assert load.points[0] == len(index), "everything is in the picture"
    assert load.covered[0] == pytest.approx((side**2).sum(), rel=0.1)
    assert load.covered[0] > 1.05 * load.points[0]


def test_calibration_never_has_the_settings_it_is_used_for():
    for threshold in (0.0, 8.0, 4096.0):
        run = parse_config({"sampling": {"pixel_threshold": threshold}})
        for point in calibration_points(run):
            found = with_point(run, point)
            same = found.sampling.pixel_threshold == threshold
            assert not same or threshold == 4096.0
    assert isinstance(with_point(RunConfig(), calibration_points(RunConfig())[0]), RunConfig)


def test_calibration_has_the_ranks_of_its_own_topologies():
    run = parse_config({"pipeline": {"topology": "hybrid", "ranks": 5, "culling_ranks": 2, "sampling_ranks": 1}})
    runs = [with_point(run, point) for point in calibration_points(run)]
    assert {of.pipeline.topology for of in runs} <= {"single", "pipelined"}
    for of in runs:
        check_topology(of)
        assert (of.pipeline.ranks, of.pipeline.culling_ranks) == (0, 0)


def test_what_if_changes_one_thing(config):
    job = Job(load_config(config))
    case = Case(job.config, TRUE, count_workload(job), Machine(4), job.scene.info.n_points)
    base = case.predict().frames_per_s

    def rate(change):
        return changed(case, str(config), [], change).predict().frames_per_s

    assert rate("points=2000000000") < rate("points=200000") < base
    assert rate("speed=3") > base
    assert rate("camera.width=1600") < base
    assert rate("sampling.pixel_threshold=4096") > base
    assert changed(case, str(config), [], "cores=16").machine.cores == 16
    assert changed(case, str(config), [], "latency=1e-3").costs.message_s == 1e-3
    assert changed(case, str(config), [], "bandwidth=1e6").machine.bandwidth_bytes_per_s == 1e6
    for change, said in [
        ("cores", "expected key=value"),
        ("core=3", "expected a key of the configuration or one of cores, hosts, bandwidth"),
        ("cores=-3", "expected a number > 0"),
        ("speed=fast", "expected a number > 0"),
        ("render.rasterizer=gl", "costs are of rasterizer cpu"),
    ]:
        with pytest.raises(InputError, match=said):
            changed(case, str(config), [], change)
    with pytest.raises(ConfigError, match=r"unknown key render\.thread, did you mean render\.threads"):
        changed(case, str(config), [], "render.thread=3")


def fake_run(config, sets):
    """The record of a run on a machine of 8 cores where everything costs what ``TRUE`` says."""
    run = load_config(config, sets)
    load, threads = count_workload(Job(run)), threads_of(run.render.threads)
    topology = run.pipeline.topology
    found = forecast(TRUE, load, Setting(topology, threads, run.pipeline.frames_in_flight), Machine(CORES))
    factor = {s: found.inflation.get(s, 1.0) for s in TRUE.stages} | {"render": list(found.inflation.values())[-1]}
    columns = stage_columns(load, threads)
    lists = {f"{s}_s": (TRUE.stages[s].of(columns[s]) * factor[s]).tolist() for s in TRUE.stages}
    return {"topology": topology, "frames_per_s": found.frames_per_s, "per_frame": lists}


CORES = len(os.sched_getaffinity(0))


def test_the_command_predicts_what_it_was_not_shown(config, tmp_path):
    predict_command(
        config, [], ["cores=64", "points=1e9"], 256, 1, tmp_path / "out", json_path=tmp_path / "r.json", runner=fake_run
    )
    results = json.loads((tmp_path / "r.json").read_text())
    cases = {found["case"]: found["frames_per_s"] for found in results["forecasts"]}
    truth = fake_run(config, ["pipeline.topology=single", "render.threads=1"])["frames_per_s"]
    assert cases["single, 1 threads"] == pytest.approx(truth, rel=0.02)
    assert cases["points=1e9"] < cases["as configured"]
    of_hybrid = [found["ranks"] for found in results["ranks"] if found["topology"] == "hybrid"]
    assert of_hybrid == [4, 16, 64, 256] * 3
    assert {found["topology"] for found in results["ranks"]} == set(TOPOLOGIES)
    assert results["ranks"][-1]["inequality"].startswith("(")
    report = (tmp_path / "out" / "report.md").read_text()
    assert "residual" in report
    assert "cores=64" in report


def test_predicted_beside_measured(config, tmp_path):
    file = tmp_path / "e.toml"
    file.write_text(
        f'[experiment]\nbase = "{config}"\noutput = "out"\nrepeats = 2\n[grid]\n'
        '"pipeline.topology" = ["single", "pipelined"]\n"render.threads" = [1, 2]\n'
    )
    validate_command(file, json_path=tmp_path / "r.json", runner=fake_run)
    results = json.loads((tmp_path / "r.json").read_text())
    assert len(results["comparisons"]) == 4
    assert results["median_error"] < 0.02
    assert results["worst_error"] < 0.05
    own = load_experiment(file)
    assert [run in own.runs for run in extended(own).runs].count(True) == 4, "calibration has other settings"
    assert "4 settings: median error" in (tmp_path / "out" / "predicted.md").read_text()


def test_the_fastest_repeats_are_not_disturbed(config, tmp_path):
    calls = []

    def disturbed(config, sets):
        record = fake_run(config, sets)
        calls.append(record)
        slower = 1.0 if len(calls) > 8 else 3.0  # some of the first repeats
        lists = {name: [slower * s for s in seconds] for name, seconds in record["per_frame"].items()}
        return record | {"frames_per_s": record["frames_per_s"] / slower, "per_frame": lists}

    file = tmp_path / "e.toml"
    file.write_text(
        f'[experiment]\nbase = "{config}"\noutput = "out"\nrepeats = 2\n[grid]\n"render.threads" = [1, 2]\n'
        '[set]\n"pipeline.topology" = "single"\n'
    )
    errors = {}
    for best in (False, True):
        validate_command(file, best=best, json_path=tmp_path / "r.json", runner=disturbed)
        errors[best] = json.loads((tmp_path / "r.json").read_text())["worst_error"]
    assert errors[True] < 0.02 < errors[False]


def test_a_run_with_layers_is_refused():
    run = parse_config({"layers": [{"path": "a.layer"}, {"path": "b.layer"}]})
    with pytest.raises(ConfigError, match="layers: found 2, expected none: predictions count points alone"):
        calibration_points(run)


def test_a_rasterizer_without_a_model_is_refused(config, tmp_path):
    with pytest.raises(InputError, match=r"render\.rasterizer = 'gl', expected cpu"):
        predict_command(config, ["render.rasterizer=gl"], [], 8, 1, tmp_path, runner=fake_run)
