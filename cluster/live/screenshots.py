"""Screenshots that viewers ask for, which cost the run pictures that others wait for: one after the other, with pauses.

A screenshot may be many times the size of a picture. After each, the run has ``REST`` times as long for pictures.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from ...shared.errors import InputError
from .protocol import ScreenshotWanted

MAX_WAITING = 8
MAX_WAITING_EACH = 2
REST = 8.0
MAX_REST_S = 30.0
PATIENCE_S = 120.0
"""With the run, for one; then it is given up."""


class _Wanted(NamedTuple):
    viewer: int
    request: int
    width: int
    height: int


class Screenshots:
    """Who has asked for one, and whose turn it is.

    to_run : sends a header to rank 0; False: it could not.  refuse : tells a viewer, by its number, why not.
    """

    def __init__(self, to_run: Callable[[dict[str, Any]], bool], refuse: Callable[[int, int, str], None]) -> None:
        self._to_run, self._refuse = to_run, refuse
        self._waiting: deque[_Wanted] = deque()
        self._under_way: _Wanted | None = None
        self._since = 0.0
        self._not_before = 0.0

    def ask(self, viewer: int, wanted: ScreenshotWanted) -> None:
        """Take one when it is its turn. Raises InputError where too many wait."""
        known = [one for one in (self._under_way, *self._waiting) if one is not None]
        own = [one.request for one in known if one.viewer == viewer]
        if len(own) >= MAX_WAITING_EACH or wanted.request in own:
            raise InputError("other screenshots are still under way")
        if len(known) >= MAX_WAITING:
            raise InputError("too many screenshots are waiting")
        self._waiting.append(_Wanted(viewer, wanted.request, wanted.width, wanted.height))
        self.tick()

    def done(self, viewer: int, request: int) -> bool:
        """The run has answered, with a picture or a refusal. Whether that was awaited."""
        one = self._under_way
        if one is None or (one.viewer, one.request) != (viewer, request):
            return False
        self._under_way = None
        now = time.monotonic()
        self._not_before = now + min(REST * (now - self._since), MAX_REST_S)
        return True

    def forget(self, viewer: int) -> None:
        """A viewer has gone. One that is under way has its pause nevertheless."""
        self._waiting = deque(one for one in self._waiting if one.viewer != viewer)

    def tick(self) -> None:
        """To be called now and then: the next one, if it is time."""
        now = time.monotonic()
        if self._under_way is not None and now - self._since > PATIENCE_S:
            self._refuse(self._under_way.viewer, self._under_way.request, f"no picture within {PATIENCE_S:g} s")
            self._under_way = None
        if self._under_way is not None or not self._waiting or now < self._not_before:
            return
        if self._to_run({"kind": "screenshot", **self._waiting[0]._asdict()}):
            self._under_way, self._since = self._waiting.popleft(), now
