"""Load balance: borders move to where the work is, come to rest, and never change a picture."""

import io
import json
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers_ranks import World
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from splatpipe.cluster.balance import balancer, can_balance, is_on, times
from splatpipe.cluster.balance.balancer import Balancer, make_policies
from splatpipe.cluster.balance.hysteresis import Hysteresis, imbalance
from splatpipe.cluster.balance.subtrees import SubtreeBorders, learned
from splatpipe.cluster.balance.tiles import GRID, CostGrid, moved_tiles
from splatpipe.cluster.balance.times import FRAMES_A_NOTE, StageTimes, TimesTeller
from splatpipe.cluster.bench.balance import bench_balance, print_balance
from splatpipe.cluster.job import Job
from splatpipe.cluster.launch import find_mpiexec, mpi_available
from splatpipe.cluster.layout import Layout, Plan, chains, hybrid, master_slave
from splatpipe.cluster.pipeline import run_layout, run_single
from splatpipe.cluster.record import StageClock
from splatpipe.cluster.topologies import layout_of
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import PipelineSection, load_config
from splatpipe.shared.errors import InputError, MessageError
from splatpipe.shared.octree_parts import balanced_borders
from splatpipe.shared.synth import CityScan
from splatpipe.shared.synth.hot_octant import HotOctant
from splatpipe.shared.windows import Window, tiles

WIDTH, HEIGHT = 320, 180


# --- simulated ranks ---------------------------------------------------------------------------------------------


class Field:
    """A picture whose work is known pixel by pixel."""

    def __init__(self, x: float, y: float, spread_px: float, background: float) -> None:
        gx, gy = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        hot = np.exp(-((gx - x) ** 2 + (gy - y) ** 2) / (2 * spread_px**2))
        self.work = hot / hot.sum() + background / hot.size

    def inside(self, window: Window) -> float:
        return float(window.of(self.work).sum())


class NoMessages:
    def has_note(self, *_):
        return False


def simulated(layout, policies, plan, seconds_of, n_frames, rng, noise):
    """(plan of each frame, balancer): frames in turn, every rank told of at once."""
    balance = Balancer(layout, NoMessages(), policies, range(n_frames))
    plans = []
    rows: dict[int, dict[str, list[float]]] = {rank: {} for rank in layout.workers}
    for frame in range(n_frames):
        plan = balance.plan_for(frame, plan)
        plans.append(plan)
        for rank, stages in seconds_of(plan, frame).items():
            for stage, seconds in stages.items():
                rows[rank].setdefault(stage, []).append(seconds * max(0.1, 1 + noise * rng.standard_normal()))
        if (frame + 1) % FRAMES_A_NOTE == 0:
            for rank, stages in rows.items():
                last = {stage: np.array(values[-FRAMES_A_NOTE:]) for stage, values in stages.items()}
                balance.hear(StageTimes(frame + 1 - FRAMES_A_NOTE, last, 1e-3), rank)
    return plans, balance


@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    st.integers(2, 8),
    st.floats(0, WIDTH),
    st.floats(0, HEIGHT),
    st.floats(15, 60),
    st.floats(0.1, 1),
    st.sampled_from([0.0, 0.05, 0.15]),
    st.integers(0, 99),
)
def test_tiles_come_to_rest_with_even_work_wherever_it_is(n, x, y, spread_px, background, noise, seed):
    layout = Layout(chains(n, 1), "tiles")
    field = Field(x, y, spread_px, background)

    def seconds_of(plan, _):
        return {rank: {"render": 0.05 * field.inside(plan.windows[rank])} for rank in range(n)}

    even = Plan(0, (), (), tuple(tiles(WIDTH, HEIGHT, [1.0] * n)))
    policies = make_policies(layout, [np.ones(1)] * n, WIDTH, HEIGHT)
    plans, balance = simulated(layout, policies, even, seconds_of, 400, np.random.default_rng(seed), noise)
    before, after = (
        imbalance(np.array([of["render"] for of in seconds_of(plan, 0).values()])) for plan in (even, plans[-1])
    )
    assert after <= max(1.15, min(before, 1.25)), (before, after, len(balance.changes))
    assert sum(a is not b for a, b in pairwise(plans[200:])) <= (10 if noise else 1), "it comes to rest"
    assert_fills(plans[-1].windows)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    st.integers(2, 6),
    st.integers(16, 60),
    st.sampled_from([0.0, 0.05, 0.15]),
    st.integers(0, 999),
    st.floats(1, 40),
)
def test_subtrees_come_to_rest_with_even_work_whoever_has_it(n, s, noise, seed, hot):
    rng = np.random.default_rng(seed)
    cells = rng.integers(1, 1000, n * s)
    work = rng.random(n * s)
    at = rng.integers(0, n * s)
    work[at : at + n * s // 8] *= hot
    work *= 0.1 / work.sum()
    layout = hybrid(2 * n + 1, n, n, 1, "none")
    first = Plan(0, (tuple(balanced_borders(cells, n).tolist()),), (tuple(balanced_borders(cells, n).tolist()),), ())

    def of_parts(borders):
        return np.array([work[a:b].sum() for a, b in pairwise(borders)])

    def seconds_of(plan, _):
        (lane,) = layout.lanes
        culled, sampled = of_parts(plan.culling[0]), of_parts(plan.sampling[0]) / 2
        found = {rank: {"culling": s} for rank, s in zip(lane.culling, culled, strict=True)}
        found |= {rank: {"sampling": s} for rank, s in zip(lane.sampling, sampled, strict=True)}
        return found | {lane.render[0]: {"render": 0.01}}

    policies = make_policies(layout, [cells], WIDTH, HEIGHT)
    assert [policy.name for policy in policies] == ["culling", "sampling"]
    plans, _ = simulated(layout, policies, first, seconds_of, 400, rng, noise)
    best = imbalance(of_parts(balanced_borders(work, n)))
    found = imbalance(of_parts(plans[-1].culling[0]))
    assert found <= 1.25 * best, (found, best, imbalance(of_parts(first.culling[0])))
    assert sum(a is not b for a, b in pairwise(plans[200:])) <= (16 if noise else 2), "it comes to rest"


def test_work_that_moves_is_followed():
    layout = Layout(chains(4, 1), "tiles")
    fields = [Field(60 + 200 * i / 49, 90, 30, 0.2) for i in range(50)]

    def seconds_of(plan, frame):
        return {rank: {"render": 0.05 * fields[frame // 20].inside(plan.windows[rank])} for rank in range(4)}

    even = Plan(0, (), (), tuple(tiles(WIDTH, HEIGHT, [1.0] * 4)))
    policies = make_policies(layout, [np.ones(1)] * 4, WIDTH, HEIGHT)
    plans, balance = simulated(layout, policies, even, seconds_of, 1000, np.random.default_rng(0), 0.03)

    def slowest(of):
        return sum(max(s["render"] for s in seconds_of(of(frame), frame).values()) for frame in range(1000))

    assert slowest(plans.__getitem__) < 0.75 * slowest(lambda _: even)
    assert 5 < len(balance.changes) < 60
    assert all(change["imbalance"] > 1.1 for change in balance.changes)


def test_even_work_and_cheap_work_are_left_alone():
    layout = hybrid(7, 2, 2, 3, "tiles")
    cells = np.full(32, 10)
    first = Plan(0, ((0, 16, 32),), ((0, 16, 32),), tuple(tiles(WIDTH, HEIGHT, [1.0] * 3)))

    def seconds_of(plan, _):
        uneven = {0: {"culling": 1e-4}, 1: {"culling": 3e-4}, 2: {"sampling": 1e-4}, 3: {"sampling": 2e-4}}
        return uneven | {rank: {"render": 0.02} for rank in (4, 5, 6)}

    policies = make_policies(layout, [cells], WIDTH, HEIGHT)
    rng = np.random.default_rng(0)
    plans, balance = simulated(layout, policies, first, seconds_of, 200, rng, 0.02)
    assert plans[-1] is first
    assert not balance.changes


def test_what_a_rank_does_for_the_picture_makes_its_tile_smaller():
    layout = Layout(chains(2, 1), "tiles")
    even = Plan(0, (), (), tuple(tiles(WIDTH, HEIGHT, [1.0] * 2)))

    def seconds_of(plan, _):
        shares = [window.n_pixels / (WIDTH * HEIGHT) for window in plan.windows]
        return {0: {"render": 0.02 * shares[0], "picture": 0.01}, 1: {"render": 0.02 * shares[1]}}

    policies = make_policies(layout, [np.ones(1)] * 2, WIDTH, HEIGHT)
    plans, _ = simulated(layout, policies, even, seconds_of, 100, np.random.default_rng(0), 0)
    assert plans[-1].windows[0].x1 == pytest.approx(WIDTH / 4, abs=2)


# --- parts of the policies ---------------------------------------------------------------------------------------

non_negative = st.floats(0, 10)


def assert_fills(windows, width=WIDTH, height=HEIGHT):
    seen = np.zeros((height, width), int)
    for window in windows:
        window.of(seen)[:] += 1
    assert (seen == 1).all()


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 70), st.integers(1, 70), st.integers(1, 9), st.data())
def test_moved_tiles_fill_the_picture_and_move_little(width, height, n, data):
    windows = tiles(width, height, [1.0] * n)
    cost = CostGrid(width, height)
    numbers = st.lists(non_negative, min_size=n, max_size=n).map(np.array)
    for _ in range(4):
        seconds, fixed = data.draw(numbers), data.draw(numbers)
        cost.learn(windows, seconds)
        held = np.array([w.n_pixels > 0 for w in windows])
        found = cost.inside(windows)
        assert found.sum() == pytest.approx(seconds[held].sum())
        if max(width, height) <= GRID:  # else a border goes through cells of the grid
            assert np.allclose(found[held], seconds[held])
        moved = moved_tiles(windows, cost, fixed)
        assert_fills(moved, width, height)
        if n == 2:
            axis = int(height > width)
            assert abs(moved[0][axis + 2] - windows[0][axis + 2]) <= max(1, (width, height)[axis] // 4 + 1)
        windows = moved


@given(st.lists(st.integers(1, 50), min_size=1, max_size=30), st.integers(1, 5), st.data())
def test_learned_weights_sum_to_what_was_measured(cells, n, data):
    even = np.array(cells, float)
    weights = np.array(data.draw(st.lists(non_negative, min_size=len(cells), max_size=len(cells))))
    borders = balanced_borders(even, n)
    parts = np.array(data.draw(st.lists(non_negative, min_size=n, max_size=n)))
    found = learned(weights, even, borders.tolist(), parts, 0.1)
    assert (found >= 0).all()
    for (a, b), measured in zip(pairwise(borders), parts, strict=True):
        assert found[a:b].sum() == pytest.approx(measured if a < b else 0)


def test_a_hot_subtree_is_found_in_one_move():
    cells = np.ones(8)
    first = learned(cells, cells, (0, 4, 8), np.array([8.0, 4.0]), 0.1)
    second = learned(first, cells, (0, 3, 8), np.array([1.0, 11.0]), 0.1)
    assert first.tolist() == [2.0] * 4 + [1.0] * 4
    assert second.sum() == 12
    assert second[3] > second[4]


def test_both_stages_of_a_rank_move_together():
    layout = master_slave(3)
    (policy,) = make_policies(layout, [np.ones(8)], WIDTH, HEIGHT)
    assert isinstance(policy, SubtreeBorders)
    plan = Plan(0, ((0, 4, 8),), ((0, 4, 8),), ())
    seconds = {0: {"render": 9.0}, 1: {"culling": 1.0, "sampling": 2.0}, 2: {"culling": 0.5, "sampling": 0.5}}
    moved, expected = policy.proposal(plan, seconds)
    assert moved.culling == moved.sampling == ((0, 3, 8),)
    assert expected.tolist() == [2.25, 1.75]


def test_a_change_that_does_not_keep_its_promise_is_not_tried_again_soon():
    hysteresis, uneven, promised = Hysteresis(), np.array([2.0, 1.0]), np.array([1.5, 1.5])
    tried = []
    for i in range(300):
        hysteresis.measured(uneven)
        if hysteresis.is_uneven and hysteresis.accepts(
            uneven, promised, slowest_s=2, adopting_s=1, frames_held=1, frames_left=300 - i
        ):
            tried.append(i)
    assert tried[:8] == [0, 1, 2, 3, 4, 8, 24, 88]
    assert not Hysteresis().accepts(uneven, promised, slowest_s=2, adopting_s=10, frames_held=9, frames_left=20)
    assert Hysteresis().accepts(uneven, promised, slowest_s=2, adopting_s=40, frames_held=90, frames_left=200)
    assert not Hysteresis().accepts(uneven, promised, slowest_s=20, adopting_s=0, frames_held=9, frames_left=20)


@pytest.mark.parametrize(
    ("layout", "expected"),
    [
        (Layout(chains(3, 3)), False),
        (Layout(chains(4, 1), "shares"), False),
        (Layout(chains(4, 1), "tiles"), True),
        (master_slave(2), False),
        (master_slave(3), True),
        (hybrid(4, 1, 1, 2, "shares"), False),
        (hybrid(4, 1, 2, 1, "none"), True),
    ],
)
def test_what_can_be_balanced(layout, expected):
    assert can_balance(layout) is expected
    assert bool(make_policies(layout, [np.ones(64)] * len(layout.lanes), 10, 10)) is expected
    assert is_on(PipelineSection(balance="measured"), layout) is expected
    assert not is_on(PipelineSection(balance="off"), layout)
    if layout.split == "tiles":
        assert not can_balance(layout, tiles_stay=True)
        assert not make_policies(layout, [np.ones(64)] * len(layout.lanes), 10, 10, tiles_stay=True)


# --- notes -------------------------------------------------------------------------------------------------------


def test_times_survive_their_note():
    clocks = {stage: StageClock(stage) for stage in ("culling", "sampling", "render", "picture", "compositing")}
    told = []
    teller = TimesTeller(clocks, True, [0.5, 0.25], told.append)
    for i in range(2 * FRAMES_A_NOTE + 3):
        clocks["render"].work_s.append(float(i))
        clocks["render"].cpu_s.append(i + 1.0 if i % 2 else i - 0.5)
        teller.done(i)
    assert [of.first for of in told] == [0, FRAMES_A_NOTE]
    back = StageTimes.from_note(json.loads(json.dumps(told[1].to_note())), 3)
    assert (back.first, back.adopting_s, list(back.seconds)) == (FRAMES_A_NOTE, 0.25, ["render"])
    assert back.seconds["render"].tolist() == [
        i if i % 2 else i - 0.5 for i in range(FRAMES_A_NOTE, 2 * FRAMES_A_NOTE)
    ], "what waits for a core does not work"


@pytest.mark.parametrize(
    "note",
    [
        {},
        {"first": 0, "adopting_s": 0, "seconds": 3},
        {"first": 0, "adopting_s": 0, "seconds": {"render": [1.0]}},
        {"first": 0, "adopting_s": 0, "seconds": {"render": [-1.0] * FRAMES_A_NOTE}},
        {"first": 0, "adopting_s": 0, "seconds": {"lunch": [1.0] * FRAMES_A_NOTE}},
        {"first": "x", "adopting_s": 0, "seconds": {}},
    ],
)
def test_times_that_are_none_are_refused(note):
    with pytest.raises(MessageError, match="STAGE_TIMES from rank 3"):
        StageTimes.from_note(note, 3)


# --- the benchmark -----------------------------------------------------------------------------------------------


def test_the_hot_octant_has_its_share_whatever_the_batches():
    source = HotOctant(150_001, share=0.8)
    batches = list(source.batches(1000, ("rgb",)))
    again = list(HotOctant(150_001, share=0.8).batches(70_000, ("rgb",)))
    positions = np.concatenate([batch.positions for batch in batches])
    assert np.array_equal(positions, np.concatenate([batch.positions for batch in again]))
    assert np.abs(positions).max() < 1
    assert (positions > 0).all(axis=1).mean() == pytest.approx(0.8, abs=0.01)
    octants = np.bincount((positions > 0) @ [4, 2, 1], minlength=8)
    assert octants[:7].max() < 1.1 * octants[:7].min()
    with pytest.raises(InputError, match=r"share = 1\.5"):
        HotOctant(10, share=1.5)


@pytest.mark.mpi
@pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
def test_the_benchmark_sets_off_beside_measured(tmp_path):
    small = {"n_points": 20_000, "share": 0.9, "points_per_cell": 1000, "width": 64, "height": 48, "frames": 12}
    results = bench_balance("sort-first-only", 2, [], **small, repeats=1, workdir=tmp_path)
    off, on = results["rows"]
    assert (off["balance"], off["changes"], off["note_bytes"]) == ("off", [0], [0])
    assert on["note_bytes"][0] > 0
    assert all(row["imbalance"]["tiles"] >= 1 and row["slowest_ms"][0] > 0 for row in (off, on))
    console = Console(width=150, file=io.StringIO())
    print_balance(results, console)
    assert "90% in one octant" in console.file.getvalue()


# --- whole runs --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "city"
    build_scene([CityScan(n_points=20_011)], folder, settings=BuildSettings(points_per_cell=300))
    return folder


@pytest.fixture
def config(scene, tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(
        f'[scene]\npath = "{scene}"\n[camera]\nwidth = 163\nheight = 91\n'
        '[render]\npoint_size_px = 2\nrasterizer = "cpu"\nthreads = 1\n[sampling]\npixel_threshold = 9\n'
        '[output]\nframes = 12\n[pipeline]\nbalance = "measured"\n'
    )
    return path


class Restless(Balancer):
    """Another plan for every frame, whatever was measured."""

    def plan_for(self, position, plan):
        super().plan_for(position, plan)
        rng = np.random.default_rng(position)

        def borders(lanes):
            return tuple((0, *sorted(rng.integers(0, b[-1] + 1, len(b) - 2).tolist()), b[-1]) for b in lanes)

        windows = plan.windows
        if windows:
            x1, y1 = max(w.x1 for w in windows), max(w.y1 for w in windows)
            windows = tuple(tiles(x1, y1, rng.integers(0, 4, len(windows)).tolist()))
        return Plan(plan.number + 1, borders(plan.culling), borders(plan.sampling), windows)


def pictures(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.png")}


@pytest.fixture
def alone(config, tmp_path):
    """The pictures of one rank."""
    out = tmp_path / "single"
    out.mkdir()
    run_single(Job(load_config(config, [f"output.directory={out}", "pipeline.topology=single"])), lambda *_: None)
    return pictures(out)


def on_threads(config, out, topology, ranks, *sets):
    sets = [*sets, f"output.directory={out}", f"pipeline.topology={topology}"]
    out.mkdir()
    layout = layout_of(load_config(config, sets).pipeline, ranks)
    world = World(ranks)
    record = world.run(
        lambda transport: run_layout(Job(load_config(config, sets)), layout, transport, lambda *_: None)
    )[0]
    return pictures(out), record, world


HYBRID = ["pipeline.culling_ranks=2", "pipeline.sampling_ranks=2"]


@pytest.mark.parametrize(
    ("topology", "ranks", "sets"),
    [
        ("hybrid", 6, HYBRID),
        ("hybrid", 7, ["pipeline.culling_ranks=3", "pipeline.sampling_ranks=2", "pipeline.render_split=shares"]),
        ("sort-first-only", 3, []),
        ("sort-first", 5, ["pipeline.frames_in_flight=9"]),
        ("master-slave", 4, []),
    ],
)
def test_another_plan_for_every_frame_gives_the_bits_of_one_rank(
    config, alone, tmp_path, monkeypatch, topology, ranks, sets
):
    monkeypatch.setattr(balancer, "Balancer", Restless)
    together, record, world = on_threads(config, tmp_path / "many", topology, ranks, *sets)
    assert together == alone
    assert world.sent["PLAN"] == 12 * (ranks - 1)
    assert record["balance"]["policy"] == "measured"


def test_measured_times_move_borders_and_the_record_says_so(config, alone, tmp_path, monkeypatch):
    """Work is slow where it is told to be: the last tile, and the subtrees of the second culling rank."""

    class Slow(TimesTeller):
        def done(self, i):
            for stage, clock in self._clocks.items():
                if clock.work_s:
                    clock.work_s[-1] = clock.cpu_s[-1] = 0.01 if stage in ("culling", "render") else 1e-3
            super().done(i)

    class Unheard(Balancer):
        def hear(self, told, rank=0):
            slow = {stage: 5 * s if rank in (1, 5) else s for stage, s in told.seconds.items()}
            super().hear(replace(told, seconds=slow, adopting_s=0.0), rank)

    monkeypatch.setattr(times, "TimesTeller", Slow)
    monkeypatch.setattr(balancer, "Balancer", Unheard)
    together, record, world = on_threads(
        config, tmp_path / "many", "hybrid", 6, *HYBRID, "output.frames=40", "pipeline.frames_in_flight=1"
    )
    assert together["frame_0000.png"] == alone["frame_0000.png"]
    balance = record["balance"]
    assert {change["moved"] for change in balance["changes"]} == {"culling", "tiles"}
    assert world.sent["STAGE_TIMES"] == 5 * (40 // FRAMES_A_NOTE)
    assert world.sent["PLAN"] % 5 == 0
    first = next(change for change in balance["changes"] if change["moved"] == "culling")
    assert first["frame"] == FRAMES_A_NOTE
    assert first["before"] != first["after"]
    assert first["after"][0][1] > first["before"][0][1]
    assert first["imbalance"] == pytest.approx(5 / 3)
    assert first["imbalance_after"] is not None
    assert len(balance["slowest_s"]) == 40
    assert len(balance["busy_s"]) == 6
    assert set(balance["imbalance"]) == {"culling", "sampling", "tiles"}


def test_nothing_is_told_where_nothing_is_balanced(config, alone, tmp_path):
    together, record, world = on_threads(config, tmp_path / "off", "sort-first-only", 3, "pipeline.balance=off")
    assert together == alone
    assert not {"PLAN", "STAGE_TIMES"} & set(world.sent)
    assert (record["balance"]["policy"], record["balance"]["changes"]) == ("off", [])
    together, record, world = on_threads(config, tmp_path / "last", "sort-last-only", 3)
    assert together == alone
    assert "balance" not in record
    assert "STAGE_TIMES" not in world.sent


@pytest.mark.mpi
@pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
@pytest.mark.parametrize(
    ("topology", "ranks", "sets"),
    [("hybrid", 6, [*HYBRID, "pipeline.render_ranks=2"]), ("sort-first-only", 3, [])],
)
def test_another_plan_for_every_frame_between_processes(config, alone, tmp_path, topology, ranks, sets):
    out = tmp_path / "mpi"
    restless = Path(__file__).parent / "ranks" / "restless.py"
    sets = [*sets, f"output.directory={out}", f"pipeline.topology={topology}"]
    command = [str(find_mpiexec()), "-n", str(ranks), sys.executable, str(restless), str(config), *sets]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    assert pictures(out) == alone
    record = json.loads((out / "run.json").read_text())
    assert record["messages"]["PLAN"]["count"] == 12 * (ranks - 1)
    assert record["messages"]["STAGE_TIMES"]["count"] == (ranks - 1) * (12 // FRAMES_A_NOTE)
