"""Stage times on their way to rank 0: a note of some frames at a time, so that messages are few.

Nobody waits for a note. Rank 0 takes those that have come when it starts frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...shared.errors import MessageError
from ..record import StageClock
from . import BUSY_STAGES

FRAMES_A_NOTE = 8
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


class TimesTeller:
    """Tells of a rank's clocks, whenever there are frames for a note.

    adopting_s : seconds of each plan that the rank adopted so far, which it adds to.
    """

    def __init__(
        self, clocks: Mapping[str, StageClock], adopting_s: Sequence[float], tell: Callable[[StageTimes], None]
    ) -> None:
        self._clocks, self._adopting_s, self._tell = clocks, adopting_s, tell

    def done(self, i: int) -> None:
        """Take note that the frame at position ``i`` is done."""
        first = i + 1 - FRAMES_A_NOTE
        if (i + 1) % FRAMES_A_NOTE:
            return
        worked = {stage: self._clocks[stage].work_s[first:] for stage in BUSY_STAGES}
        seconds = {stage: np.array(values) for stage, values in worked.items() if len(values)}
        self._tell(StageTimes(first, seconds, self._adopting_s[-1]))
