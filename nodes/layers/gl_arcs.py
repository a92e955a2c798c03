"""Arcs: attributed vertices, tessellated, and hardware instancing beside it."""

from __future__ import annotations

import numpy as np

from .expand_arcs import template
from .gl_gradient import Gradient
from .gl_layer import VARYINGS, GlLayer, commands, layer_shader, set_uniform

_RECORD = "2f4 2f4 2f4 2f4 1f4"
_NAMES = "center", "angle", "radius", "height", "value"


class GlArcs(GlLayer):
    """A record a patch of one vertex, tessellated into segments, each of which the geometry shader makes solid."""

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=layer_shader("gradient", "arc", "arcs.vert"),
            tess_control_shader=layer_shader("arcs.tesc"),
            tess_evaluation_shader=layer_shader("arcs.tese"),
            geometry_shader=layer_shader("arc", "output", "emit", "arcs.geom", defines=("FLAT",)),
            fragment_shader=layer_shader("word", "surface.frag", defines=("FLAT",)),
            varyings=VARYINGS,
        )
        self._gradient = Gradient(self._context, self._settings, self._layer.objects["value"])
        records = self._context.buffer(self._layer.objects)
        self._resident_bytes = records.size
        self.vertices = self._context.vertex_array(self.program, [(records, _RECORD, *_NAMES)], mode=moderngl.PATCHES)

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        return commands(offset, count)

    def _set_uniforms(self, camera: object) -> None:
        self._context.patch_vertices = 1
        self._gradient.set(self.program)
        set_uniform(self.program, "segments", float(self._settings.arcs.segments))
        set_uniform(self.program, "tolerance_px", self._settings.arcs.tolerance_px)


class GlArcInstances(GlArcs):
    """A template of all segments, drawn once a record."""

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=layer_shader("gradient", "arc", "output", "arcs_instanced.vert", defines=("FLAT",)),
            fragment_shader=layer_shader("word", "surface.frag", defines=("FLAT",)),
        )
        self._gradient = Gradient(self._context, self._settings, self._layer.objects["value"])
        records = self._context.buffer(self._layer.objects)
        part, code = template(self._settings.arcs.segments)
        parts, codes = self._context.buffer(part), self._context.buffer(code)
        self._n_template = len(part)
        self.static_bytes = parts.size + codes.size
        self._resident_bytes = records.size + self.static_bytes
        content = [(parts, "2f4", "part"), (codes, "2i4", "corner_face"), (records, f"{_RECORD} /i", *_NAMES)]
        self.vertices = self._context.vertex_array(self.program, content, mode=moderngl.TRIANGLES)

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        return commands(np.zeros_like(offset), np.full_like(offset, self._n_template), offset, count)
