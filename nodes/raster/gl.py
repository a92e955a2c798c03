"""The OpenGL rasterizers: points resident in storage buffers, one workgroup or one GL_POINTS draw a piece.

``GlComputeRasterizer`` takes the minimum of framebuffer words with atomics; ``GlPointsRasterizer`` is the baseline that
sends the same points through the driver's own pipeline. What a frame uploads is its pieces and block matrices.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Self

import numpy as np

from ...shared.camera import Camera
from ...shared.errors import DeviceError, InputError
from . import PointSize, ResidentPoints, check_viewport, pixel_from_blocks
from .gl_context import check_errors, open_context, shader_source, storage_limit
from .pieces import split_entries

if TYPE_CHECKING:
    import moderngl

_PIECE_POINTS = 4096
"""Most points of a piece. Fewer cost time on llvmpipe, whose threads fetch workgroups one by one; more leave a GPU
short of workgroups."""

_BATCH_PIECES = 1 << 20
"""Most pieces of one dispatch or draw call: a 16 MiB buffer."""

_ATOMIC_INT64 = ("GL_ARB_gpu_shader_int64", "GL_NV_shader_atomic_int64")

_ROWS, _PIECES, _FRAMEBUFFER = 4, 5, 6  # bindings behind x, y, z and colour, as in the shaders


class _GlRasterizer(ABC):
    """The resident half: context, chunks of the point-array, matrices, pieces.

    points : float32 and uint32 columns, copied to the device; they may be released or unmapped afterwards.
    width, height : size of every frame, pixels.
    device_index : in EGL's order; GLCONTEXT_DEVICE_INDEX wins.
    Raises InputError: the viewport is empty or above the device's texture size.
    Raises DeviceError: no OpenGL 4.5, not enough device memory, a frame or matrices above the storage-block limit.
    Device memory: 16 bytes a point. To be used from the thread that made it.
    """

    name: str

    def __init__(
        self,
        points: ResidentPoints,
        width: int,
        height: int,
        size: PointSize = PointSize(),  # noqa: B008 - frozen
        device_index: int = 0,
    ) -> None:
        import moderngl

        self._n_points = len(points)
        self._size = size
        self._shape = (height, width)
        self._block_origin = points.block_origin
        self._context = open_context(device_index)
        try:
            self.device = str(self._context.info["GL_RENDERER"])
            self._limit = storage_limit(self._context)
            most = self._context.info["GL_MAX_TEXTURE_SIZE"]
            if not (1 <= width <= most and 1 <= height <= most):
                raise InputError(f"viewport: found {width}×{height}, expected 1…{most} px a side")
            self._upload(points)
            self._prepare()
            check_errors(self._context, "setting up")
        except moderngl.Error as error:
            self.close()
            raise DeviceError(f"OpenGL: {' '.join(str(error).split())}") from error
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the context and with it all device memory. May be called twice."""
        self._context.release()

    @property
    def resident_bytes(self) -> int:
        """Device memory that the point-array takes."""
        return sum(column.size for chunk in self._chunks for column in chunk)

    def draw(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(height, width) uint64 framebuffer words, row 0 on top; valid until the next call.

        entries : (m,) RENDER_POINT.
        Raises MessageError for an entry beyond the point-array or with stride 0 and for a camera of another viewport,
        DeviceError for an OpenGL error.
        """
        height, width = self._shape
        check_viewport(camera, width, height)
        blocks, batches = self._batches(entries)
        with self._context:  # another rasterizer of this thread may have made its own current
            self._rows.write(pixel_from_blocks(camera, self._block_origin[blocks]))
            image = self._draw(camera, batches)
            check_errors(self._context, "drawing")
        return image

    @abstractmethod
    def _prepare(self) -> None:
        """Make programs and the framebuffer."""

    @abstractmethod
    def _draw(self, camera: Camera, batches: list[tuple[int, np.ndarray]]) -> np.ndarray:
        """Draw (chunk, pieces) batches; the words of the frame."""

    def _upload(self, points: ResidentPoints) -> None:
        per_chunk = self._limit // 4
        chunk_first = np.arange(0, max(len(points), 1), per_chunk)
        self._segment_first = np.union1d(points.block_first_point, chunk_first)
        self._segment_chunk = np.searchsorted(chunk_first, self._segment_first, side="right") - 1
        self._segment_block = np.searchsorted(points.block_first_point, self._segment_first, side="right") - 1
        self._chunk_first = chunk_first
        columns = (points.x, points.y, points.z, points.colour)
        self._chunks = [
            [self._buffer(np.ascontiguousarray(column[first : first + per_chunk])) for column in columns]
            for first in chunk_first
            if len(points)
        ]
        self._rows = self._buffer(bytes=48 * len(points.block_origin), what="block matrices")
        self._pieces = self._buffer(bytes=16 * _BATCH_PIECES, what="pieces")

    def _buffer(self, data: np.ndarray | None = None, *, bytes: int = 0, what: str = "points") -> moderngl.Buffer:
        if bytes > self._limit:
            raise DeviceError(
                f"{self.device}: found {bytes} bytes of {what}, expected at most {self._limit} (storage-block limit)"
            )
        buffer = self._context.buffer(data, reserve=bytes)
        check_errors(self._context, f"allocating {buffer.size} bytes for {what}")
        return buffer

    def _batches(self, entries: np.ndarray) -> tuple[np.ndarray, list[tuple[int, np.ndarray]]]:
        """What a frame draws: blocks, and batches of pieces.

        Returns: (k,) int64 indices of the blocks whose matrices the frame needs; batches of (chunk, (p, 4) uint32
            pieces: first point in the chunk, count, stride, place of the block among the k).
        """
        pieces = split_entries(entries, self._segment_first, self._n_points, _PIECE_POINTS)
        chunk, block = self._segment_chunk[pieces["segment"]], self._segment_block[pieces["segment"]]
        drawn = np.zeros(len(self._block_origin), bool)
        drawn[block] = True
        place = np.cumsum(drawn) - 1
        table = np.empty((len(pieces), 4), np.uint32)
        table[:, 0] = pieces["first"] - self._chunk_first[chunk]
        table[:, 1] = pieces["count"]
        table[:, 2] = pieces["stride"]
        table[:, 3] = place[block]
        batches = []
        for i in range(len(self._chunks)):
            mine = table[chunk == i]
            batches += [(i, mine[k : k + _BATCH_PIECES]) for k in range(0, len(mine), _BATCH_PIECES)]
        return np.flatnonzero(drawn), batches

    def _bind(self, chunk: int, pieces: np.ndarray) -> None:
        for binding, buffer in enumerate(self._chunks[chunk]):
            buffer.bind_to_storage_buffer(binding)
        self._rows.bind_to_storage_buffer(_ROWS)
        self._pieces.bind_to_storage_buffer(_PIECES)
        self._pieces.write(pieces)

    @property
    def _defines(self) -> tuple[str, ...]:
        return ("SQUARES",) if self._size.world > 0 or self._size.pixels > 1 else ()

    def _set_camera(self, program: moderngl.Program | moderngl.ComputeShader, camera: Camera) -> None:
        program["viewport"] = self._shape[::-1]
        program["near"] = camera.near
        if self._defines:
            largest = max(self._size.maximum, self._size.pixels)
            program["world_px"] = self._size.world * camera.focal_px
            program["side_range_px"] = (self._size.pixels, largest)


class GlComputeRasterizer(_GlRasterizer):
    """Compute shaders: 64-bit atomic minimum where the driver has it, else a depth pass and a colour pass."""

    name = "gl"

    def _prepare(self) -> None:
        context = self._context
        extensions, passes = (), ("PASS_DEPTH", "PASS_COLOUR")
        if context.extensions.issuperset(_ATOMIC_INT64):
            extensions, passes = _ATOMIC_INT64, ("PASS_WORD",)
        self._programs = [
            context.compute_shader(
                shader_source("points", "scatter.comp", extensions=extensions, defines=(*self._defines, one))
            )
            for one in passes
        ]
        self._most_groups = context.info["GL_MAX_COMPUTE_WORK_GROUP_COUNT"][0]
        self._image = np.full(self._shape, 0xFFFF_FFFF_FFFF_FFFF, np.uint64)
        self._words = self._buffer(bytes=self._image.nbytes, what="framebuffer")
        self._empty = context.buffer(self._image)

    def _draw(self, camera: Camera, batches: list[tuple[int, np.ndarray]]) -> np.ndarray:
        self._context.copy_buffer(self._words, self._empty)
        self._words.bind_to_storage_buffer(_FRAMEBUFFER)
        for program in self._programs:
            self._set_camera(program, camera)
            for chunk, pieces in batches:
                self._bind(chunk, pieces)
                program["n_pieces"] = len(pieces)
                # folded: above the limit of one dimension a dispatch draws nothing
                columns = min(len(pieces), self._most_groups)
                program.run(columns, -(-len(pieces) // columns))
            self._context.memory_barrier()
        self._words.read_into(self._image)
        return self._image


class GlPointsRasterizer(_GlRasterizer):
    """GL_POINTS with a depth buffer, the baseline.

    The depth test has 24 bits, on a logarithm of the depth: of points whose depths agree to two parts in a million the
    first drawn wins. The depth in the framebuffer word is exact.
    Raises DeviceError also if the largest square is above the driver's point size.
    """

    name = "gl-points"

    def _prepare(self) -> None:
        import moderngl

        context, size = self._context, (self._shape[1], self._shape[0])
        side = max(self._size.maximum if self._size.world > 0 else 1, self._size.pixels)
        most = context.info["GL_POINT_SIZE_RANGE"][1]
        if side > most:
            raise DeviceError(f"{self.device}: found point size {side} px, expected at most {most:.0f}")
        self._program = context.program(
            vertex_shader=shader_source("points", "points.vert", defines=self._defines),
            fragment_shader=shader_source("points.frag"),
        )
        self._vertices = context.vertex_array(self._program, [(self._pieces, "4u4/i", "piece")], mode=moderngl.POINTS)
        self._commands = context.buffer(reserve=20 * _BATCH_PIECES)
        self._image = np.empty(self._shape, np.uint64)
        self._empty = np.full(self._shape, 0xFFFF_FFFF_FFFF_FFFF, np.uint64)
        self._words = context.texture(size, 2, dtype="u4")
        depth = context.depth_texture(size)
        self._framebuffer = context.framebuffer([self._words], depth)
        self._depth_only = context.framebuffer(depth_attachment=depth)  # glClear is undefined for integer colours
        context.enable_only(moderngl.DEPTH_TEST | moderngl.PROGRAM_POINT_SIZE)

    def _draw(self, camera: Camera, batches: list[tuple[int, np.ndarray]]) -> np.ndarray:
        self._words.write(self._empty)
        self._depth_only.clear(depth=1.0)
        self._framebuffer.use()
        self._set_camera(self._program, camera)
        for chunk, pieces in batches:
            self._bind(chunk, pieces)
            # count, instances, first vertex, first instance, padding: the binding steps 20 bytes
            commands = np.zeros((len(pieces), 5), np.uint32)
            commands[:, 0], commands[:, 1], commands[:, 3] = pieces[:, 1], 1, np.arange(len(pieces))
            self._commands.write(commands)
            self._vertices.render_indirect(self._commands, count=len(pieces))
        self._words.read_into(self._image)
        return self._image
