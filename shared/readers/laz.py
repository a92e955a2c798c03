"""The compressed point records of LAZ and COPC files: lazrs behind checks of every length it would believe.

lazrs allocates what a file's tables promise, and an allocation that fails ends the process; so the chunk table, and for
layered compression (point formats 6 and up) the layer sizes of each chunk, are held against the file's size first.
Layout: Isenburg, "LASzip: lossless compression of LiDAR data" (2013) and the LAZ specification 1.4, section 4.
"""

from __future__ import annotations

import importlib
import struct
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..errors import InputError

_POINTWISE, _CHUNKED, _LAYERED = 1, 2, 3
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # item type → layers: point14, rgb14, rgb-nir14, wave packet14
_BYTES14 = 14  # one layer a byte
_ENDLESS_CHUNK = 0xFFFF_FFFE
_MAX_CHUNK_POINTS = 1 << 24  # the parallel decompressor holds whole chunks; writers use 50 000
PART_CHUNK_POINTS = 50_000
"""Points of a chunk as nearly all writers make them: what starts inside one has it decompressed for a part of it."""


class LazRecords:
    """The point records of a compressed file.

    file : open file; it must live as long as this object.  header : laspy.LasHeader.  dtype : of a record.
    attributes : columns to decompress besides the positions; the others are left as they come (point formats 6 and up).
    parallel : decompress the chunks of one call on all cores; such an object only reads on (seeking into the last
        of several variable-size chunks fails in lazrs 0.8).
    Raises InputError if the compression record or the chunk table contradicts the header or the file's size.
    """

    def __init__(
        self,
        path: Path,
        file: BinaryIO,
        header: Any,
        dtype: np.dtype,
        *,
        attributes: Collection[str],
        parallel: bool,
    ):
        record = _compression_record(path, header, dtype)
        self.can_seek = _compressor(record) != _POINTWISE
        if self.can_seek:
            largest = _check_chunks(path, file, header, record)
            parallel = parallel and largest <= _MAX_CHUNK_POINTS
        else:  # one stream without chunks, which lazrs reads as one chunk that never ends
            record = record[:12] + struct.pack("<I", _ENDLESS_CHUNK) + record[16:]
            parallel = False
        file.seek(header.offset_to_point_data)
        lazrs = _lazrs()
        decompressor = lazrs.ParLasZipDecompressor if parallel else lazrs.LasZipDecompressor
        self._decompressor = decompressor(file, record, _selection(attributes))

    def seek(self, point: int) -> None:
        """The next record to be read; where ``can_seek``."""
        self._decompressor.seek(point)

    def read_into(self, out: np.ndarray) -> None:
        """Fill (n,) records. Raises lazrs.LazrsError where the compressed data ends early or makes no sense."""
        self._decompressor.decompress_many(out.view(np.uint8))


class LazChunks:
    """The point records of a compressed file that has chunks, from any point on.

    lazrs 0.8 cannot seek among chunks of several sizes, those of COPC; here whole chunks are read by the chunk table,
    those that a call needs side by side.
    file, header, dtype, attributes : as for ``LazRecords``.  Memory: the chunks of one call, at most 2²⁴ points each.
    """

    def __init__(self, path: Path, file: BinaryIO, header: Any, dtype: np.dtype, *, attributes: Collection[str]):
        self._path, self._file, self._selection = path, file, _selection(attributes)
        self._record = _compression_record(path, header, dtype)
        largest = _check_chunks(path, file, header, self._record)
        if largest > _MAX_CHUNK_POINTS:
            raise InputError(f"{path}: found a chunk of {largest} points, expected at most {_MAX_CHUNK_POINTS}")
        file.seek(header.offset_to_point_data)
        self._chunks = _lazrs().read_chunk_table(file, _lazrs().LazVlr(self._record))
        n_points, n_bytes = np.array(self._chunks, np.int64).reshape(-1, 2).T
        self._first_point = np.concatenate([[0], np.cumsum(n_points)])
        self._first_byte = header.offset_to_point_data + 8 + np.concatenate([[0], np.cumsum(n_bytes)])
        self._held, self._first_held = np.empty(0, dtype), 0
        self._next, self._end = 0, header.point_count

    def seek(self, point: int) -> None:
        """The next record to be read."""
        self._next = point

    def read_into(self, out: np.ndarray) -> None:
        """Fill (n,) records. Raises lazrs.LazrsError where the compressed data makes no sense."""
        while len(out):
            at = self._next - self._first_held
            if not 0 <= at < len(self._held):
                self._decompress(self._next, min(self._next + len(out), self._end))
                at = self._next - self._first_held
            n = min(len(out), len(self._held) - at)
            out[:n] = self._held[at : at + n]
            out, self._next = out[n:], self._next + n

    def _decompress(self, first: int, last: int) -> None:
        """Hold the chunks of the points ``first`` … ``last`` − 1."""
        begin = int(np.searchsorted(self._first_point, first, side="right")) - 1
        end = int(np.searchsorted(self._first_point, last, side="left"))
        self._file.seek(int(self._first_byte[begin]))
        packed = self._file.read(int(self._first_byte[end] - self._first_byte[begin]))
        self._first_held = int(self._first_point[begin])
        self._held = np.empty(min(int(self._first_point[end]), self._end) - self._first_held, self._held.dtype)
        sizes = list(self._chunks[begin:end])
        n, n_bytes = sizes[-1]  # the last one of a file may hold fewer points than the table says
        sizes[-1] = (min(n, self._end - int(self._first_point[end - 1])), n_bytes)
        _lazrs().decompress_points_with_chunk_table(
            packed, self._record, self._held.view(np.uint8), sizes, self._selection
        )


def has_chunks(header: Any) -> bool:
    """Whether ``LazChunks`` can read a compressed file."""
    records = header.vlrs.get("LasZipVlr")
    return bool(records) and _compressor(bytes(records[0].record_data)) != _POINTWISE


def _selection(attributes: Collection[str]) -> Any:
    """What lazrs is to decompress: positions, and the layers of these attributes."""
    lazrs = _lazrs()
    layers = lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL | lazrs.SELECTIVE_DECOMPRESS_Z
    for attribute in attributes:
        layers |= getattr(lazrs, f"SELECTIVE_DECOMPRESS_{attribute.upper()}", 0)
    return lazrs.DecompressionSelection(layers)


def _lazrs() -> Any:
    """The module, imported when used; it is compiled and has no types."""
    return importlib.import_module("lazrs")


def _compression_record(path: Path, header: Any, dtype: np.dtype) -> bytes:
    records = header.vlrs.get("LasZipVlr")
    if not records:
        raise InputError(f"{path}: damaged: found no LASzip record, expected one in a compressed file")
    record = bytes(records[0].record_data)
    if len(record) < 34 or _compressor(record) not in (_POINTWISE, _CHUNKED, _LAYERED):
        raise InputError(f"{path}: damaged: the LASzip record is cut or names an unknown compressor")
    item_bytes = _lazrs().LazVlr(record).item_size()
    if item_bytes != dtype.itemsize:
        raise InputError(f"{path}: damaged: found compressed records of {item_bytes} bytes, expected {dtype.itemsize}")
    return record


def _check_chunks(path: Path, file: BinaryIO, header: Any, record: bytes) -> int:
    """Points of the largest chunk. Raises InputError where a length does not fit."""
    start = header.offset_to_point_data
    size = file.seek(0, 2)
    damaged = InputError(f"{path}: truncated or damaged: the chunk table does not fit the file's {size} bytes")
    table = _table_offset(file, start, size)
    if not start + 8 <= table <= size - 8:
        raise damaged
    file.seek(table)
    _, n_chunks = struct.unpack("<II", file.read(8))
    item_bytes = _lazrs().LazVlr(record).item_size()
    if n_chunks * item_bytes > size - start:  # a chunk starts with one raw record
        raise damaged
    file.seek(start)
    chunks = _lazrs().read_chunk_table(file, _lazrs().LazVlr(record))
    if sum(n_bytes for _, n_bytes in chunks) > size - start:
        raise damaged
    n_points = sum(n for n, _ in chunks)
    if n_points < header.point_count:
        raise InputError(
            f"{path}: truncated or damaged: found chunks for {n_points} points, expected the {header.point_count} of "
            "its header"
        )
    if _compressor(record) == _LAYERED:
        at = start + 8
        head = struct.Struct(f"<{item_bytes}xI{_layer_count(record)}I")  # first record, points, bytes of each layer
        for n, n_bytes in chunks:
            file.seek(at)
            counts = head.unpack(file.read(head.size).ljust(head.size, b"\xff"))
            if counts[0] > n or head.size + sum(counts[1:]) != n_bytes:
                raise damaged
            at += n_bytes
    return max((n for n, _ in chunks), default=0)


def _table_offset(file: BinaryIO, start: int, size: int) -> int:
    """Where the chunk table is; a writer that could not seek back left the place in the last eight bytes."""
    if size < start + 8:
        return -1
    file.seek(start)
    (offset,) = struct.unpack("<q", file.read(8))
    if offset == -1:
        file.seek(size - 8)
        (offset,) = struct.unpack("<q", file.read(8))
    return offset


def _compressor(record: bytes) -> int:
    return struct.unpack_from("<H", record)[0]


def _layer_count(record: bytes) -> int:
    (n_items,) = struct.unpack_from("<H", record, 32)
    items = [struct.unpack_from("<HHH", record, 34 + 6 * i) for i in range(n_items)]
    return sum(size if kind == _BYTES14 else _LAYERS.get(kind, 0) for kind, size, _ in items)
