"""Stage times on their way to rank 0: a note of some frames at a time, so that messages are few.

Nobody waits for a note. Rank 0 takes those that have come when it starts frames.

Where the processor draws, a stage takes no longer than its processor time: a rank that waits for a core, because there
are more ranks than cores, has no more work for that. What a GPU draws is timed by the clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...shared.errors import MessageError
from ..record import StageClock
from . import BUSY_STAGES

FRAMES_A_NOTE = 4
"""Frames of a note: enough for a median, few enough to follow a camera."""


@dataclass(frozen=True)
class StageTimes:
    """What a rank's stages took of some frames.

    first : position of the first of them among those of the job.  seconds : by stage, (n,) float64.
    adopting_s : what the last change of plan took it, seconds.
    """

    first: int
    seconds: Mapping[str, np.ndarray]
    adopting_s: float

    def to_note(self) -> dict[str, Any]:
        """JSON-able."""
        seconds = {stage: values.tolist() for stage, values in self.seconds.items()}
        return {"first": self.first, "seconds": seconds, "adopting_s": self.adopting_s}

    @classmethod
    def from_note(cls, note: Mapping[str, Any], rank: int) -> StageTimes:
        """What ``to_note`` gave. Raises MessageError for anything else."""
        try:
            first, adopting_s = int(note["first"]), float(note["adopting_s"])
            seconds = {stage: np.array(values, np.float64) for stage, values in note["seconds"].items()}
        except (KeyError, TypeError, ValueError, AttributeError):
            raise MessageError(f"STAGE_TIMES from rank {rank}: expected first, adopting_s and seconds") from None
        for stage, values in seconds.items():
            if stage not in BUSY_STAGES or values.shape != (FRAMES_A_NOTE,) or not (values >= 0).all():
                raise MessageError(
                    f"STAGE_TIMES from rank {rank}: {stage}: expected {FRAMES_A_NOTE} times of one of {BUSY_STAGES}"
                )
        return cls(first, seconds, adopting_s)


def taken(clock: StageClock, by_processor: bool, first: int = 0) -> np.ndarray:
    """(n,) seconds of the frames of a stage from the ``first`` on, as far as its clock keeps them."""
    first = max(first - clock.dropped, 0)
    work = np.array(clock.work_s[first:])
    return np.minimum(work, clock.cpu_s[first:]) if by_processor else work


class TimesTeller:
    """Tells of a rank's clocks, whenever there are frames for a note.

    by_processor : as of ``taken``.
    adopting_s : seconds of each plan that the rank adopted so far, which it adds to.
    """

    def __init__(
        self,
        clocks: Mapping[str, StageClock],
        by_processor: bool,
        adopting_s: Sequence[float],
        tell: Callable[[StageTimes], None],
    ) -> None:
        self._clocks, self._by_processor, self._adopting_s, self._tell = clocks, by_processor, adopting_s, tell

    def done(self, i: int) -> None:
        """Take note that the frame at position ``i`` is done."""
        first = i + 1 - FRAMES_A_NOTE
        if (i + 1) % FRAMES_A_NOTE:
            return
        found = {stage: taken(self._clocks[stage], self._by_processor, first) for stage in BUSY_STAGES}
        seconds = {stage: values for stage, values in found.items() if len(values)}
        self._tell(StageTimes(first, seconds, self._adopting_s[-1]))
