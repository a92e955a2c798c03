"""Outlines with heights from files of buildings, blocks, countries → polygons."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from .. import cuboids
from ..layer import Layer, simple_layer
from ..polygons import bounds as polygon_bounds
from ..polygons import polygon_layer
from .degrees import around, metres_per_degree
from .json_file import read_json

HEIGHT_NAMES = ("height", "building:height", "building_height", "render_height", "measuredheight", "measured_height")
"""Properties that are taken for a height, without regard to case; the first of which an object has a number."""
LEVEL_NAMES = ("building:levels", "building_levels", "levels", "num_floors", "floors", "storeys", "storeysaboveground")
"""The same for numbers of storeys."""
LEVEL = 3.0
"""Of a storey, metres."""
BASE_NAMES = ("min_height", "building:min_height", "render_min_height")
"""The same for the height at which an object begins."""
DEFAULT_HEIGHT = 10.0


@dataclass(frozen=True)
class Footprint:
    """An object of a file.

    where : its place there, for messages.  polygons : rings of each, (k, 2) float64.  lower, upper : of its geometry;
    equal where that is flat.
    """

    where: str
    polygons: list[list[np.ndarray]]
    properties: dict[str, Any]
    lower: float
    upper: float


@dataclass(frozen=True)
class Footprints:
    """The objects of a file.

    left_out : how many of what else there is.  crs : the name of the coordinate system, None where the file has none.
    """

    objects: list[Footprint]
    left_out: Counter[str]
    crs: str | None


@dataclass(frozen=True)
class HeightRules:
    """Where lower end, upper end and value come from.

    height : of objects that have none.  height_property : None: geometry that goes up, else ``HEIGHT_NAMES``, else
    ``LEVEL_NAMES``.  height_scale : factor for heights from properties.  base : added to all.  value_property : None:
    from lower to upper end.
    """

    height: float = DEFAULT_HEIGHT
    height_property: str | None = None
    height_scale: float = 1.0
    base: float = 0.0
    value_property: str | None = None


@dataclass(frozen=True)
class Read:
    """A layer, and what was decided while it was made, line by line."""

    layer: Layer
    notes: list[str] = field(default_factory=list)


def polygons_from_file(
    path: Path, rules: HeightRules, *, degrees: bool | None = None, types: Sequence[str] | None = None
) -> Read:
    """The polygons of a GeoJSON or CityJSON file.

    degrees : coordinates are longitude and latitude; None: as the file says or they look. They become metres east and
        north of their middle, true to scale there: d further north or south, x is wrong by d / R · tan(latitude).
    types : of city objects; None: buildings.
    Raises InputError naming file and entry.
    """
    footprints = read_footprints(path, types)
    if not footprints.objects:
        raise InputError(f"{path}: found no polygon{_among(footprints.left_out)}, expected at least one")
    lower, upper, notes = _heights(path, footprints.objects, rules)
    value, value_notes = _values(path, footprints.objects, rules, upper - lower)
    shapes, middle = _in_metres(path, footprints, degrees)
    notes += value_notes
    parameters: dict[str, Any] = {"source": path.name}
    if middle is not None:
        parameters["middle_deg"] = middle
        notes.append(f"coordinates: degrees, drawn as metres from longitude {middle[0]:.6f}, latitude {middle[1]:.6f}")
    layer, kept = polygon_layer(path.stem, shapes, np.column_stack([lower, upper]), value, **parameters)
    left_out = footprints.left_out.copy()
    left_out["without area"] += len(shapes) - len(kept)
    if left_out.total():
        notes.append(f"left out{_among(left_out)}")
    return Read(layer, notes)


def bounding_boxes(layer: Layer) -> Layer:
    """The boxes of polygons, along the axes, as cuboids."""
    lower, upper = polygon_bounds(layer)
    objects = np.empty(len(layer), cuboids.OBJECT)
    objects["center"], objects["extent"] = (lower + upper)[:, :2] / 2, (upper - lower)[:, :2]
    objects["height"], objects["value"] = layer.objects["height"], layer.objects["value"]
    return simple_layer(layer.name, "cuboids", layer.origin, objects, **layer.parameters)


def read_footprints(path: Path, types: Sequence[str] | None = None) -> Footprints:
    """The footprints of a GeoJSON or CityJSON file, whichever it is. Raises InputError naming the entry."""
    from . import cityjson, geojson

    content = read_json(path)
    kind = content.get("type")
    if kind == "CityJSON":
        return cityjson.read_cityjson(path, content, types or cityjson.BUILDINGS)
    if isinstance(kind, str) and kind in geojson.TYPES:
        return geojson.read_geojson(path, content)
    expected = ", ".join(("CityJSON", *geojson.TYPES))
    raise InputError(f"{path}: type: found {str(kind)[:40]!a}, expected one of {expected}")


def _among(left_out: Counter[str]) -> str:
    several = [f"{n:,} {what}" for what, n in left_out.most_common(8) if n]
    return f": {', '.join(several)}" if several else ""


def number_of(value: Any) -> float | None:
    """The number of a property: itself, or a text that is one, as OpenStreetMap has them ("12", "12.5 m")."""
    if isinstance(value, str):
        matched = re.fullmatch(r"\s*([-+]?\d{1,12}(?:\.\d{0,12})?)\s*m?\s*", value, re.ASCII)
        return float(matched[1]) if matched else None
    if type(value) not in (int, float) or not abs(value) <= 1e18:
        return None
    return float(value)


def _first_number(properties: dict[str, Any], names: Sequence[str]) -> float | None:
    for name in names:
        number = number_of(properties.get(name))
        if number is not None:
            return number
    return None


def _heights(path: Path, objects: list[Footprint], rules: HeightRules) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """(n,) lower and (n,) upper ends, and where they come from."""
    taken: Counter[str] = Counter()
    lower, upper = np.empty(len(objects)), np.empty(len(objects))
    for i, footprint in enumerate(objects):
        ground = footprint.lower + rules.base
        properties = {name.lower(): value for name, value in footprint.properties.items()}
        begin = 0.0
        if rules.height_property is not None:
            height, source = number_of(footprint.properties.get(rules.height_property)), rules.height_property
        elif footprint.upper > footprint.lower:
            height, source = footprint.upper - footprint.lower, "geometry"
        else:
            height, source = _first_number(properties, HEIGHT_NAMES), "a property"
            if height is None:
                levels = _first_number(properties, LEVEL_NAMES)
                height, source = (None, "") if levels is None else (LEVEL * levels, f"storeys × {LEVEL:g}")
            begin = _first_number(properties, BASE_NAMES) or 0.0
        if height is None:
            height, source = rules.height, ""
        elif source != "geometry":
            height, begin = height * rules.height_scale, begin * rules.height_scale
        taken[source] += 1
        lower[i], upper[i] = ground + begin, ground + height
    if rules.height_property is not None and rules.height_property not in taken:
        raise _not_found(path, objects, rules.height_property)
    missing = taken.pop("", 0)
    notes = [f"heights from {', '.join(f'{source} ({n:,})' for source, n in taken.most_common())}"] * bool(taken)
    notes += [f"heights: none in {missing:,} of {len(objects):,} objects, drawn {rules.height:g} high"] * bool(missing)
    return lower, upper, notes


def _values(
    path: Path, objects: list[Footprint], rules: HeightRules, height: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    if rules.value_property is None:
        return height, []
    found = [number_of(footprint.properties.get(rules.value_property)) for footprint in objects]
    numbers = [number for number in found if number is not None]
    if not numbers:
        raise _not_found(path, objects, rules.value_property)
    least, missing = min(numbers), len(found) - len(numbers)
    notes = [f"values: no number in {missing:,} of {len(found):,} objects, taken as {least:g}, the least"] * bool(
        missing
    )
    return np.array([least if number is None else number for number in found]), notes


def _not_found(path: Path, objects: list[Footprint], name: str) -> InputError:
    with_numbers = dict.fromkeys(
        key for footprint in objects for key, value in footprint.properties.items() if number_of(value) is not None
    )
    others = ", ".join(f"{key[:40]!a}"[1:-1] for key in list(with_numbers)[:20]) or "none"
    return InputError(f"{path}: property {name}: found in no object as a number, expected one of those: {others}")


def _in_metres(
    path: Path, footprints: Footprints, degrees: bool | None
) -> tuple[list[list[list[np.ndarray]]], list[float] | None]:
    """The polygons of each object, world; and the longitude and latitude of (0, 0) if they were in degrees."""
    shapes = [footprint.polygons for footprint in footprints.objects]
    rings = [ring for polygons in shapes for polygon in polygons for ring in polygon if len(ring)]
    if not rings:
        return shapes, None
    every = np.concatenate(rings)
    fits = bool((np.abs(every) <= (360.0, 90.0)).all())
    if degrees is None:
        degrees = fits and _is_geographic(footprints.crs)
    if not degrees:
        return shapes, None
    if not fits:
        bad = every[~(np.abs(every) <= (360.0, 90.0)).all(axis=1)][0]
        raise InputError(f"{path}: found the position {bad.tolist()}, expected degrees; try --no-degrees")
    reference = every[0, 0]
    longitude = every[:, 0]
    turned = around(longitude, reference)
    wraps = np.ptp(turned) < 180 < np.ptp(longitude)  # across the antimeridian
    lower, upper = every.min(axis=0), every.max(axis=0)
    if wraps:
        lower[0], upper[0] = turned.min(), turned.max()
    middle = (lower + upper) / 2
    scale = metres_per_degree(middle[1])
    metres = [
        [
            [
                (np.column_stack([around(ring[:, 0], reference), ring[:, 1]]) if wraps else ring) * scale
                - middle * scale
                for ring in polygon
            ]
            for polygon in polygons
        ]
        for polygons in shapes
    ]
    return metres, middle.tolist()


def _is_geographic(crs: str | None) -> bool:
    """Whether a coordinate system is in degrees: that of files without one, and EPSG's numbers 4000 to 4999."""
    return crs is None or "CRS84" in crs or re.search(r"(?<!\d)4\d{3}$", crs, re.ASCII) is not None
