"""Block worlds: cubes of one size on a grid, each of a type that has a colour and a texture.

====================  =======  ===================================================================
attribute             dtype    meaning
====================  =======  ===================================================================
cell                  3 × i4   place in the grid; the block's middle is that many blocks from the origin
type                  i4       0 … number of colours − 1
====================  =======  ===================================================================

16 bytes. Parameters: ``block_size``, edge of a block, world units, > 0; ``colours``, "#rrggbb" of each of at
most 256 types.

Source: "Attributed Vertex Clouds", 1.3.1.
"""

from __future__ import annotations

import math
import re

import numpy as np

from ..errors import InputError
from .layer import Layer

OBJECT = np.dtype([("cell", "<i4", 3), ("type", "<i4")])
ELEMENT = None

MOST_TYPES = 256
MOST_CELLS = 1 << 22
"""Largest coordinate in the grid: shaders count in float32."""


def bounds(layer: Layer) -> tuple[np.ndarray, np.ndarray]:
    """((n, 3), (n, 3)) float64 boxes, relative to the origin."""
    cell, size = layer.objects["cell"].astype(np.float64), float(layer.parameters["block_size"])
    return (cell - 0.5) * size, (cell + 0.5) * size


def check(layer: Layer) -> None:
    """Raise InputError for parameters that are missing or wrong, a cell too far out, a type without colour."""
    size, colours = layer.parameters.get("block_size"), layer.parameters.get("colours")
    where = f"layer {layer.name}"
    if not isinstance(size, int | float) or not (size > 0 and math.isfinite(size)):
        raise InputError(f"{where}: block_size: found {size!r}, expected a number > 0")
    if not isinstance(colours, list) or not 0 < len(colours) <= MOST_TYPES:
        raise InputError(f"{where}: colours: found {str(colours)[:40]}, expected a list of 1 … {MOST_TYPES} colours")
    for colour in colours:
        if not isinstance(colour, str) or not re.fullmatch("#[0-9a-fA-F]{6}", colour):
            raise InputError(f"{where}: colours: found {colour!r}, expected #rrggbb")
    far = np.abs(layer.objects["cell"].astype(np.int64)).max(axis=1) > MOST_CELLS
    if far.any():
        i = int(far.argmax())
        raise InputError(
            f"{where}: cell of block {i}: found {layer.objects['cell'][i].tolist()}, expected up to ±{MOST_CELLS}"
        )
    types = layer.objects["type"]
    if types.min() < 0 or types.max() >= len(colours):
        bad = int(((types < 0) | (types >= len(colours))).argmax())
        raise InputError(f"{where}: type of block {bad}: found {types[bad]}, expected 0 … {len(colours) - 1}")
