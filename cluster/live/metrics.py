"""What a rank of a live run says of itself (``metrics`` in PROTOCOL.md): means over the frames since it last did.

``LiveRank`` calls ``Meter.values`` about twice a second, also while no frame is drawn.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable
from typing import Protocol

from ...shared.process_memory import resident_bytes
from ..record import FrameCounts, StageClock

POINT_BYTES = 16
"""Of a point in a pool of pages that has a colour."""

_SAID = {"cells_visible": "cells", "entries": "entries", "points": "points"}
"""Counts of a frame → what they are called in ``metrics``."""


class Traffic(Protocol):
    """What a meter needs of a ``Transport``."""

    def traffic(self) -> dict[str, dict[str, int]]:
        """Messages and bytes sent, by kind."""
        ...

    def received_bytes(self) -> dict[str, int]:
        """Bytes received, by kind."""
        ...


class Meter:
    """Takes the values of one rank, in one thread; no thread, file or socket of its own.

    clocks : of the rank's stages; those that have no frame say nothing.  counts : of its frames.
    transport : None where there is one rank.  point_bytes : of a paged point.  clock : seconds, for tests.
    """

    def __init__(
        self,
        clocks: Iterable[StageClock],
        counts: FrameCounts,
        transport: Traffic | None = None,
        *,
        point_bytes: int = POINT_BYTES,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clocks = list(clocks)
        self._counts, self._transport, self._point_bytes, self._clock = counts, transport, point_bytes, clock
        self._time = self._cpu_s = 0.0
        self._stages: dict[str, tuple[int, float, float]] = {}
        self._totals: dict[str, tuple[int, int]] = {}
        self._sent = self._received = 0
        self._latest: dict[str, float] = {}
        self._take()

    def values(self, **given: float) -> dict[str, float]:
        """Name → finite number, by the names of PROTOCOL.md: rates and means since the last call.

        given : what only the caller knows: ``queue`` on rank 0, ``pixels`` of a frame on render ranks. What is not
        finite is left out.
        Stages are left out while no frame was done; ``points``, ``entries`` and ``cells`` are then those of before.
        Cost: 0.05 ms, two reads of /proc.
        """
        then, cpu_s, stages, totals = self._time, self._cpu_s, self._stages, self._totals
        sent, received = self._sent, self._received
        self._take()
        elapsed = max(self._time - then, 1e-6)
        frames = 0
        values: dict[str, float] = {}
        for stage, (n, worked_s, waited_s) in self._stages.items():
            n_before, worked_before, waited_before = stages[stage]
            done = n - n_before
            frames = max(frames, done)
            if done > 0:
                values[f"{stage}.work_ms"] = 1e3 * (worked_s - worked_before) / done
                values[f"{stage}.wait_ms"] = 1e3 * (waited_s - waited_before) / done
        since = {name: (n - totals.get(name, (0, 0))[0], of - totals.get(name, (0, 0))[1])
                 for name, (n, of) in self._totals.items()}  # fmt: skip
        self._latest |= {_SAID[name]: of / n for name, (n, of) in since.items() if n and name in _SAID}
        values |= self._latest
        values["frames_per_s"] = frames / elapsed
        if self._transport:
            values["sent_bytes_per_s"] = max(self._sent - sent, 0) / elapsed  # whoever starts counting anew resets it
            values["received_bytes_per_s"] = max(self._received - received, 0) / elapsed
        values["cpu"] = (self._cpu_s - cpu_s) / elapsed
        values["memory_bytes"] = resident_bytes()
        values["threads"] = len(os.listdir("/proc/self/task"))
        if "wanted_points" in since:
            values |= self._paged(since, elapsed)
        return {name: float(value) for name, value in (values | given).items() if math.isfinite(value)}

    def _paged(self, since: dict[str, tuple[int, int]], elapsed: float) -> dict[str, float]:
        """Of points that stay on disk. missing : share of the points that frames were drawn without.

        cache_hits : share of the bytes that frames drew from which the pool had already.
        """
        wanted, missing, loaded = (since[name][1] for name in ("wanted_points", "missing_points", "loaded_bytes"))
        found = {"loaded_bytes_per_s": loaded / elapsed}
        if wanted:
            found["missing"] = missing / wanted
            found["cache_hits"] = max(0.0, 1 - loaded / (wanted * self._point_bytes))
        return found

    def _take(self) -> None:
        """Where everything stands now."""
        self._time, self._cpu_s = self._clock(), time.process_time()
        self._stages = {clock.stage: (clock.frames, clock.worked_s, clock.waited_s) for clock in self._clocks}
        self._totals = dict(self._counts.totals())
        if self._transport:
            self._sent = sum(of["bytes"] for of in self._transport.traffic().values())
            self._received = sum(self._transport.received_bytes().values())
