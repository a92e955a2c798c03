"""``splatpipe build`` and ``synth`` on several ranks: starting them, and what each does."""

from __future__ import annotations

import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..shared.build import BuildReport, BuildSettings
from ..shared.build.on_ranks import build_scene_on_ranks
from ..shared.build.ranks import FailedElsewhere, step
from ..shared.errors import InputError, SplatpipeError
from ..shared.messages import Kind
from ..shared.readers.described import DescribedSource, described
from ..shared.readers.source import Source
from .launch import check_started, fail_all, launch, mpi_available, record, say_failed, show_traceback
from .progress import FrameProgress

if TYPE_CHECKING:
    from .transport import Transport

_NOTE_EVERY_S = 0.25
"""How often a rank says how far it is, and asks whether another has failed."""


def start_ranks(n_ranks: int) -> int:
    """Start this command once more on ``n_ranks`` ranks and show what they report; their exit status.

    Raises InputError where MPI is missing.
    """
    if not mpi_available():
        raise InputError(f"--ranks {n_ranks}: MPI is missing; install splatpipe[mpi] or leave --ranks out")
    with FrameProgress(None) as progress:

        def show(content: dict[str, Any]) -> None:
            progress.show(content["doing"], content["done"], content["total"])

        return launch(without_ranks(sys.argv[1:]), n_ranks, show)


def without_ranks(arguments: list[str]) -> list[str]:
    """The arguments less ``--ranks N``."""
    left, skip = [], False
    for argument in arguments:
        is_option = argument == "--ranks" and not skip
        if not (skip or is_option or argument.startswith("--ranks=")):
            left.append(argument)
        skip = is_option
    return left


def build_on_ranks(
    names: Callable[[], list[str]],
    open_named: Callable[[str], Source],
    output: Path,
    settings: BuildSettings,
    n_ranks: int,
    tell: Callable[[BuildReport], None],
) -> int:
    """Do this rank's part of a build; the exit status. What is wrong is said once, by the rank that found it first.

    names : of the inputs, asked for on rank 0.  n_ranks : that are expected; 0: any number.
    tell : called on rank 0, with what was done.
    """
    from .transport import Transport

    transport = Transport(depth=64)
    transport.patience_s = math.inf  # a part of a build takes as long as it takes
    record(rank=transport.rank, role="building", pid=os.getpid())
    try:
        check_started(transport.size, transport.library)
        if n_ranks not in (0, transport.size):
            raise InputError(f"--ranks: found a world of {transport.size} ranks, expected {n_ranks}")
        with FrameProgress(None, on_terminal=transport.rank == 0) as progress:
            ranks = MpiRanks(transport, progress)
            sources = _open_together(ranks, names, open_named)
            report = build_scene_on_ranks(sources, output, ranks, settings=settings, progress=ranks.show)
        if report is not None:
            tell(report)
        transport.meet()
    except SplatpipeError as error:
        if not isinstance(error, FailedElsewhere):
            show_traceback(error)
            say_failed(_named(transport.rank, str(error)), error.exit_status)
        transport.meet()  # so that the line is out before a rank ends
        return error.exit_status
    except BaseException as error:  # the others do not know
        fail_all(transport, _named(transport.rank, f"{type(error).__name__}: {error}"), 1, error)
    return 0


def _open_together(
    ranks: MpiRanks, names: Callable[[], list[str]], open_named: Callable[[str], Source]
) -> list[Source]:
    """The sources that rank 0 names; of several, each rank opens some and tells the others what they say."""
    told = ""
    with step(ranks):
        if ranks.rank == 0:
            told = json.dumps(names())
    found = json.loads(ranks.gather(told.encode())[0])
    own = range(ranks.rank, len(found), ranks.size) if len(found) > 1 else range(len(found))
    opened: dict[int, Source] = {}
    with step(ranks):
        opened = {i: open_named(found[i]) for i in own}
    if len(found) == 1:
        return list(opened.values())
    said: dict[str, Any] = {}
    for part in ranks.gather(json.dumps({i: described(source) for i, source in opened.items()}).encode()):
        said |= json.loads(part)
    return [opened.get(i) or DescribedSource(said[str(i)], open_named) for i in range(len(found))]


def _named(rank: int, why: str) -> str:
    return f"rank {rank}: {why}" if rank else why


class MpiRanks:
    """``shared.build.ranks.Ranks`` over MPI. Ranks wait politely; rank 0 shows how far all are."""

    def __init__(self, transport: Transport, progress: FrameProgress) -> None:
        self.rank, self.size = transport.rank, transport.size
        self._transport, self._progress = transport, progress
        self._talking = threading.Lock()
        self._next_note = 0.0
        self._failed = False
        self._stage = "starting"
        self._told: dict[str, Any] = {}
        self._done: dict[str, dict[int, tuple[int, int | None]]] = {}  # stage → rank → points done, and in all

    def ranks_here(self) -> int:
        """As ``Transport`` has it; so are the next four."""
        return self._met().count_here(True)

    def agree(self, status: int) -> list[int]:
        """A small number of every rank."""
        return self._met().agree(status)

    def join(self, values: np.ndarray) -> np.ndarray:
        """The values of all ranks."""
        return self._met().join(values)

    def total(self, counts: np.ndarray) -> np.ndarray:
        """Sums over all ranks."""
        return self._met().total(counts)

    def gather(self, data: bytes) -> list[bytes]:
        """The bytes of each rank."""
        return self._met().gather(data)

    def warn(self) -> None:
        """Tell the others that this rank has failed."""
        for rank in range(self.size):
            if rank != self.rank:
                self._transport.send_note(rank, Kind.BUILD, 0, {"failed": True})

    def warned(self) -> bool:
        """Whether another rank has, as of the last time they talked."""
        return self._failed

    def show(self, stage: str, done: int, total: int | None) -> None:
        """How far this rank is: the progress of its build. From any thread."""
        self._stage = stage
        self._done.setdefault(stage, {})[self.rank] = done, total
        self._talk()

    def _met(self) -> Transport:
        self._transport.meet(self._talk)  # the collective calls themselves wait without sleep under MPICH
        return self._transport

    def _talk(self) -> None:
        """Now and then: send or take and show how far this rank is, and find out whether another one has failed."""
        if time.monotonic() < self._next_note or not self._transport.may_talk() or not self._talking.acquire(False):
            return
        try:
            self._next_note = time.monotonic() + _NOTE_EVERY_S
            for rank in range(self.size):
                while rank != self.rank and self._transport.has_note(rank, Kind.BUILD):
                    self._take(rank, self._transport.receive_note(rank, Kind.BUILD)[1])
            if not self.rank:
                self._show()
            elif self._transport.idle(0):  # notes must not pile up where rank 0 has no time for them
                done, total = self._done.get(self._stage, {}).get(self.rank, (0, None))
                note = {"stage": self._stage, "done": done, "total": total}
                if note != self._told:
                    self._transport.send_note(0, Kind.BUILD, 0, note)
                    self._told = note
        finally:
            self._talking.release()

    def _take(self, rank: int, note: dict[str, Any]) -> None:
        if note.get("failed"):
            self._failed = True
        else:
            self._done.setdefault(note["stage"], {})[rank] = note["done"], note["total"]

    def _show(self) -> None:
        counts = list(self._done.get(self._stage, {}).values())
        done = sum(n for n, _ in counts)
        totals = [total for _, total in counts]
        total = None if None in totals else sum(n for n in totals if n is not None)
        record(doing=self._stage, done=done, total=total)
        self._progress.show(self._stage, done, total)
