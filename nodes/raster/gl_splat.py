"""Splats by OpenGL: visibility, blending, normalisation (thesis 4.4.3; Botsch et al. 2005).

A compute shader makes the splats of a frame once, in eye space; two passes draw them as rectangles, and a last one
divides. The visibility pass blends by minimum into a float32 texture instead of testing depth: exact to the last bit,
whatever the range of depths, and the pass that follows reads what this one wrote.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...shared.camera import Camera
from ...shared.points import radius_table
from . import ResidentPoints, SplatSettings
from .gl_context import shader_source
from .gl_resident import Batch, GlResident
from .splat_geometry import (
    AMBIENT,
    FALLOFF,
    LIGHT,
    MAX_SPLAT_PX,
    SCREEN_RADIUS_PX,
    EyeFrame,
    drawn_cells,
    flat_cells,
    splat_columns,
)

if TYPE_CHECKING:
    import moderngl

_SPLATS = 8  # binding of the splats, and of the quads, as in the shaders
_SPLAT_BYTES, _QUAD_BYTES = 32, 48
_BATCH_SPLATS = 1 << 22
"""Most splats of one dispatch and draw call: a 128 MiB buffer. A frame of more makes them again for the second pass."""

_HAS_QUAD = 1 << 31  # mark of a run: a quad stands for its points in the visibility pass
_FLOAT_MAX = float(np.finfo(np.float32).max)


class GlSplatRasterizer(GlResident):
    """Oriented discs with a Gaussian falloff.

    points : with normals and radii, and features where the settings ask for them.
    Raises InputError also for points without those.
    Device memory: 21 bytes a point, 32 more a splat of a frame up to 128 MiB, 32 bytes a pixel.
    Error: sums are float32, so a pixel's colour is off by up to a step where 65 000 splats fall on it.
    Arguments and errors otherwise as of ``GlResident``.
    """

    name = "gl"

    def __init__(
        self,
        points: ResidentPoints,
        width: int,
        height: int,
        settings: SplatSettings = SplatSettings(),  # noqa: B008 - frozen
        device_index: int = 0,
    ) -> None:
        self._unit_points, self._batch_units = 1, min(_BATCH_SPLATS, max(len(points), 1))
        self._settings = settings
        self._radii = np.minimum(radius_table(points.root_edge) * settings.radius_scale, _FLOAT_MAX).astype(np.float32)
        columns = (points.x, points.y, points.z, points.colour, *splat_columns(points))
        borders = None
        if settings.features:
            self._flat = flat_cells(points.features)
            borders = np.concatenate([self._flat.first_point, self._flat.first_point + self._flat.n_points])
        super().__init__(points, columns, width, height, device_index, borders)

    def _prepare(self) -> None:
        import moderngl

        context, size = self._context, (self._shape[1], self._shape[0])
        self._batch_units = min(self._batch_units, self._limit // _SPLAT_BYTES)
        self._splats = self._buffer(bytes=_SPLAT_BYTES * self._batch_units, what="splats")
        self._maker = context.compute_shader(shader_source("runs", "splats", "rows", "columns", "splats.comp"))
        self._visibility, self._colour = (
            context.program(
                vertex_shader=shader_source("splats", "splats.vert", defines=(one,)),
                fragment_shader=shader_source("splats", "splats.frag", defines=(one,)),
            )
            for one in ("PASS_VISIBILITY", "PASS_COLOUR")
        )
        whole = shader_source("whole.vert")
        self._division = context.program(vertex_shader=whole, fragment_shader=shader_source("words.frag"))
        self._set_constants()
        self._front, self._weights = (context.texture(size, 1, dtype="f4") for _ in range(2))
        self._sums, self._words = context.texture(size, 4, dtype="f4"), context.texture(size, 2, dtype="u4")
        self._front_target = context.framebuffer([self._front])
        self._sums_target = context.framebuffer([self._sums, self._weights])
        self._words_target = context.framebuffer([self._words])
        self._strips = {
            program: context.vertex_array(program, [], mode=moderngl.TRIANGLE_STRIP)
            for program in (self._visibility, self._colour, self._division)
        }
        if self._settings.features:
            self._quads = self._buffer(bytes=_QUAD_BYTES << 4, what="quads")
            self._quad_program = context.program(
                vertex_shader=shader_source("splats", "quads.vert"),
                fragment_shader=shader_source("splats", "quads.frag"),
            )
            self._reopening = context.program(vertex_shader=whole, fragment_shader=shader_source("reopen.frag"))
            self._reopening["weights"] = 0
            for program in (self._quad_program, self._reopening):
                self._strips[program] = context.vertex_array(program, [], mode=moderngl.TRIANGLE_STRIP)
        self._image = np.empty(self._shape, np.uint64)

    def _set_constants(self) -> None:
        maker, colour = self._maker, self._colour
        maker["radius_of"] = tuple(self._radii)
        maker["max_splat_px"] = MAX_SPLAT_PX
        maker["light"], maker["ambient"] = tuple(LIGHT), AMBIENT
        maker["lighting"] = self._settings.lighting
        for program in (maker, self._visibility, colour):
            program["screen_radius_px"] = SCREEN_RADIUS_PX
        colour["depth_offset"] = min(self._settings.depth_offset, _FLOAT_MAX)
        colour["falloff"] = FALLOFF
        colour["front"] = 0
        colour["everything"] = True
        self._division["sums"], self._division["weights"] = 0, 1

    def _marks(self, segment: np.ndarray) -> np.ndarray | int:
        if not self._settings.features:
            return 0
        first, flat = self._segment_first[segment], self._flat
        cell = np.searchsorted(flat.first_point, first, side="right")  # the last one that begins before, or 0
        return np.where(first < np.append(0, flat.first_point + flat.n_points)[cell], _HAS_QUAD, 0)

    def _block_rows(self, camera: Camera, blocks: np.ndarray) -> np.ndarray:
        frame = EyeFrame.of(camera)
        rows = np.empty((len(blocks), 3, 4), np.float32)
        rows[:, :, :3] = frame.rotation
        rows[:, :, 3] = frame.eye_from_blocks(camera, self._block_origin[blocks])
        return rows

    def _draw(self, camera: Camera, entries: np.ndarray, batches: list[Batch]) -> np.ndarray:
        import moderngl

        context = self._context
        self._set_camera(camera)
        context.blend_func = moderngl.ONE, moderngl.ONE
        self._sums_target.use()
        self._sums_target.clear(alpha=_FLOAT_MAX)
        self._front_target.use()
        self._front_target.clear(red=_FLOAT_MAX)
        context.enable_only(moderngl.BLEND)
        context.blend_equation = moderngl.MIN, moderngl.MIN
        has_quads = self._settings.features and self._draw_quads(camera, entries)
        self._draw_both_passes(batches, everything=not has_quads)
        if has_quads:
            self._draw_whole(self._reopening, self._front_target, self._weights)
            self._draw_both_passes(batches, everything=True)
        self._draw_whole(self._division, self._words_target, self._sums, self._weights)
        self._words.read_into(self._image)
        return self._image

    def _draw_both_passes(self, batches: list[Batch], *, everything: bool) -> None:
        """Visibility, of everything or of what no quad stands for, then colour."""
        import moderngl

        context = self._context
        context.enable_only(moderngl.BLEND)
        self._visibility["everything"] = everything
        self._front_target.use()
        context.blend_equation = moderngl.MIN, moderngl.MIN
        for batch in batches:
            self._make_splats(batch)
            self._strips[self._visibility].render(vertices=4, instances=batch.n_units)
        self._sums_target.use()
        self._front.use(0)
        context.blend_equation = moderngl.FUNC_ADD, moderngl.MIN  # of colours and weights; of the depth
        for batch in batches:
            if len(batches) > 1:
                self._make_splats(batch)
            self._strips[self._colour].render(vertices=4, instances=batch.n_units)

    def _draw_whole(self, program: moderngl.Program, target: moderngl.Framebuffer, *textures: moderngl.Texture) -> None:
        """Run a program on every pixel of a target."""
        import moderngl

        self._context.enable_only(moderngl.NOTHING)
        target.use()
        for unit, texture in enumerate(textures):
            texture.use(unit)
        self._strips[program].render(vertices=3)

    def _set_camera(self, camera: Camera) -> None:
        frame = EyeFrame.of(camera)
        for program in (self._maker, *self._strips):
            values = {"viewport": self._shape[::-1], "focal": tuple(frame.focal), "center": tuple(frame.center)}
            for name, value in {**values, "near": camera.near}.items():
                if name in program:  # a compiler leaves out what a program does not use
                    program[name] = value
        self._maker["focal_px"] = camera.focal_px

    def _make_splats(self, batch: Batch) -> None:
        self._bind(batch)
        self._splats.bind_to_storage_buffer(_SPLATS)
        self._dispatch(self._maker, batch)
        self._context.memory_barrier()

    def _draw_quads(self, camera: Camera, entries: np.ndarray) -> bool:
        """Draw the quads of the flat cells that the entries draw; whether there are any."""
        drawn = drawn_cells(self._flat, entries)
        if not drawn.any():
            return False
        frame = EyeFrame.of(camera)
        quads = np.zeros((int(drawn.sum()), 3, 4), np.float32)
        quads[:, 0, :3] = frame.eye_from_blocks(camera, self._flat.quad_center[drawn])
        quads[:, 1:, :3] = self._flat.quad_axes[drawn].astype(np.float64) @ frame.rotation.T
        self._quads = self._write(self._quads, quads, "quads")
        self._quads.bind_to_storage_buffer(_SPLATS)
        self._strips[self._quad_program].render(vertices=4, instances=len(quads))
        return True
