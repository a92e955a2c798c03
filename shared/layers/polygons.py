"""Polygons: outlines drawn up to prisms, as of buildings, blocks, countries.

====================  =======  ===================================================================
attribute             dtype    meaning
====================  =======  ===================================================================
of an object
height                2 × f4   lower and upper z, relative to the layer's origin
value                 f4       what a colour map colours
of an element
position              2 × f4   a vertex, relative to the layer's origin
apex                  2 × f4   the vertex from which its fan is filled, likewise
side                  u1       1: a side face stands on the edge to the next element
====================  =======  ===================================================================

12 bytes an object, 17 an element; on the device 20 (the object's number is put beside ``side``).

An element and the next one make a *wedge*: the triangles of both with the apex at the lower and the upper end, and
the side face. Elements of an object are *fans* (``outlines.fans``): the first and last element of a fan are its apex.
So where one of the two elements is the apex there are no triangles, and between fans there is nothing at all. Every
outline, convex, concave or with holes, is of this one form.

Positions are multiples of a power of two that is at most 2**-23 of the layer's extent, all of them float32 without
rounding: outlines that share a vertex still do.

Source: "Attributed Vertex Clouds", 1.3.3 (there a wedge has the polygon's centre, for star-shaped outlines, and y is
up).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from .layer import Layer, check_layer
from .outlines import COORDINATE_BITS, DONE, NOT_SETTLED, TOO_MANY_ABREAST, TOO_MANY_CROSSINGS, fans

OBJECT = np.dtype([("height", "<f4", 2), ("value", "<f4")])
ELEMENT = np.dtype([("position", "<f4", 2), ("apex", "<f4", 2), ("side", "u1")])

_WHY = {
    TOO_MANY_CROSSINGS: "crosses itself too often",
    TOO_MANY_ABREAST: "too many long edges side by side",
    NOT_SETTLED: "does not come apart at its crossings",
}

Polygon = Sequence[np.ndarray]
"""Rings, (k, 2) float64 each, world: what lies in an odd number of them. They may repeat their first point or not."""


def bounds(layer: Layer) -> tuple[np.ndarray, np.ndarray]:
    """((n, 3), (n, 3)) float64 boxes, relative to the origin."""
    height, position = layer.objects["height"].astype(np.float64), layer.elements["position"].astype(np.float64)
    first = layer.first_element[:-1]
    lower, upper = np.minimum.reduceat(position, first), np.maximum.reduceat(position, first)
    return np.column_stack([lower, height.min(axis=1)]), np.column_stack([upper, height.max(axis=1)])


def check(layer: Layer) -> None:
    """Raise InputError for an object that has no elements or whose last fan is not closed."""
    first, elements = layer.first_element, layer.elements
    empty = first[:-1] == first[1:]
    if empty.any():
        raise InputError(
            f"layer {layer.name}: object {int(empty.argmax())}: found no elements, expected a fan at least"
        )
    if (elements["side"] > 1).any():
        i = int((elements["side"] > 1).argmax())
        raise InputError(f"layer {layer.name}: side of element {i}: found {elements['side'][i]}, expected 0 or 1")
    last = elements[first[1:] - 1]
    is_open = (last["position"] != last["apex"]).any(axis=1) | (last["side"] != 0)
    if is_open.any():
        i = int(is_open.argmax())
        raise InputError(f"layer {layer.name}: object {i}: its last element is not the apex of its fan")


def polygon_layer(
    name: str, shapes: Sequence[Sequence[Polygon]], height: np.ndarray, value: np.ndarray, **parameters: Any
) -> tuple[Layer, np.ndarray]:
    """The layer of objects that consist of polygons, checked and in octree order; and which objects it has, ascending.

    shapes : of each object its polygons.  height : (n, 2) float64, lower and upper z, world.  value : (n,).
    Objects without area are left out. Raises InputError, naming the object, for coordinates that are not finite and
    outlines with more crossings than there is room for; and if no object is left.
    """
    origin, unit = _grid(name, shapes, height)
    elements: list[np.ndarray] = []
    count = np.zeros(len(shapes), np.int64)
    for i, polygons in enumerate(shapes):
        made = [_elements(name, i, polygon, origin[:2], unit) for polygon in polygons]
        count[i] = sum(map(len, made))
        elements += made
    kept = np.flatnonzero(count)
    objects = np.empty(len(kept), OBJECT)
    with np.errstate(over="ignore"):  # beyond float32: found below
        objects["height"], objects["value"] = height[kept] - origin[2], value[kept]
    first = np.concatenate([[0], np.cumsum(count[kept])])
    layer = Layer(
        name, "polygons", origin, objects, np.concatenate([np.empty(0, ELEMENT), *elements]), first, parameters
    )
    if not len(kept):
        raise InputError(f"layer {name}: found no outline with an area, expected at least one")
    check_layer(layer)
    return layer.in_octree_order(), kept


def _grid(name: str, shapes: Sequence[Sequence[Polygon]], height: np.ndarray) -> tuple[np.ndarray, float]:
    """The origin, in the middle and below, and the unit of positions."""
    lower, upper = np.full(2, np.inf), np.full(2, -np.inf)
    for i, polygons in enumerate(shapes):
        for ring in (ring for polygon in polygons for ring in polygon if len(ring)):
            if not np.isfinite(ring).all():
                raise InputError(
                    f"layer {name}: outline of object {i}: found {ring[~np.isfinite(ring)][0]}, expected finite numbers"
                )
            lower, upper = np.minimum(lower, ring.min(axis=0)), np.maximum(upper, ring.max(axis=0))
    if not np.isfinite(lower).all():
        raise InputError(f"layer {name}: found no outline, expected at least one")
    if not np.isfinite(height).all():
        i = int((~np.isfinite(height)).any(axis=1).argmax())
        raise InputError(f"layer {name}: height of object {i}: found {height[i].tolist()}, expected finite numbers")
    origin = np.append((lower + upper) / 2, height.min())
    half = float((upper - lower).max()) / 2
    if not np.isfinite(half) or half > 1e30:
        raise InputError(f"layer {name}: found an extent of {2 * half:g}, expected at most 2e30")
    return origin, 2.0 ** (np.ceil(np.log2(max(half, 1e-30))) - COORDINATE_BITS)


def _elements(name: str, i: int, polygon: Polygon, origin: np.ndarray, unit: float) -> np.ndarray:
    rings = [np.rint((ring - origin) / unit).astype(np.int64) for ring in polygon]
    point, apex, side, status = fans(rings)
    if status != DONE:
        raise InputError(f"layer {name}: outline of object {i}, of {sum(map(len, rings))} points: {_WHY[status]}")
    elements = np.empty(len(point), ELEMENT)
    elements["position"], elements["apex"], elements["side"] = point * unit, apex * unit, side
    return elements
