"""Triangles and strips of objects, in NumPy: the baselines' buffers, and what the shaders are held against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CUBE_CORNER = np.array(
    [
        *((-1, 1, -1), (-1, 1, 1), (1, 1, -1), (1, 1, 1), (1, -1, 1), (-1, 1, 1), (-1, -1, 1)),
        *((-1, 1, -1), (-1, -1, -1), (1, 1, -1), (1, -1, -1), (1, -1, 1), (-1, -1, -1), (-1, -1, 1)),
    ],
    np.float64,
)
"""(14, 3): a cube of half edge 1 as one strip ("Attributed Vertex Clouds", listing 1.3), as in ``cube.glsl``."""

CUBE_NORMAL = np.repeat(
    [(0, 1, 0), (1, 0, 0), (0, 0, 1), (-1, 0, 0), (0, 0, -1), (1, 0, 0), (0, -1, 0)], [4, 1, 2, 2, 2, 1, 2], axis=0
).astype(np.float64)
"""(14, 3): a triangle of the strip has the normal of its last vertex."""


@dataclass(frozen=True)
class Mesh:
    """Vertices of objects, object after object.

    position, normal : (v, 3) float64, relative to the layer's origin; normals of length 1.
    value : (v,) float64, what the colour map colours, the object's.
    first_vertex : (n + 1,) int64, where the vertices of each object begin.
    first_strip_vertex : (s + 1,) int64, where strips begin, of which each object has whole ones; None: triangles, each
        three vertices.
    flat : a triangle has the normal of its last vertex; else normals are interpolated.
    """

    position: np.ndarray
    normal: np.ndarray
    value: np.ndarray
    first_vertex: np.ndarray
    first_strip_vertex: np.ndarray | None = None
    flat: bool = False

    def triangles(self) -> np.ndarray:
        """(t, 3) int64 vertices of the triangles, those of strips in the order in which OpenGL takes them apart."""
        if self.first_strip_vertex is None:
            return np.arange(len(self.position)).reshape(-1, 3)
        starts, ends = self.first_strip_vertex[:-1], self.first_strip_vertex[1:]
        n = np.maximum(ends - starts - 2, 0)
        k = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
        first = np.repeat(starts, n) + k
        odd = k % 2  # every other triangle is turned, so that all have one winding; the last vertex stays the last
        return np.column_stack([first + odd, first + 1 - odd, first + 2])


def cube_strips(lower: np.ndarray, upper: np.ndarray, value: np.ndarray) -> Mesh:
    """Boxes as strips of 14 vertices, from (n, 3) float64 corners."""
    n = len(lower)
    position = lower[:, None] + (0.5 + 0.5 * CUBE_CORNER) * (upper - lower)[:, None]
    first = 14 * np.arange(n + 1)
    return Mesh(
        position.reshape(-1, 3),
        np.tile(CUBE_NORMAL, (n, 1)),
        np.repeat(value, 14).astype(np.float64),
        first,
        first,
        True,
    )


def for_technique(strips: Mesh, technique: str) -> Mesh:
    """Strips as they are for technique ``strips``, else their triangles."""
    return strips if technique == "strips" else separate(strips)


def separate(strips: Mesh) -> Mesh:
    """The triangles of strips one by one: each vertex has the normal of its triangle where that is flat."""
    assert strips.first_strip_vertex is not None
    corners = strips.triangles()
    normal = strips.normal[corners[:, 2]].repeat(3, axis=0) if strips.flat else strips.normal[corners.ravel()]
    of_strip = np.maximum(np.diff(strips.first_strip_vertex) - 2, 0)
    strip_of = np.searchsorted(strips.first_strip_vertex, strips.first_vertex)
    first = 3 * np.concatenate([[0], np.cumsum(of_strip)])[strip_of]
    return Mesh(strips.position[corners.ravel()], normal, strips.value[corners.ravel()], first)
