"""The pipeline as a max-plus recurrence over ranks and frames.

Stage *i* starts frame *f* once the frame has arrived from every stage *j* that it comes after, in a chain the stage
before, and one of its workers is free; a stage after none starts it once fewer than ``in_flight`` are unfinished:

    start(i, f)  = max(finish(j, f) + link(j), free(i), start(i, f − 1))
    start(0, f)  = max(free(0), finish(last, f − in_flight) + credit)
    finish(i, f) = start(i, f) + cost(i, f)

Stages on the same rank, or the same link, share its workers and take turns in the order that they
stand in. Only maximum and addition: the times are monotone in every cost.
Source: Baccelli, Cohen, Olsder, Quadrat, "Synchronization and Linearity", 1992, chapter 2.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...shared.errors import InputError


@dataclass(frozen=True)
class Stage:
    """One stage of the pipeline: a rank, or several that take frames in turn; or a link that messages pass.

    cost_s : (n_frames,) float64, seconds of work of each frame, ≥ 0 and finite.
    workers : frames it works on at once.
    link_s : seconds a frame is under way to the next stages while none works on it.
    after : numbers of the stages that it takes frames from, all before it; None: from the one before it, if any.
    on : what works, where that has other stages too, with as many workers; "": what ``name`` says.
    """

    name: str
    cost_s: np.ndarray
    workers: int = 1
    link_s: float = 0.0
    after: tuple[int, ...] | None = None
    on: str = ""

    @property
    def worker(self) -> str:
        """Name of what works."""
        return self.on or self.name


@dataclass(frozen=True)
class Schedule:
    """When every frame is where.

    start_s, finish_s : (n_stages, n_frames) float64, seconds since the first frame could start.
    """

    stages: Sequence[Stage]
    start_s: np.ndarray
    finish_s: np.ndarray

    @property
    def total_s(self) -> float:
        """Seconds until the last frame is done."""
        return float(self.finish_s[-1].max())

    @property
    def frames_per_s(self) -> float:
        """Frames over total time, filling and draining included, as a run reports it; infinite if nothing costs."""
        return self.finish_s.shape[1] / self.total_s if self.total_s > 0 else np.inf

    @property
    def steady_frames_per_s(self) -> float:
        """Slope of the second half of the finish times: what a long run tends to. Needs two frames."""
        done = np.sort(self.finish_s[-1])
        first = len(done) // 2 - 1 if len(done) > 3 else 0
        gained = done[-1] - done[first]
        return float((len(done) - 1 - first) / gained) if gained > 0 else np.inf

    @property
    def latency_s(self) -> np.ndarray:
        """(n_frames,) seconds from the start of a frame's first stage to the end of its last one listed."""
        return self.finish_s[-1] - self.start_s[0]

    @property
    def utilisation(self) -> dict[str, float]:
        """What works (a stage, where it is alone there) → share of the total time that it does."""
        total = self.total_s
        shares: dict[str, float] = {}
        for s in self.stages:
            busy = float(s.cost_s.sum()) / (s.workers * total) if total > 0 else 0.0
            shares[s.worker] = shares.get(s.worker, 0.0) + busy
        return shares

    @property
    def bottleneck(self) -> str:
        """What has the highest utilisation; the first of equals."""
        shares = self.utilisation
        return max(shares, key=lambda name: shares[name])


def run_schedule(stages: Sequence[Stage], *, in_flight: int, credit_s: float = 0.0) -> Schedule:
    """The schedule of stages; a frame is done when it has left the last of them.

    in_flight : frames started and unfinished, at most; ≥ 1.
    credit_s : seconds until the first stage knows that a frame is done.
    Raises InputError for costs that are negative, not finite or of different lengths, a stage after a later one,
    no stage or no frame.
    Cost: O((stages + what they come after) · frames · log workers).
    """
    _check(stages, in_flight)
    n_frames = len(stages[0].cost_s)
    costs = [stage.cost_s.tolist() for stage in stages]
    start: list[list[float]] = []
    finish: list[list[float]] = []
    began = [0.0] * len(stages)
    free = {stage.worker: [0.0] * min(stage.workers, n_frames) for stage in stages}
    before = [(i - 1,) if stage.after is None and i else stage.after or () for i, stage in enumerate(stages)]
    done: list[float] = []  # when frame f and all before it were done
    for f in range(n_frames):
        issued = done[f - in_flight] + credit_s if f >= in_flight else 0.0
        arrived: list[float] = []  # at the stages after
        ended: list[float] = []
        for i, stage in enumerate(stages):
            workers = free[stage.worker]
            begin = max(max((arrived[j] for j in before[i]), default=issued), workers[0], began[i])
            end = begin + costs[i][f]
            heapq.heapreplace(workers, end)
            began[i] = begin
            arrived.append(end + stage.link_s)
            ended.append(end)
        start.append(began.copy())
        finish.append(ended)
        done.append(max(end, done[-1] if done else 0.0))
    return Schedule(stages, np.array(start).T, np.array(finish).T)


def _check(stages: Sequence[Stage], in_flight: int) -> None:
    if in_flight < 1:
        raise InputError(f"frames in flight: found {in_flight}, expected at least 1")
    if not stages or not len(stages[0].cost_s):
        raise InputError("schedule: found no stage or no frame, expected at least one of each")
    n_frames = len(stages[0].cost_s)
    for i, stage in enumerate(stages):
        if any(not 0 <= j < i for j in stage.after or ()):
            raise InputError(f"stage {stage.name}: found it after {stage.after}, expected stages before it")
        cost = np.asarray(stage.cost_s)
        if len(cost) != n_frames:
            raise InputError(f"stage {stage.name}: found {len(cost)} costs, expected {n_frames}")
        if not (np.isfinite(cost).all() and (cost >= 0).all() and 0 <= stage.link_s < np.inf and stage.workers >= 1):
            raise InputError(f"stage {stage.name}: expected finite costs ≥ 0, a finite link ≥ 0 and a worker")
