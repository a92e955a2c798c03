"""What a monitor knows of a run: the latest values of every rank, what was predicted, and how a few went over time.

Messages may come from a file that somebody has tampered with: nothing is taken without a check, everything has a bound,
and text has no control characters.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import islice
from typing import Any

from ...shared.errors import MessageError

HUB = -1
"""Rank as which the hub speaks of itself."""

STAGES = ("culling", "sampling", "render", "compositing", "picture")
"""In the order of the pipeline; others come after them."""

HISTORY = 512
"""Values that are kept of a watched parameter."""
MAX_RANKS = 4096
MAX_VALUES = 96
"""Of a rank."""
MAX_SERIES = 64
MAX_TEXT = 64


@dataclass
class RankState:
    """What a rank said last, and what was predicted of it: name → number."""

    rank: int
    role: str = ""
    host: str = ""
    values: dict[str, float] = field(default_factory=dict)
    predicted: dict[str, float] = field(default_factory=dict)

    @property
    def stages(self) -> list[str]:
        """Its stages, in the order of the pipeline."""
        found = [name.removesuffix(".work_ms") for name in self.values if name.endswith(".work_ms")]
        return sorted(found, key=lambda stage: (STAGES.index(stage) if stage in STAGES else len(STAGES), stage))


class Board:
    """The state that messages add up to.

    watched : names of metrics, or patterns of them (``render.*``), whose course is kept.
    t : seconds of the run.  run : of ``welcome``, its text and numbers.  ended : why there is no run any more.
    heard : messages with metrics so far.
    """

    def __init__(self, watched: Sequence[str] = ()) -> None:
        self.watched = tuple(watched)
        self.t = 0.0
        self.heard = 0
        self.run: dict[str, Any] = {}
        self.ended = ""
        self.ranks: dict[int, RankState] = {}
        self.series: dict[tuple[str, int], deque[float]] = {}
        self.rate: deque[float] = deque(maxlen=HISTORY)

    def hear(self, header: dict[str, Any]) -> bool:
        """Take a header in; whether there is something new to show. Raises MessageError for one that is damaged."""
        kind = header.get("kind")
        if kind == "metrics":
            self.t = number(header.get("t", self.t), "metrics.t")
            self._hear_values(header, "values")
            self.heard += 1
            self._remember()
            return True
        if kind == "prediction":
            self._hear_values(header, "predicted")
            return True
        if kind == "welcome":
            self._welcome(header.get("run"))
            return True
        if kind == "bye":
            self.ended = text(header.get("why", "")) or "the run has ended"
            return True
        return False

    def in_order(self) -> list[RankState]:
        """The ranks, the hub not among them."""
        return [self.ranks[rank] for rank in sorted(self.ranks) if rank != HUB]

    def total(self, name: str) -> float | None:
        """Sum of a value over the ranks that have it; None if none has."""
        found = [of.values[name] for of in self.in_order() if name in of.values]
        return sum(found) if found else None

    def of_first(self, name: str, kind: str = "values") -> float | None:
        """The value of the lowest rank that has it."""
        return next((getattr(of, kind)[name] for of in self.in_order() if name in getattr(of, kind)), None)

    @property
    def frames_per_s(self) -> float | None:
        """Frames that are done: of the slowest rank that has any, as ranks of a lane may have none of a frame."""
        found = [of.values["frames_per_s"] for of in self.in_order() if of.stages and "frames_per_s" in of.values]
        return min(found, default=self.of_first("frames_per_s"))

    @property
    def hub(self) -> dict[str, float]:
        """What the hub says of itself."""
        return self.ranks[HUB].values if HUB in self.ranks else {}

    def _hear_values(self, header: dict[str, Any], kind: str) -> None:
        """Take in ``ranks`` of a message, whole or not at all. Ranks that it leaves out stay as they were."""
        found = rank_values(header)
        if len(self.ranks.keys() | {of.rank for of in found}) > MAX_RANKS:
            raise MessageError(f"{header['kind']}.ranks: expected at most {MAX_RANKS}")
        for of in found:
            state = self.ranks.setdefault(of.rank, of)
            state.role, state.host = of.role or state.role, of.host or state.host
            if kind == "values":  # a rank that rests, or a hub that nobody answers, says no times: the last ones hold
                held = state.values.items() if state is not of else ()
                times = [(name, value) for name, value in held if name.endswith("_ms") and name not in of.values]
                state.values = dict(times[: MAX_VALUES - len(of.values)]) | of.values
            else:
                state.values, state.predicted = (state.values if state is not of else {}), of.values

    def _welcome(self, run: Any) -> None:
        if not isinstance(run, dict):
            raise MessageError("welcome.run: expected an object")
        names = ("scene", "topology", "rasterizer", "points", "cells")
        said = {name: run[name] for name in names if isinstance(run.get(name), str | int | float)}
        before, self.run = (
            self.run,
            {name: text(of) if isinstance(of, str) else number(of, f"welcome.run.{name}") for name, of in said.items()},
        )
        self.ended = ""
        if self.run != before:
            self.ranks.clear()  # another run, not the same after a while
        ranks = run.get("ranks")
        if isinstance(ranks, list) and len(ranks) <= MAX_RANKS:
            for of in rank_values({"kind": "welcome", "ranks": ranks}):
                self.ranks.setdefault(of.rank, of)

    def _remember(self) -> None:
        rate = self.frames_per_s
        if rate is not None:
            self.rate.append(rate)
        for of in self.ranks.values() if self.watched else ():
            for name, value in of.values.items():
                if any(fnmatchcase(name, pattern) for pattern in self.watched):
                    key = name, of.rank
                    if key in self.series or len(self.series) < MAX_SERIES:
                        self.series.setdefault(key, deque(maxlen=HISTORY)).append(value)


def rank_values(header: dict[str, Any]) -> list[RankState]:
    """The ``ranks`` of a message, checked. Raises MessageError in one line."""
    kind, ranks = header["kind"], header.get("ranks")
    if not isinstance(ranks, list) or len(ranks) > MAX_RANKS:
        raise MessageError(f"{kind}.ranks: expected a list of at most {MAX_RANKS} ranks")
    found = []
    for of in ranks:
        if not isinstance(of, dict):
            raise MessageError(f"{kind}.ranks: expected objects")
        rank, values = of.get("rank"), of.get("values", {})
        if not isinstance(rank, int) or isinstance(rank, bool) or not HUB <= rank < 1 << 20:
            raise MessageError(f"{kind}.ranks.rank: expected a whole number from {HUB} on")
        if not isinstance(values, dict):
            raise MessageError(f"{kind}.ranks.values: expected an object")
        known = {
            text(name): number(value, f"{kind}.ranks.values") for name, value in islice(values.items(), MAX_VALUES)
        }
        found.append(RankState(rank, text(of.get("role", "")), text(of.get("host", "")), known))
    return found


def number(value: Any, where: str) -> float:
    """A finite number. Raises MessageError naming where it stands."""
    try:
        found = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    except OverflowError:
        found = math.nan
    if not abs(found) <= 1e300:
        raise MessageError(f"{where}: expected finite numbers")
    return found


def text(value: Any) -> str:
    """Text for a terminal: one short line that moves no cursor. Raises MessageError for what is no text."""
    if not isinstance(value, str):
        raise MessageError("found something else where a text is expected")
    return "".join(c if c.isprintable() else "·" for c in value[:MAX_TEXT])
