"""What the OpenGL rasterizers share: points resident in storage buffers, a frame's runs of points, allocations.

A storage block has a largest size, so the point-array lies in *chunks* below it. A *run* is what an entry of
render-points draws of one block within one chunk; runs and block matrices are all that a frame sends.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...shared.camera import Camera
from ...shared.errors import DeviceError
from . import ResidentPoints, check_viewport
from .gl_context import ContextOwner, check_errors, storage_limit
from .pieces import split_entries

if TYPE_CHECKING:
    import moderngl

ROWS, RUNS = 6, 7
"""Bindings behind those of the columns, as in ``columns.glsl`` and ``runs.glsl``."""

GROUP_SIZE = 64
"""Invocations of a workgroup, as in the shaders."""

RUN = np.dtype([("first", "<u4"), ("count", "<u4"), ("stride", "<u4"), ("block", "<u4"), ("first_unit", "<u4")])
"""As in ``runs.glsl``. first: in the chunk; block: place of its matrix; first_unit: units of the runs before."""

_MOST_POINTS = (1 << 32) - 1  # of a run


@dataclass(eq=False)
class Resident:
    """What lies on the device in chunks, and what a frame sends of it.

    chunks : buffers, in the order of their bindings.  runs : (n_runs,) RUN.  rows : the matrices that runs name.
    """

    chunks: list[list[moderngl.Buffer]]
    runs: moderngl.Buffer
    rows: moderngl.Buffer
    n_runs: int = 0

    @property
    def n_bytes(self) -> int:
        """Device memory of the chunks."""
        return sum(buffer.size for chunk in self.chunks for buffer in chunk)


@dataclass(frozen=True)
class Batch:
    """What one dispatch or draw works on: units of work of a frame's runs, all in one chunk."""

    resident: Resident
    chunk: int
    first_unit: int
    n_units: int


class GlResident(ContextOwner, ABC):
    """An OpenGL rasterizer: context, chunks of the point-array, block matrices, runs.

    points : copied to the device; its columns may be released or unmapped afterwards.
    columns : (n,) float32, uint32 or uint8 arrays of ``points``, in the order of their bindings.
    borders : point numbers that no run crosses, besides those of blocks and chunks.
    width, height : size of every frame, pixels.
    device_index : in EGL's order; GLCONTEXT_DEVICE_INDEX wins.
    Raises InputError: the viewport is empty or above the device's texture size.
    Raises DeviceError: no OpenGL 4.5, not enough device memory, something above the storage-block limit.
    To be used from the thread that made it.
    """

    name: str
    _unit_points: int  # most points of a unit of work
    _batch_units: int  # most units of a batch

    def __init__(
        self,
        points: ResidentPoints,
        columns: Sequence[np.ndarray],
        width: int,
        height: int,
        device_index: int,
        borders: np.ndarray | None = None,
    ) -> None:
        self._n_points = len(points)
        self._shape = (height, width)
        self._block_origin = points.block_origin
        with self._set_up(device_index, width, height, "setting up"):
            self._limit = storage_limit(self._context)
            self._most_groups = self._context.info["GL_MAX_COMPUTE_WORK_GROUP_COUNT"][0]
            self._upload(points.block_first_point, columns, borders)
            self._prepare()

    @property
    def resident_bytes(self) -> int:
        """Device memory that the point-array takes."""
        return self._points.n_bytes

    def draw(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(height, width) uint64 framebuffer words, row 0 on top; valid until the next call.

        entries : (m,) RENDER_POINT.
        Raises MessageError for an entry beyond the point-array or with stride 0 and for a camera of another viewport,
        DeviceError for an OpenGL error.
        """
        height, width = self._shape
        check_viewport(camera, width, height)
        with self._context:  # another rasterizer of this thread may have made its own current
            image = self._draw(camera, entries, self._send(camera, entries))
            check_errors(self._context, "drawing")
        return image

    @abstractmethod
    def _prepare(self) -> None:
        """Make programs and the framebuffer."""

    @abstractmethod
    def _block_rows(self, camera: Camera, blocks: np.ndarray) -> np.ndarray:
        """(k, 3, 4) float32 matrices of (k,) blocks."""

    @abstractmethod
    def _draw(self, camera: Camera, entries: np.ndarray, batches: list[Batch]) -> np.ndarray:
        """Draw the runs that were sent; the words of the frame."""

    def _upload(self, block_first: np.ndarray, columns: Sequence[np.ndarray], borders: np.ndarray | None) -> None:
        per_chunk = self._limit // 16 * 4  # whole words of one-byte columns too
        self._chunk_first = np.arange(0, max(self._n_points, 1), per_chunk)
        first = np.concatenate([block_first, self._chunk_first, np.empty(0, int) if borders is None else borders])
        self._segment_first = np.unique(first[first < max(self._n_points, 1)])
        self._segment_chunk = np.searchsorted(self._chunk_first, self._segment_first, side="right") - 1
        self._segment_block = np.searchsorted(block_first, self._segment_first, side="right") - 1
        chunks = (
            [column[first : first + per_chunk] for column in columns] for first in self._chunk_first if self._n_points
        )
        self._points = self._hold(chunks, len(self._block_origin), "block matrices")

    def _hold(self, chunks: Iterable[Sequence[np.ndarray]], n_rows: int, what: str) -> Resident:
        """Arrays of each chunk copied to the device, and room for runs and ``n_rows`` matrices."""
        buffers = [[self._buffer(_whole_words(array)) for array in arrays] for arrays in chunks]
        runs = self._buffer(bytes=RUN.itemsize << 6, what="runs")
        return Resident(buffers, runs, self._buffer(bytes=48 * n_rows, what=what))

    def _buffer(self, data: np.ndarray | None = None, *, bytes: int = 0, what: str = "points") -> moderngl.Buffer:
        bytes = bytes if data is None else data.nbytes
        if bytes > self._limit:
            raise DeviceError(
                f"{self.device}: found {bytes} bytes of {what}, expected at most {self._limit} (storage-block limit)"
            )
        buffer = self._context.buffer(data, reserve=0 if data is not None else bytes)
        check_errors(self._context, f"allocating {buffer.size} bytes for {what}")
        return buffer

    def _write(self, buffer: moderngl.Buffer, data: np.ndarray, what: str) -> moderngl.Buffer:
        """Fill a buffer, or a larger one in its place if the data needs it."""
        if data.nbytes > buffer.size:
            larger = self._buffer(bytes=max(data.nbytes, min(2 * data.nbytes, self._limit)), what=what)
            buffer.release()
            buffer = larger
        buffer.write(data)
        return buffer

    def _send(self, camera: Camera, entries: np.ndarray) -> list[Batch]:
        """Send runs and matrices of a frame; its batches.

        Cost: O(entries and the borders they cross), no more for more points.
        """
        parts = split_entries(entries, self._segment_first, self._n_points, _MOST_POINTS)
        if len(self._points.chunks) > 1:
            parts = parts[np.argsort(self._segment_chunk[parts["segment"]], kind="stable")]
        segment = parts["segment"]
        chunk, block = self._segment_chunk[segment], self._segment_block[segment]
        drawn = np.zeros(len(self._block_origin), bool)
        drawn[block] = True
        runs = np.empty(len(parts), RUN)
        runs["first"] = parts["first"] - self._chunk_first[chunk]
        runs["count"], runs["stride"] = parts["count"], parts["stride"]
        runs["block"] = (np.cumsum(drawn) - 1)[block] | self._marks(segment)
        n_units = -(-parts["count"].astype(np.int64) // self._unit_points)
        return self._send_runs(self._points, runs, n_units, chunk, self._block_rows(camera, np.flatnonzero(drawn)))

    def _send_runs(
        self, resident: Resident, runs: np.ndarray, n_units: np.ndarray, chunk: np.ndarray, rows: np.ndarray
    ) -> list[Batch]:
        """Send (r,) RUN, whose ``first_unit`` is filled here, and (k, 3, 4) float32 matrices; the frame's batches.

        n_units, chunk : (r,) int64, units of work of each run, and its chunk, ascending.
        """
        end = np.cumsum(n_units)
        runs["first_unit"] = end - n_units
        resident.runs, resident.n_runs = self._write(resident.runs, runs, "runs"), len(runs)
        resident.rows = self._write(resident.rows, rows, "matrices")
        last = np.append(0, end)[np.searchsorted(chunk, np.arange(len(resident.chunks)), side="right")]
        return [
            Batch(resident, i, unit, min(stop - unit, self._batch_units))
            for i, (begin, stop) in enumerate(zip([0, *last[:-1].tolist()], last.tolist(), strict=False))
            for unit in range(begin, stop, self._batch_units)
        ]

    def _marks(self, segment: np.ndarray) -> np.ndarray | int:
        """Bits above the place of a run's block, for (r,) segments."""
        return 0

    def _bind(self, batch: Batch) -> None:
        for binding, buffer in enumerate(batch.resident.chunks[batch.chunk]):
            buffer.bind_to_storage_buffer(binding)
        batch.resident.rows.bind_to_storage_buffer(ROWS)
        batch.resident.runs.bind_to_storage_buffer(RUNS)

    def _dispatch(self, program: moderngl.ComputeShader, batch: Batch) -> None:
        """Run a program that includes ``runs.glsl``, one invocation a unit of the batch."""
        program["n_runs"] = batch.resident.n_runs
        program["first_unit"], program["n_units"] = batch.first_unit, batch.n_units
        program.run(*self._folded(-(-batch.n_units // GROUP_SIZE)))

    def _folded(self, n_groups: int) -> tuple[int, int]:
        """Columns and rows of a dispatch of at least this many groups: above the limit of one it does nothing."""
        columns = min(n_groups, self._most_groups)
        return columns, -(-n_groups // columns)


def _whole_words(column: np.ndarray) -> np.ndarray:
    """A column as 32-bit words, one at least; the last bytes of a shorter type are padded."""
    column = np.ascontiguousarray(column)
    if column.itemsize == 4 and column.size:
        return column
    words = np.zeros(max(-(-column.nbytes // 4), 1), np.uint32)
    words.view(np.uint8)[: column.nbytes] = column.view(np.uint8).ravel()
    return words
