"""Speed and acceleration of nodes, from where and when they were, and what is missing of them."""

from __future__ import annotations

import numpy as np


def path_length(position: np.ndarray, part: np.ndarray) -> np.ndarray:
    """(n,) float64: how far each of (n, 3) nodes is along its part of a track.

    part : (n,) ascending.
    """
    steps = np.zeros(len(position))
    steps[1:] = np.linalg.norm(np.diff(position, axis=0), axis=1)
    first = np.searchsorted(part, part)
    steps[first] = 0
    length = np.cumsum(steps)
    return length - length[first]


def derivative(values: np.ndarray, time: np.ndarray, part: np.ndarray) -> np.ndarray:
    """(n,) float64: change of a quantity between the times before and after each node, at ends beside it.

    time : (n,) float64, seconds, ascending in each part, and may stay the same: the nodes of one time have one value,
    from the first of them. 0 where a part has one time only.
    """
    begins = np.append(True, part[1:] != part[:-1])
    starts = begins | np.append(True, time[1:] != time[:-1])
    group = np.cumsum(starts) - 1
    node = np.flatnonzero(starts)
    same = part[node][1:] == part[node][:-1]
    index = np.arange(len(node))
    before = np.where(np.append(False, same), index - 1, index)
    after = np.where(np.append(same, False), index + 1, index)
    v, t = values[node], time[node]
    duration = t[after] - t[before]
    with np.errstate(over="ignore"):  # of times all but the same
        change = np.divide(v[after] - v[before], duration, out=np.zeros(len(node)), where=duration > 0)
    return change[group]


def filled(values: np.ndarray, time: np.ndarray, part: np.ndarray) -> np.ndarray:
    """(n,) float64 with values that are not finite put between those that are; NaN in parts where none is.

    time, part : as of ``derivative``.
    """
    values = np.where(np.isfinite(values), values, np.nan)
    missing = np.isnan(values)
    for p in np.unique(part[missing]):
        nodes = slice(*np.searchsorted(part, (p, p + 1)))
        known = ~missing[nodes]
        if known.any():
            values[nodes] = np.interp(time[nodes], time[nodes][known], values[nodes][known])
    return values
