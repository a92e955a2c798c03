"""The lie of the land: a valley around each park."""

from __future__ import annotations

from typing import Any

import numpy as np

STREET_M = 9.0
BLOCK_M = 63.0
PITCH_M = STREET_M + BLOCK_M
DISTRICT = 3
"""Blocks a side of the pattern that repeats; its middle block is the park."""

_AMPLITUDE_M = 0.9
LOWEST_M, HIGHEST_M = 0.0, 4 * _AMPLITUDE_M


def height(x: Any, y: Any) -> Any:
    """Terrain height in metres at city coordinates x, y (arrays or scalars, metres); 0 in the middle of a park."""
    k = 2 * np.pi / (DISTRICT * PITCH_M)
    middle = STREET_M + PITCH_M * (DISTRICT // 2) + BLOCK_M / 2
    return _AMPLITUDE_M * (2 - np.cos(k * (x - middle)) - np.cos(k * (y - middle)))
