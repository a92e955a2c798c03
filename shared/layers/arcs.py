"""Arcs: segments of rings with a height, as of sunbursts.

====================  =======  ===================================================================
attribute             dtype    meaning
====================  =======  ===================================================================
center                2 × f4   of the circle, x and y, relative to the layer's origin
angle                 2 × f4   where the arc starts and ends, radians, anticlockwise from +x; a span of 2π is closed
radius                2 × f4   inner and outer, 0 ≤ inner ≤ outer
height                2 × f4   lower and upper z, relative to the layer's origin
value                 f4       what a colour map colours
====================  =======  ===================================================================

36 bytes.  Source: "Attributed Vertex Clouds", 1.3.4 (there y is up).
"""

from __future__ import annotations

import math

import numpy as np

from ..errors import InputError
from .layer import Layer

OBJECT = np.dtype(
    [("center", "<f4", 2), ("angle", "<f4", 2), ("radius", "<f4", 2), ("height", "<f4", 2), ("value", "<f4")]
)
ELEMENT = None

FULL = 2 * math.pi
_SLACK = 1e-5


def bounds(layer: Layer) -> tuple[np.ndarray, np.ndarray]:
    """((n, 3), (n, 3)) float64 boxes, relative to the origin."""
    o = layer.objects
    start, end = o["angle"].astype(np.float64).T
    quarter = np.ceil(start / (np.pi / 2))[:, None] + np.arange(5)
    turning = np.where(
        quarter * np.pi / 2 <= end[:, None], quarter * np.pi / 2, start[:, None]
    )  # where x or y is largest
    angles = np.column_stack([start, end, turning])[:, :, None]
    radii = o["radius"].astype(np.float64)[:, None]
    x, y = (radii * np.cos(angles)).reshape(len(o), -1), (radii * np.sin(angles)).reshape(len(o), -1)
    center, height = o["center"].astype(np.float64), o["height"].astype(np.float64)
    slack = _SLACK * o["radius"][:, 1:].astype(np.float64)  # shaders count in float32
    lower, upper = (
        np.column_stack([center + np.column_stack([pick(x, axis=1), pick(y, axis=1)]), pick(height, axis=1)])
        for pick in (np.min, np.max)
    )
    lower[:, :2] -= slack
    upper[:, :2] += slack
    return lower, upper


def check(layer: Layer) -> None:
    """Raise InputError for radii that are negative or in the wrong order, angles that are, or a span above 2π."""
    o = layer.objects
    span = o["angle"][:, 1].astype(np.float64) - o["angle"][:, 0]
    for attribute, bad, expected in (
        ("radius", (o["radius"][:, 0] < 0) | (o["radius"][:, 0] > o["radius"][:, 1]), "0 ≤ inner ≤ outer"),
        ("angle", (span < 0) | (span > FULL * (1 + _SLACK)), "start ≤ end ≤ start + 2π"),
    ):
        if bad.any():
            i = int(bad.argmax())
            found = o[attribute][i].tolist()
            raise InputError(f"layer {layer.name}: {attribute} of object {i}: found {found}, expected {expected}")
