"""A latency and a rate from timed samples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Fit(NamedTuple):
    """``seconds = latency_s + amount / per_s``, and the largest relative residual; no rate where the slope is 0."""

    latency_s: float
    per_s: float | None
    worst_residual: float


def fit_latency_and_rate(amounts: Sequence[float], seconds: Sequence[float]) -> Fit:
    """The line through n ≥ 2 samples with the least squared relative error, neither latency nor slope negative.

    Relative, because the times span orders of magnitude and the latency shows at the small end only.
    """
    amount, time_s = np.asarray(amounts, np.float64), np.asarray(seconds, np.float64)
    scale = max(float(amount.max()), 1.0)
    columns = np.column_stack([np.ones_like(amount), amount / scale]) / time_s[:, None]
    ones = np.ones_like(time_s)
    lines = []
    for kept in ([0, 1], [0], [1]):  # both terms, or one of them alone
        line = np.zeros(2)
        line[kept] = np.linalg.lstsq(columns[:, kept], ones, rcond=None)[0]
        if (line >= 0).all():
            lines.append(line)
    latency_s, slope = min(lines, key=lambda line: float(((columns @ line - 1) ** 2).sum()))
    residual = np.abs(columns @ [latency_s, slope] - 1).max()
    return Fit(float(latency_s), float(scale / slope) if slope > 0 else None, float(residual))
