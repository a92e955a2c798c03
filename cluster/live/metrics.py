"""What a rank of a live run says of itself (``metrics`` in PROTOCOL.md): means over the frames since it last did.

A ``Reporter`` asks its ``Meter`` twice a second, also while the run rests, and sends what it gets:

    clocks = {name: StageClock(name, keep=KEPT_FRAMES) for name in STAGES}
    counts = FrameCounts(keep=KEPT_FRAMES)
    meter = Meter(clocks.values(), counts, transport)
    with Reporter(meter, link, rank, role, host, lambda: {"queue": frames.queue}):
        …

Whoever would rather ask between two frames calls ``meter.values(queue=…, pixels=…)`` and sends that.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol, Self

from ..record import FrameCounts, StageClock, resident_bytes

KEPT_FRAMES = 64
"""Frames whose times and counts a live run keeps: more than balancing looks at (``balance.times``)."""

EVERY_S = 0.5
"""Between two messages."""

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
    """Takes the values of one rank; called by one thread, which need not be that of the frames.

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


class Link(Protocol):
    """What a reporter needs of a ``RunLink``."""

    def send(self, header: dict[str, Any]) -> bool:
        """Send without waiting."""
        ...


class Reporter:
    """Sends a rank's values to the hub again and again, from a thread of its own; context manager.

    link : of this rank.  given : what only the rank knows, as of ``Meter.values``; called from the thread.
    Messages that the hub has no room for are lost.  Cost: 0.1 ms a message.
    """

    def __init__(
        self,
        meter: Meter,
        link: Link,
        rank: int,
        role: str,
        host: str,
        given: Callable[[], Mapping[str, float]] = dict,
        *,
        every_s: float = EVERY_S,
    ) -> None:
        self._meter, self._link, self._given, self._every_s = meter, link, given, every_s
        self._head = {"kind": "metrics", "rank": rank, "role": role, "host": host}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="metrics", daemon=True)

    def _run(self) -> None:
        begun = time.monotonic()
        while not self._over.wait(self._every_s):
            values = self._meter.values(**self._given())
            self._link.send(self._head | {"t": time.monotonic() - begun, "values": values})

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
