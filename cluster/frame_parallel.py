"""Frame-parallel: each rank draws whole pictures, as one rank alone would, and writes them itself.

Picture i of those to be drawn goes to rank i mod n: neighbours on a camera path take about as long, so that ranks end
together. Rank 0 hears of each frame that another rank has drawn, and at the end of everything that rank has counted and
timed. Where there is a film, rank 0 is sent its pictures (``film``).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..shared.messages import Kind
from .coordinator import Progress
from .drawn import Drawn
from .film import GatheredFilm, SentFilm
from .job import Job
from .layout import ALONE
from .pipeline import FrameLoop
from .record import FrameCounts, StageClock, rank_record, summed_traffic
from .sink import Film
from .transport import Transport


def frames_of(frames: Sequence[int], views: int, rank: int, size: int) -> list[int]:
    """Of frames, ``views`` to a picture, those of the whole pictures that a rank draws, in their order."""
    return [frame for i, frame in enumerate(frames) if i // views % size == rank]


def run_frame_parallel(job: Job, transport: Transport, progress: Progress) -> dict[str, Any] | None:
    """Draw and write this rank's pictures; the statistics of the run on rank 0, None elsewhere. Collective."""
    views, whole = job.views.per_picture, job.frames
    frames = [frames_of(whole, views, rank, transport.size) for rank in range(transport.size)]
    job.frames = frames[transport.rank]
    job.make_film = _film_maker(job, frames, transport)
    work = _first_rank if transport.rank == 0 else _other_rank
    result = work(job, frames, transport, progress)
    transport.finish()
    job.frames = whole
    return result


def _film_maker(job: Job, frames: list[list[int]], transport: Transport) -> Callable[[Path, float], Film]:
    pictures = [[frame // job.views.per_picture for frame in of[:: job.views.per_picture]] for of in frames]
    if transport.rank:
        return lambda path, fps: SentFilm(transport, pictures[transport.rank])
    return lambda path, fps: GatheredFilm(path, fps, transport, pictures, *job.picture_size)


def _other_rank(job: Job, frames: list[list[int]], transport: Transport, _: Progress) -> None:
    def tell(doing: str, done: int) -> None:
        if doing == "rendering":
            transport.send_note(0, Kind.FRAME_DONE, job.frames[done - 1])

    drawn = FrameLoop(job, ALONE, None, tell, transport.meet).run()
    transport.send_note(0, Kind.STATISTICS, len(job.frames), _told(drawn, transport))


def _first_rank(job: Job, frames: list[list[int]], transport: Transport, progress: Progress) -> dict[str, Any]:
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

    drawn = FrameLoop(job, ALONE, None, show, transport.meet).run()
    for rank in range(1, transport.size):
        while done[rank] < len(frames[rank]):
            hear(rank)
            show("rendering", done[0])
    drawn = replace(drawn, drawn=time.perf_counter())
    told = [_told(drawn, transport)]
    told += [transport.receive_note(rank, Kind.STATISTICS)[1] for rank in range(1, transport.size)]
    return _merged(drawn, told, frames)


def _told(drawn: Drawn, transport: Transport) -> dict[str, Any]:
    """What rank 0 is told of a rank, JSON-able."""
    record = rank_record("pictures", transport.rank)
    record |= {"stages": {clock.stage: clock.summary() for clock in drawn.clocks}, "loading_s": drawn.loading_s}
    return {
        "rank": record,
        "work_s": {clock.stage: clock.work_s for clock in drawn.clocks},
        "wait_s": {clock.stage: clock.wait_s for clock in drawn.clocks},
        "counts": drawn.counts.lists(),
        "times": drawn.times,
        "latency_s": drawn.latency_s,
        "messages": transport.traffic(),
    }


def _merged(drawn: Drawn, told: list[dict[str, Any]], frames: list[list[int]]) -> dict[str, Any]:
    """The statistics of the run, of those that each rank told of its frames; lists are in the order of frames."""
    drawn_in_turn = [frame for of_rank in frames for frame in of_rank]

    def in_order(lists: list[list[Any]]) -> list[Any]:
        found = dict(zip(drawn_in_turn, (value for values in lists for value in values), strict=True))
        return [found[frame] for frame in sorted(found)]

    clocks = []
    for stage in told[0]["work_s"]:
        clock = StageClock(stage)
        clock.work_s = in_order([of["work_s"].get(stage, []) for of in told])
        clock.wait_s = [value for of in told for value in of["wait_s"].get(stage, [])]  # not in every frame
        clocks.append(clock)
    names = told[0]["counts"]
    counts = FrameCounts({name: in_order([of["counts"].get(name, []) for of in told]) for name in names})
    times = {name: [value for of in told for value in of["times"].get(name, [])] for name in told[0]["times"]}
    latency_s = in_order([of["latency_s"] for of in told])
    messages = summed_traffic(of["messages"] for of in told)
    merged = replace(drawn, clocks=clocks, counts=counts, times=times, latency_s=latency_s)
    return merged.record() | {"ranks": [of["rank"] for of in told], "messages": messages}
