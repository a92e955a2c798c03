"""GeoJSON (RFC 7946, and its forerunner of 2008 with ``crs``): polygons and their properties."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from .footprints import Footprint, Footprints
from .json_file import expect_list, numbers, wrong

TYPES = ("FeatureCollection", "Feature", "Polygon", "MultiPolygon", "GeometryCollection")
"""Values of ``type`` that a file may have."""

_OTHERS = ("Point", "MultiPoint", "LineString", "MultiLineString")


def read_geojson(path: Path, content: dict[str, Any]) -> Footprints:
    """A footprint a feature with polygons; other geometry is left out, and counted.

    Where positions have a height, the least of a feature is its lower end. Raises InputError naming the entry.
    """
    left_out: Counter[str] = Counter()
    found = []
    kind = content.get("type")
    if kind == "FeatureCollection":
        features = expect_list(path, "features", content.get("features"), "a list of features")
        named = [(f"features[{i}]", f) for i, f in enumerate(features)]
    elif kind == "Feature":
        named = [("feature", content)]
    else:
        named = [("feature", {"type": "Feature", "geometry": content, "properties": None})]
    for where, feature in named:
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            raise wrong(path, where, feature, 'a feature: an object of type "Feature"')
        properties = feature.get("properties")
        if not isinstance(properties, dict | None):
            raise wrong(path, f"{where}.properties", properties, "an object or null")
        parts = _polygons(path, f"{where}.geometry", feature.get("geometry"), left_out, 0)
        if parts:
            heights = [ring[:, 2] for part in parts for ring in part if len(ring)]
            flat = [[ring[:, :2] for ring in part] for part in parts]
            lower = float(min(h.min() for h in heights)) if heights else 0.0
            found.append(Footprint(where, flat, properties or {}, lower, lower))
    return Footprints(found, left_out, _crs(content))


def _polygons(path: Path, where: str, geometry: Any, left_out: Counter[str], depth: int) -> list[list[np.ndarray]]:
    """The polygons of a geometry: lists of (k, 3) rings, height 0 where there is none."""
    if geometry is None:
        left_out["no geometry"] += 1
        return []
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind in _OTHERS:
        left_out[kind] += 1
        return []
    if kind == "GeometryCollection" and depth < 8:
        members = expect_list(path, f"{where}.geometries", geometry.get("geometries"), "a list of geometries")
        return [
            polygon
            for i, member in enumerate(members)
            for polygon in _polygons(path, f"{where}.geometries[{i}]", member, left_out, depth + 1)
        ]
    coordinates, at = geometry.get("coordinates") if kind else None, f"{where}.coordinates"
    if kind == "Polygon":
        return [_rings(path, at, coordinates)]
    if kind == "MultiPolygon":
        polygons = expect_list(path, at, coordinates, "a list of polygons")
        return [_rings(path, f"{at}[{i}]", polygon) for i, polygon in enumerate(polygons)]
    raise wrong(path, where, kind or geometry, "a geometry, as Polygon or MultiPolygon")


def _rings(path: Path, where: str, value: Any) -> list[np.ndarray]:
    rings = []
    for i, ring in enumerate(expect_list(path, where, value, "a list of rings")):
        positions = numbers(path, f"{where}[{i}]", ring, 2, 4)
        height = positions[:, 2:3] if positions.shape[1] > 2 else np.zeros((len(positions), 1))
        rings.append(np.hstack([positions[:, :2], height]))
    return rings


def _crs(content: dict[str, Any]) -> str | None:
    """The name of the coordinate system, where the file has one."""
    crs = content.get("crs")
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    return name if isinstance(name, str) else None
