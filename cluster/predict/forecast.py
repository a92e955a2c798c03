"""Costs and parts → what a run would do: the steps of every rank and link on the cores there are, then the recurrence.

**Cores that ranks share.** While a stage works, b cores are busy: its own threads, and the threads of each other rank
for the share of time that it works. Its work then takes max(1, b / cores) · (1 + contention · (min(b, cores) − 1))
times as long. A rank with a thread on every core loses ``late_s`` more to the other ranks, but is never slower than
with one thread. Shares depend on the schedule and the schedule on the shares; they are iterated to a fixed point. That
is a mean-value model: it knows neither which frames meet nor how the kernel of the operating system chooses.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..topologies import FRAME_PARALLEL
from .costs import STAGES, Costs, Measured
from .machine import Machine
from .parts import EvenParts, Parts
from .recurrence import Schedule, Stage, run_schedule
from .setting import Setting
from .steps import Step, Steps, largest_part, stage_parts
from .workload import Workload

ROUNDS = 30
LOSSES_S = np.concatenate([[0.0], np.geomspace(5e-6, 10e-3, 100)])
"""Losses around a message or a woken thread that are tried: up to the longest tick of an operating system."""


@dataclass(frozen=True)
class Forecast:
    """The predicted run.

    steps : what its ranks and links have to do.
    inflation : rank's role → how many times longer its work takes than alone.
    """

    setting: Setting
    schedule: Schedule
    steps: Sequence[Step]
    inflation: dict[str, float]

    @property
    def frames_per_s(self) -> float:
        """As a run would report it."""
        return self.schedule.frames_per_s

    @property
    def latency_ms(self) -> float:
        """Median over the frames."""
        return 1e3 * float(np.median(self.schedule.latency_s))

    @property
    def limit(self) -> tuple[str, str]:
        """(rank's role or link, inequality) that bounds the rate: the largest part of what is busiest."""
        busiest = self.schedule.bottleneck
        return busiest, largest_part([step for step in self.steps if step.on == busiest])


def forecast(costs: Costs, load: Workload | Parts, setting: Setting, machine: Machine) -> Forecast:
    """The prediction for a workload on a setting and a machine. Cost: some ms a hundred frames and rank.

    load : a workload is dealt evenly to ranks.
    """
    parts = EvenParts(load) if isinstance(load, Workload) else load
    if setting.topology == FRAME_PARALLEL:
        return _whole_pictures(costs, parts.whole, setting, machine)
    made = Steps(setting, parts, costs, machine, threads=setting.threads)
    steps, layout = made.steps, made.layout
    one = Steps(setting, parts, costs, machine).steps if setting.threads > 1 else steps
    n_frames = parts.whole.n_frames
    work = [step.seconds(n_frames, waiting=False) for step in steps]
    waiting = [step.seconds(n_frames, working=False) for step in steps]
    by_one = [step.seconds(n_frames, waiting=False) for step in one]
    pools = [None if step.rank is None else machine.pool_of(step.rank) for step in steps]
    crowded = len({rank for rank in layout.workers if machine.pool_of(rank) == machine.pool_of(0)}) > 1
    factor = [inflation(step.threads, costs.contention, machine.cores) for step in steps]
    for _ in range(ROUNDS):
        stages = []
        for i, step in enumerate(steps):
            cost = work[i] * factor[i]
            if crowded and step.draws and step.threads >= machine.cores > 1:
                cost = np.minimum(cost + costs.late_s, by_one[i] * factor[i])
            stages.append(Stage(step.on, cost + waiting[i], link_s=step.link_s, after=step.after))
        schedule = run_schedule(stages, in_flight=setting.in_flight if len(layout.workers) > 1 else 1)
        busy: dict[tuple[int | None, int | None], float] = {}
        for i, step in enumerate(steps):
            share = float(work[i].sum()) * factor[i] / schedule.total_s * step.threads if schedule.total_s else 0.0
            for key in ((pools[i], step.rank), (pools[i], None)):
                busy[key] = busy.get(key, 0.0) + share
        wanted = [
            inflation(s.threads + busy[pool, None] - busy[pool, s.rank], costs.contention, machine.cores)
            if s.threads
            else 1.0
            for s, pool in zip(steps, pools, strict=True)
        ]
        if all(abs(w - f) < 1e-4 for w, f in zip(wanted, factor, strict=True)):
            break
        factor = [(w + f) / 2 for w, f in zip(wanted, factor, strict=True)]
    return Forecast(setting, schedule, steps, {s.on: f for s, f in zip(steps, factor, strict=True) if s.threads})


def _whole_pictures(costs: Costs, load: Workload, setting: Setting, machine: Machine) -> Forecast:
    """Each rank draws every n-th frame, as ``single`` would, and tells rank 0."""
    n = setting.size
    here = max(Counter(machine.pool_of(rank) for rank in range(n)).values())
    steps = [picture_step(costs, load, machine, setting.threads, here, told) for told in (n - 1, min(n - 1, 1))]
    first, other = (step.seconds(load.n_frames) for step in steps)
    cost = np.where(np.arange(load.n_frames) % n == 0, first, other)
    schedule = run_schedule([Stage("pictures", cost, workers=n)], in_flight=load.n_frames)
    return Forecast(
        setting,
        schedule,
        steps[:1],
        {"pictures": inflation(here - 1 + setting.threads, costs.contention, machine.cores)},
    )


def picture_step(costs: Costs, load: Workload, machine: Machine, threads: int, here: int, messages: int) -> Step:
    """What a rank of ``frame-parallel``, one of ``here`` on its cores, has to do of a frame that is its own."""
    step = Step("pictures", 0, ())
    step.add("work", costs.loop_s / machine.speed)
    for stage in STAGES:
        of_stage = threads if stage == "render" else 1
        slower = inflation(here - 1 + of_stage, costs.contention, machine.cores)
        for name, seconds in stage_parts(costs, stage, load, of_stage).items():
            step.add(name, seconds * slower / machine.speed)
    step.add("messages", costs.message_s / machine.speed * messages)
    return step


def fit_messages(costs: Costs, runs: Sequence[Measured], machine: Machine) -> Costs:
    """The costs with what ranks lose to each other, so that forecasts come nearest to the measured pipelined runs.

    ``message_s`` from the runs that leave a core free of render threads, then ``late_s`` from the others: of
    ``LOSSES_S`` those with the least sum of squared relative errors. The software latency holds whatever a rank loses
    around a message: packing, polling, waking late. Where there is no run, costs unchanged.
    """
    pipelined = [run for run in runs if run.topology == "pipelined"]
    for name, group in (
        ("message_s", [run for run in pipelined if run.threads < machine.cores]),
        ("late_s", [run for run in pipelined if run.threads >= machine.cores]),
    ):
        if group:
            tried = [replace(costs, **{name: seconds}) for seconds in LOSSES_S.tolist()]
            costs = min(tried, key=lambda of: sum(_error(of, run, machine) ** 2 for run in group))
    return costs


def _error(costs: Costs, run: Measured, machine: Machine) -> float:
    """(predicted − measured) / measured frames/s."""
    return forecast(costs, run.load, run.setting, machine).frames_per_s * run.frame_s - 1


def inflation(busy: float, contention: float, cores: int) -> float:
    """How many times longer work takes while so many cores, its own among them, are busy."""
    return max(1.0, busy / cores) * (1 + contention * max(min(busy, cores) - 1, 0.0))
