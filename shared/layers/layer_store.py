"""A layer on disk: a directory of ``.npy`` arrays of records, and ``layer.json``.

====================  =====================  ==========================================================
file                  records                content
====================  =====================  ==========================================================
objects.npy           the kind's OBJECT      (n,) in the order of their octree
elements.npy          the kind's ELEMENT     (m,), only for kinds that have it
first_element.npy     int64                  (n + 1,), likewise
layer.json                                   kind, origin, counts, parameters, checksums; written last
====================  =====================  ==========================================================

The octree is not stored: every rank that needs it makes it from the boxes, so there is nothing in it to be believed.
"""

from __future__ import annotations

import json
import math
import shutil
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ..array_source import data_offset
from ..errors import InputError, StoreError
from ..files import disk_error
from .kinds import KINDS
from .layer import Layer, check_layer

LAYER_FILE = "layer.json"
FORMAT_VERSION = 1
_MAX_BYTES = 1 << 24


def write_layer(layer: Layer, out: Path, *, overwrite: bool = False) -> None:
    """Write a layer to the directory ``out``, whole or not at all.

    Raises InputError if ``out`` exists and is no layer or must not be replaced, or cannot be written.
    """
    if out.exists() and not (out / LAYER_FILE).is_file():
        raise InputError(f"{out}: exists and is not a layer, expected a new name or a layer")
    if out.exists() and not overwrite:
        raise InputError(f"{out}: the layer exists, expected a new name or --overwrite")
    partial = out.with_name(f".{out.name}.partial")
    arrays = {"objects": layer.objects}
    if KINDS[layer.kind].ELEMENT is not None:
        arrays |= {"elements": layer.elements, "first_element": layer.first_element.astype("<i8")}
    lower, upper = layer.bounds
    content = {
        "format_version": FORMAT_VERSION,
        "name": layer.name,
        "kind": layer.kind,
        "origin": layer.origin.tolist(),
        "lower": lower.min(axis=0).tolist(),
        "upper": upper.max(axis=0).tolist(),
        "parameters": layer.parameters,
        "arrays": {name: {"n": len(a), "crc32": _crc(a)} for name, a in arrays.items()},
    }
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        for name, array in arrays.items():
            np.save(partial / f"{name}.npy", np.ascontiguousarray(array), allow_pickle=False)
        (partial / LAYER_FILE).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        if out.exists():
            shutil.rmtree(out)
        partial.rename(out)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise disk_error(error, out) from error


def open_layer(path: str | Path) -> Layer:
    """The layer in directory ``path``, checked in full. Raises StoreError, InputError naming file and attribute."""
    path = Path(path)
    content = _content(path / LAYER_FILE)
    kind = KINDS[content["kind"]]
    promised = content["arrays"]
    names = {"objects"} if kind.ELEMENT is None else {"objects", "elements", "first_element"}
    if set(promised) != names:
        raise StoreError(f"{path / LAYER_FILE}: arrays: found {sorted(promised)}, expected {sorted(names)}")
    objects = _load(path / "objects.npy", kind.OBJECT, promised["objects"])
    if kind.ELEMENT is None:
        elements, first = np.empty(0, np.uint8), np.zeros(len(objects) + 1, np.int64)
    else:
        elements = _load(path / "elements.npy", kind.ELEMENT, promised["elements"])
        first = _load(path / "first_element.npy", np.dtype("<i8"), promised["first_element"])
        whole = len(first) == len(objects) + 1 and first[0] == 0 and first[-1] == len(elements)
        if not whole or (np.diff(first) < 0).any():
            raise StoreError(f"{path}/first_element.npy: not ascending from 0 to {len(elements)}")
    layer = Layer(
        content["name"], content["kind"], np.array(content["origin"]), objects, elements, first, content["parameters"]
    )
    check_layer(layer)
    return layer


def _content(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise StoreError(f"{path}: found {path.stat().st_size} bytes, expected at most {_MAX_BYTES}")
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise StoreError(f"{path.parent}: not a layer: {path.name} not found") from None
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(content, dict) or content.get("format_version") != FORMAT_VERSION:
        raise StoreError(f"{path}: expected an object with format_version = {FORMAT_VERSION}")
    for key, holds, expected in (
        ("name", lambda v: isinstance(v, str), "a text"),
        ("kind", lambda v: v in KINDS, f"one of {', '.join(KINDS)}"),
        ("origin", _is_point, "three finite numbers"),
        ("lower", _is_point, "three finite numbers"),
        ("upper", _is_point, "three finite numbers"),
        ("parameters", lambda v: isinstance(v, dict), "an object"),
        ("arrays", _are_arrays, "objects of n and crc32"),
    ):
        if key not in content or not holds(content[key]):
            raise StoreError(f"{path}: {key} = {str(content.get(key))[:80]}, expected {expected}")
    return content


def _is_point(value: Any) -> bool:
    return (
        isinstance(value, list) and len(value) == 3 and all(type(v) in (int, float) and math.isfinite(v) for v in value)
    )


def _are_arrays(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(a, dict) and all(type(a.get(k)) is int and 0 <= a[k] < 1 << 40 for k in ("n", "crc32"))
        for a in value.values()
    )


def _load(path: Path, dtype: np.dtype, promised: dict[str, int]) -> np.ndarray:
    """An array that is what ``layer.json`` promises: header and size are held against it before anything is read."""
    offset = data_offset(path, dtype, (promised["n"],), "layer")
    array = np.fromfile(path, dtype, promised["n"], offset=offset)
    if _crc(array) != promised["crc32"]:
        raise StoreError(f"{path}: checksum {_crc(array):08x}, expected {promised['crc32']:08x}: the file is damaged")
    return array


def _crc(array: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(array).view(np.uint8).data)
