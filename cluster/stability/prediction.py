"""The max-plus recurrence where stages differ by many orders of magnitude, against rational arithmetic."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from ...shared.stability.case import case, cases
from ..predict.recurrence import Stage, run_schedule

_N_FRAMES = 2000


def _stages(ratio: float) -> list[Stage]:
    """Three stages: fast, slow by ``ratio``, fast; costs that are no round numbers, links of the fast one's size."""
    rng = np.random.default_rng(67)
    scales = (1e-3, 1e-3 * ratio, 1e-3)
    return [Stage(f"s{i}", s * rng.uniform(0.7, 1.3, _N_FRAMES), link_s=1e-4) for i, s in enumerate(scales)]


def _exact_total(stages: list[Stage], in_flight: int) -> Fraction:
    """Time until the last frame is done, with one worker a stage, in rationals."""
    free = [Fraction(0)] * len(stages)
    done: list[Fraction] = []
    for frame in range(_N_FRAMES):
        ready = done[frame - in_flight] if frame >= in_flight else Fraction(0)
        for i, stage in enumerate(stages):
            free[i] = max(ready, free[i]) + Fraction(float(stage.cost_s[frame]))
            ready = free[i] + Fraction(stage.link_s)
        done.append(free[-1])
    return done[-1]


@cases("prediction/stage rates apart by", bounds=dict.fromkeys((1e-6, 1.0, 1e6, 1e12), 1e-12), unit="of the time")
def rates_apart(ratio: float) -> float:
    """Total time of 2000 frames through three stages whose middle one is slower by this ratio, against rationals, with
    3 frames in flight (bound: a rounding for each sum on the way).
    """
    stages = _stages(ratio)
    exact = _exact_total(stages, 3)
    return float(abs(Fraction(run_schedule(stages, in_flight=3).total_s) - exact) / exact)


@cases("prediction/rate of the slowest stage, others faster by", bounds={1e6: 1e-5, 1e12: 1e-9}, unit="of the rate")
def slowest(ratio: float) -> float:
    """Steady rate of three stages against that of the slowest alone, when the others hardly count."""
    stages = [Stage("fast", np.full(_N_FRAMES, 1 / ratio)), Stage("slow", np.ones(_N_FRAMES))]
    return abs(run_schedule(stages, in_flight=3).steady_frames_per_s - 1.0)


@case("prediction/nothing costs", bound=0.0, unit="answers")
def nothing_costs() -> float:
    """Answers that are negative or not numbers where no stage takes any time."""
    schedule = run_schedule([Stage("a", np.zeros(5)), Stage("b", np.zeros(5))], in_flight=1)
    answers = [schedule.total_s, schedule.frames_per_s, schedule.steady_frames_per_s, *schedule.utilisation.values()]
    return sum(not answer >= 0 for answer in answers)
