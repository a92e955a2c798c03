"""Blocks as strips, in NumPy."""

from __future__ import annotations

from ...shared.layers.blocks import bounds
from ...shared.layers.layer import Layer
from .mesh import Mesh, cube_strips


def strips(layer: Layer) -> Mesh:
    """A strip of 14 vertices a block; the value is its type."""
    lower, upper = bounds(layer)
    return cube_strips(lower, upper, layer.objects["type"])
