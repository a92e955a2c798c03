"""Eye-dome lighting: pixels darken where their neighbours are nearer, which shows edges and hollows without normals.

With depths d and n = 8 neighbours at a radius, the response of a pixel is Σ max(0, log2 d − log2 dᵢ) / n and its shade
exp(−300 · strength · response), as Potree has it. Logarithms make the same relative step equally dark near and far.
A neighbour that is background or outside the image adds nothing; background is not shaded.

Σ log2 (d / dᵢ) is the logarithm of a product, so the shade is (Π min(1, dᵢ / d)) ^ (300 · strength / (n · ln 2)): one
power a pixel and no logarithm.

Source: Boucheny 2009, "Visualisation scientifique de grands volumes de données", chapter 3; Schütz 2016, "Potree".
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .rows import Rows

POTREE_SCALE = 300.0
"""What a strength of 1 multiplies responses by."""

_ONE = np.float32(1)


class EyeDomeLighting:
    """Shades of the pixels of frames of one size.

    strength : > 0; Potree's default is 0.4.  radius_px : of the eight neighbours, ≥ 0.5 pixels.
    wrap : the left edge of the image is beside its right edge.
    """

    def __init__(self, strength: float, radius_px: float, *, wrap: bool) -> None:
        self._exponent = np.float32(shade_exponent(strength))
        self._offsets = neighbours(radius_px)
        self._wrap = wrap

    def shades(self, words: np.ndarray, rows: Rows) -> np.ndarray:
        """(h, w) float32 factors in [0, 1] on the colours of (h, w) uint64 framebuffer words; 1 for background.

        Error: below 1e-4 · max(1, strength) against float64.  Cost: 8 divisions and a power a pixel.
        """
        out = np.empty(words.shape, np.float32)
        depths = words.view(np.float32)  # every second one; NaN for background
        rows.run(len(words), _shade_rows, depths, self._offsets, self._exponent, self._wrap, out)
        return out


def shade_exponent(strength: float) -> float:
    """Exponent of the product of the eight depth ratios."""
    return POTREE_SCALE * strength / (8 * math.log(2))


def neighbours(radius_px: float) -> np.ndarray:
    """(8, 2) int64 (rows, columns) of the pixels nearest to a circle, at least one pixel away on each axis used."""
    straight, diagonal = (max(1, math.floor(r + 0.5)) for r in (radius_px, radius_px * math.sqrt(0.5)))
    steps = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]
    return np.array([np.multiply(step, diagonal if all(step) else straight) for step in steps])


@njit(nogil=True, cache=True, error_model="numpy")
def _shade_rows(depths, offsets, exponent, wrap, out, first, end):
    """Fill rows of ``out``. depths : (h, 2 w) float32, the odd columns.

    Unsigned indices need no test for negative ones, so that the inner loop is vectorised.
    """
    height, width = out.shape
    product = np.empty(width, np.float32)
    for row in range(first, end):
        product[:] = _ONE
        for k in range(len(offsets)):
            other, step = row + offsets[k, 0], offsets[k, 1]
            if other < 0 or other >= height:
                continue
            inside_from = min(max(0, -step), width)
            inside_to = max(inside_from, min(width, width - step))
            here, there = np.uintp(inside_from), np.uintp(inside_from + step)
            for i in range(np.uintp(inside_to - inside_from)):
                product[here + i] *= _nearer(depths, np.uintp(other), there + i, np.uintp(row), here + i)
            if wrap:
                for column in range(width):
                    if column < inside_from or column >= inside_to:
                        beside = (column + step) % width
                        product[column] *= _nearer(depths, other, beside, row, column)
        for column in range(width):
            out[row, column] = product[column] ** exponent if product[column] < _ONE else _ONE


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _nearer(depths, other_row, other_column, row, column):
    """min(1, depth of the other / depth); 1 where either is background, whose depth is NaN."""
    one, two = np.uintp(1), np.uintp(2)
    ratio = depths[other_row, two * np.uintp(other_column) + one] / depths[row, two * np.uintp(column) + one]
    return ratio if ratio < _ONE else _ONE
