"""NPY and NPZ. Nothing is unpickled, and nothing is allocated before its size is held against the file's.

An NPY file is an (n, ≥ 3) array, its columns told as those of a text file without a header, or a structured array.
An NPZ file holds (n, 3) arrays (``xyz`` or ``positions`` or ``points``, ``rgb`` or ``colors``, ``normals``) and (n,)
arrays (``x``, ``y``, ``z``, ``intensity``, ``classification``, …); arrays of other names are passed over.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from ..errors import InputError
from .columns import Table, TableSource, find_roles, guess_names, split_group
from .records import Records, RecordSource, sample_records
from .source import Source, check_promise, foreign_errors

_MAX_DEFLATE_RATIO = 1032


@dataclass(frozen=True)
class _Array:
    """What an NPY header says. offset : byte where the values start."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype
    offset: int

    @property
    def n_rows(self) -> int:
        """Length of the first axis."""
        return self.shape[0]

    @property
    def row_bytes(self) -> int:
        """Bytes of one row."""
        return math.prod(self.shape[1:]) * self.dtype.itemsize


def open_npy(path: Path) -> Source:
    """An NPY file. Raises InputError for an array that is not of points, or that the file is too short for."""
    with foreign_errors(path), path.open("rb") as file:
        array = _read_header(path, file)
        if array.dtype.names and len(array.shape) == 1:
            dtype = _flat_dtype(array.dtype)
        elif not array.dtype.names and len(array.shape) == 2 and array.shape[1] >= 3:
            if array.fortran and array.n_rows > 1:
                return _ColumnMajorNpy(path, array)
            dtype = np.dtype([(f"column {i}", array.dtype) for i in range(array.shape[1])])
            check_promise(path, array.n_rows, dtype.itemsize, path.stat().st_size - array.offset)
            sample = sample_records(Records(path, file, array.offset, dtype), array.n_rows, dtype)
            dtype.names = tuple(guess_names(sample.view(array.dtype).reshape(-1, array.shape[1])))
        else:
            raise InputError(
                f"{path}: found an array of shape {array.shape}, expected (n, 3 or more), or (n,) with named fields"
            )
        return RecordSource(path, offset=array.offset, dtype=dtype, n_points=array.n_rows, format="npy")


class _ColumnMajorNpy(TableSource):
    """A column after the other (``fortran_order``)."""

    def __init__(self, path: Path, array: _Array):
        self._path, self._array = path, array
        n_points, n_columns = array.shape
        check_promise(path, n_points, n_columns * array.dtype.itemsize, path.stat().st_size - array.offset)
        self._names = [str(i) for i in range(n_columns)]
        sample = next(self._tables(1 << 16, self._names))
        self._names = guess_names(np.column_stack([sample[name] for name in self._names]))
        super().__init__(self._names, path=path, format="npy", n_points=n_points)

    def _tables(self, max_points: int, columns: Collection[str]) -> Iterator[Table]:
        n_points, dtype = self._array.n_rows, self._array.dtype
        with self._path.open("rb") as file:
            for first in range(0, n_points, max_points):
                table = {}
                for name in columns:
                    start = self._array.offset + self._names.index(name) * n_points * dtype.itemsize
                    records = Records(self._path, file, start, dtype)
                    records.seek(first)
                    table[name] = np.empty(min(max_points, n_points - first), dtype)
                    records.read_into(table[name])
                yield table


class NpzSource(TableSource):
    """An NPZ file; its arrays are read side by side."""

    def __init__(self, path: Path):
        """Raises InputError for arrays of different lengths, or which their file is too short for."""
        self._path = path
        self._columns_of_member: dict[str, tuple[str, ...]] = {}
        lengths = {}
        with foreign_errors(path):
            with zipfile.ZipFile(path) as archive:
                for member in archive.namelist():
                    name = member.removesuffix(".npy")
                    if not (split_group(name) or find_roles([name])):
                        continue
                    with archive.open(member) as stream:
                        array = _read_header(path, stream)
                    parts = (name,) if len(array.shape) == 1 else split_group(name)
                    if array.dtype.names or len(array.shape) > 2 or not 0 < len(parts) <= math.prod(array.shape[1:]):
                        raise InputError(
                            f"{path}: {name}: found {array.dtype} of shape {array.shape}, expected columns"
                        )
                    self._check_member(archive.getinfo(member), array)
                    self._columns_of_member[member] = parts
                    lengths[member] = array.n_rows
            if len(set(lengths.values())) > 1:
                raise InputError(f"{path}: found arrays of different lengths: {lengths}")
            names = [part for parts in self._columns_of_member.values() for part in parts]
            super().__init__(names, path=path, format="npz", n_points=max(lengths.values(), default=0))

    def _check_member(self, info: zipfile.ZipInfo, array: _Array) -> None:
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError(f"{self._path}: {info.filename}: found an unknown compression, expected one of NumPy's")
        available = min(info.file_size, info.compress_size * _MAX_DEFLATE_RATIO) - array.offset
        check_promise(self._path, array.n_rows, array.row_bytes, available)

    def _tables(self, max_points: int, columns: Collection[str]) -> Iterator[Table]:
        members = {m: parts for m, parts in self._columns_of_member.items() if not {*parts}.isdisjoint(columns)}
        with zipfile.ZipFile(self._path) as archive:
            streams = [_member_rows(self._path, archive, member, max_points) for member in members]
            for blocks in zip(*streams, strict=True):
                yield {
                    part: block if block.ndim == 1 else block[:, i]
                    for parts, block in zip(members.values(), blocks, strict=True)
                    for i, part in enumerate(parts)
                }


def _member_rows(path: Path, archive: zipfile.ZipFile, member: str, max_rows: int) -> Iterator[np.ndarray]:
    """Blocks of rows of one array; a column-major one is held as a whole."""
    with archive.open(member) as stream:
        array = _read_header(path, stream)
        whole = array.fortran and len(array.shape) == 2
        step = array.n_rows if whole else max_rows
        for first in range(0, array.n_rows, step):
            shape = (min(step, array.n_rows - first), *array.shape[1:])
            data = stream.read(shape[0] * array.row_bytes)
            rows = np.frombuffer(data, array.dtype).reshape(shape, order="F" if whole else "C")
            for i in range(0, len(rows), max_rows):
                yield rows[i : i + max_rows]


def _read_header(path: Path, file: IO[bytes]) -> _Array:
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_2_0(file)
    else:
        raise InputError(f"{path}: found NPY version {version}, expected (1, 0) or (2, 0)")
    if dtype.hasobject:
        raise InputError(f"{path}: found an array of Python objects, expected numbers (nothing is unpickled)")
    if not shape or min(shape) < 0 or (not dtype.names and dtype.kind not in "biuf"):
        raise InputError(f"{path}: found an array of {dtype} with shape {shape}, expected rows of numbers")
    return _Array(shape, fortran, dtype, file.tell())


def _flat_dtype(dtype: np.dtype) -> np.dtype:
    """The numeric fields of a structured dtype, those of a group such as ``xyz`` split into their parts."""
    fields = []
    for name, (kind, offset, *_) in (dtype.fields or {}).items():
        parts = (name,) if kind.shape == () else split_group(name)
        if kind.base.kind not in "biuf" or len(kind.shape) > 1 or math.prod(kind.shape) < len(parts):
            continue
        fields += [(part, kind.base, offset + i * kind.base.itemsize) for i, part in enumerate(parts)]
    names, formats, offsets = zip(*fields, strict=True) if fields else ((), (), ())
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": dtype.itemsize})
