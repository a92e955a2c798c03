"""Recorded runs as the messages that they were: a recording (``view --record``), or a batch run's ``run.json``.

A recording has a message's header a line. It is read line by line, and nothing of it is believed: a line that is no
message is an error that names it, but for the last one, which may have been cut short with the run.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ...shared.errors import InputError, MessageError
from .board import MAX_RANKS, Board, text
from .protocol import MAX_HEADER_BYTES, parse_json

MAX_RUN_BYTES = 64 << 20
"""Of a ``run.json``."""
MESSAGE_S = 0.5
"""Seconds of a batch run that become one message."""
REPLAYED_KINDS = ("welcome", "metrics", "prediction", "bye")

_COUNTS = {"cells_visible": ("culling", "cells"), "entries": ("sampling", "entries"), "points": ("sampling", "points")}
"""List of ``run.json`` → stage whose rank counted it, and its name as a metric."""


def is_recording(path: Path) -> bool:
    """Whether a file is a recording or a ``run.json``, not a connection file. Raises InputError for what is none."""
    try:
        with path.open("rb") as file:
            if not path.is_file():
                raise InputError(f"{path}: found no regular file, expected a connection file, a recording or run.json")
            start = file.read(1 << 16)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    return path.suffix == ".jsonl" or b'"server_key"' not in start


def replayed(path: Path) -> Iterator[dict[str, Any]]:
    """The headers of a recording, or of what a ``run.json`` says, in order; those of other kinds are left out.

    Raises InputError naming file and line.  Memory: a line, of a ``run.json`` all of it.
    """
    try:
        with path.open("rb") as file:
            first = file.readline(MAX_HEADER_BYTES + 2)
            file.seek(0)
            if path.suffix != ".jsonl" and not _is_message(first):
                yield from _of_run(path, file)
            else:
                yield from _of_recording(path, file)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


def _is_message(line: bytes) -> bool:
    try:
        parse_json(line.rstrip(b"\r\n"))
    except MessageError:
        return False
    return True


def _of_recording(path: Path, file: BinaryIO) -> Iterator[dict[str, Any]]:
    taken, number = Board(), 0
    while line := file.readline(MAX_HEADER_BYTES + 2):
        number += 1
        content = line.rstrip(b"\r\n")
        if not content:
            continue
        try:
            header = parse_json(content)
            known = header["kind"] in REPLAYED_KINDS
            if known:
                taken.hear(header)
        except MessageError as error:
            if len(line) <= MAX_HEADER_BYTES and not line.endswith(b"\n") and not file.read(1):
                return  # the last line, cut short
            raise InputError(f"{path}: line {number}: {error}") from None
        if known:
            yield header
    if not taken.heard:
        raise InputError(f"{path}: found no metrics, expected a recording of a live run")


# --- of a batch run --------------------------------------------------------------------------------------------------


def _of_run(path: Path, file: BinaryIO) -> Iterator[dict[str, Any]]:
    data = file.read(MAX_RUN_BYTES + 1)
    if len(data) > MAX_RUN_BYTES:
        raise InputError(f"{path}: found more than {MAX_RUN_BYTES >> 20} MiB, expected a recording or run.json")
    try:
        record = json.loads(data)
    except (ValueError, RecursionError):
        raise InputError(f"{path}: no JSON, expected a connection file, a recording or run.json") from None
    if not isinstance(record, dict) or not isinstance(record.get("per_frame"), dict):
        raise InputError(f"{path}: found no per_frame, expected a connection file, a recording or run.json")
    try:
        yield from run_messages(record)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError, MessageError, RecursionError):
        raise InputError(f"{path}: not as splatpipe run writes it, expected a run.json") from None


def run_messages(record: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A batch run as a live one would have told it: a message for each ``MESSAGE_S`` of the run.

    Frames are spread evenly over the seconds that the run took. A stage of several ranks was recorded as its slowest
    rank took; the first of them says so in its role. Waiting is known as a mean only.
    Raises ValueError, KeyError, TypeError, MessageError for a record that is none.
    """
    lists = {name: _numbers(values) for name, values in record["per_frame"].items() if name != "objects"}
    stages = [name.removesuffix("_s") for name in lists if f"{name.removesuffix('_s')}" in record["stages"]]
    n_frames = max((len(lists[f"{stage}_s"]) for stage in stages), default=0)
    pictures_per_s = float(record["frames_per_s"])
    rate = pictures_per_s * int(record.get("views_per_picture", 1))
    if not n_frames or not 0 < rate < 1e9:
        raise ValueError("no frames")
    ranks, having = _ranks_of(record, stages)
    names = {name: record[name] for name in ("topology", "rasterizer") if name in record}
    scene = {key: record["scene"][key] for key in ("points", "cells")}
    path = record.get("config", {}).get("scene", {}).get("path", "")
    yield {"kind": "welcome", "run": {"scene": Path(text(path)).name, **names, **scene, "ranks": ranks}}
    waits_ms = {stage: 1e3 * float(record["stages"][stage]["wait_s"]) / n_frames for stage in stages}
    frames = max(1, round(rate * MESSAGE_S))
    for first in range(0, n_frames, frames):
        part = slice(first, first + frames)
        values: dict[int, dict[str, float]] = {of["rank"]: {"frames_per_s": rate} for of in ranks}
        for stage in stages:
            if len(lists[f"{stage}_s"][part]):
                values[having[stage]][f"{stage}.work_ms"] = 1e3 * float(lists[f"{stage}_s"][part].mean())
                values[having[stage]][f"{stage}.wait_ms"] = waits_ms[stage]
        for name, (stage, called) in _COUNTS.items():
            if name in lists and len(lists[name][part]):
                values[having[stage] if stage in having else ranks[0]["rank"]][called] = float(lists[name][part].mean())
        if "missing" in lists and len(lists["missing"][part]):
            values[having["render"]]["missing"] = float(lists["missing"][part].mean())
        for of in record["ranks"]:
            values[of["rank"]]["memory_bytes"] = float(of["rss_bytes"])
        t = min(first + frames, n_frames) / rate
        yield {"kind": "metrics", "t": t, "ranks": [of | {"values": values[of["rank"]]} for of in ranks]}


def _ranks_of(record: dict[str, Any], stages: Sequence[str]) -> tuple[list[dict[str, Any]], dict[str, int]]:
    """Rank, role and host of each rank; of each stage, the rank that its times are shown at."""
    if not 0 < len(record["ranks"]) <= MAX_RANKS:
        raise ValueError("ranks")
    ranks = [{name: of[name] for name in ("rank", "role", "host")} for of in record["ranks"]]
    if len({of["rank"] for of in ranks}) < len(ranks) or not all(type(of["rank"]) is int for of in ranks):
        raise ValueError("ranks")
    having = {}
    for stage in stages:
        found = [i for i, of in enumerate(record["ranks"]) if stage in of.get("stages", {})] or [0]
        having[stage] = ranks[found[0]]["rank"]
        if len(found) > 1:
            shown = ranks[found[0]]
            shown["role"] = f"{text(shown['role'])} (slowest of {len(found)})"
    return ranks, having


def _numbers(values: Any) -> np.ndarray:
    """(n,) float64. Raises ValueError for what is no list of finite numbers."""
    found = np.asarray(values, np.float64)
    if found.ndim != 1 or not np.isfinite(found).all():
        raise ValueError("numbers")
    return found
