"""LAS, LAZ and COPC: laspy reads the header, the point records are read here.

A record has a fixed number of bytes, so a block of them is one read into a buffer that stays in the cache. Positions
and colours are taken out of it by compiled loops, which leave the interpreter lock to the thread that takes the points
on (with NumPy alone that thread waited for it half the time); the plain columns by NumPy. Points come in file order;
the hierarchy of a COPC file is not used.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numba import njit

from ..errors import InputError
from ..points import ATTRIBUTES, PointBatch
from .columns import ColourRange
from .laz import PART_CHUNK_POINTS, LazChunks, LazRecords, has_chunks
from .records import BLOCK_POINTS, Records, sample_records
from .source import Source, SourceInfo, check_promise, foreign_errors

logging.getLogger("laspy").addHandler(logging.NullHandler())  # what it complains of is raised here, once

_VLR_HEADER_BYTES = 54
_RGB = ("red", "green", "blue")


class LasSource(Source):
    """A LAS, LAZ or COPC file."""

    def __init__(self, path: Path):
        """Read the header and a sample of the colours, and hold the promised count against the file's size."""
        import laspy

        with foreign_errors(path), path.open("rb") as file:
            size = _check_header(path, file)
            self._header = header = laspy.LasHeader.read_from(file, read_evlrs=False)
            self._dtype = np.dtype(header.point_format.dtype())
            self._names = self._dtype.names or ()
            record_bytes = 0 if header.are_points_compressed else self._dtype.itemsize
            check_promise(path, header.point_count, record_bytes, size - header.offset_to_point_data)
            present = {"intensity", "classification", "return_number"} | {"gps_time"} & {*self._names}
            if "red" in self._names:
                records = self._records(path, file, ["rgb"], parallel=False)
                sample = sample_records(records, header.point_count, self._dtype)
                self._colours = ColourRange.of(*(sample[channel] for channel in _RGB))
                present |= {"rgb"} if self._colours.present else set()
            self.info = SourceInfo(
                path=path,
                format=_format(header),
                n_points=header.point_count,
                attributes=tuple(a for a in ATTRIBUTES if a in present),
                lower=np.array(header.mins, np.float64),
                upper=np.array(header.maxs, np.float64),
                crs=_well_known_text(header),
            )
            if not header.are_points_compressed:
                self.part_points = 1
            elif has_chunks(header):
                self.part_points = PART_CHUNK_POINTS

    def _records(
        self, path: Path, file: BinaryIO, attributes: Collection[str], *, parallel: bool
    ) -> Records | LazRecords:
        if self._header.are_points_compressed:
            return LazRecords(path, file, self._header, self._dtype, attributes=attributes, parallel=parallel)
        return Records(path, file, self._header.offset_to_point_data, self._dtype)

    def _read(self, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        with self.info.path.open("rb") as file:
            records = self._records(self.info.path, file, attributes, parallel=True)
            yield from self._batches(records, self._header.point_count, max_points, attributes)

    def _read_part(self, first: int, last: int, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        with self.info.path.open("rb") as file:
            if self._header.are_points_compressed:
                records = LazChunks(self.info.path, file, self._header, self._dtype, attributes=attributes)
            else:
                records = self._records(self.info.path, file, attributes, parallel=True)
            records.seek(first)
            yield from self._batches(records, last - first, max_points, attributes)

    def _batches(
        self, records: Records | LazRecords | LazChunks, n_points: int, max_points: int, attributes: tuple[str, ...]
    ) -> Iterator[PointBatch]:
        # lazrs works on the chunks of one call in parallel, so it is given a whole batch at a time
        step = BLOCK_POINTS if isinstance(records, Records) else max_points
        buffer = np.empty(min(step, max_points, n_points), self._dtype)
        for first in range(0, n_points, max_points):
            n = min(max_points, n_points - first)
            batch = PointBatch(np.empty((n, 3)), {a: np.empty(n, ATTRIBUTES[a]) for a in attributes})
            for i in range(0, n, len(buffer)):
                block = buffer[: n - i]
                records.read_into(block)
                for j in range(0, len(block), BLOCK_POINTS):
                    self._unpack(block[j : j + BLOCK_POINTS], batch, i + j)
            yield batch

    def _unpack(self, records: np.ndarray, batch: PointBatch, first: int) -> None:
        """Write the columns of (n,) records into rows ``first`` … of ``batch``."""
        rows = slice(first, first + len(records))
        data = records.view(np.uint8).reshape(len(records), -1)
        scales, offsets = (np.asarray(v, np.float64) for v in (self._header.scales, self._header.offsets))
        _unpack_positions(data, self._byte("X"), scales, offsets, batch.positions[rows])
        for attribute, column in batch.attributes.items():
            match attribute:
                case "rgb":
                    _unpack_rgb(data, self._byte("red"), self._colours.factor, column[rows])
                case "classification" if "raw_classification" in self._names:
                    column[rows] = records["raw_classification"] & 31  # the upper bits are flags
                case "return_number":
                    column[rows] = records["bit_fields"] & (7 if self._header.point_format.id < 6 else 15)
                case _:
                    column[rows] = records[attribute]

    def _byte(self, name: str) -> int:
        """Where a field stands in a record."""
        fields: Any = self._dtype.fields
        return fields[name][1]


@njit(nogil=True, cache=True)
def _unpack_positions(data, at, scales, offsets, positions):
    """Scale the three int32 from byte ``at`` of each of (n,) records ((n, record bytes) uint8) to (n, 3) float64."""
    for i in range(len(data)):
        for axis in range(3):
            b = at + 4 * axis
            whole = np.int32(data[i, b]) | np.int32(data[i, b + 1]) << 8
            whole |= np.int32(data[i, b + 2]) << 16 | np.int32(data[i, b + 3]) << 24
            positions[i, axis] = np.int32(whole) * scales[axis] + offsets[axis]


@njit(nogil=True, cache=True)
def _unpack_rgb(data, at, factor, words):
    """Pack the three uint16 from byte ``at`` of each record, scaled by a ``ColourRange.factor``, to colour words."""
    for i in range(len(data)):
        word = np.uint32(255)
        for channel in range(2, -1, -1):
            b = at + 2 * channel
            if factor < 1:  # 1/256: the upper byte
                value = np.uint32(data[i, b + 1])
            else:  # 1 or 255: whole numbers
                value = np.uint32(min((np.uint32(data[i, b + 1]) << 8 | np.uint32(data[i, b])) * factor, 255.0))
            word = np.uint32(word << 8 | value)
        words[i] = word


def _check_header(path: Path, file: BinaryIO) -> int:
    """The file's bytes, if the lengths that laspy is going to believe fit into them."""
    size = file.seek(0, 2)
    file.seek(0)
    head = file.read(227)
    file.seek(0)
    if len(head) < 227:
        raise InputError(f"{path}: truncated: found {len(head)} bytes, expected a LAS header of 227 or more")
    header_bytes, offset, n_vlrs = struct.unpack_from("<HII", head, 94)
    if not header_bytes <= offset <= size:
        raise InputError(
            f"{path}: truncated or damaged: the header puts the points at byte {offset}, found {size} bytes"
        )
    if n_vlrs * _VLR_HEADER_BYTES > offset - header_bytes:
        raise InputError(
            f"{path}: damaged: the header promises {n_vlrs} variable-length records, found {offset - header_bytes} "
            "bytes for them"
        )
    return size


def _format(header: Any) -> str:
    if not header.are_points_compressed:
        return "las"
    return "copc" if any(v.user_id == "copc" and v.record_id == 1 for v in header.vlrs) else "laz"


def _well_known_text(header: Any) -> str | None:
    """The coordinate reference system, if a record holds it as text (GeoTIFF keys are passed over)."""
    records = header.vlrs.get("WktCoordinateSystemVlr")
    return records[0].string.rstrip("\0") or None if records else None
