"""PLY rows that differ in length because some properties are lists. Rare in point clouds, so short rather than fast."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..errors import InputError
from .columns import Table
from .rows import MAX_LINE_BYTES

_Property = tuple[str, str, str | None]


def binary_rows(
    path: Path, file: BinaryIO, n_rows: int, properties: Sequence[_Property], max_rows: int
) -> Iterator[Table]:
    """The scalar columns of ``n_rows`` binary rows from where ``file`` stands; lists are passed over.

    properties : see ``ply.Element``. Raises InputError where the file ends early or a list has a negative length.
    """
    types = [(np.dtype(kind), np.dtype(length) if length else None) for _, kind, length in properties]
    for first in range(0, n_rows, max_rows):
        rows: list[list[bytes]] = [[] for _ in properties]
        for _ in range(min(max_rows, n_rows - first)):
            for column, (kind, length) in zip(rows, types, strict=True):
                if length is None:
                    column.append(_read(path, file, kind.itemsize))
                else:
                    n_items = int(np.frombuffer(_read(path, file, length.itemsize), length)[0])
                    _skip(path, file, n_items * kind.itemsize)
        yield {
            name: np.frombuffer(b"".join(column), kind)
            for (name, _, _), column, (kind, length) in zip(properties, rows, types, strict=True)
            if length is None
        }


def ascii_rows(
    path: Path, file: BinaryIO, n_rows: int, properties: Sequence[_Property], max_rows: int
) -> Iterator[Table]:
    """As ``binary_rows``, of text lines; the columns are float64."""
    names = [name for name, _, length in properties if length is None]
    for first in range(0, n_rows, max_rows):
        rows = []
        while len(rows) < min(max_rows, n_rows - first):
            line = file.readline(MAX_LINE_BYTES)
            if not line:
                raise InputError(f"{path}: truncated: found {first + len(rows)} vertices, expected {n_rows}")
            if fields := line.split():
                rows.append(_scalars(path, fields, properties))
        yield dict(zip(names, np.array(rows).T, strict=True))


def _scalars(path: Path, fields: list[bytes], properties: Sequence[_Property]) -> list[float]:
    values, at = [], 0
    try:
        for _, _, length in properties:
            if length is None:
                values.append(float(fields[at]))
                at += 1
            else:
                at += 1 + int(fields[at])
    except (ValueError, IndexError):
        raise InputError(f"{path}: found vertex {b' '.join(fields)[:80]!r}, expected its header's properties") from None
    return values


def _read(path: Path, file: BinaryIO, n_bytes: int) -> bytes:
    data = file.read(n_bytes)
    if len(data) < n_bytes:
        raise InputError(f"{path}: truncated: the file ends inside an element with lists")
    return data


def _skip(path: Path, file: BinaryIO, n_bytes: int) -> None:
    if n_bytes < 0:
        raise InputError(f"{path}: damaged: found a list of negative length")
    file.seek(n_bytes, 1)
