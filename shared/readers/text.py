"""Text files of points: XYZ, TXT, CSV, ASC, PTS.

Columns are named by a header line (commas, semicolons or blanks between the names, a comment mark in front of them does
not matter) or, without one, known by their number:

=======  ======================================================================================
columns  meaning
=======  ======================================================================================
4        x y z intensity
6        x y z, then red green blue if these are whole numbers in 0…255, normals if within ±1
7        x y z intensity red green blue (PTS)
other    x y z first, the rest unknown
=======  ======================================================================================

A line with a single whole number before the first point is the count of a PTS file.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from pathlib import Path

from ..errors import InputError
from .columns import Table, TableSource, find_roles, guess_names
from .rows import read_rows
from .source import check_promise, foreign_errors

_HEAD_BYTES = 1 << 18
_GUESS_ROWS = 1000


class TextSource(TableSource):
    """A text file of points."""

    def __init__(self, path: Path):
        """Read the first lines. Raises InputError for binary data, or if x, y or z cannot be told."""
        self._path = path
        with foreign_errors(path):
            with path.open("rb") as file:
                head = file.read(_HEAD_BYTES)
            if b"\0" in head:
                raise InputError(f"{path}: found binary data, expected text")
            names, n_points, self._start, self._n_columns = _parse_head(path, head)
            if n_points is not None:
                check_promise(path, n_points, 2 * self._n_columns, path.stat().st_size - self._start + 1)
            if not names:
                with path.open("rb") as file:
                    file.seek(self._start)
                    rows = read_rows(path, file, self._n_columns, range(self._n_columns), _GUESS_ROWS)
                    names = guess_names(next(rows))
            self._index = {name: i for i, name in reversed(list(enumerate(names)))}
            super().__init__(names, path=path, format="text", n_points=n_points)

    def _tables(self, max_points: int, columns: Collection[str]) -> Iterator[Table]:
        columns = sorted(columns, key=self._index.__getitem__)
        wanted = [self._index[name] for name in columns]
        with self._path.open("rb") as file:
            file.seek(self._start)
            for rows in read_rows(self._path, file, self._n_columns, wanted, max_points):
                yield dict(zip(columns, rows.T, strict=True))


def _parse_head(path: Path, head: bytes) -> tuple[list[str], int | None, int, int]:
    """(names or none, count or None, byte of the first row, number of columns)."""
    names: list[str] = []
    n_points = None
    start = 3 if head.startswith(b"\xef\xbb\xbf") else 0
    for line in re.split(rb"(?<=\n)|(?<=\r)(?!\n)", head[start:]):
        fields = _fields(line)
        comment = line.lstrip()[:2] == b"//" or line.lstrip()[:1] == b"#"
        if fields and (comment or not all(map(_is_number, fields))):
            if {"x", "y", "z"} <= find_roles(fields).keys():
                names = [f for f in fields if f.strip("/#")]
            elif not comment:
                raise InputError(f"{path}: found columns {', '.join(fields)[:200]}; expected x, y and z among them")
        elif len(fields) == 1 and n_points is None and not names and fields[0].isdigit():
            n_points = int(fields[0])
        elif fields:
            return names, n_points, start, len(names) or len(fields)
        start += len(line)
    raise InputError(f"{path}: found no points, expected lines of at least three numbers")


def _fields(line: bytes) -> list[str]:
    text = line.decode("ascii", "backslashreplace").strip()
    if not text:
        return []
    if "," in text or ";" in text:
        return [field.strip() for field in re.split("[,;]", text.rstrip(",;"))]
    return text.split()


def _is_number(field: str) -> bool:
    try:
        float(field or "nan")
    except ValueError:
        return False
    return True
