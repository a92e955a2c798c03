"""The pipeline as a max-plus recurrence over ranks and frames.

Stage *i* starts frame *f* once the frame has arrived from stage *i − 1* and one of its workers is free; the first
stage starts it once fewer than ``in_flight`` frames are unfinished:

    start(i, f)  = max(finish(i − 1, f) + link(i − 1), free(i), start(i, f − 1))
    start(0, f)  = max(free(0), finish(last, f − in_flight) + credit)
    finish(i, f) = start(i, f) + cost(i, f)

Only maximum and addition: the times are monotone in every cost.
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
    """One stage of the pipeline: a rank, or several that take frames in turn.

    cost_s : (n_frames,) float64, seconds of work of each frame, ≥ 0 and finite.
    workers : frames it works on at once.
    link_s : seconds a frame is under way to the next stage while neither works on it.
    """

    name: str
    cost_s: np.ndarray
    workers: int = 1
    link_s: float = 0.0


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
        """(n_frames,) seconds from the start of a frame's first stage to the end of its last."""
        return self.finish_s[-1] - self.start_s[0]

    @property
    def utilisation(self) -> dict[str, float]:
        """Stage → share of the total time that its workers work."""
        total = self.total_s
        return {s.name: float(s.cost_s.sum()) / (s.workers * total) if total > 0 else 0.0 for s in self.stages}

    @property
    def bottleneck(self) -> str:
        """The stage with the highest utilisation; the first of equals."""
        shares = self.utilisation
        return max(shares, key=lambda name: shares[name])


def run_schedule(stages: Sequence[Stage], *, in_flight: int, credit_s: float = 0.0) -> Schedule:
    """The schedule of a chain of stages.

    in_flight : frames started and unfinished, at most; ≥ 1.
    credit_s : seconds until the first stage knows that a frame is done.
    Raises InputError for costs that are negative, not finite or of different lengths, no stage or no frame.
    Cost: O(stages · frames · log workers).
    """
    _check(stages, in_flight)
    n_frames = len(stages[0].cost_s)
    start, finish = np.zeros((2, len(stages), n_frames))
    free = [[0.0] * min(stage.workers, n_frames) for stage in stages]
    done: list[float] = []  # when frame f and all before it were done
    for f in range(n_frames):
        ready = done[f - in_flight] + credit_s if f >= in_flight else 0.0
        for i, stage in enumerate(stages):
            begin = max(ready, heapq.heappop(free[i]), start[i, f - 1] if f else 0.0)
            end = begin + float(stage.cost_s[f])
            heapq.heappush(free[i], end)
            start[i, f], finish[i, f] = begin, end
            ready = end + stage.link_s
        done.append(max(end, done[-1] if done else 0.0))
    return Schedule(stages, start, finish)


def _check(stages: Sequence[Stage], in_flight: int) -> None:
    if in_flight < 1:
        raise InputError(f"frames in flight: found {in_flight}, expected at least 1")
    if not stages or not len(stages[0].cost_s):
        raise InputError("schedule: found no stage or no frame, expected at least one of each")
    n_frames = len(stages[0].cost_s)
    for stage in stages:
        cost = np.asarray(stage.cost_s)
        if len(cost) != n_frames:
            raise InputError(f"stage {stage.name}: found {len(cost)} costs, expected {n_frames}")
        if not (np.isfinite(cost).all() and (cost >= 0).all() and 0 <= stage.link_s < np.inf and stage.workers >= 1):
            raise InputError(f"stage {stage.name}: expected finite costs ≥ 0, a finite link ≥ 0 and a worker")
