"""Cases of the codecs."""

from __future__ import annotations

from itertools import product

import numpy as np

from ..codecs.autocorrelation import circular_counts, padded_shape
from .case import cases, expect

_EDGE, _REACH = 128, 12


@cases("codec/FFT autocorrelation", bounds=dict.fromkeys((0.001, 0.02, 0.5, 1.0), 1e-6), unit="counts")
def autocorrelation(share: float) -> float:
    """Counts of translations in a grid of 128³, this share of it filled, against counts in integers: all of a full
    grid, of others 64 and how far each is from a whole number. At 0.5 a count would be rounded to another one.
    """
    full = np.stack(np.meshgrid(*[np.arange(_EDGE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(67)
    points = full[rng.random(len(full)) < share]
    found = circular_counts(points, padded_shape(np.full(3, _EDGE), np.full(3, _REACH)))
    expect(np.rint(found[0, 0, 0]) == len(points), "as many points as no translation takes to a point")
    if share == 1.0:
        overlap = _EDGE - np.abs(np.arange(-_REACH, _REACH + 1))
        window = found[np.ix_(*[np.arange(-_REACH, _REACH + 1)] * 3)]
        return float(np.abs(window - overlap[:, None, None] * overlap[:, None] * overlap).max())
    grid = np.zeros((_EDGE,) * 3, bool)
    grid[tuple(points.T)] = True
    worst = float(np.abs(found - np.rint(found)).max())
    for t in product((-_REACH, -1, 3, 7), repeat=3):
        here, there = (tuple(slice(max(0, s * a), _EDGE + min(0, s * a)) for a in t) for s in (-1, 1))
        worst = max(worst, abs(found[t] - np.count_nonzero(grid[here] & grid[there])))
    return worst
