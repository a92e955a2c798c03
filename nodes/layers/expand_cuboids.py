"""Cuboids as strips, in NumPy."""

from __future__ import annotations

from ...shared.layers.cuboids import bounds
from ...shared.layers.layer import Layer
from .mesh import Mesh, cube_strips


def strips(layer: Layer) -> Mesh:
    """A strip of 14 vertices an object."""
    lower, upper = bounds(layer)
    return cube_strips(lower, upper, layer.objects["value"])
