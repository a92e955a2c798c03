"""The baselines that keep geometry on the device: triangles, and triangle strips."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .gl_gradient import Gradient
from .gl_layer import GlLayer, commands, layer_shader
from .mesh import Mesh

if TYPE_CHECKING:
    import moderngl

    from ...shared.layer_config import LayerSection
    from ...shared.layers.layer import Layer

VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("value", "<f4")])


class GlMesh(GlLayer):
    """A mesh of a layer's objects, triangles or strips; strips are drawn by a command each, in one call."""

    def __init__(self, context: moderngl.Context, layer: Layer, settings: LayerSection, mesh: Mesh) -> None:
        self._mesh = mesh
        super().__init__(context, layer, settings)

    def _prepare(self) -> None:
        import moderngl

        mesh = self._mesh
        flat = ("FLAT",) if mesh.flat else ()
        self.program = self._context.program(
            vertex_shader=layer_shader("gradient", "output", "mesh.vert", defines=flat),
            fragment_shader=layer_shader("word", "surface.frag", defines=flat),
        )
        self._gradient = Gradient(self._context, self._settings, mesh.value)
        vertices = np.empty(len(mesh.position), VERTEX)
        vertices["position"], vertices["normal"], vertices["value"] = mesh.position, mesh.normal, mesh.value
        buffer = self._context.buffer(vertices)
        self._resident_bytes = buffer.size
        mode = moderngl.TRIANGLES if mesh.first_strip_vertex is None else moderngl.TRIANGLE_STRIP
        content = [(buffer, "3f4 3f4 1f4", "position", "normal", "value")]
        self.vertices = self._context.vertex_array(self.program, content, mode=mode, skip_errors=True)

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        first, end = self._mesh.first_vertex[offset], self._mesh.first_vertex[offset + count]
        strips = self._mesh.first_strip_vertex
        if strips is None:
            return commands(first, end - first)
        drawn = np.concatenate([np.arange(*np.searchsorted(strips, ends)) for ends in zip(first, end, strict=True)])
        return commands(strips[drawn], strips[drawn + 1] - strips[drawn])

    def _set_uniforms(self, camera: object) -> None:
        self._gradient.set(self.program)
