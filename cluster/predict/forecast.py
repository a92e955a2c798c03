"""Costs and workload → what a run would do: stage times on the ranks and cores it has, then the recurrence.

**Ranks.** ``single`` is one rank whose work is the sum of the stages; ``pipelined`` three. A rank pays the software
latency of each message it sends or receives; a message's bytes are under way for bytes / bandwidth.

**Cores that ranks share.** While a stage works, b cores are busy: its own threads, and the threads of each other rank
for the share of time that it works. Its work then takes max(1, b / cores) · (1 + contention · (min(b, cores) − 1))
times as long. Shares depend on the schedule and the schedule on the shares; they are iterated to a fixed point. That is
a mean-value model: it knows neither which frames meet nor how the kernel of the operating system chooses.
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
MAX_MESSAGE_S = 20e-3


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
    for _ in range(ROUNDS):
        stages = [Stage(s, alone[s] * factor[s] + fixed[s], link_s=links[s]) for s in STAGES]
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
    """The costs with the software latency that brings the forecasts of the pipelined runs nearest to the measured ones.

    Nearest by the sum of relative errors, so the median of what each run asks for, weighted by its frames/s. The figure
    holds whatever a rank loses around a message: packing, polling, waking late. No pipelined run: costs unchanged.
    """
    pipelined = [run for run in runs if run.topology == "pipelined"]
    if not pipelined:
        return costs
    found = []
    for run in pipelined:
        setting = Setting("pipelined", run.threads, run.config.pipeline.frames_in_flight)
        found.append(_latency_that_gives(run.frame_s, costs, run.load, setting, machine))
    order = np.argsort(found)
    weight = np.cumsum([1 / pipelined[i].frame_s for i in order])
    return replace(costs, message_s=found[order[np.searchsorted(weight, weight[-1] / 2)]])


def _latency_that_gives(frame_s: float, costs: Costs, load: Workload, setting: Setting, machine: Machine) -> float:
    """By bisection: frame time grows with latency. 0 if the forecast is slower than measured even without."""
    low, high = 0.0, MAX_MESSAGE_S
    for _ in range(16):
        middle = (low + high) / 2
        predicted = forecast(replace(costs, message_s=middle), load, setting, machine)
        if 1 / predicted.frames_per_s > frame_s:
            high = middle
        else:
            low = middle
    return low


def _inflation(busy: float, contention: float, cores: int) -> float:
    return max(1.0, busy / cores) * (1 + contention * max(min(busy, cores) - 1, 0.0))
