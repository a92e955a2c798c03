"""Files of tracks → trajectories: CSV and Parquet tables, GPX, PLY with a node a vertex."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...errors import InputError
from ..layer import Layer
from ..motion import filled
from ..trajectories import trajectory_layer, typical_gap
from .degrees import around, metres_per_degree
from .table import read_table

COLUMN_NAMES = {
    "x": ("x", "easting", "east"),
    "y": ("y", "northing", "north"),
    "z": ("z", "altitude", "alt", "ele", "elevation", "height", "geoaltitude", "baroaltitude"),
    "lon": ("lon", "longitude", "lng", "long"),
    "lat": ("lat", "latitude"),
    "time": ("time", "timestamp", "t", "datetime", "date_time", "date"),
    "id": ("id", "trajectory", "track_id", "trackid", "flight", "flight_id", "callsign", "icao24", "mmsi", "vehicle",
           "vehicle_id", "individual-local-identifier", "name"),
    "speed": ("speed", "velocity", "groundspeed", "sog"),
}  # fmt: skip
"""What columns may be called, without regard to case; the first that a file has is taken."""

KNOT = 1852 / 3600
"""Metres a second."""

SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "kt": KNOT, "mph": 0.44704}


@dataclass
class Nodes:
    """The nodes of a file, as they stand there.

    position : (n, 3) float64; longitude, latitude and height if ``degrees``. NaN: not known.
    trajectory : (n,) int64, places in ``names``.
    time : (n,) float64, seconds, NaN: not known; None: the file has none.  speed : (n,) float64, metres a second, NaN:
    not known; None: likewise.
    notes : what was decided, line by line.
    """

    position: np.ndarray
    trajectory: np.ndarray
    names: list[str]
    time: np.ndarray | None
    speed: np.ndarray | None
    degrees: bool
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class TrackRules:
    """How a file is taken.

    columns : names of columns by what they are (keys of ``COLUMN_NAMES``), others are looked for.
    speed_unit : of the speed column, a key of ``SPEED_UNITS``; None: kt if it is called groundspeed or sog, else m/s.
    degrees : x and y are longitude and latitude; None: columns called so are.
    gap_s : where a trajectory is cut; None: ``typical_gap``; 0: nowhere.
    radius : what tubes are measured in; None: as the extent asks for.
    """

    columns: dict[str, str] = field(default_factory=dict)
    speed_unit: str | None = None
    degrees: bool | None = None
    gap_s: float | None = None
    radius: float | None = None


def trajectories_from_file(path: Path, rules: TrackRules) -> tuple[Layer, list[str]]:
    """The trajectories of a file, and what was decided while they were made, line by line.

    Nodes without position or time are left out; heights and speeds that are missing lie between those that are known.
    Degrees become metres east and north of their middle, true to scale there.
    Raises InputError naming the file.
    """
    suffix = path.suffix.lower()
    if suffix == ".gpx":
        from .gpx import read_gpx

        nodes = read_gpx(path)
    else:
        nodes = _of_columns(path, _ply_columns(path) if suffix == ".ply" else read_table(path), rules)
    notes = list(nodes.notes)
    if nodes.time is not None and not np.isfinite(nodes.time).any():
        nodes.time = None
    known = np.isfinite(nodes.position[:, 0]) & np.isfinite(nodes.position[:, 1])
    if nodes.time is not None:
        known &= np.isfinite(nodes.time)
    if not known.any():
        raise InputError(f"{path}: found no node with a position, expected at least one")
    if not known.all():
        notes.append(f"left out: {(~known).sum():,} of {len(known):,} nodes, without position or time")
    position, trajectory = nodes.position[known], nodes.trajectory[known]
    time = None if nodes.time is None else nodes.time[known]
    speed = None if nodes.speed is None else nodes.speed[known]
    if time is None:
        notes.append("time: none, nodes are counted instead: speed is the way from node to node")
    position[:, 2] = _heights(position[:, 2], trajectory, time)
    parameters: dict[str, object] = {"source": path.name}
    if nodes.degrees:
        position[:, :2], middle = _in_metres(path, position[:, :2])
        parameters["middle_deg"] = middle
        notes.append(f"coordinates: degrees, drawn as metres from longitude {middle[0]:.6f}, latitude {middle[1]:.6f}")
    gap = rules.gap_s
    if gap is None and time is not None:
        gap = typical_gap(time, trajectory)
        if gap is not None:
            notes.append(f"trajectories are cut where nothing was seen for {gap:.4g} s: --gap")
    layer = trajectory_layer(
        path.stem, position, trajectory, nodes.names, time, speed, radius=rules.radius, gap_s=gap or None, **parameters
    )
    return layer, notes


def _ply_columns(path: Path) -> dict[str, np.ndarray]:
    from ...readers.ply import open_ply
    from ...readers.source import foreign_errors

    with foreign_errors(path):
        return open_ply(path).columns()


def _of_columns(path: Path, table: dict[str, np.ndarray], rules: TrackRules) -> Nodes:
    plain: dict[str, str] = {}
    for name in table:
        plain.setdefault(name.strip().lower(), name)
    found = {
        role: next(plain[name] for name in names if name in plain)
        for role, names in COLUMN_NAMES.items()
        if any(name in plain for name in names)
    }
    for role, name in rules.columns.items():
        if name not in table:
            raise InputError(f"{path}: column {name}: not found, expected it among {_some(table)}")
        found[role] = name
    if rules.degrees is True:
        found.setdefault("lon", found.get("x", ""))
        found.setdefault("lat", found.get("y", ""))
    planar, geographic = {"x", "y"} <= found.keys(), all(found.get(role) for role in ("lon", "lat"))
    degrees = geographic and not planar if rules.degrees is None else rules.degrees
    if not (geographic if degrees else planar):
        raise InputError(f"{path}: found columns {_some(table)}, expected x and y, or lon and lat, among them")
    n = len(next(iter(table.values())))
    if not n:
        raise InputError(f"{path}: found no node, expected at least one")
    roles = ("lon", "lat", "z") if degrees else ("x", "y", "z")
    position = np.zeros((n, 3))
    for axis, role in enumerate(roles):
        if role in found:
            position[:, axis] = _numbers(path, found[role], table[found[role]])
    time = _seconds(path, found["time"], table[found["time"]]) if "time" in found else None
    speed, notes = None, []
    if "speed" in found:
        name = found["speed"]
        unit = rules.speed_unit or ("kt" if name.strip().lower() in ("groundspeed", "sog") else "m/s")
        speed = _numbers(path, name, table[name]) * SPEED_UNITS[unit]
        notes.append(f"speed: of column {name}, in {unit}: --speed-unit")
        missing = int((~np.isfinite(speed)).sum())
        if missing:
            notes.append(f"speed: missing in {missing:,} of {n:,} nodes, taken from those around")
    if "id" not in found:
        return Nodes(position, np.zeros(n, np.int64), [path.stem], time, speed, degrees, notes)
    names, trajectory = _names(table[found["id"]])
    return Nodes(position, trajectory, names, time, speed, degrees, notes)


def _some(table: dict[str, np.ndarray]) -> str:
    return ", ".join(f"{name[:40]!a}"[1:-1] for name in list(table)[:20])


def _numbers(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    if values.dtype.kind == "O" and all(value is None for value in values):  # a column that is empty throughout
        return np.full(len(values), np.nan)
    if values.dtype.kind not in "iuf":
        raise InputError(f"{path}: column {name}: found {values.dtype}, expected numbers")
    return values.astype(np.float64)


def _seconds(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    """Numbers as they are, dates as seconds since 1970."""
    if values.dtype.kind == "M":
        since = (values.astype("datetime64[ns]") - np.datetime64(0, "ns")) / np.timedelta64(1, "s")
        return np.where(np.isnat(values), np.nan, since)
    return _numbers(path, name, values)


def _names(values: np.ndarray) -> tuple[list[str], np.ndarray]:
    """(names, (n,) which of them each is); whole numbers are not written as fractions."""
    if values.dtype.kind == "O":
        values = np.array(["" if v is None else str(v) for v in values])
    distinct, trajectory = np.unique(values, return_inverse=True)
    if distinct.dtype.kind == "f" and (distinct == np.rint(distinct)).all():
        distinct = distinct.astype(np.int64)
    return [str(name) for name in distinct.tolist()], trajectory.ravel().astype(np.int64)


def _heights(height: np.ndarray, trajectory: np.ndarray, time: np.ndarray | None) -> np.ndarray:
    """Heights that are not known, between those that are; 0 in trajectories where none is."""
    if np.isfinite(height).all():
        return height
    when = np.arange(len(height), dtype=np.float64) if time is None else time
    order = np.lexsort((when, trajectory))
    found = np.empty(len(height))
    found[order] = np.nan_to_num(filled(height[order], when[order], trajectory[order]))
    return found


def _in_metres(path: Path, degrees: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """(n, 2) metres from the middle of (n, 2) longitudes and latitudes, and that middle."""
    outside = ~(np.abs(degrees) <= (360.0, 90.0)).all(axis=1)
    if outside.any():
        raise InputError(f"{path}: found the position {degrees[outside][0].tolist()}, expected degrees")
    turned = around(degrees[:, 0], degrees[0, 0])
    if np.ptp(turned) < 180 < np.ptp(degrees[:, 0]):  # across the antimeridian
        degrees = np.column_stack([turned, degrees[:, 1]])
    middle = (degrees.min(axis=0) + degrees.max(axis=0)) / 2
    return (degrees - middle) * metres_per_degree(middle[1]), middle.tolist()
