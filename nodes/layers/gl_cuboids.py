"""Cuboids: attributed vertices, and hardware instancing beside it."""

from __future__ import annotations

import numpy as np

from .gl_gradient import Gradient
from .gl_layer import VARYINGS, GlLayer, commands, layer_shader
from .mesh import CUBE_CORNER, CUBE_NORMAL

_RECORD = "2f4 2f4 2f4 1f4"
_NAMES = "center", "extent", "height", "value"


class GlCuboids(GlLayer):
    """A record a vertex; the geometry shader makes the box."""

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=layer_shader("gradient", "cuboids.vert"),
            geometry_shader=layer_shader("output", "emit", "cube", "cuboids.geom", defines=("FLAT",)),
            fragment_shader=layer_shader("word", "surface.frag", defines=("FLAT",)),
            varyings=VARYINGS,
        )
        self._gradient = Gradient(self._context, self._settings, self._layer.objects["value"])
        records = self._context.buffer(self._layer.objects)
        self._resident_bytes = records.size
        self.vertices = self._context.vertex_array(self.program, [(records, _RECORD, *_NAMES)], mode=moderngl.POINTS)

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        return commands(offset, count)

    def _set_uniforms(self, camera: object) -> None:
        self._gradient.set(self.program)


class GlCuboidInstances(GlCuboids):
    """A template of 14 vertices, drawn once a record."""

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=layer_shader("gradient", "output", "cuboids_instanced.vert", defines=("FLAT",)),
            fragment_shader=layer_shader("word", "surface.frag", defines=("FLAT",)),
        )
        self._gradient = Gradient(self._context, self._settings, self._layer.objects["value"])
        records = self._context.buffer(self._layer.objects)
        template = self._context.buffer(np.hstack([CUBE_CORNER, CUBE_NORMAL]).astype("f4"))
        self.static_bytes = template.size
        self._resident_bytes = records.size + template.size
        content = [(template, "3f4 3f4", "corner", "normal"), (records, f"{_RECORD} /i", *_NAMES)]
        self.vertices = self._context.vertex_array(self.program, content, mode=moderngl.TRIANGLE_STRIP)

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        return commands(np.zeros_like(offset), np.full_like(offset, 14), offset, count)
