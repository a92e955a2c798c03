"""Cuboids: boxes along the axes, as of treemaps and simple buildings.

====================  =======  ===================================================================
attribute             dtype    meaning
====================  =======  ===================================================================
center                2 × f4   middle, x and y, relative to the layer's origin
extent                2 × f4   size along x and y, ≥ 0
height                2 × f4   lower and upper z, relative to the layer's origin
value                 f4       what a colour map colours
====================  =======  ===================================================================

28 bytes.  Source: "Attributed Vertex Clouds", 1.3.2 (there y is up).
"""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from .layer import Layer

OBJECT = np.dtype([("center", "<f4", 2), ("extent", "<f4", 2), ("height", "<f4", 2), ("value", "<f4")])
ELEMENT = None


def bounds(layer: Layer) -> tuple[np.ndarray, np.ndarray]:
    """((n, 3), (n, 3)) float64 boxes, relative to the origin."""
    o = layer.objects
    center, half = o["center"].astype(np.float64), o["extent"].astype(np.float64) / 2
    height = o["height"].astype(np.float64)
    return np.column_stack([center - half, height.min(axis=1)]), np.column_stack([center + half, height.max(axis=1)])


def check(layer: Layer) -> None:
    """Raise InputError for an extent below 0."""
    bad = (layer.objects["extent"] < 0).any(axis=1)
    if bad.any():
        i = int(bad.argmax())
        found = layer.objects["extent"][i].tolist()
        raise InputError(f"layer {layer.name}: extent of object {i}: found {found}, expected numbers ≥ 0")
