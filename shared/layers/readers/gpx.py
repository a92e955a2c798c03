"""GPX 1.0 and 1.1: tracks and routes, read as a stream by Expat; nothing is resolved, expanded or fetched."""

from __future__ import annotations

import math
from array import array
from datetime import UTC, datetime
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

import numpy as np

from ...errors import InputError
from ..trajectories import MOST_TRAJECTORIES, NAME_LENGTH
from .tracks import Nodes

MAX_BYTES = 1 << 30
MOST_POINTS = 20_000_000
_DEPTH = 32
_TEXT = 256
_CHUNK = 1 << 20
_COLUMNS = ("lon", "lat", "ele", "time", "speed")


def read_gpx(path: Path) -> Nodes:
    """The points of tracks and routes. Each segment is a trajectory, called as its track and, from the second on, "#2".

    Heights (``ele``), times and speeds are NaN where a point has none. Waypoints are left out.
    Raises InputError for what is no GPX, a document type or an entity, and whatever is larger than it may be.
    """
    return _Reader(path).read()


class _Reader:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._open: list[str] = []
        self._text: list[str] | None = None
        self._track = self._name = ""
        self._n_tracks = self._n_segments = self._n_waypoints = 0
        self._names: list[str] = []
        self._points, self._trajectory = array("d"), array("q")
        self._point: dict[str, float] | None = None
        self._parser = expat.ParserCreate(namespace_separator=" ")
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = self._characters
        self._parser.StartDoctypeDeclHandler = self._refuse
        self._parser.EntityDeclHandler = self._refuse

    def read(self) -> Nodes:
        try:
            size = self._path.stat().st_size
            if size > MAX_BYTES:
                raise InputError(f"{self._path}: found {size} bytes, expected at most {MAX_BYTES}")
            with self._path.open("rb") as file:
                while chunk := file.read(_CHUNK):
                    self._parser.Parse(chunk, False)
            self._parser.Parse(b"", True)
        except OSError as error:
            raise InputError(f"{self._path}: cannot be read: {error.strerror}") from None
        except expat.ExpatError as error:
            raise InputError(f"{self._path}: not valid XML: {error}") from None
        except (ValueError, LookupError) as error:  # encodings that there are not
            raise InputError(f"{self._path}: not valid XML: {str(error)[:120]}") from None
        if not self._points:
            found = f", {self._n_waypoints} waypoints" if self._n_waypoints else ""
            raise InputError(f"{self._path}: found no point of a track or route{found}, expected at least one")
        values = np.array(self._points).reshape(-1, len(_COLUMNS))
        notes = [f"left out: {self._n_waypoints:,} waypoints"] if self._n_waypoints else []
        has_speed = np.isfinite(values[:, 4]).any()
        return Nodes(
            values[:, :3].copy(),
            np.array(self._trajectory),
            self._names,
            values[:, 3],
            values[:, 4] if has_speed else None,
            True,
            notes,
        )

    def _wrong(self, what: str) -> InputError:
        return InputError(f"{self._path}: line {self._parser.CurrentLineNumber}: {what}")

    def _refuse(self, *_: object) -> NoReturn:
        raise self._wrong("found a document type or an entity, which GPX has none of")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        name = name.rpartition(" ")[2]
        if not self._open and name != "gpx":
            raise self._wrong(f"found element {name[:40]!a}, expected gpx")
        if len(self._open) >= _DEPTH:
            raise self._wrong(f"found elements in elements, more than {_DEPTH} deep")
        self._open.append(name)
        self._text = []
        if name in ("trk", "rte"):
            self._n_tracks += 1
            self._track, self._name, self._n_segments = f"{name}{self._n_tracks}", "", 0
        if name == "rte" or (name == "trkseg" and self._track):
            self._begin_segment()
        elif name == "wpt":
            self._n_waypoints += 1
        elif name in ("trkpt", "rtept"):
            self._begin_point(attributes)

    def _begin_segment(self) -> None:
        if len(self._names) >= MOST_TRAJECTORIES:
            raise self._wrong(f"found more than {MOST_TRAJECTORIES} segments")
        self._n_segments += 1
        self._names.append("")
        self._call()

    def _call(self) -> None:
        number = f" #{self._n_segments}" if self._n_segments > 1 else ""
        self._names[-1] = (self._name or self._track)[: NAME_LENGTH - 12] + number

    def _begin_point(self, attributes: dict[str, str]) -> None:
        if self._open[-2:-1] not in (["trkseg"], ["rte"]) or not self._names:
            raise self._wrong("found a point of a track that is in none")
        if len(self._trajectory) >= MOST_POINTS:
            raise self._wrong(f"found more than {MOST_POINTS} points")
        lon, lat = (self._number(attributes.get(key, ""), key) for key in ("lon", "lat"))
        if not (abs(lon) <= 360 and abs(lat) <= 90):
            raise self._wrong(f"found the position {lon:g}, {lat:g}, expected degrees")
        self._point = {"lon": lon, "lat": lat}

    def _characters(self, text: str) -> None:
        if self._text is not None and len(self._text) < _TEXT:
            self._text.append(text[:_TEXT])

    def _end(self, name: str) -> None:
        name = name.rpartition(" ")[2]
        text = "".join(self._text or ()).strip()[:_TEXT]
        self._text = None
        self._open.pop()
        parent = self._open[-1] if self._open else ""
        if name in ("trkpt", "rtept") and self._point is not None:
            p = self._point
            self._points.extend(p.get(key, math.nan) for key in _COLUMNS)
            self._trajectory.append(len(self._names) - 1)
            self._point = None
        elif self._point is not None and text:
            if name == "time" and parent in ("trkpt", "rtept"):
                self._point["time"] = self._seconds(text)
            elif name == "speed" or (name == "ele" and parent in ("trkpt", "rtept")):
                self._point[name] = self._number(text, name)
        elif name == "name" and parent in ("trk", "rte"):
            self._name = " ".join(text.split())
            if parent == "rte":  # whose segment has begun
                self._call()

    def _number(self, text: str, what: str) -> float:
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not abs(number) <= 1e9:
            raise self._wrong(f"{what}: found {text[:40]!a}, expected a number")
        return number

    def _seconds(self, text: str) -> float:
        try:
            when = datetime.fromisoformat(text)
            return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
        except (ValueError, OverflowError):
            raise self._wrong(f"time: found {text[:40]!a}, expected a date as 2024-05-01T12:00:00Z") from None
