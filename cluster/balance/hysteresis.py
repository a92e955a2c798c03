"""When a proposal is worth changing to: not for noise, not for less than it costs, and not there and back again."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

HORIZON_FRAMES = 64
"""Frames for which the work is thought to stay where it is, at least: else for as long as the plan has held."""


@dataclass
class Hysteresis:
    """Decides over one policy, measurement after measurement.

    threshold : most that the slowest part takes, in means of all parts, for parts that are even enough.
    least_gain : least gain for which borders move, as a share of what the slowest rank takes of a frame.
    tries : changes that may bring less than half of what they promised. Each one more makes the number of measurements
    in a row that must be above the threshold four times as long, at most ``most_patience``: where the work is not as
    thought, borders come to rest. Once parts at rest are less even by ``unrest`` than they were, the view has changed,
    and there is another try.

    What changes have brought is summed up, so that one and its reversal bring nothing together; what the view does in
    between does not count.
    """

    threshold: float = 1.1
    least_gain: float = 0.05
    tries: int = 4
    most_patience: int = 64
    unrest: float = 0.1
    _above: int = field(default=0, init=False)
    _misses: int = field(default=0, init=False)
    _brought: float = field(default=0.0, init=False)
    _most_brought: float = field(default=0.0, init=False)
    _at_rest: float = field(default=np.inf, init=False)
    _promised: tuple[float, float] | None = field(default=None, init=False)

    def measured(self, parts: np.ndarray) -> None:
        """Take note of the (n,) seconds of the parts under the plan that holds."""
        found = imbalance(parts)
        if self._promised is not None:
            before, promised = self._promised
            self._brought += before - found
            if self._brought > self._most_brought + (before - promised) / 2:
                self._misses = max(0, self._misses - 1)
            else:
                self._misses += 1
            self._most_brought = max(self._most_brought, self._brought)
            self._promised, self._at_rest = None, found
        self._at_rest = min(self._at_rest, found)
        if found > self._at_rest + self.unrest:
            self._misses, self._at_rest = min(self._misses, self.tries), found
        self._above = self._above + 1 if found > self.threshold else 0

    @property
    def patience(self) -> int:
        """Measurements in a row that must be above the threshold."""
        return int(min(4 ** max(0, self._misses - self.tries), self.most_patience))

    @property
    def is_uneven(self) -> bool:
        """Whether the parts have been uneven for long enough."""
        return self._above >= self.patience

    def accepts(
        self,
        parts: np.ndarray,
        expected: np.ndarray,
        *,
        slowest_s: float,
        adopting_s: float,
        frames_held: int,
        frames_left: int,
    ) -> bool:
        """Whether to change to a plan whose parts are expected to take (n,) seconds, in place of those of now.

        slowest_s : what the slowest of all ranks takes of a frame: what gains less than a share of that is for nothing.
        adopting_s : what a change of plan was measured to cost.
        frames_held, frames_left : how long the plan has held, and how long the run goes on.
        """
        gain_s = float(parts.max() - expected.max())
        frames = min(frames_left, max(frames_held, HORIZON_FRAMES))
        accepted = gain_s > self.least_gain * slowest_s and gain_s * frames > adopting_s
        if accepted:
            self._promised, self._above = (imbalance(parts), imbalance(expected)), 0
        return accepted


def imbalance(parts: np.ndarray) -> float:
    """What the slowest of (n,) parts takes, in means of all; 1 where nothing takes any time."""
    mean = float(parts.mean())
    return float(parts.max()) / mean if mean > 0 else 1.0
