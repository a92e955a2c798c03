"""What a run says about itself: stage times, messages, machine; the content of ``run.json``."""

from __future__ import annotations

import os
import platform
import resource
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..shared.messages import RenderPoints, VisibilityBits
from ..shared.process_memory import resident_bytes

if TYPE_CHECKING:
    from ..nodes.raster.paged_points import Residency

RECORD_VERSION = 1
KEPT_FRAMES = 64
"""Frames whose times and counts a live run keeps: more than balancing looks at (``balance.times``)."""


class StageClock:
    """Times of one stage, frame by frame: seconds of work, of the processor in it, and of waiting for messages
    or room.

    keep : of the latest frames so many at least, and fewer than twice as many; None: all. A live run lasts for days.
    frames, worked_s, waited_s : of all frames so far, kept or not.  dropped : frames that are not kept.
    """

    def __init__(self, stage: str, keep: int | None = None) -> None:
        self.stage, self.keep = stage, keep
        self.work_s: list[float] = []
        self.cpu_s: list[float] = []
        self.wait_s: list[float] = []
        self.frames = self.dropped = 0
        self.worked_s = self.waited_s = 0.0

    @contextmanager
    def working(self) -> Iterator[None]:
        """Around one frame's work."""
        start, cpu = time.perf_counter(), time.process_time()
        yield
        self.cpu_s.append(time.process_time() - cpu)
        self.work_s.append(time.perf_counter() - start)
        self.frames += 1
        self.worked_s += self.work_s[-1]
        self.dropped += _keep_latest(self.work_s, self.keep)
        _keep_latest(self.cpu_s, self.keep)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Around one frame's wait."""
        start = time.perf_counter()
        yield
        self.wait_s.append(time.perf_counter() - start)
        self.waited_s += self.wait_s[-1]
        _keep_latest(self.wait_s, self.keep)

    def summary(self) -> dict[str, Any]:
        """Median, spread and sum of the work in milliseconds; the sum of waiting in seconds."""
        return {"work_ms": spread_ms(self.work_s), "work_s": sum(self.work_s), "wait_s": sum(self.wait_s)}


class FrameCounts:
    """How much of everything each frame had: cells that may be seen, render-points entries, points drawn;
    of those, the pooled ones; objects of layers.

    lists : counts to begin with, as of ``lists``.
    keep : as of ``StageClock``.
    """

    def __init__(self, lists: dict[str, list[Any]] | None = None, keep: int | None = None) -> None:
        self._lists: dict[str, list[Any]] = {} if lists is None else lists
        self._keep = keep
        self._totals: dict[str, tuple[int, int]] = {}

    def add(self, *messages: VisibilityBits | RenderPoints) -> None:
        """Count a frame's messages. Outside the stage clocks: it is no work of the pipeline."""
        for message in messages:
            if isinstance(message, VisibilityBits):
                found = {"cells_visible": int(np.bitwise_count(message.bits).sum())}
            else:
                found = {"entries": len(message.entries), "points": message.n_points, "pooled_points": message.n_pooled}
            for name, count in found.items():
                self._count(name, count)

    def add_layers(self, of_layers: Sequence[RenderPoints]) -> None:
        """Count the objects that a frame draws, a number for each layer; nothing where there is no layer."""
        if of_layers:
            objects = self._lists.setdefault("objects", [])
            objects.append([chosen.n_points for chosen in of_layers])
            _keep_latest(objects, self._keep)

    def add_residency(self, found: Residency | None) -> None:
        """Count what a frame found of paged points; nothing where points are resident."""
        for name, value in (asdict(found) if found else {}).items():
            self._count(name, value)

    def lists(self) -> dict[str, list[Any]]:
        """Name → one count a frame; ``objects``: one list a frame, a count for each layer."""
        return self._lists

    def totals(self) -> dict[str, tuple[int, int]]:
        """Name → frames that were counted so far and their sum, kept or not; none of layers."""
        return self._totals

    def _count(self, name: str, count: int) -> None:
        values = self._lists.setdefault(name, [])
        values.append(count)
        _keep_latest(values, self._keep)
        frames, total = self._totals.get(name, (0, 0))
        self._totals[name] = frames + 1, total + count


def _keep_latest(values: list[Any], keep: int | None) -> int:
    """Drop the oldest once there are twice as many as are kept; how many were dropped."""
    n = len(values) - keep if keep is not None and len(values) >= 2 * keep else 0
    del values[:n]
    return n


def with_missing(per_frame: dict[str, list[Any]]) -> dict[str, list[Any]]:
    """The lists of a run with ``missing``: of each frame, the share of paged points that were not there."""
    if "missing_points" not in per_frame:
        return per_frame
    counts = zip(per_frame["missing_points"], per_frame["wanted_points"], strict=True)
    return per_frame | {"missing": [missing / max(wanted, 1) for missing, wanted in counts]}


def spread_ms(seconds: list[float]) -> dict[str, float]:
    """Median, minimum, 95th percentile and maximum, in milliseconds; empty for no samples."""
    if not seconds:
        return {}
    values = np.asarray(seconds) * 1e3
    names = ("median", "min", "p95", "max")
    return dict(zip(names, (float(v) for v in np.percentile(values, [50, 0, 95, 100])), strict=True))


def summed_traffic(of_ranks: Iterable[Mapping[str, Mapping[str, int]]]) -> dict[str, dict[str, int]]:
    """Messages and bytes that ranks have sent together, by kind."""
    sums: dict[str, dict[str, int]] = {}
    for traffic in of_ranks:
        for kind, counts in traffic.items():
            of_kind = sums.setdefault(kind, {})
            for unit, n in counts.items():
                of_kind[unit] = of_kind.get(unit, 0) + n
    return sums


def rank_record(role: str, rank: int) -> dict[str, Any]:
    """Who this rank is: role, host, process, cores it may use, resident memory now and at its peak so far."""
    return {
        "rank": rank,
        "role": role,
        "host": platform.node(),
        "pid": os.getpid(),
        "cores": len(os.sched_getaffinity(0)),
        "rss_bytes": resident_bytes(),
        "peak_rss_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def machine_record() -> dict[str, Any]:
    """The machine and the versions that a figure stands with."""
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "commit": _commit(),
        "versions": {name: package_version(name) for name in ("splatpipe", "numpy", "numba", "mpi4py", "moderngl")},
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")


def _commit() -> str | None:
    """Commit of the checkout that this file stands in; None for an installed package."""
    checkout = Path(__file__).resolve().parent.parent
    if not (checkout / ".git").exists():
        return None
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def package_version(name: str) -> str | None:
    """Version of an installed package, None where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None
