"""Predicted beside measured frames/s, on runs that the costs were not fitted on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..experiment.grid import Experiment, Point
from .calibrate import all_costs
from .costs import Costs, Measured
from .forecast import Forecast, forecast
from .machine import Machine

MEDIAN_GOAL, WORST_GOAL = 0.15, 0.30


@dataclass(frozen=True)
class Comparison:
    """One point of the experiment.

    records : of the repeats.  measured : frames/s of each.
    """

    point: Point
    records: Sequence[dict[str, Any]]
    measured: list[float]
    predicted: Forecast

    @property
    def error(self) -> float:
        """(predicted − measured) / measured, of the median."""
        return self.predicted.frames_per_s / float(np.median(self.measured)) - 1


def compare(
    experiment: Experiment, measured: dict[int, Measured], n_points: int, machine: Machine
) -> tuple[list[Comparison], Costs]:
    """Every one of the first ``n_points`` points against one set of costs for all scenes; those costs.

    The others are calibration: other settings than any of the compared points (``calibrate.extended``).
    """
    costs = all_costs([run for i, run in measured.items() if i >= n_points], machine)
    out = []
    for i, run in measured.items():
        if i < n_points:
            found = forecast(costs, run.parts, run.setting, machine)
            out.append(Comparison(experiment.points[i], run.records, run.frames_per_s, found))
    return out, costs


def errors(comparisons: Sequence[Comparison]) -> tuple[float, float]:
    """(median, worst) absolute relative error; zeros for none."""
    values = np.abs([c.error for c in comparisons])
    return (float(np.median(values)), float(values.max())) if len(values) else (0.0, 0.0)
