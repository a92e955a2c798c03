"""E57 through pye57 (an extra): all scans of a file, each placed by its pose. Format: ASTM E2807-11.

libE57 checks every page's checksum, so damage in transit ends as an error; but it is compiled code, and a file made to
harm it (valid checksums around false contents) is not caught before it gets there.
"""

from __future__ import annotations

import importlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .columns import Table, TableSource
from .source import check_promise, foreign_errors

_SYSTEMS = {  # coordinate columns, the preferred first, and the column that marks points without coordinates
    ("cartesianX", "cartesianY", "cartesianZ"): "cartesianInvalidState",
    ("sphericalRange", "sphericalAzimuth", "sphericalElevation"): "sphericalInvalidState",
}
_NORMAL = ("nor:normalX", "nor:normalY", "nor:normalZ")
_OTHERS = ("intensity", "colorRed", "colorGreen", "colorBlue", *_NORMAL)
_MIN_POINT_BYTES = 1 / 8


class E57Source(TableSource):
    """An E57 file. Its columns are those that every scan has; points marked as invalid become NaN."""

    def __init__(self, path: Path):
        """Raises InputError if pye57 is not installed, or for a scan that is neither cartesian nor spherical."""
        self._path = path
        with foreign_errors(path):
            n_points = 0
            common = set(_OTHERS)
            with _open(path) as image:
                for scan in _scans(image):
                    fields = _fields(scan)
                    if not any(fields.issuperset(system) for system in _SYSTEMS):
                        raise InputError(f"{path}: found a scan of {sorted(fields)}, expected coordinates")
                    n_points += scan["points"].childCount()
                    common &= fields
                root = image.root()
                crs = root["coordinateMetadata"].value() if root.isDefined("coordinateMetadata") else None
            check_promise(path, n_points, _MIN_POINT_BYTES, path.stat().st_size)
            names = ["x", "y", "z", *(name for name in _OTHERS if name in common)]
            super().__init__(names, path=path, format="e57", n_points=n_points, crs=crs or None)

    def _tables(self, max_points: int, columns: Collection[str]) -> Iterator[Table]:
        with _open(self._path) as image:
            for scan in _scans(image):
                yield from _scan_tables(image, scan, max_points, columns)


def _scan_tables(image: Any, scan: Any, max_points: int, columns: Collection[str]) -> Iterator[Table]:
    points = scan["points"]
    fields = _fields(scan)
    system, invalid = next(item for item in _SYSTEMS.items() if fields.issuperset(item[0]))
    capacity = min(max_points, points.childCount())
    arrays = {name: np.empty(capacity) for name in (*system, invalid, *columns) if name in fields}
    buffers = _libe57().VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(_libe57().SourceDestBuffer(image, name, array, capacity, True, True))
    rotation, translation = _pose(scan)
    reader = points.reader(buffers)
    try:
        while n := reader.read():
            table = {name: array[:n].copy() for name, array in arrays.items()}
            xyz = np.stack([table[name] for name in system])
            if "sphericalRange" in system:
                xyz = _cartesian(*xyz)
            xyz = rotation @ xyz + translation[:, None]
            if invalid in table:
                xyz[:, table[invalid] != 0] = np.nan
            table |= dict(zip("xyz", xyz, strict=True))
            if table.keys() >= {*_NORMAL}:
                table |= dict(zip(_NORMAL, rotation @ np.stack([table[name] for name in _NORMAL]), strict=True))
            yield table
    finally:
        reader.close()


def _cartesian(distance: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """(3, n) of spherical coordinates; metres and radians (ASTM E2807-11, 8.4.4)."""
    level = distance * np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)])


def _pose(scan: Any) -> tuple[np.ndarray, np.ndarray]:
    """(3, 3) rotation and (3,) translation, world from scan; the identity where the scan has none."""
    rotation, translation = np.eye(3), np.zeros(3)
    pose = scan["pose"] if scan.isDefined("pose") else None
    if pose is not None and pose.isDefined("rotation"):
        w, x, y, z = quaternion = np.array([pose["rotation"][name].value() for name in "wxyz"])
        length = np.linalg.norm(quaternion)
        if length > 0:
            w, x, y, z = quaternion / length
            rotation = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
                ]
            )
    if pose is not None and pose.isDefined("translation"):
        translation = np.array([pose["translation"][name].value() for name in "xyz"])
    return rotation, translation


def _libe57() -> Any:
    """The module, imported when used; it is compiled and has no types."""
    return importlib.import_module("pye57.libe57")


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    try:
        image = _libe57().ImageFile(str(path), "r")
    except ModuleNotFoundError:
        raise InputError(f"{path}: reading E57 needs pye57: pip install 'splatpipe[e57]'") from None
    try:
        yield image
    finally:
        image.close()


def _scans(image: Any) -> list[Any]:
    """The scans that hold points."""
    data = image.root()["data3D"]
    return [data[i] for i in range(data.childCount()) if data[i]["points"].childCount()]


def _fields(scan: Any) -> set[str]:
    prototype = _libe57().StructureNode(scan["points"].prototype())
    return {prototype.get(i).elementName() for i in range(prototype.childCount())}
