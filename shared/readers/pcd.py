"""PCD (Point Cloud Library): ascii, binary and binary_compressed.

The viewpoint in the header says where the sensor stood; as in PCL it is not applied. Organised clouds keep their NaN
points. Format: pointclouds.org, "The PCD (Point Cloud Data) file format".
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from .columns import Table, TableSource
from .lzf import MAX_EXPANSION, decompress
from .records import RecordSource
from .rows import read_rows
from .source import Source, check_promise, foreign_errors

_HEADER_BYTES = 1 << 16
_KEYS = {"VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"}
_KINDS = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}


@dataclass(frozen=True)
class _Header:
    """dtype : of a record, little-endian; fields of several values are opaque bytes.

    counts : values of each field.  start : byte where the data starts.
    """

    dtype: np.dtype
    counts: list[int]
    n_points: int
    encoding: str
    start: int


def open_pcd(path: Path) -> Source:
    """A PCD file. Raises InputError for a malformed header, or counts that the file is too short for."""
    with foreign_errors(path):
        with path.open("rb") as file:
            header = _parse_header(path, file.read(_HEADER_BYTES))
        if header.encoding == "binary":
            return RecordSource(path, offset=header.start, dtype=header.dtype, n_points=header.n_points, format="pcd")
        return (_AsciiPcd if header.encoding == "ascii" else _CompressedPcd)(path, header)


class _AsciiPcd(TableSource):
    def __init__(self, path: Path, header: _Header):
        self._path, self._header = path, header
        check_promise(path, header.n_points, 2 * sum(header.counts), path.stat().st_size - header.start + 1)
        super().__init__(header.dtype.names or (), path=path, format="pcd", n_points=header.n_points)

    def _tables(self, max_points: int, columns: Collection[str]) -> Iterator[Table]:
        header = self._header
        first_value = dict(zip(header.dtype.names or (), np.cumsum([0, *header.counts]).tolist(), strict=False))
        wanted = [first_value[name] for name in columns]
        with self._path.open("rb") as file:
            file.seek(header.start)
            for rows in read_rows(self._path, file, sum(header.counts), wanted, max_points, header.n_points):
                yield {
                    name: column if header.dtype[name].kind == "V" else _cast(column, header.dtype[name])
                    for name, column in zip(columns, rows.T, strict=True)
                }


class _CompressedPcd(TableSource):
    """All of field 1, then all of field 2, …, as one LZF block: it can only be decompressed as a whole."""

    def __init__(self, path: Path, header: _Header):
        self._path, self._header = path, header
        with path.open("rb") as file:
            file.seek(header.start)
            sizes = file.read(8)
        if len(sizes) < 8:
            raise InputError(f"{path}: truncated: found no sizes of the compressed data")
        self._compressed_bytes, n_bytes = struct.unpack("<II", sizes)
        available = path.stat().st_size - header.start - 8
        if self._compressed_bytes > available:
            raise InputError(
                f"{path}: truncated: found {available} bytes of compressed data, expected {self._compressed_bytes}"
            )
        check_promise(path, header.n_points, header.dtype.itemsize, self._compressed_bytes * MAX_EXPANSION)
        if n_bytes != header.n_points * header.dtype.itemsize:
            raise InputError(
                f"{path}: damaged: found {n_bytes} bytes of points, expected {header.n_points} points of "
                f"{header.dtype.itemsize} bytes"
            )
        super().__init__(header.dtype.names or (), path=path, format="pcd", n_points=header.n_points)

    def _tables(self, max_points: int, columns: Collection[str]) -> Iterator[Table]:
        header, n_points = self._header, self._header.n_points
        with self._path.open("rb") as file:
            file.seek(header.start + 8)
            compressed = np.frombuffer(file.read(self._compressed_bytes), np.uint8)
        data = np.empty(n_points * header.dtype.itemsize, np.uint8)
        if decompress(compressed, data) != len(data):
            raise InputError(f"{self._path}: damaged: the compressed data makes no sense")
        table = {}
        for name, (kind, offset, *_) in (header.dtype.fields or {}).items():
            table[name] = data[offset * n_points : (offset + kind.itemsize) * n_points].view(kind)
        for first in range(0, n_points, max_points):
            yield {name: column[first : first + max_points] for name, column in table.items()}


def _cast(column: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Text values as their field's type, which decides how packed colours are read; NaN as a whole number is 0."""
    with np.errstate(over="ignore"):
        return (np.nan_to_num(column, nan=0.0) if dtype.kind in "iu" else column).astype(dtype)


def _parse_header(path: Path, head: bytes) -> _Header:
    values: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in values:
        end = head.find(b"\n", start)
        line = head[start : end if end >= 0 else len(head)].decode("ascii", "backslashreplace").split()
        if line and not line[0].startswith("#"):
            if line[0] not in _KEYS:
                raise InputError(f"{path}: found header line {' '.join(line)[:80]!r}, expected a PCD header entry")
            values[line[0]] = line[1:]
        if end < 0 and "DATA" not in values:
            raise InputError(f"{path}: truncated: found no DATA line in the header")
        start = end + 1 if end >= 0 else len(head)
    names = values.get("FIELDS") or values.get("COLUMNS") or []
    sizes, counts = _integers(path, values, "SIZE"), _integers(path, values, "COUNT") or [1] * len(names)
    kinds = values.get("TYPE", [])
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise InputError(f"{path}: found {len(names)} fields, expected as many in SIZE, TYPE and COUNT")
    fields = []
    for i, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        if size not in _KINDS.get(kind, ()) or count < 1:
            raise InputError(f"{path}: field {name}: found type {kind} of {size} bytes times {count}")
        unique = name if name != "_" and names.index(name) == i else f"{name} {i}"
        fields.append((unique, f"<{kind.lower()}{size}" if count == 1 else f"V{size * count}"))
    shape = [*_integers(path, values, "WIDTH"), *(_integers(path, values, "HEIGHT") or [1])]
    points = _integers(path, values, "POINTS") or ([shape[0] * shape[1]] if len(shape) == 2 else [])
    if len(points) != 1 or (len(shape) == 2 and shape[0] * shape[1] != points[0]):
        raise InputError(f"{path}: found WIDTH × HEIGHT {shape} and POINTS {points}, expected the same count")
    encoding = " ".join(values["DATA"])
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise InputError(f"{path}: found DATA {encoding[:40]!r}, expected ascii, binary or binary_compressed")
    return _Header(np.dtype(fields), counts, points[0], encoding, start)


def _integers(path: Path, values: dict[str, list[str]], key: str) -> list[int]:
    if not all(v.isdigit() and len(v) < 20 for v in values.get(key, [])):
        raise InputError(f"{path}: found {key} {' '.join(values[key])[:80]!r}, expected whole numbers")
    return [int(v) for v in values.get(key, [])]
