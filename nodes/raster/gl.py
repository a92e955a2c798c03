"""The OpenGL rasterizers of points: one workgroup or one GL_POINTS draw a piece.

``GlComputeRasterizer`` takes the minimum of framebuffer words with atomics; ``GlPointsRasterizer`` is the baseline that
sends the same points through the driver's own pipeline. What a frame sends is its runs and block matrices; the device
cuts runs into pieces by itself, so a frame of a billion points sends no more than one of a thousand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...shared.camera import Camera
from ...shared.errors import DeviceError
from ...shared.messages import FRAMEBUFFER_EMPTY
from . import PointSize, ResidentPoints, pixel_from_blocks, world_sides
from .gl_budget import SentEachFrame
from .gl_context import shader_source
from .gl_resident import Batch, GlResident, Resident
from .pieces import split_forms

if TYPE_CHECKING:
    import moderngl

    from .gl_pools import PoolUnits

_PIECE_POINTS = 4096
"""Most points of a piece. Fewer cost time on llvmpipe, whose threads fetch workgroups one by one; more leave a GPU
short of workgroups."""

_BATCH_PIECES = 1 << 20
"""Most pieces of one dispatch or draw call: a 16 MiB buffer."""

_ATOMIC_INT64 = ("GL_ARB_gpu_shader_int64", "GL_NV_shader_atomic_int64")

_PIECES, _FRAMEBUFFER, _COMMANDS, _SIDES = 8, 9, 10, 11  # bindings, as in the shaders


@dataclass(frozen=True)
class _Pools:
    """Pooled cells: where their units are, and what lies on the device. A piece is a unit."""

    units: PoolUnits
    resident: Resident


class _GlPointRasterizer(GlResident):
    """Points as squares: sizes, and the pieces of a frame. Pools are drawn if the points have them.

    points : 16 bytes a point of device memory; of pools about their own size, and 8 more for each vertex.
    Arguments and errors otherwise as of ``GlResident``; InputError also for adaptive sizes without spacings.
    """

    def __init__(
        self,
        points: ResidentPoints,
        width: int,
        height: int,
        size: PointSize = PointSize(),  # noqa: B008 - frozen
        device_index: int = 0,
    ) -> None:
        self._unit_points, self._batch_units = _PIECE_POINTS, _BATCH_PIECES
        self._size = size
        self._world = world_sides(points, size)
        self._pool_cells = points.pools
        super().__init__(points, (points.x, points.y, points.z, points.colour), width, height, device_index)

    @property
    def resident_bytes(self) -> int:
        """Device memory that points and pools take."""
        return super().resident_bytes + (self._pools.resident.n_bytes if self._pools else 0)

    def points_sent(self, n_kept: int) -> SentEachFrame:
        """The point-array without its first ``n_kept`` points, to be sent with each frame."""
        kept = [4 * max(n_kept - int(first), 0) for first in self._chunk_first]
        parts = [(buffer, n) for chunk, n in zip(self._points.chunks, kept, strict=False) for buffer in chunk]
        return SentEachFrame(self._context, parts)

    def loose_sent(self, n_kept: int) -> SentEachFrame:
        """The points of pooled cells that no pool covers, without the first ``n_kept``, to be sent with each frame."""
        parts = []
        if self._pools:
            for buffers, n in zip(self._pools.resident.chunks, self._pools.units.loose_left(n_kept), strict=True):
                _, records, _, colours, _ = buffers
                parts += [(records, records.size - 4 * int(n)), (colours, colours.size - int(n))]
        return SentEachFrame(self._context, parts)

    def _prepare_pieces(self, *defines: str) -> None:
        self._pieces = self._buffer(bytes=16 * self._batch_units, what="pieces")
        self._cuts = {self._points: self._cut_program(self._unit_points, "runs", "cut.comp", defines=defines)}
        self._pools, cells = None, self._pool_cells
        if cells is not None:
            from .gl_pools import PoolUnits
            from .pools import sized

            units, self._pool_cells = PoolUnits(sized(cells, self._size), self._limit), None
            self._pools = _Pools(units, self._hold(units.chunks(cells), 1, "matrices"))
            cut = self._cut_program(1, "runs", "pools", "cut.comp", defines=("POOLS", *defines))
            self._cuts[self._pools.resident] = cut
        if self._size.adaptive:
            self._sides = {resident: self._buffer(bytes=4, what="point sizes") for resident in self._cuts}

    def _cut_program(self, piece_points: int, *names: str, defines: tuple[str, ...]) -> moderngl.ComputeShader:
        program = self._context.compute_shader(shader_source(*names, defines=defines))
        program["piece_points"] = piece_points
        return program

    def _files(self, between: str, points: str, pools: str) -> dict[Resident, tuple[str, ...]]:
        """Shader files of what is resident: what draws points, and what draws pools."""
        files: dict[Resident, tuple[str, ...]] = {
            self._points: ("rows", "columns", "squares", "points", between, points)
        }
        if self._pools:
            files[self._pools.resident] = "rows", "squares", "pools", between, pools
        return files

    def _send(self, camera: Camera, entries: np.ndarray) -> list[Batch]:
        if not self._pools:
            return super()._send(camera, entries)
        units, resident = self._pools.units, self._pools.resident
        ranges, cells = split_forms(entries, units.first_point)
        cells = np.unique(cells)
        batches = super()._send(camera, ranges)
        self._send_sides(resident, camera, units.world_sides(cells))
        return batches + self._send_runs(resident, *units.runs(cells), units.rows(camera, cells))

    def _block_rows(self, camera: Camera, blocks: np.ndarray) -> np.ndarray:
        self._send_sides(self._points, camera, self._world[blocks])
        return pixel_from_blocks(camera, self._block_origin[blocks])

    def _send_sides(self, resident: Resident, camera: Camera, world: np.ndarray) -> None:
        if self._size.adaptive:
            sides = (world * camera.focal_px).astype(np.float32)
            self._sides[resident] = self._write(self._sides[resident], sides, "point sizes")

    @property
    def _defines(self) -> tuple[str, ...]:
        if self._size.adaptive:
            return "SQUARES", "ADAPTIVE"
        return ("SQUARES",) if self._size.world > 0 or self._size.pixels > 1 else ()

    def _set_camera(self, program: moderngl.Program | moderngl.ComputeShader, camera: Camera) -> None:
        program["viewport"] = self._shape[::-1]
        program["near"] = camera.near
        if self._defines:
            program["side_range_px"] = (self._size.pixels, max(self._size.maximum, self._size.pixels))
            if not self._size.adaptive:
                program["world_px"] = self._size.world * camera.focal_px

    def _cut_runs(self, batch: Batch) -> None:
        """Make the pieces of a batch on the device, and bind what drawing them needs."""
        self._bind(batch)
        if self._size.adaptive:
            self._sides[batch.resident].bind_to_storage_buffer(_SIDES)
        self._pieces.bind_to_storage_buffer(_PIECES)
        self._dispatch(self._cuts[batch.resident], batch)
        self._context.memory_barrier()


class GlComputeRasterizer(_GlPointRasterizer):
    """Compute shaders: 64-bit atomic minimum where the driver has it, else a depth pass and a colour pass.

    two_passes : take two passes in any case. Other arguments and errors as of ``_GlPointRasterizer``.
    """

    name = "gl"

    def __init__(
        self,
        points: ResidentPoints,
        width: int,
        height: int,
        size: PointSize = PointSize(),  # noqa: B008 - frozen
        device_index: int = 0,
        *,
        two_passes: bool = False,
    ) -> None:
        self._two_passes = two_passes
        super().__init__(points, width, height, size, device_index)

    @property
    def passes(self) -> int:
        """How often a frame reads the points."""
        return len(self._programs)

    def _prepare(self) -> None:
        context = self._context
        self._prepare_pieces()
        extensions, passes = (), ("PASS_DEPTH", "PASS_COLOUR")
        if not self._two_passes and context.extensions.issuperset(_ATOMIC_INT64):
            extensions, passes = _ATOMIC_INT64, ("PASS_WORD",)
        names = self._files("framebuffer", "scatter.comp", "pools.comp")
        self._programs = [
            {
                resident: context.compute_shader(
                    shader_source(*files, extensions=extensions, defines=(*self._defines, one))
                )
                for resident, files in names.items()
            }
            for one in passes
        ]
        self._image = np.full(self._shape, FRAMEBUFFER_EMPTY)
        self._words = self._buffer(bytes=self._image.nbytes, what="framebuffer")
        self._empty = context.buffer(self._image)

    def _draw(self, camera: Camera, entries: np.ndarray, batches: list[Batch]) -> np.ndarray:
        self._context.copy_buffer(self._words, self._empty)
        for programs in self._programs:
            for program in programs.values():
                self._set_camera(program, camera)
            for batch in batches:
                program = programs[batch.resident]
                self._cut_runs(batch)
                self._words.bind_to_storage_buffer(_FRAMEBUFFER)
                program["n_pieces"] = batch.n_units
                program.run(*self._folded(batch.n_units))
                self._context.memory_barrier()  # the next one writes its pieces over these
        self._words.read_into(self._image)
        return self._image


class GlPointsRasterizer(_GlPointRasterizer):
    """GL_POINTS with a depth buffer, the baseline.

    The depth test has 24 bits, on a logarithm of the depth: of points whose depths agree to two parts in a million the
    first drawn wins. The depth in the framebuffer word is exact.
    Raises DeviceError also if the largest square is above the driver's point size.
    """

    name = "gl-points"

    def _prepare(self) -> None:
        import moderngl

        context, size = self._context, (self._shape[1], self._shape[0])
        self._prepare_pieces("COMMANDS")
        self._commands = self._buffer(bytes=20 * self._batch_units, what="draw commands")
        grows = self._size.world > 0 or self._size.adaptive
        side = max(self._size.maximum if grows else 1, self._size.pixels)
        most = context.info["GL_POINT_SIZE_RANGE"][1]
        if side > most:
            raise DeviceError(f"{self.device}: found point size {side} px, expected at most {most:.0f}")
        self._programs = {
            resident: context.program(
                vertex_shader=shader_source(*files, defines=self._defines), fragment_shader=shader_source("points.frag")
            )
            for resident, files in self._files("squares.vert", "points.vert", "pools.vert").items()
        }
        self._vertices = {
            resident: context.vertex_array(program, [(self._pieces, "4u4/r", "piece")], mode=moderngl.POINTS)
            for resident, program in self._programs.items()
        }
        self._image = np.empty(self._shape, np.uint64)
        self._empty = np.full(self._shape, FRAMEBUFFER_EMPTY)
        self._words = context.texture(size, 2, dtype="u4")
        depth = context.depth_texture(size)
        self._framebuffer = context.framebuffer([self._words], depth)
        self._depth_only = context.framebuffer(depth_attachment=depth)  # glClear is undefined for integer colours
        context.enable_only(moderngl.DEPTH_TEST | moderngl.PROGRAM_POINT_SIZE)

    def _draw(self, camera: Camera, entries: np.ndarray, batches: list[Batch]) -> np.ndarray:
        self._words.write(self._empty)
        self._depth_only.clear(depth=1.0)
        self._framebuffer.use()
        for program in self._programs.values():
            self._set_camera(program, camera)
        for batch in batches:
            self._commands.bind_to_storage_buffer(_COMMANDS)
            self._cut_runs(batch)
            self._vertices[batch.resident].render_indirect(self._commands, count=batch.n_units)
        self._words.read_into(self._image)
        return self._image
