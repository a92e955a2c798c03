"""PLY: ASCII and both binary orders. The points are the first ``vertex`` element, wherever it stands in the file."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from .columns import Table, TableSource
from .ply_lists import ascii_rows, binary_rows
from .records import RecordSource
from .rows import read_rows, skip_rows
from .source import check_promise, foreign_errors

_HEADER_BYTES = 1 << 20
_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8", "bool"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class Element:
    """One element of the header.

    properties : (name, type, type of the length in front of a list or None), types as NumPy codes with byte order.
    """

    name: str
    count: int
    properties: list[tuple[str, str, str | None]]

    @property
    def has_lists(self) -> bool:
        """Whether rows differ in length."""
        return any(length for _, _, length in self.properties)

    @property
    def least_bytes(self) -> int:
        """Bytes of a binary row whose lists are empty."""
        return sum(np.dtype(length or kind).itemsize for _, kind, length in self.properties)


def open_ply(path: Path) -> TableSource:
    """A PLY file. Raises InputError for a malformed header, or counts that the file is too short for."""
    with foreign_errors(path):
        with path.open("rb") as file:
            head = file.read(_HEADER_BYTES)
        order, elements, start = _parse_header(path, head)
        at = next((i for i, element in enumerate(elements) if element.name == "vertex"), None)
        if at is None:
            found = ", ".join(element.name for element in elements) or "none"
            raise InputError(f"{path}: found elements {found}; expected one named vertex")
        before, vertex = [element for element in elements[:at] if element.properties], elements[at]
        size = path.stat().st_size
        for element in (*before, vertex):
            least = element.least_bytes if order else 2 * len(element.properties)
            if element.count or element is vertex:
                check_promise(path, element.count, least, size - start + (not order))
        if not order or any(element.has_lists for element in (*before, vertex)):
            return _SequentialPly(path, start, order, before, vertex)
        offset = start + sum(element.count * element.least_bytes for element in before)
        dtype = np.dtype([(name, kind) for name, kind, _ in vertex.properties])
        return RecordSource(path, offset=offset, dtype=dtype, n_points=vertex.count, format="ply")


class _SequentialPly(TableSource):
    """A file whose vertices cannot be addressed: text, or lists in or before the vertex element."""

    def __init__(self, path: Path, start: int, order: str, before: list[Element], vertex: Element):
        self._path, self._start, self._order, self._before, self._vertex = path, start, order, before, vertex
        names = [name for name, _, length in vertex.properties if not length]
        super().__init__(names, path=path, format="ply", n_points=vertex.count)

    def _tables(self, max_points: int, columns: Collection[str]) -> Iterator[Table]:
        with self._path.open("rb") as file:
            file.seek(self._start)
            if self._order:
                for element in self._before:
                    for _ in binary_rows(self._path, file, element.count, element.properties, max_points):
                        pass
                yield from binary_rows(self._path, file, self._vertex.count, self._vertex.properties, max_points)
                return
            skip_rows(file, sum(element.count for element in self._before))
            if self._vertex.has_lists:
                yield from ascii_rows(self._path, file, self._vertex.count, self._vertex.properties, max_points)
                return
            index = {name: i for i, (name, _, _) in enumerate(self._vertex.properties)}
            wanted = [index[name] for name in columns]
            for rows in read_rows(self._path, file, len(index), wanted, max_points, self._vertex.count):
                yield dict(zip(columns, rows.T, strict=True))


def _parse_header(path: Path, head: bytes) -> tuple[str, list[Element], int]:
    """(byte order, or nothing for ASCII; elements; byte where the data starts)."""
    end = re.search(rb"^end_header[ \t]*(\r\n|\n|\r)", head, re.MULTILINE) or re.search(
        rb"(?<=\r)end_header[ \t]*(\r)", head
    )
    if end is None:
        raise InputError(f"{path}: truncated or damaged: found no end_header in the first {len(head)} bytes")
    order, elements = None, []
    for line in head[: end.start()].decode("ascii", "backslashreplace").splitlines()[1:]:
        match line.split():
            case ["format", name, *_] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isdigit() and len(count) < 20:
                elements.append(Element(name, int(count), []))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= _TYPES.keys():
                _add(path, elements[-1], name, (order or "") + _TYPES[kind], (order or "") + _TYPES[length])
            case ["property", kind, name] if elements and kind in _TYPES:
                _add(path, elements[-1], name, (order or "") + _TYPES[kind], None)
            case [] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                raise InputError(f"{path}: found header line {line[:80]!r}, expected a PLY format, element or property")
    if order is None:
        raise InputError(f"{path}: found no format line, expected one of {', '.join(_ORDERS)}")
    return order, elements, end.end()


def _add(path: Path, element: Element, name: str, kind: str, length: str | None) -> None:
    if any(name == known for known, _, _ in element.properties):
        raise InputError(f"{path}: found property {name} twice in element {element.name}")
    element.properties.append((name, kind, length))
