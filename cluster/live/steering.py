"""What the next picture of a live run is: from where, with which settings, how large, and whether there is one at all.

Times are seconds of one clock, given by the caller: nothing here waits, sends or draws.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ...shared.config import LiveSection
from ...shared.messages import Use
from .protocol import View

SCALES = (1.0, 0.84, 0.71, 0.59, 0.5, 0.42, 0.35, 0.3, 0.25, 0.21, 0.18, 0.15, 0.125, 0.1)
"""Of the sides of a picture while the camera moves: some 1.4 in pixels from one to the next."""
MULTIPLE_PX = 8
"""Widths of smaller pictures are multiples of this."""
MAX_SCREENSHOTS = 4
_BUSY = 0.9
"""Share of the time between two pictures that drawing one may take."""
_IDLE = 0.5
_RAISE_AFTER = 12
"""Pictures in a row that take less than ``_IDLE`` before they become larger."""
_UNSEEN_S = 1.0
"""After so long, a picture that nobody has acknowledged holds up no other."""


@dataclass(frozen=True)
class Wanted:
    """The next picture.

    size : width and height, px.  scale : of the size that was asked for.  t : the viewer's clock.
    asked_s : when it was asked for.  at : when the hub had that from a viewer; None where nobody waits for it.
    screenshot : who asked for it: viewer, request.
    """

    view: View
    use: Use
    settings: Mapping[str, Any]
    size: tuple[int, int]
    scale: float
    t: float
    viewer: int
    asked_s: float
    at: float | None
    screenshot: Mapping[str, Any] | None = None


@dataclass
class Scale:
    """How large pictures are while the camera moves, so that their time is kept: one step at a time."""

    least: float
    step: int = 0
    _quick: int = 0
    _slow: int = 0

    @property
    def now(self) -> float:
        """Of each side."""
        return SCALES[self.step]

    def took(self, busy_s: float, period_s: float) -> None:
        """A moving picture took ``busy_s`` of the slowest rank, of ``period_s`` that there are for one."""
        lowest = next((i for i, s in enumerate(SCALES) if s <= self.least), len(SCALES) - 1)
        self._quick = self._quick + 1 if busy_s < _IDLE * period_s else 0
        self._slow = self._slow + 1 if busy_s > _BUSY * period_s else 0
        if self._slow >= 2 and self.step < lowest:
            far = 2 if busy_s > 2 * period_s else 1
            self.step, self._slow = min(self.step + far, lowest), 0
        elif self._quick >= _RAISE_AFTER and self.step:
            self.step, self._quick = self.step - 1, 0


@dataclass
class Steering:
    """The latest of all that viewers have said.

    viewers : how many want pictures; none: there are no pictures.
    """

    view: View
    size: tuple[int, int]
    live: LiveSection
    settings: dict[str, Any] = field(default_factory=dict)
    viewers: int = 0
    _t: float = 0.0
    _viewer: int = 0
    _asked_s: float = 0.0
    _at: float | None = None
    _moving: bool = False
    _due: Use | None = Use.STILL
    _last_s: float = -1e9
    _screenshots: deque[dict[str, Any]] = field(default_factory=deque)
    _unseen: deque[tuple[int, float]] = field(default_factory=deque)

    def __post_init__(self) -> None:
        self.scale = Scale(self.live.least_scale)

    def looked(self, view: View, moving: bool, t: float, viewer: int, now: float, at: float | None = None) -> None:
        """The camera has moved, or come to rest."""
        self.view, self._t, self._viewer, self._at = view, t, viewer, at
        self._ask(moving, now)

    def set(self, settings: dict[str, Any], size: tuple[int, int], live: LiveSection, viewer: int, now: float) -> None:
        """Settings have changed; more changes may follow at once, as of a slider."""
        self.settings, self.size, self.live, self._viewer, self._t, self._at = settings, size, live, viewer, 0.0, None
        self.scale.least = live.least_scale
        self._ask(True, now)

    def watched(self, viewers: int, now: float) -> None:
        """So many viewers want pictures."""
        came, self.viewers = viewers > self.viewers, viewers
        if came and self._due is None and not self._moving:
            self._due = Use.STILL  # who comes sees what is there

    def shoot(self, request: dict[str, Any]) -> bool:
        """Take a screenshot of {viewer, request, width, height}. False: too many wait."""
        if len(self._screenshots) >= MAX_SCREENSHOTS:
            return False
        self._screenshots.append(request)
        return True

    def started(self, frame: int, now: float) -> None:
        """A picture for viewers has been begun."""
        self._unseen.append((frame, now))

    def shown(self, frame: int) -> None:
        """A viewer has seen a picture, and so no earlier one is waited for."""
        while self._unseen and self._unseen[0][0] <= frame:
            self._unseen.popleft()

    def next(self, now: float, room: int = 3) -> Wanted | None:
        """The picture to begin now; None: none, or not yet (``wait_s``). room : unseen ones, at most."""
        if self._screenshots:
            shot = self._screenshots.popleft()
            of = {name: shot[name] for name in ("viewer", "request")}
            size = shot["width"], shot["height"]
            return Wanted(self.view, Use.SCREENSHOT, self.settings, size, 1.0, 0.0, shot["viewer"], now, None, of)
        if not self.viewers or self.wait_s(now, room) > 0:
            return None
        use = self._due or Use.STILL
        scale = self.scale.now if use is Use.MOVING else 1.0
        self._due, self._last_s = None, now
        if use is Use.STILL:
            self._moving = False
        t, at, self._t, self._at = self._t, self._at, 0.0, None  # of one picture, not of another that follows by itself
        size = _sized(self.size, scale)
        return Wanted(self.view, use, self.settings, size, scale, t, self._viewer, self._asked_s, at)

    def wait_s(self, now: float, room: int = 3) -> float:
        """Seconds until the next picture may be begun if nobody says anything; a minute: not before somebody does."""
        if self._screenshots:
            return 0.0
        if not self.viewers:
            return 60.0
        while self._unseen and now - self._unseen[0][1] > _UNSEEN_S:
            self._unseen.popleft()
        if len(self._unseen) >= room:
            return self._unseen[0][1] + _UNSEEN_S - now
        if self._due is None and not self._moving:
            return 60.0
        period = 1 / self.live.fps
        if self._due is None:  # the camera may stand
            return max(self._asked_s + self.live.still_after_s - now, 0.0)
        return max(self._last_s + period - now, 0.0) if self._due is Use.MOVING else 0.0

    def _ask(self, moving: bool, now: float) -> None:
        self._asked_s, self._moving = now, moving
        self._due = Use.MOVING if moving else Use.STILL


def _sized(size: tuple[int, int], scale: float) -> tuple[int, int]:
    if scale == 1.0:
        return size
    width = min(max(MULTIPLE_PX, round(size[0] * scale / MULTIPLE_PX) * MULTIPLE_PX), size[0])
    return width, max(1, round(size[1] * width / size[0]))  # the same shape: nothing jumps when the camera stands
