"""What the ranks of a live run measure, put together for those who look, and written down if that is wanted."""

from __future__ import annotations

import math
import time
from collections import deque
from pathlib import Path
from typing import IO, Any

from ...shared.errors import InputError
from .protocol import MAX_HEADER_BYTES, to_json

MAX_RECORD_BYTES = 256 << 20
_MAX_RANKS = 4096
_MAX_VALUES = 128
_LATENCIES = 64


class Gathered:
    """The latest of each rank, with the hub as rank −1."""

    def __init__(self, host: str) -> None:
        self._host = host
        self._ranks: dict[int, dict[str, Any]] = {}
        self._latencies: deque[float] = deque(maxlen=_LATENCIES)
        self._since = time.monotonic()

    def take(self, header: dict[str, Any]) -> None:
        """What a rank measured, as it says it: numbers that are finite."""
        rank, values = header.get("rank"), header.get("values")
        if not isinstance(rank, int) or not isinstance(values, dict):
            return
        if rank not in self._ranks and len(self._ranks) >= _MAX_RANKS:
            return
        named = {name: header.get(name, "") for name in ("role", "host")}
        self._ranks[rank] = {"rank": rank, **named, "values": finite(values)}

    def shown(self, latency_s: float) -> None:
        """A picture was acknowledged this long after its camera had come."""
        self._latencies.append(latency_s)

    def counts(self) -> dict[str, float]:
        """Of the latest frame, all ranks together: ``cells``, ``entries``, ``points``, ``pixels``, ``frames_per_s``;
        nothing while one is missing.
        """
        said: dict[str, list[float]] = {name: [] for name in ("cells", "entries", "points", "pixels", "frames_per_s")}
        for rank in self._ranks.values():
            for name, values in said.items():
                if name in rank["values"]:
                    values.append(rank["values"][name])
        if not all(said.values()):
            return {}
        summed = {name: sum(said[name]) for name in ("cells", "entries", "points")}
        return summed | {name: max(said[name]) for name in ("pixels", "frames_per_s")}

    def message(self, run_s: float, n_viewers: int, n_pictures: int, n_bytes: int) -> dict[str, Any]:
        """The header ``metrics``; n_pictures, n_bytes : sent since the last one. Ranks that do not fit are left out."""
        now = time.monotonic()
        past_s = max(now - self._since, 1e-6)
        own = {
            "viewers": n_viewers,
            "pictures_per_s": n_pictures / past_s,
            "sent_bytes_per_s": n_bytes / past_s,
        }
        if self._latencies:
            own["latency_ms"] = 1e3 * sum(self._latencies) / len(self._latencies)
        self._since = now
        self._latencies.clear()
        hub = {"rank": -1, "role": "hub", "host": self._host, "values": finite(own)}
        ranks = [hub, *(self._ranks[rank] for rank in sorted(self._ranks))]
        header = {"kind": "metrics", "t": round(run_s, 3), "ranks": ranks}
        while len(to_json(header)) > MAX_HEADER_BYTES:
            del ranks[len(ranks) * 7 // 8 :]
        return header


def finite(values: dict[str, Any]) -> dict[str, float]:
    """Those of the values that are finite numbers, to five digits; at most ``_MAX_VALUES`` of them."""
    kept: dict[str, float] = {}
    for name, value in list(values.items())[:_MAX_VALUES]:
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            kept[name] = value if isinstance(value, int) else float(f"{value:.5g}")
    return kept


def parts_ms(started: dict[str, Any], picture: dict[str, Any], host: str) -> dict[str, float]:
    """Where the time went from a camera's arrival here to that of its picture.

    A moment that nobody has told, such as that of a picture that no camera has asked for, belongs to no part; nor does
    one of another host than ``host``, the hub's, since the clock there has begun at another time.
    """
    started, picture = (said if said.get("host", host) == host else {} for said in (started, picture))
    moments = {
        "to_run": started.get("asked_at"),
        "waiting": started.get("begun_at"),
        "drawing": picture.get("composed_at"),
        "queued": picture.get("encoding_at"),
        "encoding": picture.get("sent_at"),
        "to_hub": time.monotonic(),
    }
    parts, before = {}, started.get("camera_at")
    for name, at in moments.items():
        if before is not None and at is not None:
            parts[name] = round(1e3 * max(at - before, 0.0), 2)
        before = at
    return parts


class Record:
    """A file of JSON lines; complete under its name once closed. Stops with a note at ``MAX_RECORD_BYTES``.

    Raises InputError where it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._part = path, path.with_name(path.name + ".part")
        self._bytes = 0
        self._file: IO[bytes] | None
        try:
            self._file = self._part.open("wb")
        except OSError as error:
            raise InputError(f"{path}: cannot write the record: {error.strerror}") from None

    def write(self, header: dict[str, Any]) -> None:
        """Add a line."""
        if self._file is None:
            return
        line = to_json(header) + b"\n"
        self._bytes += len(line)
        if self._bytes > MAX_RECORD_BYTES:
            line = to_json({"kind": "bye", "why": f"the record stops here, at {MAX_RECORD_BYTES >> 20} MiB"}) + b"\n"
        try:
            self._file.write(line)
            self._file.flush()
        except OSError:  # a full disk ends the record, not the run
            self._bytes = MAX_RECORD_BYTES + 1
        if self._bytes > MAX_RECORD_BYTES:
            self.close()

    def close(self) -> None:
        """Give it its name."""
        if self._file is not None:
            self._file.close()
            self._file = None
            self._part.replace(self._path)
