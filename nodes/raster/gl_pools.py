"""Pooled cells as they lie on an OpenGL device: units of work, and a record of each vertex.

A *unit* is up to ``UNIT_VERTICES`` vertices of a pool, or up to ``UNIT_LOOSE`` points that no pool covers. The record
of a vertex says where its first colour stands, so that no invocation needs to know of another. Units stay as they are:
a frame sends the cells that it draws, a run of units and a matrix each.

Nothing here calls OpenGL; ``gl`` does, with the shaders ``pools.*``. ``pools`` is the same for the CPU.

Source: Kim, Lee, Varshney, "Vertex Transformation Streams", section 3 and figure 5.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...shared.camera import Camera
from ...shared.codecs.pools import TAG_BITS
from .gl_resident import RUN
from .pools import PoolCells

UNIT_VERTICES = 256
UNIT_LOOSE = 4096
"""Some thousand points either way, as the pieces of ``gl`` and for their reasons."""

UNIT = np.dtype(
    [
        ("first", "<u4"),
        ("count", "<u4"),
        ("tag_words", "<u4"),
        ("translation", "<u4"),
        ("n_translations", "<u4"),
        ("colour", "<u4"),
        ("cell", "<u4"),
    ]
)
"""As in ``pools.glsl``."""

_VERTEX_WORDS = 2
"""Words of a vertex's record besides its tag."""

_PALETTE_BYTES = 1024


class PoolUnits:
    """Pooled cells, and where their units are. Chunks are consecutive cells.

    limit : bytes, of the largest array of a chunk; a cell with a larger one is a chunk of its own.
    first_point : (c + 1,) int64, number of the first pooled point of each cell, and of them all.
    """

    def __init__(self, pools: PoolCells, limit: int) -> None:
        self.first_point = pools.first_point
        self._origin, self._step, self._world_side = pools.origin, pools.step, pools.world_side
        vertices, loose = np.diff(pools.first_vertex), np.diff(pools.first_loose)
        record_words = _starts((_VERTEX_WORDS + _tag_words(pools)) * vertices)
        pool = pools.first_pool
        self._first_unit = _starts(-(-vertices // UNIT_VERTICES))[pool] + _starts(-(-loose // UNIT_LOOSE))
        bytes_before = np.array(
            [
                UNIT.itemsize * self._first_unit,
                4 * (record_words[pool] + pools.first_loose),
                4 * pools.first_translation[pool],
                pools.first_point,
                _PALETTE_BYTES * np.arange(len(pool)),
            ]
        )
        first = [0]
        while first[-1] < len(pool) - 1:
            most = bytes_before[:, first[-1]] + limit // 4 * 4
            ends = [np.searchsorted(*each, side="right") - 1 for each in zip(bytes_before, most, strict=True)]
            first.append(max(int(min(ends)), first[-1] + 1))
        self._chunk_first = np.array(first)
        self._first_loose = pools.first_loose[self._chunk_first]

    def chunks(self, pools: PoolCells) -> Iterator[tuple[np.ndarray, ...]]:
        """(u,) UNIT; records, translations and colour indices as bytes or words; (c, 256) palettes: of each chunk.

        Cost: a copy of a chunk, and some 8-byte numbers for each vertex in it.
        """
        for begin, end in zip(self._chunk_first[:-1], self._chunk_first[1:], strict=True):
            cells = _between(pools, begin, end)
            records, first_record = _records(cells)
            translations = _packed(cells.translations.view(np.uint8))
            yield _units(cells, first_record), records, translations, _colours(cells), cells.palette

    def loose_left(self, n_kept: int) -> np.ndarray:
        """(chunks,) int64, loose points behind the first ``n_kept`` ones. They are the last records and colours."""
        return np.diff(self._first_loose) - np.diff(np.minimum(self._first_loose, n_kept))

    def runs(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(k,) RUN of (k,) int64 cells, ascending; their numbers of units, their chunks. Matrices stand in their order.

        A run's points are units.
        """
        chunk = np.searchsorted(self._chunk_first, cells, side="right") - 1
        count = np.diff(self._first_unit)[cells]
        runs = np.empty(len(cells), RUN)
        runs["first"] = self._first_unit[cells] - self._first_unit[self._chunk_first[chunk]]
        runs["count"], runs["stride"], runs["block"] = count, 1, np.arange(len(cells))
        return runs, count, chunk

    def rows(self, camera: Camera, cells: np.ndarray) -> np.ndarray:
        """(k, 3, 4) float32: rows X, Y, W over grid points of (k,) cells, as of ``pools``: rounded once."""
        m, step = camera.pixel_from_world[:, :3], self._step[cells, None]
        out = np.empty((len(cells), 3, 4))
        out[:, :, :3] = m * step[:, None]
        x, y, z = (self._origin[cells] - camera.eye + 0.5 * step).T[:, :, None]
        out[:, :, 3] = x * m[:, 0] + y * m[:, 1] + z * m[:, 2]
        return out.astype(np.float32)

    def world_sides(self, cells: np.ndarray) -> np.ndarray:
        """(k,) float64, side of the squares of each cell's points, world units."""
        return self._world_side[cells]


def _starts(counts: np.ndarray) -> np.ndarray:
    """(n + 1,) int64: where each of (n,) counts begins, and where the last one ends."""
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])


def _tag_words(pools: PoolCells) -> np.ndarray:
    """(p,) int64, words of a tag of each pool."""
    return -(-np.diff(pools.first_translation) // TAG_BITS)


def _packed(triples: np.ndarray) -> np.ndarray:
    """(n,) uint32 of (n, 3) uint8, the first one lowest."""
    x, y, z = triples.T.astype(np.uint32)
    return x | y << 8 | z << 16


def _between(pools: PoolCells, begin: int, end: int) -> PoolCells:
    """The cells ``begin`` … ``end`` − 1 by themselves: views, but for numbers, which count from 0 again."""

    def cut(first: np.ndarray, a: int, b: int) -> tuple[np.ndarray, slice]:
        part = first[a : b + 1]
        return part - part[0], slice(int(part[0]), int(part[-1]))

    cells = slice(begin, end)
    first_pool, pool = cut(pools.first_pool, begin, end)
    first_loose, loose = cut(pools.first_loose, begin, end)
    first_point, point = cut(pools.first_point, begin, end)
    first_vertex, vertex = cut(pools.first_vertex, pool.start, pool.stop)
    first_translation, translation = cut(pools.first_translation, pool.start, pool.stop)
    first_word, word = cut(pools.first_word, pool.start, pool.stop)
    return PoolCells(
        pools.origin[cells],
        pools.step[cells],
        pools.world_side[cells],
        pools.palette[cells],
        pools.colour[point],
        first_pool,
        first_loose,
        first_point,
        first_vertex,
        first_translation,
        first_word,
        pools.vertices[vertex],
        pools.translations[translation],
        pools.tags[word],
        pools.loose[:, loose],
    )


def _records(cells: PoolCells) -> tuple[np.ndarray, np.ndarray]:
    """(w,) uint32 records, those of vertices before those of loose points; (v + 1,) int64: where each vertex's begins,
    and where they end.

    A vertex: its place on the grid, the number of its first colour, its tag. A loose point: its place. The vertices of
    a pool stand by number of points, so that invocations side by side go through as many: drawing took a sixth longer
    without.
    """
    vertices = np.diff(cells.first_vertex)
    n_words = np.repeat(_tag_words(cells), vertices)
    first, first_tag = _starts(_VERTEX_WORDS + n_words), _starts(n_words)
    covered = _starts(np.bitwise_count(cells.tags))[first_tag]  # points of the vertices before
    order = np.lexsort((-np.diff(covered), np.repeat(np.arange(len(vertices)), vertices)))
    records = np.empty(first[-1] + cells.loose.shape[1], np.uint32)
    at, tag, words = first[:-1], first_tag[:-1], np.arange(len(cells.tags))
    records[at] = _packed(cells.vertices[order])
    records[at + 1] = covered[order]
    # a pool's tags are of one length, so they stand where others of the same pool stood
    records[np.repeat(at + _VERTEX_WORDS - tag, n_words) + words] = cells.tags[
        np.repeat(tag[order] - tag, n_words) + words
    ]
    records[first[-1] :] = _packed(cells.loose.T)
    return records, first


def _colours(cells: PoolCells) -> np.ndarray:
    """(n,) uint8 colour indices in the order of the records."""
    loose = np.diff(cells.first_loose)
    covered = np.diff(cells.first_point) - loose
    is_loose = np.repeat(np.tile([False, True], len(loose)), np.column_stack([covered, loose]).ravel())
    return np.concatenate([cells.colour[~is_loose], cells.colour[is_loose]])


def _units(cells: PoolCells, first_record: np.ndarray) -> np.ndarray:
    """(u,) UNIT, cell after cell, the pools of a cell before its loose points.  first_record : as of ``_records``."""
    pools, loose = np.zeros(cells.first_pool[-1], UNIT), np.zeros(len(cells.step), UNIT)
    pools["first"] = first_record[cells.first_vertex[:-1]]
    pools["count"] = np.diff(cells.first_vertex)
    pools["tag_words"] = _tag_words(cells)
    pools["translation"] = cells.first_translation[:-1]
    pools["n_translations"] = np.diff(cells.first_translation)
    pools["cell"] = np.repeat(np.arange(len(cells.step)), np.diff(cells.first_pool))
    loose["first"] = first_record[-1] + cells.first_loose[:-1]
    loose["count"] = np.diff(cells.first_loose)
    loose["colour"] = len(cells.colour) - cells.first_loose[-1] + cells.first_loose[:-1]
    loose["cell"] = np.arange(len(cells.step))
    parts = np.concatenate([pools, loose])
    parts = parts[np.argsort(parts["cell"], kind="stable")]
    pooled = parts["tag_words"] > 0
    most, words = np.where(pooled, UNIT_VERTICES, UNIT_LOOSE), np.where(pooled, _VERTEX_WORDS + parts["tag_words"], 1)
    n_units = -(-parts["count"].astype(np.int64) // most)
    units, most, words, before = (np.repeat(a, n_units) for a in (parts, most, words, _starts(n_units)[:-1]))
    done = most * (np.arange(len(units)) - before)
    units["first"] += (done * words).astype(np.uint32)
    units["colour"] += done.astype(np.uint32)
    units["count"] = np.minimum(units["count"] - done, most)
    return units
