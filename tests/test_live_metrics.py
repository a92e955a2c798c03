"""What ranks say of themselves while a run goes on, and that they remember no more than they need."""

import math
import time

import numpy as np
from splatpipe.cluster.balance.times import FRAMES_A_NOTE, TimesTeller
from splatpipe.cluster.live.metrics import Meter
from splatpipe.cluster.record import KEPT_FRAMES, FrameCounts, StageClock
from splatpipe.nodes.raster.paged_points import Residency
from splatpipe.shared.messages import RENDER_POINT, RenderPoints, VisibilityBits


class Traffic:
    """A transport that sends 100 bytes a call and receives 50."""

    def __init__(self):
        self.calls = 0

    def traffic(self):
        self.calls += 1
        return {"VISIBILITY": {"count": self.calls, "bytes": 100 * self.calls}}

    def received_bytes(self):
        return {"FRAME_START": 50 * self.calls}


def entries(n, points):
    found = np.zeros(n, RENDER_POINT)
    found["range"], found["stride"] = points, 1
    return RenderPoints(0, found)


def worked(clock, work_s, wait_s=0.0):
    """A frame that took so long, without taking it."""
    with clock.working():
        pass
    with clock.waiting():
        pass
    clock.worked_s += work_s - clock.work_s[-1]
    clock.waited_s += wait_s - clock.wait_s[-1]


def test_means_and_rates_since_the_last_call():
    now = [10.0]
    culling, sampling, counts = StageClock("culling", 8), StageClock("sampling", 8), FrameCounts(keep=8)
    worked(culling, 9.0)  # before the meter is made
    meter = Meter([culling, sampling], counts, Traffic(), clock=lambda: now[0])
    for work_s in (0.010, 0.030):
        worked(culling, work_s, 0.004)
        counts.add(VisibilityBits.pack(0, np.arange(40) < 16), entries(3, 100))
    now[0] += 0.5
    values = meter.values(queue=3)
    assert math.isclose(values["culling.work_ms"], 20)
    assert math.isclose(values["culling.wait_ms"], 4)
    assert "sampling.work_ms" not in values, "no frame"
    assert values["frames_per_s"] == 4
    assert values["queue"] == 3
    assert (values["cells"], values["entries"], values["points"]) == (16, 3, 300)
    assert (values["sent_bytes_per_s"], values["received_bytes_per_s"]) == (200, 100)
    assert values["memory_bytes"] > 1e6
    assert values["threads"] >= 1
    assert values["cpu"] >= 0
    assert "missing" not in values, "resident points"
    now[0] += 1
    values = meter.values(queue=math.inf, pixels=math.nan)
    assert values["frames_per_s"] == 0
    assert values["points"] == 300, "the frame before is still what is seen"
    assert not {"queue", "pixels", "culling.work_ms"} & set(values)
    assert all(isinstance(value, float) and math.isfinite(value) for value in values.values())


def test_paged_points():
    now = [0.0]
    counts = FrameCounts(keep=8)
    meter = Meter([StageClock("render", 8)], counts, clock=lambda: now[0])
    counts.add_residency(Residency(1000, 250, 8000, 0))
    counts.add_residency(Residency(1000, 0, 0, 0))
    now[0] += 2
    values = meter.values()
    assert values["missing"] == 0.125
    assert values["loaded_bytes_per_s"] == 4000
    assert values["cache_hits"] == 0.75, "8000 of 32000 bytes were read"
    assert "sent_bytes_per_s" not in values


def test_a_run_of_many_frames_remembers_few_and_sums_all():
    clock, counts = StageClock("render", KEPT_FRAMES), FrameCounts(keep=KEPT_FRAMES)
    message = entries(1, 5)
    for _ in range(10 * KEPT_FRAMES):
        worked(clock, 0.001, 0.002)
        counts.add(message)
        counts.add_layers([message])
        counts.add_residency(Residency(2, 1))
    kept = [clock.work_s, clock.cpu_s, clock.wait_s, *counts.lists().values()]
    assert all(KEPT_FRAMES <= len(values) < 2 * KEPT_FRAMES for values in kept)
    assert clock.frames == 10 * KEPT_FRAMES == clock.dropped + len(clock.work_s)
    assert math.isclose(clock.worked_s, 0.001 * clock.frames)
    assert math.isclose(clock.waited_s, 0.002 * clock.frames)
    assert counts.totals()["points"] == (clock.frames, 5 * clock.frames)


def test_a_batch_run_remembers_all():
    clock, counts = StageClock("render"), FrameCounts()
    for _ in range(300):
        worked(clock, 0.001)
        counts.add(entries(1, 5))
    assert len(clock.work_s) == len(clock.cpu_s) == len(clock.wait_s) == len(counts.lists()["points"]) == 300


def test_load_is_balanced_by_clocks_that_forget():
    clocks = {name: StageClock(name, 8) for name in ("culling", "sampling", "render", "picture", "compositing")}
    notes = []
    teller = TimesTeller(clocks, False, [0.0], notes.append)
    for i in range(100):
        with clocks["render"].working():
            pass
        clocks["render"].work_s[-1] = float(i)
        teller.done(i)
    assert [note.seconds["render"].tolist() for note in notes] == [
        [float(i) for i in range(n, n + FRAMES_A_NOTE)] for n in range(0, 100, FRAMES_A_NOTE)
    ]


def test_a_call_is_cheap():
    meter = Meter([StageClock("render", 8)], FrameCounts(keep=8), Traffic())
    started = time.perf_counter()
    for _ in range(20):
        meter.values(queue=1)
    print(f"{(time.perf_counter() - started) / 20 * 1e3:.3f} ms")  # said, not asserted: machines differ
