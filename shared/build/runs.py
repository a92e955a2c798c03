"""Points that do not fit into memory: sorted runs on disk, and the partitions that do fit.

Every batch that fills the memory is sorted stably by bucket (``partition.BUCKET_LEVEL``) and written as one *run*, a
raw file a column. A *partition* is a cell of the octree whose points fit; they are the same slice of every run, or,
below the bucket level, the points of that slice whose key has the cell's code for a prefix. Read run after run they
stand in the order that one sort in memory would have given them: the scene does not depend on the memory it was built
in.

Partitions are taken in the order of their codes, so what lies in front of one in every run is not read again: its
disk space is given back while the scene grows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit

from ..octree import MAX_LEVEL
from ..points import ATTRIBUTES, PointBatch
from .flatness import N_MOMENTS, add_moments, bucket_moments, central_moments, flatness
from .holes import punch_hole
from .ingest import Columns
from .morton import count_buckets, keys_of
from .parallel import Workers
from .partition import BUCKET_LEVEL, Subdivision, sort_into_buckets, upper_cells
from .writer import write_all, writing

_CHUNK = 1 << 17
_N_BUCKETS = 8**BUCKET_LEVEL
_STEP = 3
"""Levels that one pass over an oversize cell below the bucket level looks ahead."""


@dataclass(frozen=True)
class Partition:
    """A cell, and whether its points fit into memory; if not, it is a leaf and its points are streamed."""

    level: int
    code: int
    n_points: int
    fits: bool


@njit(nogil=True, cache=True)
def _gather_rows(positions, ids, begin, end, out):
    for j in range(begin, end):
        for axis in range(3):
            out[j - begin, axis] = positions[ids[j], axis]


class Runs:
    """Sorted runs in a directory of their own, until they are discarded.

    origin, edge : the root cube, which holds all points.
    Raises InputError if the disk is full.
    """

    def __init__(
        self,
        directory: Path,
        attributes: tuple[str, ...],
        origin: np.ndarray,
        edge: float,
        rule: Subdivision,
        workers: Workers,
    ) -> None:
        self._directory = directory
        self.attributes = attributes
        self._origin, self._edge = origin, edge
        self._rule = rule
        self._workers = workers
        self._runs: list[Path] = []
        self.counts = np.zeros(_N_BUCKETS, np.int64)
        self.moments = np.zeros((_N_BUCKETS, N_MOMENTS), np.int64) if rule.flatness > 0 else None
        self._ahead: dict[tuple[int, int], np.ndarray] = {}
        self._released = 0
        self.bytes = 0
        with writing(directory):
            directory.mkdir()

    def add(self, points: PointBatch) -> None:
        """Sort points and write them as a run. Memory: 12 bytes a point and a chunk a column."""
        keys = self.keys(points)
        ids, first = sort_into_buckets(keys, BUCKET_LEVEL, 0, _N_BUCKETS, self._workers)
        self.counts += np.diff(first)
        if self.moments is not None:
            pieces = self._workers.ranges(_N_BUCKETS)
            self._workers.map(bucket_moments, [(keys, ids, first, a, b, BUCKET_LEVEL, self.moments) for a, b in pieces])
        run = self._directory / f"{len(self._runs):05d}"
        with writing(self._directory):
            with open(_file(run, "first"), "wb", buffering=0) as file:
                write_all(file, first)
            columns = {"positions": points.positions, **points.attributes}
            self._workers.map(self._write_column, [(run, name, column, ids) for name, column in columns.items()])
        self._runs.append(run)
        self.bytes += first.nbytes + sum(column.nbytes for column in columns.values())

    def built_for(self, origin: np.ndarray, edge: float) -> bool:
        """Whether the runs are sorted in this root cube."""
        return bool((origin == self._origin).all()) and edge == self._edge

    def discard(self) -> None:
        """Remove the files."""
        for file in self._directory.iterdir():
            file.unlink()
        self._directory.rmdir()

    @property
    def n_runs(self) -> int:
        """Runs so far."""
        return len(self._runs)

    def read_on(self, directories: list[tuple[Path, int]], counts: np.ndarray, moments: np.ndarray | None) -> None:
        """From now on read the runs of several processes, in this order: (directory, number of runs) of each.

        counts, moments : of all of them, as these are.
        """
        self._runs = [directory / f"{run:05d}" for directory, n_runs in directories for run in range(n_runs)]
        self.counts, self.moments = counts, moments

    def release_before(self, partition: Partition) -> None:
        """Give back the disk space of all points in front of the bucket that a partition begins in."""
        begin, _ = _buckets(partition.level, partition.code)
        if begin == self._released:
            return
        for run, start, stop in self._slices(self._released, begin):
            for name, row_bytes in (("positions", 24), *((a, ATTRIBUTES[a].itemsize) for a in self.attributes)):
                punch_hole(_file(run, name), start * row_bytes, (stop - start) * row_bytes)
        self._released = begin

    def _write_column(self, run: Path, name: str, column: np.ndarray, ids: np.ndarray) -> None:
        out = np.empty((_CHUNK, *column.shape[1:]), column.dtype)
        with open(_file(run, name), "wb", buffering=0) as file:
            for begin in range(0, len(ids), _CHUNK):
                end = min(begin + _CHUNK, len(ids))
                if column.ndim == 2:
                    _gather_rows(column, ids, begin, end, out)
                else:
                    np.take(column, ids[begin:end], out=out[: end - begin], mode="clip")
                write_all(file, out[: end - begin])

    def partitions(self, capacity: int, wanted: int | None = None) -> Iterator[Partition]:
        """Cells in Morton order that hold all points, each of at most ``capacity`` points or an oversize leaf.

        wanted : cells of more points than this, at most ``capacity``, are partitions only if they are leaves.
        Cost: where a cell of the bucket level is oversize, a pass over its points for every three levels below.
        """
        wanted = capacity if wanted is None else wanted
        first = np.zeros(_N_BUCKETS + 1, np.int64)
        np.cumsum(self.counts, out=first[1:])
        cells = upper_cells(0, 0, first, self.moments, self._rule)
        oversize = cells.take(np.flatnonzero(cells.count > wanted))
        split = dict(
            zip(zip(oversize.level.tolist(), oversize.code.tolist(), strict=True), oversize.split, strict=True)
        )

        def below(level: int, code: int) -> Iterator[Partition]:
            width = 3 * (BUCKET_LEVEL - level)
            if width >= 0:
                n = int(first[(code + 1) << width] - first[code << width])
            else:
                n = self._count(level, code)
            if n == 0:
                return
            if n <= wanted:
                yield Partition(level, code, n, fits=True)
            elif split[level, code] if width >= 0 else self._splits(level, code, n):
                for octant in range(8):
                    yield from below(level + 1, code << 3 | octant)
            else:
                yield Partition(level, code, n, fits=n <= capacity)

        yield from below(0, 0)

    def _count(self, level: int, code: int) -> int:
        """Points of a cell below the bucket level, from a histogram under the ancestor that is looked ahead from."""
        ahead = BUCKET_LEVEL + (level - 1 - BUCKET_LEVEL) // _STEP * _STEP
        lowest = min(ahead + _STEP, MAX_LEVEL)
        ancestor = code >> 3 * (level - ahead)
        if (ahead, ancestor) not in self._ahead:
            counts = np.zeros(8 ** (lowest - ahead), np.int64)
            for keys in map(self.keys, self.stream(ahead, ancestor, ())):
                base = ancestor << 3 * (lowest - ahead)
                count_buckets(keys, 0, len(keys), 3 * (MAX_LEVEL - lowest), base, counts)
            self._ahead[ahead, ancestor] = counts
        width = 3 * (lowest - level)
        at = (code << width) - (ancestor << 3 * (lowest - ahead))
        return int(self._ahead[ahead, ancestor][at : at + (1 << width)].sum())

    def _splits(self, level: int, code: int, n: int) -> bool:
        if not self._rule.counts_allow(n, level):
            return False
        if not self._rule.flatness > 0:
            return True
        moments, central = np.zeros(N_MOMENTS, np.int64), np.empty(N_MOMENTS)
        for keys in map(self.keys, self.stream(level, code, ())):
            add_moments(keys, np.arange(len(keys), dtype=np.uint32), 0, len(keys), level, moments)
        central_moments(moments, central)
        return bool(flatness(central) >= self._rule.flatness)

    def load(self, partition: Partition) -> tuple[PointBatch, np.ndarray]:
        """(points, keys) of a partition that fits."""
        if partition.level <= BUCKET_LEVEL:
            points = self._read_buckets(*_buckets(partition.level, partition.code), self.attributes)
        else:
            columns = Columns(partition.n_points, self.attributes)
            for batch in self.stream(partition.level, partition.code):
                columns.add(batch)
            points = columns.points()
        return points, self.keys(points)

    def stream(self, level: int, code: int, attributes: tuple[str, ...] | None = None) -> Iterator[PointBatch]:
        """The points of a cell in the order of one sort in memory, in small batches; all attributes or some."""
        wanted = self.attributes if attributes is None else attributes
        for begin, end, n in self._small_groups(*_buckets(level, code)):
            if n <= _CHUNK:
                batches = iter([self._read_buckets(begin, end, wanted)])
            else:
                batches = self._stream_slices(self._slices(begin, end), wanted)
            for batch in batches:
                keys = self.keys(batch)
                if level > BUCKET_LEVEL:
                    batch = batch.select(keys >> 3 * (MAX_LEVEL - level) == code)
                elif end - begin > 1:
                    batch = batch.select(np.argsort(keys >> 3 * (MAX_LEVEL - BUCKET_LEVEL), kind="stable"))
                if len(batch):
                    yield batch

    def _small_groups(self, begin: int, end: int) -> Iterator[tuple[int, int, int]]:
        """(begin, end, points) of consecutive buckets: together at most a chunk, or a single one with points."""
        first, n = begin, 0
        for bucket in range(begin, end):
            here = int(self.counts[bucket])
            if n and n + here > _CHUNK:
                yield first, bucket, n
                n = 0
            if not n:
                first = bucket
            n += here
        if n:
            yield first, end, n

    def keys(self, points: PointBatch) -> np.ndarray:
        """(n,) int64 Morton keys."""
        return keys_of(points.positions, self._origin, self._edge, self._workers)

    def _slices(self, begin: int, end: int) -> list[tuple[Path, int, int]]:
        """(run, start, stop) of the buckets [begin, end) in every run."""

        def offset(run: Path, bucket: int) -> int:
            return int(np.fromfile(_file(run, "first"), "<i8", 1, offset=8 * bucket)[0])

        return [(run, offset(run, begin), offset(run, end)) for run in self._runs]

    def _stream_slices(self, slices: list[tuple[Path, int, int]], attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        for run, start, stop in slices:
            for begin in range(start, stop, _CHUNK):
                yield self._read_slices([(run, begin, min(begin + _CHUNK, stop))], attributes)

    def _read_buckets(self, begin: int, end: int, attributes: tuple[str, ...]) -> PointBatch:
        return self._read_slices(self._slices(begin, end), attributes)

    def _read_slices(self, slices: list[tuple[Path, int, int]], attributes: tuple[str, ...]) -> PointBatch:
        points = Columns(sum(stop - start for _, start, stop in slices), attributes).whole()
        columns = {"positions": points.positions, **points.attributes}
        self._workers.map(self._read_column, [(name, slices, column) for name, column in columns.items()])
        return points

    def _read_column(self, name: str, slices: list[tuple[Path, int, int]], out: np.ndarray) -> None:
        at = 0
        for run, start, stop in slices:
            self._read(run, name, start, stop, out[at : at + stop - start])
            at += stop - start

    def _read(self, run: Path, name: str, start: int, stop: int, out: np.ndarray) -> None:
        """Fill ``out``, C-contiguous, with rows [start, stop) of a run's column."""
        if stop > start:
            data = out.reshape(-1).view(np.uint8).data
            with open(_file(run, name), "rb", buffering=0) as file:
                file.seek(start * (out.nbytes // len(out)))
                while data:
                    n_read = file.readinto(data)
                    if not n_read:
                        raise OSError(f"{file.name}: ended early")
                    data = data[n_read:]


def _file(run: Path, name: str) -> Path:
    return run.with_name(f"{run.name}.{name}")


def _buckets(level: int, code: int) -> tuple[int, int]:
    """The range of buckets that a cell covers, or the one it lies in."""
    if level > BUCKET_LEVEL:
        bucket = code >> 3 * (level - BUCKET_LEVEL)
        return bucket, bucket + 1
    width = 3 * (BUCKET_LEVEL - level)
    return code << width, (code + 1) << width
