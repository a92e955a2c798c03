"""CityJSON 1 and 2: the ground outline of each building, and how far up it goes.

The outline is that of the surfaces named GroundSurface; where none is named, of those at the bottom that face down;
where there are hardly any, of those that face up, the roofs. An edge that two of them share is no outline. Where they
overlap, each is a prism of its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ..outlines import fans
from .footprints import Footprint, Footprints
from .json_file import LARGEST, expect_list, numbers, wrong

BUILDINGS = ("Building", "BuildingPart")

_DEPTH = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}
_BOTTOM = 0.1  # of an object's height: surfaces below may be its ground
_ENOUGH = 0.5  # of the area of its roofs
_OVERLAP = 1e-3  # of the area of surfaces: below they are taken for neighbours


def read_cityjson(path: Path, content: dict[str, Any], types: Sequence[str] = BUILDINGS) -> Footprints:
    """A footprint an object of ``types``; of objects with parts, which have their own, the parts.

    Of several geometries that of the lowest level of detail from 1 on is taken. Raises InputError naming the entry.
    """
    objects = content.get("CityObjects")
    if not isinstance(objects, dict):
        raise wrong(path, "CityObjects", objects, "an object")
    vertices = _vertices(path, content)
    chosen = {}
    left_out: Counter[str] = Counter()
    for name, city_object in objects.items():
        where = f"CityObjects.{name[:60]!a}"
        if not isinstance(city_object, dict):
            raise wrong(path, where, city_object, "an object")
        kind, geometry = city_object.get("type"), city_object.get("geometry", [])
        if kind not in types:
            left_out[f"{kind[:40]!a}"[1:-1] if isinstance(kind, str) else "no type"] += 1
        elif expect_list(path, f"{where}.geometry", geometry, "a list of geometries"):
            chosen[name] = where, city_object
    found = []
    for where, city_object in chosen.values():
        children = city_object.get("children", [])
        if isinstance(children, list) and any(isinstance(c, str) and c in chosen for c in children):
            continue
        footprint = _footprint(path, where, city_object, vertices)
        if footprint is None:
            left_out["no surfaces"] += 1
        else:
            found.append(footprint)
    metadata = content.get("metadata")
    crs = metadata.get("referenceSystem") if isinstance(metadata, dict) else None
    return Footprints(found, left_out, crs if isinstance(crs, str) else "")


def _vertices(path: Path, content: dict[str, Any]) -> np.ndarray:
    """(n, 3) float64, transformed."""
    vertices = numbers(path, "vertices", content.get("vertices"), 3, 3)
    transform = content.get("transform")
    if transform is None:
        return vertices
    if not isinstance(transform, dict):
        raise wrong(path, "transform", transform, "an object of scale and translate")
    scale, translate = (
        numbers(path, f"transform.{key}", [transform.get(key)], 3, 3)[0] for key in ("scale", "translate")
    )
    vertices = vertices * scale + translate
    if not (np.abs(vertices) <= LARGEST).all():
        raise InputError(f"{path}: transform: found vertices beyond {LARGEST:g}, expected finite numbers")
    return vertices


def _footprint(path: Path, where: str, city_object: dict[str, Any], vertices: np.ndarray) -> Footprint | None:
    geometries = []
    for i, geometry in enumerate(city_object["geometry"]):
        if not isinstance(geometry, dict):
            raise wrong(path, f"{where}.geometry[{i}]", geometry, "an object")
        if isinstance(kind := geometry.get("type"), str) and kind in _DEPTH:
            geometries.append((_level(geometry.get("lod")), i, geometry))
    if not geometries:
        return None
    low = [g for g in geometries if g[0] >= 1]
    _, i, geometry = min(low, key=lambda g: g[:2]) if low else max(geometries, key=lambda g: g[:2])
    surfaces, names = _surfaces(path, f"{where}.geometry[{i}]", geometry, vertices)
    if not surfaces:
        return None
    z = np.concatenate([ring[:, 2] for rings in surfaces for ring in rings])
    properties = city_object.get("attributes", {})
    if not isinstance(properties, dict):
        raise wrong(path, f"{where}.attributes", properties, "an object")
    ground = [[ring[:, :2] for ring in rings] for rings in _ground(surfaces, names, z)]
    return Footprint(where, _without_seams(ground), properties, float(z.min()), float(z.max()))


def _level(lod: Any) -> float:
    try:
        return float(lod) if isinstance(lod, (str, int, float)) else 0.0
    except (ValueError, OverflowError):
        return 0.0


def _surfaces(
    path: Path, where: str, geometry: dict[str, Any], vertices: np.ndarray
) -> tuple[list[list[np.ndarray]], list[str | None]]:
    """The rings, (k, 3) each, of each surface that has some, and its name; of solids only the outer shell."""
    at, depth = f"{where}.boundaries", _DEPTH[geometry["type"]]
    semantics = geometry.get("semantics")
    names = semantics.get("surfaces") if isinstance(semantics, dict) else None
    values = semantics.get("values") if isinstance(semantics, dict) else None
    boundaries = [(expect_list(path, at, geometry.get("boundaries"), "a list"), values)]
    for level in range(depth, 0, -1):
        inner = []
        for members, named in boundaries:
            for k, member in enumerate(members[:1] if level == 1 else members):
                below = named[k] if isinstance(named, list) and k < len(named) else None
                inner.append((expect_list(path, at, member, "a list of surfaces"), below))
        boundaries = inner
    found, their_names = [], []
    for members, named in boundaries:
        for k, surface in enumerate(members):
            rings = [
                vertices[_indices(path, at, ring, len(vertices))]
                for ring in expect_list(path, at, surface, "a list of rings")
            ]
            rings = [ring for ring in rings if len(ring)]
            if rings:
                found.append(rings)
                their_names.append(_name(names, named[k] if isinstance(named, list) and k < len(named) else None))
    return found, their_names


def _indices(path: Path, where: str, ring: Any, n: int) -> np.ndarray:
    for index in expect_list(path, where, ring, "a ring: a list of numbers of vertices"):
        if type(index) is not int or not 0 <= index < n:
            raise wrong(path, where, index, f"the number of a vertex, 0 to {n - 1}")
    return np.array(ring, np.int64)


def _name(names: Any, index: Any) -> str | None:
    if not isinstance(names, list) or type(index) is not int or not 0 <= index < len(names):
        return None
    return names[index].get("type") if isinstance(names[index], dict) else None


def _ground(surfaces: list[list[np.ndarray]], names: list[str | None], z: np.ndarray) -> list[list[np.ndarray]]:
    """The surfaces whose outline is the object's."""
    ground = [surface for surface, name in zip(surfaces, names, strict=True) if name == "GroundSurface"]
    if ground:
        return ground
    area = np.array([_area(rings[0]) for rings in surfaces])
    top = np.array([rings[0][:, 2].max() for rings in surfaces])
    lowest = (area < 0) & (top <= z.min() + _BOTTOM * (z.max() - z.min()))
    is_ground = lowest if -area[lowest].sum() > _ENOUGH * area[area > 0].sum() else area > 0
    return [surface for surface, chosen in zip(surfaces, is_ground, strict=True) if chosen]


def _without_seams(surfaces: list[list[np.ndarray]]) -> list[list[np.ndarray]]:
    """Polygons with the inside of the surfaces: one, in which edges of two surfaces vanish, unless they overlap."""
    rings = [ring for surface in surfaces for ring in surface]
    if len(surfaces) < 2:
        return [rings]
    every = np.concatenate(rings)
    middle, half = (every.min(axis=0) + every.max(axis=0)) / 2, max(np.ptp(every, axis=0).max() / 2, 1e-30)
    scale = (1 << 20) / half
    point, apex, *_ = fans([np.rint((ring - middle) * scale).astype(np.int64) for ring in rings])
    start, end = (point - apex)[:-1], (point[1:] - apex[:-1])
    area = (start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]).sum() / 2 / scale**2
    expected = sum(2 * abs(_area(surface[0])) - sum(abs(_area(ring)) for ring in surface) for surface in surfaces)
    return [rings] if area > (1 - _OVERLAP) * expected else surfaces


def _area(ring: np.ndarray) -> float:
    """As seen from above: above 0 if the ring goes counterclockwise."""
    x, y = (ring[:, :2] - ring[0, :2]).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
