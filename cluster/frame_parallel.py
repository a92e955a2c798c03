"""Frame-parallel: each rank draws whole pictures, as one rank alone would, and writes them itself.

Picture i is drawn by rank i mod n: neighbours on a camera path take about as long, so that ranks end together. Rank 0
hears of each frame that another rank has drawn, and at the end of everything that rank has counted and timed.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from ..shared.messages import Kind
from .job import Job
from .pipeline import Drawn, Progress, draw_alone
from .record import FrameCounts, StageClock, rank_record
from .topologies import role_of
from .transport import Transport


def frames_of(job: Job, rank: int, size: int) -> list[int]:
    """The frames, views of whole pictures, that a rank draws, ascending."""
    views = job.views.per_picture
    return [picture * views + view for picture in job.pictures[rank::size] for view in range(views)]


def run_frame_parallel(job: Job, transport: Transport, progress: Progress) -> dict[str, Any] | None:
    """Draw and write this rank's pictures; the statistics of the run on rank 0, None elsewhere. Collective."""
    work = _first_rank if transport.rank == 0 else _other_rank
    result = work(job, transport, progress)
    transport.finish()
    return result


def _other_rank(job: Job, transport: Transport, _: Progress) -> None:
    frames = frames_of(job, transport.rank, transport.size)

    def tell(doing: str, done: int) -> None:
        if doing == "rendering":
            transport.send_note(0, Kind.FRAME_DONE, frames[done - 1])

    drawn = draw_alone(job, frames, tell, transport.meet)
    transport.send_note(0, Kind.STATISTICS, len(frames), _told(job, drawn, transport))


def _first_rank(job: Job, transport: Transport, progress: Progress) -> dict[str, Any]:
    frames = [frames_of(job, rank, transport.size) for rank in range(transport.size)]
    done = [0] * transport.size

    def hear(rank: int) -> None:
        transport.receive_note(rank, Kind.FRAME_DONE)
        done[rank] += 1

    def show(doing: str, of_these: int) -> None:
        done[0] = of_these
        for rank in range(1, transport.size):
            while done[rank] < len(frames[rank]) and transport.has_note(rank, Kind.FRAME_DONE):
                hear(rank)
        progress(doing, sum(done))

    drawn = draw_alone(job, frames[0], show, transport.meet)
    for rank in range(1, transport.size):
        while done[rank] < len(frames[rank]):
            hear(rank)
            show("rendering", done[0])
    drawn = replace(drawn, drawn=time.perf_counter())
    told = [_told(job, drawn, transport)]
    told += [transport.receive_note(rank, Kind.STATISTICS)[1] for rank in range(1, transport.size)]
    return _merged(drawn, told, frames)


def _told(job: Job, drawn: Drawn, transport: Transport) -> dict[str, Any]:
    """What rank 0 is told of a rank, JSON-able."""
    record = rank_record(role_of(job.config.pipeline, transport.rank), transport.rank)
    record |= {"stages": {clock.stage: clock.summary() for clock in drawn.clocks}, "loading_s": drawn.loading_s}
    return {
        "rank": record,
        "work_s": [clock.work_s for clock in drawn.clocks],
        "wait_s": [clock.wait_s for clock in drawn.clocks],
        "counts": drawn.counts.lists(),
        "times": drawn.times,
    }


def _merged(drawn: Drawn, told: list[dict[str, Any]], frames: list[list[int]]) -> dict[str, Any]:
    """The statistics of the run, of those that each rank told of its frames; lists are in the order of frames."""
    drawn_in_turn = [frame for of_rank in frames for frame in of_rank]

    def in_order(lists: list[list[Any]]) -> list[Any]:
        found = dict(zip(drawn_in_turn, (value for values in lists for value in values), strict=True))
        return [found[frame] for frame in sorted(found)]

    clocks = [StageClock(clock.stage) for clock in drawn.clocks]
    for i, clock in enumerate(clocks):
        clock.work_s = in_order([of["work_s"][i] for of in told])
        clock.wait_s = [value for of in told for value in of["wait_s"][i]]  # a stage need not wait in every frame
    names = told[0]["counts"]
    counts = FrameCounts({name: in_order([of["counts"].get(name, []) for of in told]) for name in names})
    times = {name: [value for of in told for value in of["times"].get(name, [])] for name in drawn.times}
    merged = replace(drawn, clocks=clocks, counts=counts, times=times)
    return merged.record() | {"ranks": [of["rank"] for of in told], "messages": {}}
