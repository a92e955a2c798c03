"""Arcs as strips, in NumPy."""

from __future__ import annotations

import math

import numpy as np

from ...shared.layers.layer import Layer
from .mesh import Mesh

CORNER = np.array([1, 5, 3, 7, 6, 5, 4, 1, 0, 3, 2, 6, 0, 4])
"""(14,): vertices of a segment as in ``arc.glsl``; bit 0: the segment's end, 1: outer radius, 2: upper height."""

RIGHT, BACK, TOP, FRONT, BOTTOM, LEFT = range(6)
FACE = np.array([RIGHT] * 4 + [BACK] + [TOP] * 2 + [FRONT] * 2 + [BOTTOM] * 2 + [BACK] + [LEFT] * 2)

DEFAULT_SEGMENTS = 64
"""Of techniques that do not tessellate, where the configuration leaves it open."""

CLOSED = 6.283180
"""Spans from here on are whole rings, which have no side faces: float32 rounds 2π."""


def whole_root(segments: float) -> int:
    """Segments are the square of this: so many lines of so many segments are tessellated."""
    return min(max(math.ceil(math.sqrt(segments)), 2), 64)


def strips(layer: Layer, segments: int) -> Mesh:
    """A strip a segment, ``whole_root(segments)``² segments an arc, of 10 to 12 vertices."""
    o, n = layer.objects, whole_root(segments or DEFAULT_SEGMENTS) ** 2
    start, end = o["angle"].astype(np.float64).T
    angles = start[:, None] + np.linspace(0, 1, n + 1) * (end - start)[:, None]
    ends = np.stack([angles[:, :-1], angles[:, 1:]], axis=-1)  # (arcs, segments, 2)
    open_ = (o["angle"][:, 1] - o["angle"][:, 0]) < np.float32(CLOSED)
    kept = np.ones((len(o), n, 14), bool)
    kept[:, :-1, :2] = False
    kept[:, 1:, 12:] = False
    kept[~open_, :, :2] = kept[~open_, :, 12:] = False
    arc, segment, vertex = np.nonzero(kept)
    corner, face, at = CORNER[vertex], FACE[vertex], ends[arc, segment]
    angle = at[np.arange(len(at)), corner & 1]
    radius = o["radius"].astype(np.float64)[arc, corner >> 1 & 1]
    height = np.sort(o["height"].astype(np.float64), axis=1)[arc, corner >> 2]
    flat = o["center"].astype(np.float64)[arc] + radius[:, None] * _on_circle(angle)
    counts = kept.sum(axis=2)
    first_strip = np.concatenate([[0], np.cumsum(counts)])
    return Mesh(
        np.column_stack([flat, height]),
        _normals(face, at),
        o["value"].astype(np.float64)[arc],
        first_strip[::n],
        first_strip,
        True,
    )


def template(segments: int) -> tuple[np.ndarray, np.ndarray]:
    """((v, 2) float32 part, (v, 2) int32 corner and face) of the triangles of an arc, for instancing; 8 marks sides."""
    n = whole_root(segments or DEFAULT_SEGMENTS) ** 2
    part, code = [], []
    for segment in range(n):
        for k in range(12):
            side = k < 2 or k >= 10
            if (k < 2 and segment < n - 1) or (k >= 10 and segment > 0):
                continue
            for vertex in (k, k + 1, k + 2):
                part.append((segment / n, (segment + 1) / n))
                code.append((CORNER[vertex] + 8 * side, FACE[k + 2]))
    return np.array(part, np.float32), np.array(code, np.int32)


def _on_circle(angle: np.ndarray) -> np.ndarray:
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _normals(face: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """(v, 3) unit normals of faces of segments with these (v, 2) angles; no radius, span or height of 0 matters."""
    middle, start, end = _on_circle(ends.mean(axis=1)), _on_circle(ends[:, 0]), _on_circle(ends[:, 1])
    normal = np.zeros((len(face), 3))
    for which, flat in (
        (RIGHT, end[:, ::-1] * (-1, 1)),
        (LEFT, start[:, ::-1] * (1, -1)),
        (BACK, middle),
        (FRONT, -middle),
    ):
        normal[face == which, :2] = flat[face == which]
    normal[face == TOP, 2], normal[face == BOTTOM, 2] = 1, -1
    return normal
