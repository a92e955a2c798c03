"""Finished runs on disk: a first line that says which experiment they belong to, then one JSON line a run.

A line is written and synced before the next run starts, so a kill loses at most the run that was going on. A torn last
line is a run that did not finish.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from ...shared.errors import InputError
from ...shared.files import disk_error
from ..record import RECORD_VERSION

JOURNAL_VERSION = 1


@dataclass(frozen=True)
class Run:
    """One finished run: which point, which repeat, and its ``run.json`` or the line it failed with."""

    point: int
    repeat: int
    record: dict[str, Any] | None = None
    failed: str | None = None


@dataclass
class Journal:
    """The runs of one experiment; ``add`` makes each durable.

    path : file, made if missing.
    plan_sha256 : hash of what is measured.
    started : when its first run started, ISO 8601, UTC.
    Raises InputError if the file belongs to another experiment or another version, or cannot be written.
    """

    path: Path
    plan_sha256: str
    runs: list[Run] = field(default_factory=list)
    started: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

    @classmethod
    def open(cls, path: Path, plan_sha256: str, *, fresh: bool) -> Self:
        """The journal at a path, its finished runs read; ``fresh`` starts an empty one."""
        journal = cls(path, plan_sha256)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if fresh:
                path.unlink(missing_ok=True)
            content = path.read_bytes() if path.exists() else b""
            whole = content.rfind(b"\n") + 1
            if whole:
                first, *lines = content[:whole].splitlines()
                header = _parse(first, path, 1)
                journal._check(header)
                journal.started = str(header.get("started"))
                journal.runs = [_run(_parse(line, path, i), path, i) for i, line in enumerate(lines, 2)]
            if whole < len(content):
                os.truncate(path, whole)
            if not whole:
                journal._append(journal._header() | {"started": journal.started})
        except OSError as error:
            raise disk_error(error, path) from None
        return journal

    @property
    def finished(self) -> set[tuple[int, int]]:
        """(point, repeat) of the runs that succeeded."""
        return {(run.point, run.repeat) for run in self.runs if run.record is not None}

    @property
    def failures(self) -> dict[int, str]:
        """Point → why its last failed run did, of points and repeats that never succeeded."""
        finished = self.finished
        return {run.point: run.failed for run in self.runs if run.failed and (run.point, run.repeat) not in finished}

    def add(self, run: Run) -> None:
        """Keep a run. Durable when this returns. Raises InputError when the disk will not have it."""
        content = {"point": run.point, "repeat": run.repeat}
        content |= {"failed": run.failed} if run.record is None else {"record": run.record}
        try:
            self._append(content)
        except OSError as error:
            raise disk_error(error, self.path) from None
        self.runs.append(run)

    def _header(self) -> dict[str, Any]:
        return {"journal_version": JOURNAL_VERSION, "record_version": RECORD_VERSION, "plan_sha256": self.plan_sha256}

    def _check(self, header: dict[str, Any]) -> None:
        for key, expected in self._header().items():
            if header.get(key) != expected:
                found = str(header.get(key, "nothing"))[:12]
                what = "of another experiment" if key == "plan_sha256" else "of another version"
                raise InputError(
                    f"{self.path}: results {what}: found {key} {found}, expected {str(expected)[:12]};"
                    " --fresh starts over, or choose another experiment.output"
                )

    def _append(self, content: dict[str, Any]) -> None:
        with self.path.open("ab") as file:
            file.write(json.dumps(content).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())


def _parse(line: bytes, path: Path, number: int) -> dict[str, Any]:
    try:
        content = json.loads(line)
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise InputError(f"{path}: line {number}: found {line[:20]!r}, expected a JSON object; --fresh starts over")
    return content


def _run(content: dict[str, Any], path: Path, number: int) -> Run:
    point, repeat = content.get("point"), content.get("repeat")
    record, failed = content.get("record"), content.get("failed")
    if not (isinstance(point, int) and isinstance(repeat, int) and isinstance(record or failed, dict | str)):
        raise InputError(f"{path}: line {number}: expected point, repeat and record; --fresh starts over")
    return Run(point, repeat, record, failed)
