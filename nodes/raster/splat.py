"""The ``cpu`` splat rasterizer: three passes over tiles of the image, on all allowed cores (thesis 4.4.3).

Points are projected once a frame into records of one cache line. A tile then takes visibility, colour and
normalisation one after the other in a buffer of its own, so the passes never meet in memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from ...shared.camera import Camera
from ...shared.points import radius_table
from . import CellFeatures, ResidentPoints, SplatSettings, check_viewport
from .pieces import split_entries
from .splat_geometry import MAX_SPLAT_PX, EyeFrame, drawn_cells, flat_cells, splat_columns
from .threads import ThreadedRasterizer, read_only

PIECE_POINTS = 1 << 14
"""Most points of a piece."""

CHUNKS_PER_THREAD = 8
"""Runs of entries that a thread projects in a frame: enough to level the threads' work."""


@dataclass(frozen=True)
class SplatCounts:
    """What a frame drew of what reaches into the image, and seconds of its phases.

    visibility_splats, quads : splats and quads (of flat cells) of the visibility pass.
    colour_splats : splats of the colour pass.
    tile_splats : the same, once for each tile that they reach into.
    project_s : points to the screen.  lists_s : which tile they reach into.  tiles_s : the three passes.
    """

    visibility_splats: int = 0
    quads: int = 0
    colour_splats: int = 0
    tile_splats: int = 0
    project_s: float = 0.0
    lists_s: float = 0.0
    tiles_s: float = 0.0


class CpuSplatRasterizer(ThreadedRasterizer):
    """Draws a resident point-array as splats on the CPU; a context manager that owns its threads and buffers.

    points : the render rank's half of a scene, with normals and radii. Not modified, not copied if its arrays have the
        documented dtypes.
    width, height : viewport, 1…32768 px.
    threads : at most this many; None: all cores this process may run on.
    Raises InputError if the viewport or the number of threads is out of range, or the points lack what splats need.
    Memory: 8 bytes a pixel, 96 KiB a thread; of the largest frame so far 72 bytes for each point drawn (80 for each
    flat cell) and 4 for each tile of 64 × 64 px it reaches into, at most 81. One byte a point with features.
    Frames have the same bits for any number of threads.

    counts : of the last frame.
    """

    name = "cpu"

    def __init__(
        self, points: ResidentPoints, width: int, height: int, settings: SplatSettings, threads: int | None = None
    ) -> None:
        from . import splat_project, splat_quads, splat_tiles

        super().__init__(width, height, threads)
        self.counts = SplatCounts()
        normal, radius = splat_columns(points)
        columns = (points.x, points.y, points.z, points.colour, normal, radius)
        self._columns = tuple(map(read_only, columns))
        self._settings = settings
        self._radii = (radius_table(points.root_edge) * settings.radius_scale).astype(np.float32)
        self._block_first_point = np.asarray(points.block_first_point, np.int64)
        self._block_origin = points.block_origin
        self._rows = np.zeros((len(points.block_origin), 3, 4), np.float32)
        self._cells = flat_cells(points.features) if settings.features else None
        self._in_flat_cell = np.empty(0, np.uint8) if self._cells is None else _points_in(self._cells, len(points))

        self._n_across, n_down = -(-width // splat_tiles.TILE), -(-height // splat_tiles.TILE)
        self._splats = _Listed(splat_project.SPLAT, splat_project.BOUNDS, self._n_across * n_down)
        self._quads = _Listed(splat_quads.QUAD, splat_project.BOUNDS, self._n_across * n_down)
        self._planes = np.empty((self._threads, splat_tiles.PLANES * splat_tiles.TILE**2), np.float32)
        self._frame = np.empty((height, width), np.uint64)

    def draw(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(height, width) uint64 framebuffer words, row 0 on top; valid until the next call.

        entries : (m,) RENDER_POINT.  Raises MessageError for an entry beyond the point-array or with stride 0, and
        for a camera of another viewport.
        """
        from .splat_tiles import LANES, draw_tiles

        height, width = self._frame.shape
        check_viewport(camera, width, height)
        times = [perf_counter()]
        totals = self._project(camera, entries)
        n_quads = 0
        if self._cells:
            quad_totals = self._project_quads(self._cells, camera, entries)
            self._quads.list_tiles(quad_totals, self._n_across, self._run)
            n_quads = int(quad_totals[:, 0].sum())
        times.append(perf_counter())
        self._splats.list_tiles(totals, self._n_across, self._run)
        times.append(perf_counter())
        counter = np.zeros(1, np.int64)
        listed, n_across, near = (self._splats.listed, self._quads.listed), self._n_across, np.float32(camera.near)
        self._run(lambda i: draw_tiles(*listed, near, n_across, LANES, self._planes[i], self._frame, counter))
        times.append(perf_counter())
        n_splats, n_visible = totals.sum(axis=0).tolist()
        n_listed = int(self._splats.listed[3][-1])
        self.counts = SplatCounts(n_visible, n_quads, n_splats, n_listed, *np.diff(times).tolist())
        return self._frame

    def _project(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(c, 2) int64: splats on the screen and visible ones of each chunk of the entries."""
        from .splat_project import project

        pieces = split_entries(entries, self._block_first_point, len(self._columns[0]), PIECE_POINTS)
        n_before = np.concatenate([[0], np.cumsum(pieces["count"], dtype=np.int64)])
        share = np.linspace(0, n_before[-1], CHUNKS_PER_THREAD * self._threads + 1)
        first_piece = np.searchsorted(n_before, share)
        chunks = np.column_stack([first_piece, n_before[first_piece]])
        totals = np.zeros((len(chunks) - 1, 2), np.int64)
        out = self._splats.begin(chunks)

        frame = EyeFrame.of(camera)
        used = np.flatnonzero(np.bincount(pieces["segment"], minlength=len(self._rows)))
        self._rows[used, :, :3] = frame.rotation
        self._rows[used, :, 3] = frame.eye_from_blocks(camera, self._block_origin[used])
        rotation = frame.rotation.astype(np.float32)
        pinhole = tuple(map(np.float32, (*frame.focal, *frame.center, MAX_SPLAT_PX / camera.focal_px)))
        view = tuple(map(np.float32, (camera.near, camera.width, camera.height)))
        behind = np.float32(min(self._settings.depth_offset, float(np.finfo(np.float32).max)))
        counter = np.zeros(1, np.int64)
        to_screen = (self._rows, rotation, pinhole, view, self._radii, behind, self._settings.lighting)
        self._run(
            lambda _: project(self._columns, self._in_flat_cell, pieces, chunks, *to_screen, out, totals, counter)
        )
        return totals

    def _project_quads(self, cells: CellFeatures, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(c, 2) int64: quads on the screen of each chunk of the flat cells, and 0."""
        from .splat_quads import project_quads

        n_chunks = CHUNKS_PER_THREAD * self._threads
        share = np.linspace(0, len(cells.first_point), n_chunks + 1).astype(np.int64)
        chunks = np.column_stack([share, share])
        totals = np.zeros((n_chunks, 2), np.int64)
        out = self._quads.begin(chunks)
        drawn = drawn_cells(cells, entries)
        frame = EyeFrame.of(camera)
        pinhole = tuple(map(float, (*frame.focal, *frame.center)))
        view = (camera.near, float(camera.width), float(camera.height))
        planes = (cells.quad_center, cells.quad_axes, drawn)
        counter = np.zeros(1, np.int64)
        self._run(
            lambda _: project_quads(*planes, chunks, camera.eye, frame.rotation, pinhole, view, out, totals, counter)
        )
        return totals


class _Listed:
    """Records on the screen, written chunk by chunk, and for each tile the list of those that reach into it."""

    def __init__(self, record: np.dtype, bounds: np.dtype, n_tiles: int) -> None:
        self._records, self._bounds = np.empty(0, record), np.empty(0, bounds)
        self._lists = np.empty(0, np.uint32)
        self._first = np.zeros(n_tiles + 1, np.int64)
        self._places = np.empty((0, n_tiles), np.int64)
        self._chunks = np.zeros((1, 2), np.int64)

    @property
    def listed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Records, their bounds, lists of indices, first place of each tile's list."""
        return self._records, self._bounds, self._lists, self._first

    def begin(self, chunks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Room for the records of chunks and their bounds; see ``splat_project.project``."""
        self._chunks = chunks
        self._records = _room(self._records, int(chunks[-1, 1]))
        self._bounds = _room(self._bounds, int(chunks[-1, 1]))
        return self._records, self._bounds

    def list_tiles(self, totals: np.ndarray, n_across: int, run: Callable[[Callable[[int], None]], None]) -> None:
        """Fill the lists with (c, 2) int64 ``totals`` records of each chunk; ``run`` calls work on every thread."""
        from .splat_tiles import count_tiles, fill_lists, place_lists

        places, written, counter = self._places, (self._bounds, self._chunks, totals), np.zeros(1, np.int64)
        if len(places) != len(totals):
            self._places = places = np.empty((len(totals), len(self._first) - 1), np.int64)
        run(lambda _: count_tiles(*written, n_across, places, counter))
        place_lists(places, self._first)
        self._lists = _room(self._lists, int(self._first[-1]))
        counter[0] = 0
        run(lambda _: fill_lists(*written, n_across, places, self._lists, counter))


def _room(array: np.ndarray, n: int) -> np.ndarray:
    """The array if it has room for ``n`` elements, else a larger one, content lost."""
    return array if len(array) >= n else np.empty(n + n // 4, array.dtype)


def _points_in(cells: CellFeatures, n_points: int) -> np.ndarray:
    """(n_points,) uint8: 1 for the points of ascending cells."""
    steps = np.zeros(n_points + 1, np.int8)
    np.add.at(steps, cells.first_point, 1)
    np.add.at(steps, cells.first_point + cells.n_points, -1)
    return np.cumsum(steps[:-1], dtype=np.int8).view(np.uint8)
