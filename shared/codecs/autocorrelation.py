"""The most common translations between the points of a set, counted exactly: 3-D autocorrelation by real FFT.

The number of points that a translation takes to another point is the autocorrelation of the set's occupancy grid. A
transform of N_a values along axis a gives circular counts: those of translations a multiple of N_a apart, summed. The
grid is padded only to the translations that are looked for: with N_a ≥ extent_a + reach_a no other translation that
the set can have coincides with one of at most reach_a along every axis. Most common ones of a scanned surface are
short, so a short reach does, and the circular counts prove it: beyond the reach they are upper bounds. Where the
bounds leave room for a more common translation, the reach is doubled.

Counts are exact: they are integers, and rounding finds them while the transform is off by less than 0.5. Its error
grows with log2(N) times the number of points times half a unit in the last place; measured on grids of 128³, it is at
most 0.02 up to ``FLOAT32_POINTS`` in float32, which takes 0.6 of the time, and 1e-9 for a full grid in float64
(``shared/stability`` holds both to a bound). In float32 a full grid would be off by 0.5.

Source: Kim, Lee, Varshney, "Vertex Transformation Streams", section 5, equations 1 to 3.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import fft

_fft: Any = fft  # its functions have no types of their own: they are dispatched

PALETTE_SIZE = 256
"""Most translations of a palette: the paper's."""

LEAST_SHARE = 1 / 32
"""Of the points, that a translation must take to another one: below, it could not fill its row of a pool."""

MAX_REACH = 127
"""Longest translation along an axis: a signed byte."""

FLOAT32_POINTS = 1 << 16
"""Most points that are counted in float32."""

_FIRST_REACH = 12


def common_translations(
    points: np.ndarray, size: int = PALETTE_SIZE, longest: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The most common translations between (n, 3) distinct grid points, and how many points each takes to another.

    longest : along an axis; None: ``MAX_REACH``. A short one spares the proof that no longer one is more common.
    Returns (m, 3) int64, each axis in −longest … longest, and (m,) int64 counts; m ≤ size, all ≥ n · ``LEAST_SHARE``.
    The first is no translation at all, of count n; t and −t are two. Most common first, of equal ones the one that is
    shorter along its longest axis, then by x, y, z.
    Cost: O(N log N) time and 16 bytes for each of the N values of the padded grid (32 in float64); n > 0.
    """
    lower = points.min(axis=0).astype(np.int64)
    extent = points.max(axis=0) - lower + 1
    least = max(1, int(np.ceil(len(points) * LEAST_SHARE)))
    most_reach = np.minimum(extent - 1, MAX_REACH if longest is None else longest)
    reach = np.minimum(most_reach, _FIRST_REACH)
    while True:
        counts = circular_counts(points - lower, padded_shape(extent, reach))
        window = np.ix_(*(np.arange(-r, r + 1) for r in reach))
        inside = np.rint(counts[window]).astype(np.int64)
        counts[window] = 0
        translations, found = _most_common(inside, reach, least, size)
        if (reach == most_reach).all() or np.rint(counts.max()) < (found[-1] + 1 if len(found) == size else least):
            return translations, found
        reach = np.minimum(most_reach, 2 * reach)


def padded_shape(extent: np.ndarray, reach: np.ndarray) -> tuple[int, ...]:
    """Values along each axis so that circular counts are those of translations up to ``reach``; lengths that are
    fast to transform.
    """
    return tuple(_fft.next_fast_len(int(e + r), real=True) for e, r in zip(extent, reach, strict=True))


def circular_counts(points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Array of this shape: at t, how many of (n, 3) points are points when t is added, modulo the shape.

    Float32 for at most ``FLOAT32_POINTS``, else float64.
    """
    grid = np.zeros(shape, np.float32 if len(points) <= FLOAT32_POINTS else np.float64)
    grid[tuple(points.T)] = 1
    spectrum = _fft.rfftn(grid)
    spectrum *= spectrum.conj()
    return _fft.irfftn(spectrum, s=shape, overwrite_x=True)


def _most_common(counts: np.ndarray, reach: np.ndarray, least: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The ``size`` largest of the counts that are at least ``least``; counts start at −reach along each axis."""
    flat = counts.ravel()
    if len(flat) > size:
        least = max(least, int(np.partition(flat, -size)[-size]))
    chosen = np.flatnonzero(flat >= least)
    x, y, z = translations = np.array(np.unravel_index(chosen, counts.shape)) - reach[:, None]
    order = np.lexsort([z, y, x, np.abs(translations).max(axis=0), -flat[chosen]])[:size]
    return translations.T[order], flat[chosen][order]
