"""Small point files of every format, written without the readers under test."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np


def write_las(path: Path, positions: np.ndarray, *, point_format: int = 3, scale: float = 0.001, **columns) -> Path:
    """LAS, or LAZ by its suffix. columns : laspy dimension → (n,) values."""
    import laspy

    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.2")
    header.offsets, header.scales = np.floor(positions.min(axis=0)), np.full(3, scale)
    las = laspy.LasData(header)
    las.xyz = positions
    for name, values in columns.items():
        las[name] = values
    las.write(str(path))
    return path


def write_ply(path: Path, elements: dict[str, np.ndarray], *, text: bool = False, order: str = "<") -> Path:
    """Structured arrays as elements, by plyfile."""
    from plyfile import PlyData, PlyElement

    described = [PlyElement.describe(array, name) for name, array in elements.items()]
    PlyData(described, text=text, byte_order=order).write(str(path))
    return path


def write_ply_lists(path: Path, elements: dict[str, np.ndarray], *, text: bool, order: str) -> Path:
    """As ``write_ply``, with object fields as lists of int32 (plyfile writes big-endian rows with lists wrongly)."""
    names = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}
    head = ["ply", f"format {'ascii' if text else {'<': 'binary_little_endian', '>': 'binary_big_endian'}[order]} 1.0"]
    body = []
    for name, array in elements.items():
        head.append(f"element {name} {len(array)}")
        for field in array.dtype.names:
            kind = array.dtype[field]
            head.append(f"property {'list uchar int' if kind.hasobject else names[kind.str[1:]]} {field}")
        for row in array:
            for field in array.dtype.names:
                kind, value = array.dtype[field], row[field]
                if text:
                    body.append(" ".join(map(str, [len(value), *value])) if kind.hasobject else str(value))
                elif kind.hasobject:
                    body.append(struct.pack(f"{order}B{len(value)}i", len(value), *value))
                else:
                    body.append(np.array(value, kind.newbyteorder(order)).tobytes())
                if text:
                    body.append("\n" if field == array.dtype.names[-1] else " ")
    data = "".join(body).encode() if text else b"".join(body)
    path.write_bytes("\n".join([*head, "end_header", ""]).encode() + data)
    return path


def write_pcd(path: Path, records: np.ndarray, encoding: str, *, width: int | None = None) -> Path:
    """A structured array; binary_compressed holds literal runs only, so also ``lzf_compress`` is used by tests."""
    names = records.dtype.names
    types = [records.dtype[name] for name in names]
    width = width or len(records)
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(str(t.base.itemsize) for t in types)}",
        f"TYPE {' '.join(t.base.kind.upper() for t in types)}",
        f"COUNT {' '.join(str(int(np.prod(t.shape))) for t in types)}",
        f"WIDTH {width}",
        f"HEIGHT {len(records) // width}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(records)}",
        f"DATA {encoding}",
    ]
    if encoding == "ascii":
        data = "\n".join(" ".join(str(v) for n in names for v in np.ravel(row[n])) for row in records).encode()
    elif encoding == "binary":
        data = records.tobytes()
    else:
        plain = b"".join(np.ascontiguousarray(records[name]).tobytes() for name in names)
        packed = lzf_compress(plain)
        data = struct.pack("<II", len(packed), len(plain)) + packed
    path.write_bytes("\n".join(header).encode() + b"\n" + data)
    return path


def lzf_compress(data: bytes) -> bytes:
    """LZF with a dictionary of three-byte groups: short, and it produces every kind of token."""
    out, literal, seen, at = bytearray(), bytearray(), {}, 0

    def flush():
        for i in range(0, len(literal), 32):
            run = literal[i : i + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literal.clear()

    while at < len(data):
        key = data[at : at + 3]
        back, seen[key] = seen.get(key), at
        if len(key) < 3 or back is None or at - back > 8192:
            literal.append(data[at])
            at += 1
            continue
        flush()
        n = 3
        while n < 264 and at + n < len(data) and data[back + n] == data[at + n]:
            n += 1
        distance = at - back - 1
        code = min(n - 2, 7)
        out.append(code << 5 | distance >> 8)
        if code == 7:
            out.append(n - 9)
        out.append(distance & 255)
        at += n
    flush()
    return bytes(out)


def write_text(path: Path, columns: np.ndarray, *, header: str = "", delimiter: str = " ") -> Path:
    """Shortest decimal numbers that read back as the same float64."""
    lines = [delimiter.join(repr(float(v)) for v in row) for row in columns]
    path.write_text("\n".join([header, *lines] if header else lines) + "\n")
    return path


def write_e57(path: Path, scans: list[dict]) -> Path:
    """scans : pye57 columns, with ``rotation`` (w, x, y, z) and ``translation``."""
    import pye57

    with pye57.E57(str(path), mode="w") as file:
        for scan in scans:
            columns = dict(scan)
            pose = {k: np.array(columns.pop(k)) for k in ("rotation", "translation")}
            file.write_scan_raw(columns, **pose)
    return path
