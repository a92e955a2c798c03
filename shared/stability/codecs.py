"""Cases of the codecs."""

from __future__ import annotations

from itertools import product

import numpy as np

from ..codecs.autocorrelation import circular_counts, padded_shape
from .case import cases, expect

_EDGE, _REACH = 128, 12


def _some(share: float) -> np.ndarray:
    """Points that fill this share of a grid, here and there."""
    full = np.argwhere(np.ones((_EDGE,) * 3, bool))
    return full[np.random.default_rng(67).random(len(full)) < share]


_SETS = {
    "0.001 filled": lambda: _some(0.001),
    "0.03 filled": lambda: _some(0.03),
    "largest cube in float32": lambda: np.argwhere(np.ones((40,) * 3, bool)),
    "planes": lambda: np.argwhere(np.add.outer(np.add.outer(*[np.arange(_EDGE)] * 2), np.arange(_EDGE)) % 33 == 0),
    "half filled": lambda: _some(0.5),
    "full": lambda: _some(1.0),
}
_BOUNDS = dict.fromkeys(_SETS, 0.05) | dict.fromkeys(("half filled", "full"), 1e-6)


@cases("codec/FFT autocorrelation", bounds=_BOUNDS, unit="counts")
def autocorrelation(name: str) -> float:
    """Counts of translations in a grid of 128³ against counts in integers, of 64 translations, and how far any is from
    a whole number; in float32, the last two in float64. At 0.5 a count would be rounded to another one.
    """
    points = _SETS[name]()
    found = circular_counts(points, padded_shape(np.full(3, _EDGE), np.full(3, _REACH)))
    expect((found.dtype == np.float32) == (_BOUNDS[name] > 1e-3), "counted in the precision that the case is for")
    grid = np.zeros((_EDGE,) * 3, bool)
    grid[tuple(points.T)] = True
    worst = float(np.abs(found - np.rint(found)).max())
    for t in product((-_REACH, -1, 3, 7), repeat=3):
        here, there = (tuple(slice(max(0, s * a), _EDGE + min(0, s * a)) for a in t) for s in (-1, 1))
        worst = max(worst, abs(float(found[t]) - np.count_nonzero(grid[here] & grid[there])))
    return worst
