"""Polygons as triangles and strips, in NumPy."""

from __future__ import annotations

import numpy as np

from ...shared.layers.layer import Layer
from .mesh import Mesh

CENTER_BELOW, END_BELOW, START_BELOW, END_ABOVE, START_ABOVE, CENTER_ABOVE = range(6)
"""The vertices of a wedge in the order of its strip; its center is the apex."""
DOWN, OUT, UP = range(3)
"""Its normals."""

_WHOLE = ([0, 0, 1, 2, 3, 4, 5, 5], [DOWN] * 4 + [OUT] * 2 + [UP] * 2)
_SIDE = ([1, 1, 3, 2, 4, 4], [OUT] * 6)
_ENDS = ([0, 0, 1, 2, 2, 2, 4, 4, 3, 5, 5, 5], [DOWN] * 6 + [UP] * 6)
"""Strips of vertices and the normals of these. Their ends are there twice, so that a strip can follow another."""


def triangles(layer: Layer) -> Mesh:
    """Up to four triangles a wedge: lower end, two of the side, upper end; counterclockwise from outside."""
    vertices, normals, ends, side = _wedges(layer)
    corners = [
        [CENTER_BELOW, END_BELOW, START_BELOW],
        [START_BELOW, END_BELOW, END_ABOVE],
        [START_BELOW, END_ABOVE, START_ABOVE],
        [START_ABOVE, END_ABOVE, CENTER_ABOVE],
    ]
    drawn = np.column_stack([ends, side, side, ends])
    position = vertices[:, corners][drawn].reshape(-1, 3)
    normal = normals[:, [DOWN, OUT, OUT, UP]][drawn].repeat(3, axis=0)
    return _mesh(layer, position, normal, 3 * drawn.sum(axis=1), is_strip=False)


def strips(layer: Layer) -> Mesh:
    """A strip an object: that of each wedge behind the last."""
    vertices, normals, ends, side = _wedges(layer)
    vertex, normal = np.full((4, 12), -1), np.zeros((4, 12), np.int64)
    for case, (strip, its_normals) in ((1, _SIDE), (2, _ENDS), (3, _WHOLE)):
        vertex[case, : len(strip)], normal[case, : len(strip)] = strip, its_normals
    case = side + 2 * ends
    wedge, place = np.nonzero(vertex[case] >= 0)
    object_of = np.repeat(np.arange(len(layer)), np.diff(layer.first_element))
    follows = (
        np.diff(object_of[wedge], prepend=-1) == 0
    )  # an object's first vertex is there once: triangles 0, 2 … are not turned
    wedge, place = wedge[follows], place[follows]
    code = case[wedge], place
    count = np.bincount(wedge, minlength=len(case))
    return _mesh(layer, vertices[wedge, vertex[code]], normals[wedge, normal[code]], count, is_strip=True)


def _wedges(layer: Layer) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(m, 6, 3) vertices, (m, 3, 3) normals, (m,) bool has it ends, has it a side; of each element and the next."""
    start, apex = (layer.elements[a].astype(np.float64) for a in ("position", "apex"))
    end = np.roll(start, -1, axis=0)
    height = np.sort(layer.objects["height"].astype(np.float64), axis=1)
    height = height.repeat(np.diff(layer.first_element), axis=0)
    below, above = height[:, :1], height[:, 1:]
    vertices = np.stack(
        [
            np.hstack(v)
            for v in ((apex, below), (end, below), (start, below), (end, above), (start, above), (apex, above))
        ],
        axis=1,
    )
    along = end - start
    length = np.linalg.norm(along, axis=1)
    along[length > 0] /= length[length > 0, None]
    out = np.column_stack([along[:, 1], -along[:, 0], np.zeros(len(along))])
    up = np.broadcast_to([0.0, 0.0, 1.0], out.shape)
    ends = (start != apex).any(axis=1) & (end != apex).any(axis=1)
    return vertices, np.stack([-up, out, up], axis=1), ends, layer.elements["side"] == 1


def _mesh(layer: Layer, position: np.ndarray, normal: np.ndarray, count: np.ndarray, *, is_strip: bool) -> Mesh:
    """The mesh of the vertices of elements, ``count`` of each."""
    before = np.concatenate([[0], np.cumsum(count)])
    first = before[layer.first_element]
    value = layer.objects["value"].astype(np.float64).repeat(np.diff(first))
    return Mesh(position, normal, value, first, first if is_strip else None, is_strip)
