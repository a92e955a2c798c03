"""Fixed-size binary records at an offset of a file: the heart of LAS, and all there is to binary PLY, PCD and NPY."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import InputError
from ..points import PointBatch
from .columns import SAMPLE_POINTS, Table, TableSource
from .source import check_promise

BLOCK_POINTS = 1 << 14
"""Records worked on at a time, so that they stay in the cache."""

SAMPLE_PLACES = 4


class Records:
    """Records of ``dtype`` from byte ``offset`` of an open file.

    Plain reads rather than a memory map: a file cut short meanwhile is an error here and would end the process there.
    """

    can_seek = True

    def __init__(self, path: Path, file: BinaryIO, offset: int, dtype: np.dtype):
        self._path, self._file, self._offset, self._dtype = path, file, offset, dtype
        self.seek(0)

    def seek(self, point: int) -> None:
        """The next record to be read."""
        self._file.seek(self._offset + point * self._dtype.itemsize)

    def read_into(self, out: np.ndarray) -> None:
        """Fill (n,) records. Raises InputError if the file ends before."""
        n_bytes = self._file.readinto(out.view(np.uint8))  # type: ignore[attr-defined]
        if n_bytes != out.nbytes:
            raise InputError(f"{self._path}: the file became shorter while it was read")


def sample_records(records: Any, n_points: int, dtype: np.dtype) -> np.ndarray:
    """(≤ SAMPLE_POINTS,) records from a few places spread over the file, or from its begin if it cannot seek."""
    count = min(n_points, SAMPLE_POINTS // SAMPLE_PLACES)
    places = {(n_points - count) * i // (SAMPLE_PLACES - 1) for i in range(SAMPLE_PLACES if records.can_seek else 1)}
    sample = np.empty((len(places), count), dtype)
    for part, place in zip(sample, sorted(places), strict=True):
        if place:
            records.seek(place)
        records.read_into(part)
    return sample.ravel()


class RecordSource(TableSource):
    """A file whose points are records of one structured dtype."""

    part_points = 1

    def __init__(self, path: Path, *, offset: int, dtype: np.dtype, n_points: int, format: str, **info: Any):
        """Raises InputError if the file is too short for ``n_points`` records from byte ``offset``."""
        check_promise(path, n_points, dtype.itemsize, path.stat().st_size - offset)
        self._path, self._offset, self._dtype, self._n_points = path, offset, dtype, n_points
        super().__init__(dtype.names or (), path=path, format=format, n_points=n_points, **info)

    def _sample(self, columns: Collection[str]) -> Table:
        with self._path.open("rb") as file:
            return sample_records(Records(self._path, file, self._offset, self._dtype), self._n_points, self._dtype)

    def _tables(self, max_points: int, columns: Collection[str]) -> Iterator[Table]:
        return self._blocks(0, self._n_points, max_points)

    def _read_part(self, first: int, last: int, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        return self._batches_of(self._blocks(first, last, max_points), attributes)

    def _blocks(self, first: int, last: int, max_points: int) -> Iterator[np.ndarray]:
        with self._path.open("rb") as file:
            records = Records(self._path, file, self._offset, self._dtype)
            records.seek(first)
            for begin in range(first, last, max_points):
                block = np.empty(min(max_points, last - begin), self._dtype)
                records.read_into(block)
                yield block
