"""Blocks: attributed vertices, hardware instancing, triangles and strips, with a texture for each type."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .gl_gradient import Gradient
from .gl_layer import VARYINGS, GlLayer, commands, layer_shader, set_uniform
from .gl_mesh import GlMesh
from .mesh import CUBE_CORNER, CUBE_NORMAL, Mesh

if TYPE_CHECKING:
    import moderngl

    from ...shared.layer_config import LayerSection
    from ...shared.layers.layer import Layer

TEXTURE_PX = 16

BLOCK_VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("local", "<f4", 3), ("type", "<i4")])
"""40 bytes, as in table 1.1 of the paper."""


class BlockLook:
    """Textures and filter of blocks; what all four techniques share."""

    def __init__(self, context: moderngl.Context, layer: Layer, settings: LayerSection) -> None:
        import moderngl

        self._gradient = Gradient(context, settings, layer.objects["type"])
        self._block_size = float(layer.parameters["block_size"])
        pixels = block_textures(layer.parameters["colours"], plain=settings.blocks.texture == "plain")
        self._textures = context.texture_array((TEXTURE_PX, TEXTURE_PX, len(pixels)), 4, pixels)
        self._textures.build_mipmaps()
        self._textures.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.NEAREST)
        self._textures.repeat_x = self._textures.repeat_y = False

    def set(self, program: moderngl.Program) -> None:
        """Bind the textures and set the uniforms of a program."""
        self._gradient.set(program)
        self._textures.use(1)
        set_uniform(program, "textures", 1)
        set_uniform(program, "block_size", self._block_size)


def block_textures(colours: list[str], *, plain: bool) -> np.ndarray:
    """(types, 16, 16, 4) uint8: each colour with grain and a dark edge, different for each type; plain: neither."""
    rgb = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in colours], np.float64)
    light = np.ones((len(colours), TEXTURE_PX, TEXTURE_PX))
    if not plain:
        light += np.random.default_rng(0).uniform(-0.14, 0.06, light.shape)
        light[:, [0, -1]] *= 0.82
        light[:, :, [0, -1]] *= 0.82
    pixels = np.full((*light.shape, 4), 255, np.uint8)
    pixels[..., :3] = np.clip(np.rint(light[..., None] * rgb[:, None, None]), 0, 255)
    return pixels


class GlBlocks(GlLayer):
    """A record a vertex; the geometry shader makes the cube."""

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=layer_shader("blocks.vert"),
            geometry_shader=layer_shader("gradient", "cube", "block_output", "blocks.geom", defines=self._defines),
            fragment_shader=layer_shader("word", "blocks.frag"),
            varyings=VARYINGS if self._defines else (),
        )
        self._look = BlockLook(self._context, self._layer, self._settings)
        records = self._context.buffer(self._layer.objects)
        self._resident_bytes = records.size
        self.vertices = self._context.vertex_array(
            self.program, [(records, "4i4", "cell_and_type")], mode=moderngl.POINTS
        )

    _defines: tuple[str, ...] = ()

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        return commands(offset, count)

    def _set_uniforms(self, camera: object) -> None:
        self._look.set(self.program)


class GlBlockInstances(GlBlocks):
    """A template of 14 vertices, drawn once a record."""

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=layer_shader("gradient", "block_output", "blocks_instanced.vert"),
            fragment_shader=layer_shader("word", "blocks.frag"),
        )
        self._look = BlockLook(self._context, self._layer, self._settings)
        records = self._context.buffer(self._layer.objects)
        template = self._context.buffer(np.hstack([CUBE_CORNER, CUBE_NORMAL]).astype("f4"))
        self.static_bytes = template.size
        self._resident_bytes = records.size + template.size
        content = [(template, "3f4 3f4", "corner", "normal"), (records, "4i4 /i", "cell_and_type")]
        self.vertices = self._context.vertex_array(self.program, content, mode=moderngl.TRIANGLE_STRIP)

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        return commands(np.zeros_like(offset), np.full_like(offset, 14), offset, count)


class GlBlockMesh(GlMesh):
    """The cubes as they stand in the buffer, triangles or strips."""

    def _prepare(self) -> None:
        import moderngl

        mesh: Mesh = self._mesh
        self.program = self._context.program(
            vertex_shader=layer_shader("gradient", "block_output", "block_mesh.vert"),
            fragment_shader=layer_shader("word", "blocks.frag"),
        )
        self._look = BlockLook(self._context, self._layer, self._settings)
        vertices = np.empty(len(mesh.position), BLOCK_VERTEX)
        of_block = np.repeat(np.arange(len(self._layer)), np.diff(mesh.first_vertex))
        size = float(self._layer.parameters["block_size"])
        vertices["position"], vertices["normal"], vertices["type"] = mesh.position, mesh.normal, mesh.value
        vertices["local"] = 2 * (mesh.position / size - self._layer.objects["cell"][of_block])
        buffer = self._context.buffer(vertices)
        self._resident_bytes = buffer.size
        mode = moderngl.TRIANGLES if mesh.first_strip_vertex is None else moderngl.TRIANGLE_STRIP
        content = [(buffer, "3f4 3f4 3f4 1i4", "position", "normal", "local", "type")]
        self.vertices = self._context.vertex_array(self.program, content, mode=mode)

    def _set_uniforms(self, camera: object) -> None:
        self._look.set(self.program)
