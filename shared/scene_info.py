"""``scene.json``: what a scene says of itself, and the checks before any of it is believed."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from .codecs import MAX_BITS, MAX_STREAM_BITS
from .codecs.positions import most_position_bits
from .errors import StoreError
from .points import ATTRIBUTES

FORMAT_VERSION = 3
SCENE_FILE = "scene.json"
POINT_ORDERS = ("layered", "depth-first")
POSITIONS = ("float32", "ci", "eci", "occupancy", "groups")
"""Forms in which the positions of a scene may be stored: three columns, or one of ``codecs`` cell by cell."""
UP_AXES = ("x", "y", "z", "-x", "-y", "-z", "auto")
CELL_ARRAYS = {
    "cell_level": np.dtype("u1"),
    "cell_code": np.dtype("<u8"),
    "cell_parent": np.dtype("<i4"),
    "cell_first_child": np.dtype("<i4"),
    "cell_n_children": np.dtype("u1"),
    "cell_first_point": np.dtype("<i8"),
    "cell_n_points": np.dtype("<i8"),
    "cell_n_below": np.dtype("<i8"),
    "cell_cone": np.dtype("<f4"),
    "cell_area": np.dtype("<f4"),
    "cell_feature": np.dtype("u1"),
    "cell_quad": np.dtype("<f4"),
    "cell_position_bytes": np.dtype("<u4"),
    "cell_pool_points": np.dtype("<u4"),
    "cell_pool_bytes": np.dtype("<u4"),
}
_NEWER_KEYS = {
    2: ("features",),
    3: ("positions", "position_bits", "position_bytes", "pool_bits", "pool_bytes"),
}
"""Keys that came with a format version; in older scenes they have their defaults."""
_ROW_SHAPES = {"cell_cone": (4,), "cell_quad": (3, 3)}
MAX_INFO_BYTES = 1 << 26
"""Longest ``scene.json`` that is read."""


@dataclass(frozen=True)
class ArrayInfo:
    """One array as ``scene.json`` promises it. crc32 : of the data bytes, the header left out."""

    dtype: str
    shape: tuple[int, ...]
    bytes: int
    crc32: int


@dataclass(frozen=True)
class SourceCount:
    """An input file: its base name and the points it gave, dropped ones left out."""

    name: str
    n_points: int


@dataclass(frozen=True)
class SceneInfo:
    """What ``scene.json`` holds.

    origin, edge : the root cube.  lower, upper : tight bounds of the input points; world frame.
    n_points : input points.  n_stored : points in the point-array, level-of-detail copies included.
    n_dropped : input points left out because a coordinate was not finite.
    block_levels : in layered order, the points of a cell are relative to the centre of its ancestor this many levels
        above; 0 in depth-first order, where blocks are cells of up to 2048 points or leaves.
    features : whether cells say what their points look like (``cell_feature``, ``cell_quad``).
    positions : form of the positions, one of ``POSITIONS``.  position_bits : bits an axis of the grid in each cell's
        cube; 0 for float32.  position_bytes : length of ``position_codes``; 0 for float32.
    pool_bits : bits an axis of the pooled form that cells have beside their points; 0 where none was built.
    pool_bytes : length of ``pool_codes``.
    up : the axis that points up, one of ``UP_AXES``.  crs : well-known text, or None.
    build : the settings the scene was built with.
    """

    point_order: str
    origin: tuple[float, float, float]
    edge: float
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    n_points: int
    n_stored: int
    n_cells: int
    n_blocks: int
    n_dropped: int
    attributes: tuple[str, ...]
    block_levels: int
    up: str
    crs: str | None
    sources: tuple[SourceCount, ...]
    build: dict[str, Any]
    arrays: dict[str, ArrayInfo]
    features: bool = False
    positions: str = "float32"
    position_bits: int = 0
    position_bytes: int = 0
    pool_bits: int = 0
    pool_bytes: int = 0
    format_version: int = FORMAT_VERSION

    @property
    def splats(self) -> bool:
        """Whether points have what splats need: normals and radii."""
        return {"normal", "radius"} <= set(self.attributes)

    @property
    def coded(self) -> bool:
        """Whether positions are in the form of a codec."""
        return self.positions != "float32"

    @property
    def position_arrays(self) -> tuple[str, ...]:
        """The arrays that hold the positions of points."""
        return ("position_codes",) if self.coded else ("x", "y", "z")

    def to_json(self) -> str:
        """The text of ``scene.json``."""
        return json.dumps(asdict(self), indent=1, allow_nan=False) + "\n"


def parse_info(path: Path) -> SceneInfo:
    """The checked content of a ``scene.json``.

    Raises StoreError if it is missing, not JSON, of a newer version, or a key is missing or of the wrong kind.
    """
    try:
        if path.stat().st_size > MAX_INFO_BYTES:
            raise StoreError(f"{path}: found {path.stat().st_size} bytes, expected at most {MAX_INFO_BYTES}")
        text = path.read_bytes()
    except FileNotFoundError:
        raise StoreError(f"{path.parent}: not a scene: {path.name} not found") from None
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {error.strerror}") from error
    return info_from_json(text, path)


def info_from_json(text: bytes, path: Path) -> SceneInfo:
    """The checked content of the text of a ``scene.json``; ``path`` is what errors call it. Raises StoreError."""
    try:
        content = json.loads(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(content, dict):
        raise StoreError(f"{path}: found {type(content).__name__}, expected an object")
    version = content.get("format_version")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise StoreError(f"{path}: format_version = {version!r}, expected a whole number ≥ 1")
    if version > FORMAT_VERSION:
        raise StoreError(
            f"{path}: format_version = {version}, this splatpipe reads up to {FORMAT_VERSION}: "
            "upgrade splatpipe, or build the scene again"
        )
    for newer in (key for since, keys in _NEWER_KEYS.items() if version < since for key in keys):
        content[newer] = SceneInfo.__dataclass_fields__[newer].default
    for field in fields(SceneInfo):
        if field.name not in content:
            raise StoreError(f"{path}: {field.name} not found")
    for key, (accepts, expected) in _RULES.items():
        if not accepts(content[key]):
            raise StoreError(f"{path}: {key} = {str(content[key])[:80]}, expected {expected}")
    known = {field.name for field in fields(SceneInfo)}
    values = {key: value for key, value in content.items() if key in known}
    for key in ("origin", "lower", "upper", "attributes"):
        values[key] = tuple(values[key])
    values["sources"] = tuple(SourceCount(s["name"], s["n_points"]) for s in values["sources"])
    values["arrays"] = {
        name: ArrayInfo(a["dtype"], tuple(a["shape"]), a["bytes"], a["crc32"]) for name, a in values["arrays"].items()
    }
    info = SceneInfo(**values)
    _check_positions(path, info)
    _check_arrays(path, info)
    return info


def _check_positions(path: Path, info: SceneInfo) -> None:
    most_bits = most_position_bits(info.positions) if info.coded else 0
    if not min(1, most_bits) <= info.position_bits <= most_bits:
        expected = f"1 … {most_bits}" if info.coded else "0"
        raise StoreError(f"{path}: position_bits = {info.position_bits} of {info.positions}, expected {expected}")
    if info.coded != (info.position_bytes > 0):
        expected = "a whole number > 0" if info.coded else "0"
        raise StoreError(f"{path}: position_bytes = {info.position_bytes} of {info.positions}, expected {expected}")


def expected_arrays(info: SceneInfo) -> dict[str, tuple[np.dtype, tuple[int, ...]]]:
    """(dtype, shape) of each array that a scene of these counts and attributes has."""
    expected: dict[str, tuple[np.dtype, tuple[int, ...]]] = {}
    present = {
        "cell_cone": "normal" in info.attributes,
        "cell_area": info.point_order == "layered" and info.format_version >= 2,
        "cell_feature": info.features,
        "cell_quad": info.features,
        "cell_position_bytes": info.coded,
        "cell_pool_points": info.pool_bits > 0,
        "cell_pool_bytes": info.pool_bits > 0,
    }
    for name, dtype in CELL_ARRAYS.items():
        if present.get(name, True):
            expected[name] = (dtype, (info.n_cells, *_ROW_SHAPES.get(name, ())))
    for name in info.position_arrays:
        expected[name] = (np.dtype("u1"), (info.position_bytes,)) if info.coded else (np.dtype("<f4"), (info.n_stored,))
    if info.pool_bits:
        expected["pool_codes"] = (np.dtype("u1"), (info.pool_bytes,))
    for name in info.attributes:
        expected[f"attr_{name}"] = (ATTRIBUTES[name], (info.n_stored,))
    expected["block_first_point"] = (np.dtype("<i8"), (info.n_blocks,))
    expected["block_origin"] = (np.dtype("<f8"), (info.n_blocks, 3))
    return expected


def _check_arrays(path: Path, info: SceneInfo) -> None:
    expected = expected_arrays(info)
    if set(expected) != set(info.arrays):
        odd = sorted(set(expected) ^ set(info.arrays))[0]
        raise StoreError(f"{path}: arrays: {odd} is {'missing' if odd in expected else 'unknown'}")
    for name, (dtype, shape) in expected.items():
        found = info.arrays[name]
        if found.dtype != dtype.str or found.shape != shape:
            raise StoreError(f"{path}: array {name}: found {found.dtype} {found.shape}, expected {dtype.str} {shape}")
        if found.bytes != math.prod(shape) * dtype.itemsize:
            raise StoreError(
                f"{path}: array {name}: found {found.bytes} bytes, expected {math.prod(shape) * dtype.itemsize}"
            )


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 62


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _is_point(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(_is_number(v) for v in value)


def _is_array_info(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and isinstance(value.get("dtype"), str)
        and isinstance(value.get("shape"), list)
        and all(_is_count(n) for n in value["shape"])
        and _is_count(value.get("bytes"))
        and _is_count(value.get("crc32"))
    )


def _is_source(value: Any) -> bool:
    return isinstance(value, dict) and isinstance(value.get("name"), str) and _is_count(value.get("n_points"))


_POSITIVE = (lambda v: _is_count(v) and v > 0, "a whole number > 0")
_COUNT = (_is_count, "a whole number ≥ 0")
_POINT = (_is_point, "three finite numbers")
_RULES = {
    "point_order": (lambda v: v in POINT_ORDERS, f"one of {', '.join(POINT_ORDERS)}"),
    "origin": _POINT,
    "edge": (lambda v: _is_number(v) and v > 0, "a number > 0"),
    "lower": _POINT,
    "upper": _POINT,
    "n_points": _POSITIVE,
    "n_stored": _POSITIVE,
    "n_cells": _POSITIVE,
    "n_blocks": _POSITIVE,
    "n_dropped": _COUNT,
    "attributes": (
        lambda v: isinstance(v, list) and len(set(map(str, v))) == len(v) and set(map(str, v)) <= set(ATTRIBUTES),
        f"different names of {', '.join(ATTRIBUTES)}",
    ),
    "block_levels": _COUNT,
    "features": (lambda v: isinstance(v, bool), "true or false"),
    "positions": (lambda v: v in POSITIONS, f"one of {', '.join(POSITIONS)}"),
    "position_bits": (lambda v: _is_count(v) and v <= MAX_BITS, f"a whole number up to {MAX_BITS}"),
    "position_bytes": _COUNT,
    "pool_bits": (lambda v: _is_count(v) and v <= MAX_STREAM_BITS, f"a whole number up to {MAX_STREAM_BITS}"),
    "pool_bytes": _COUNT,
    "up": (lambda v: v in UP_AXES, f"one of {', '.join(UP_AXES)}"),
    "crs": (lambda v: v is None or isinstance(v, str), "a text or null"),
    "sources": (lambda v: isinstance(v, list) and all(_is_source(s) for s in v), "a list of name and n_points"),
    "build": (lambda v: isinstance(v, dict), "an object"),
    "arrays": (
        lambda v: isinstance(v, dict) and all(_is_array_info(a) for a in v.values()),
        "objects of dtype, shape, bytes and crc32",
    ),
}
