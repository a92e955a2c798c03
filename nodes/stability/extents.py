"""Clouds of any extent, from 1e-300 to 1e300, through the whole chain."""

from __future__ import annotations

import numpy as np

from ...shared.errors import InputError
from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.stability.case import cases, expect, out_of_reach
from .chain import built, camera_at, city

_SIZE = 200.0
"""Extent of ``city``, metres."""
_EYE, _TARGET = np.array([100.0, 62.0, 3.0]), np.array([112.0, 112.0, 8.0])


def _frame(factor: float) -> np.ndarray:
    """(270, 480) words of the city with everything, eye and near plane too, times ``factor``."""
    with built(city() * factor) as chain:
        camera = camera_at(_EYE * factor, _TARGET * factor, width=480, height=270, near=0.05 * factor)
        return chain.frame(camera, pixel_threshold=12.0)


@cases("extent/power of two", bounds=dict.fromkeys((-70, -38, -10, 10, 32, 70), 0.0), unit="pixels")
def power_of_two(exponent: int) -> float:
    """Pixels of a city with everything times two to this power that differ from the city's in colour or in depth times
    that power: built, culled, sampled, drawn. Scaling by a power of two rounds nothing.
    """
    here, there = _frame(1.0), _frame(2.0**exponent)
    expect((here != FRAMEBUFFER_EMPTY).mean() > 0.01, "the picture shows something")
    depth = (there >> np.uint64(32)).astype(np.uint32).view(np.float32)
    back = np.ldexp(depth, -exponent).view(np.uint32).astype(np.uint64) << np.uint64(32) | there & np.uint64(0xFFFFFFFF)
    return int((np.where(there == FRAMEBUFFER_EMPTY, FRAMEBUFFER_EMPTY, back) != here).sum())


@cases("extent/metres", bounds=dict.fromkeys((1e-30, 1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9, 1e12, 1e30), 0.01), unit="px")
def metres(extent: float) -> float:
    """Image position of every drawn point of a city of this extent, against float64; 1920×1080."""
    factor = extent / _SIZE
    with built(city() * factor) as chain:
        camera = camera_at(_EYE * factor, _TARGET * factor, near=0.05 * factor)
        moved = chain.moved_px(camera)
        expect(len(moved) > 1000, "points are in the image")
        return float(moved.max())


@cases("extent/too large", bounds={1e31: 0.0, 1e39: 0.0, 1e300: 0.0}, unit="not refused")
def too_large(extent: float) -> float:
    """Clouds beyond what float32 offsets can hold are refused in one line when they are built."""
    try:
        with built(city() * (extent / _SIZE)):
            return 1.0
    except InputError as error:
        expect("extent" in str(error), "the line says why")
        return 0.0


@cases("extent/too small", bounds={1e-45: 0.0, 1e-300: 0.0}, unit="pixels")
def too_small(extent: float) -> float:
    """Pixels that differ from brute force for clouds whose float32 offsets underflow: each block's points are drawn at
    its origin, and no word is made of what is not a number.
    """
    factor = extent / _SIZE
    with built(city() * factor) as chain:
        camera = camera_at(_EYE * factor, _TARGET * factor, width=480, height=270, near=0.05 * factor)
        return chain.differing_pixels(camera)


below_float32 = out_of_reach(
    "extent/metres below 1e-37",
    "Image position of every drawn point of a city of an extent below 1e-37, against float64.",
    "a stored offset is a float32, which has fewer digits below 1.2e-38 (measured 0.007 px at 1e-38, 41 px at 1e-42)",
)
