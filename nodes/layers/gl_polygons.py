"""Polygons: attributed vertices, and hardware instancing beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .expand_polygons import (
    CENTER_ABOVE,
    CENTER_BELOW,
    DOWN,
    END_ABOVE,
    END_BELOW,
    OUT,
    START_ABOVE,
    START_BELOW,
    UP,
)
from .gl_gradient import Gradient
from .gl_layer import VARYINGS, GlLayer, commands, layer_shader

if TYPE_CHECKING:
    import moderngl

RECORD = np.dtype([("position", "<f4", 2), ("apex", "<f4", 2), ("owner", "<u4")])
"""An element on the device. owner : twice the number of its object, and 1 where it has a side face."""

_OBJECTS = 0  # where polygon.glsl expects them

TEMPLATE = np.array(
    [
        *((CENTER_BELOW, DOWN), (END_BELOW, DOWN), (START_BELOW, DOWN)),
        *((START_BELOW, OUT), (END_BELOW, OUT), (END_ABOVE, OUT)),
        *((START_BELOW, OUT), (END_ABOVE, OUT), (START_ABOVE, OUT)),
        *((START_ABOVE, UP), (END_ABOVE, UP), (CENTER_ABOVE, UP)),
    ],
    np.int32,
)
"""(12, 2): vertices and normals of the four triangles of a wedge."""


class GlPolygons(GlLayer):
    """An element a vertex, which takes the next one's position too; the geometry shader makes the wedge."""

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=layer_shader("gradient", "polygon", "polygons.vert"),
            geometry_shader=layer_shader("output", "emit", "polygons.geom", defines=("FLAT",)),
            fragment_shader=layer_shader("word", "surface.frag", defines=("FLAT",)),
            varyings=VARYINGS,
        )
        records = self._send()
        content = [(records, "2f4 2f4 1u4", "position", "apex", "owner")]
        self.vertices = self._context.vertex_array(self.program, content, mode=moderngl.POINTS)
        self.vertices.vertices = len(self._layer.elements)
        self._bind_next(0)

    def _send(self) -> moderngl.Buffer:
        """The records on the device, with one more at the end, for the last one's next."""
        layer = self._layer
        records = np.zeros(len(layer.elements) + 1, RECORD)
        records["position"][:-1], records["apex"][:-1] = layer.elements["position"], layer.elements["apex"]
        number = np.repeat(np.arange(len(layer)), np.diff(layer.first_element))
        records["owner"][:-1] = 2 * number + layer.elements["side"]
        self._gradient = Gradient(self._context, self._settings, layer.objects["value"])
        self._objects = self._context.buffer(layer.objects)
        self._records = self._context.buffer(records)
        self._resident_bytes = self._objects.size + self._records.size
        return self._records

    def _bind_next(self, divisor: int) -> None:
        location = self.program["next_position"].location  # type: ignore[union-attr]
        stride = RECORD.itemsize
        self.vertices.bind(location, "f", self._records, "2f4", offset=stride, stride=stride, divisor=divisor)

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        first = self._layer.first_element
        return commands(first[offset], first[offset + count] - first[offset])

    def _set_uniforms(self, camera: object) -> None:
        self._gradient.set(self.program)
        self._objects.bind_to_storage_buffer(_OBJECTS)


class GlPolygonInstances(GlPolygons):
    """A template of the four triangles of a wedge, drawn once an element."""

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=layer_shader("gradient", "output", "polygon", "polygons_instanced.vert", defines=("FLAT",)),
            fragment_shader=layer_shader("word", "surface.frag", defines=("FLAT",)),
        )
        records = self._send()
        template = self._context.buffer(TEMPLATE)
        self.static_bytes = template.size
        self._resident_bytes += template.size
        content = [(template, "2i4", "corner"), (records, "2f4 2f4 1u4 /i", "position", "apex", "owner")]
        self.vertices = self._context.vertex_array(self.program, content, mode=moderngl.TRIANGLES)
        self._bind_next(1)

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        first = self._layer.first_element
        drawn = first[offset + count] - first[offset]
        return commands(np.zeros_like(offset), np.full_like(offset, len(TEMPLATE)), first[offset], drawn)
