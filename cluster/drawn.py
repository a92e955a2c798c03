"""What a rank has to say of the frames it has drawn, and what a run says of what all ranks say."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .layout import Layout
from .record import FrameCounts, StageClock, rank_record, spread_ms, summed_traffic, with_missing
from .transport import Transport

STAGES = ("culling", "sampling", "render", "compositing", "picture")


@dataclass(frozen=True)
class Drawn:
    """What a rank has to say of its frames.

    clocks : of its stages.  times : of encoding, by kind of output.  held : what its record says beside the rest.
    latency_s : on the coordinator, of each frame.
    started, drawn : when the first frame began and the last one was drawn (``time.perf_counter``).
    """

    clocks: list[StageClock]
    counts: FrameCounts
    times: dict[str, list[float]]
    rasterizer: str
    held: dict[str, Any]
    latency_s: list[float]
    loading_s: float
    started: float
    drawn: float

    def record(self) -> dict[str, Any]:
        """The statistics of a run of these frames, but for its ranks and messages."""
        return {
            "rasterizer": self.rasterizer,
            "stages": {clock.stage: clock.summary() for clock in self.clocks},
            "latency_ms": spread_ms(self.latency_s),
            "per_frame": with_missing(
                {f"{clock.stage}_s": clock.work_s for clock in self.clocks} | self.counts.lists() | self.times
            ),
            "loading_s": self.loading_s,
            "rendered_s": self.drawn - self.started,
            "finished_s": time.perf_counter() - self.started,
        }


def told_of(layout: Layout, drawn: Drawn, transport: Transport) -> dict[str, Any]:
    """What rank 0 is told of a rank, JSON-able."""
    record = rank_record(layout.role_of(transport.rank), transport.rank) | drawn.held
    record |= {"stages": {clock.stage: clock.summary() for clock in drawn.clocks}, "loading_s": drawn.loading_s}
    return {
        "rank": record,
        "work_s": {clock.stage: clock.work_s for clock in drawn.clocks},
        "wait_s": {clock.stage: sum(clock.wait_s) for clock in drawn.clocks},
        "counts": drawn.counts.lists(),
        "times": drawn.times,
        "rasterizer": drawn.rasterizer,
        "messages": transport.traffic(),
    }


def merged(drawn: Drawn, told: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The statistics of the run of what each rank told: a stage takes as long as the slowest of its ranks."""
    clocks = []
    for stage in STAGES:
        having = [of for of in told if stage in of["work_s"]]
        if having:
            clock = StageClock(stage)
            clock.work_s = np.max([of["work_s"][stage] for of in having], axis=0).tolist()
            clock.wait_s = [min(of["wait_s"][stage] for of in having)]
            clocks.append(clock)
    counts: dict[str, list[Any]] = {}
    for of in told:
        for name, values in of["counts"].items():
            counts[name] = np.add(counts[name], values).tolist() if name in counts else values
    names = dict.fromkeys(name for of in told for name in of["times"])
    times = {name: [s for of in told for s in of["times"].get(name, [])] for name in names}
    rasterizer = next(of["rasterizer"] for of in told if of["rasterizer"])
    per_frame = with_missing({f"{clock.stage}_s": clock.work_s for clock in clocks} | counts | times)
    return drawn.record() | {
        "rasterizer": rasterizer,
        "stages": {clock.stage: clock.summary() for clock in clocks},
        "per_frame": per_frame,
        "ranks": [of["rank"] for of in told],
        "messages": summed_traffic(of["messages"] for of in told),
    }
