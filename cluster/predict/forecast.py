"""Costs and workload → what a run would do: stage times on the ranks and cores it has, then the recurrence.

**Ranks.** ``single`` is one rank whose work is the sum of the stages; ``pipelined`` three. A rank pays the software
latency of each message it sends or receives; a message's bytes are under way for bytes / bandwidth.

**Cores that ranks share.** While a stage works, b cores are busy: its own threads, and the threads of each other rank
for the share of time that it works. Its work then takes max(1, b / cores) · (1 + contention · (min(b, cores) − 1))
times as long. A rank with a thread on every core loses ``late_s`` more to the other ranks, but is never slower than
with one thread. Shares depend on the schedule and the schedule on the shares; they are iterated to a fixed point. That
is a mean-value model: it knows neither which frames meet nor how the kernel of the operating system chooses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .costs import STAGES, Costs, Measured, stage_columns
from .recurrence import Schedule, Stage, run_schedule
from .workload import Workload

MESSAGES = {"culling": 4, "sampling": 3, "render": 3}
"""Messages a frame that each rank of ``pipelined`` sends and receives: two cameras, bits and a note; camera, bits and
render-points; camera, render-points and a note."""

ROUNDS = 30
LOSSES_S = np.concatenate([[0.0], np.geomspace(5e-6, 10e-3, 100)])
"""Losses around a message or a woken thread that are tried: up to the longest tick of an operating system."""


@dataclass(frozen=True)
class Machine:
    """What a run has.

    cores : that its ranks share.
    bandwidth_bytes_per_s : of messages between ranks.
    speed : of a core, 1 being the measured one.
    """

    cores: int
    bandwidth_bytes_per_s: float = 10e9
    speed: float = 1.0


@dataclass(frozen=True)
class Setting:
    """How a run is laid out."""

    topology: str
    threads: int
    in_flight: int


@dataclass(frozen=True)
class Forecast:
    """The predicted run.

    inflation : rank → how many times longer its work takes than alone.
    """

    setting: Setting
    schedule: Schedule
    inflation: dict[str, float]

    @property
    def frames_per_s(self) -> float:
        """As a run would report it."""
        return self.schedule.frames_per_s

    @property
    def latency_ms(self) -> float:
        """Median over the frames."""
        return 1e3 * float(np.median(self.schedule.latency_s))


def forecast(costs: Costs, load: Workload, setting: Setting, machine: Machine) -> Forecast:
    """The prediction for a workload on a setting and a machine. Cost: some ms a hundred frames."""
    columns = stage_columns(load, setting.threads)
    alone = {stage: costs.stages[stage].of(columns[stage]) / machine.speed for stage in STAGES}
    threads = {"culling": 1.0, "sampling": 1.0, "render": float(setting.threads)}
    loop_s, message_s = costs.loop_s / machine.speed, costs.message_s / machine.speed
    if setting.topology == "single":
        factor = {stage: _inflation(threads[stage], costs.contention, machine.cores) for stage in STAGES}
        work = loop_s + sum(alone[stage] * factor[stage] for stage in STAGES)
        schedule = run_schedule([Stage("single", np.asarray(work))], in_flight=1)
        return Forecast(setting, schedule, {"single": factor["render"]})
    links = {
        "culling": load.visibility_bytes / machine.bandwidth_bytes_per_s,
        "sampling": float(load.render_points_bytes.mean()) / machine.bandwidth_bytes_per_s,
        "render": 0.0,
    }
    fixed = {stage: MESSAGES[stage] * message_s + (loop_s if stage == "culling" else 0.0) for stage in STAGES}
    factor: dict[str, float] = dict.fromkeys(STAGES, 1.0)
    crowded = setting.threads >= machine.cores > 1
    one_thread = costs.stages["render"].of(stage_columns(load, 1)["render"]) / machine.speed
    for _ in range(ROUNDS):
        work = {s: alone[s] * factor[s] for s in STAGES}
        if crowded:
            work["render"] = np.minimum(work["render"] + costs.late_s, one_thread * factor["render"])
        stages = [Stage(s, work[s] + fixed[s], link_s=links[s]) for s in STAGES]
        schedule = run_schedule(stages, in_flight=setting.in_flight)
        busy = {s: float(alone[s].sum()) * factor[s] / schedule.total_s * threads[s] for s in STAGES}
        wanted = {
            s: _inflation(threads[s] + sum(busy[o] for o in STAGES if o != s), costs.contention, machine.cores)
            for s in STAGES
        }
        if all(abs(wanted[s] - factor[s]) < 1e-4 for s in STAGES):
            break
        factor = {s: (wanted[s] + factor[s]) / 2 for s in STAGES}
    return Forecast(setting, schedule, factor)


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
    setting = Setting(run.topology, run.threads, run.config.pipeline.frames_in_flight)
    return forecast(costs, run.load, setting, machine).frames_per_s * run.frame_s - 1


def _inflation(busy: float, contention: float, cores: int) -> float:
    return max(1.0, busy / cores) * (1 + contention * max(min(busy, cores) - 1, 0.0))
