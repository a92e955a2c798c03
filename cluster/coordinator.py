"""The coordinator: starts frames on the ranks of a layout, and hears when they are done."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from ..shared.messages import FrameStart, Kind
from .job import Job
from .layout import Layout, Plan
from .transport import Transport

if TYPE_CHECKING:
    from .balance.balancer import Balancer

Progress = Callable[[str, int], None]
"""Called with what is going on and how many frames are done."""


class Coordinator:
    """Starts frames on the other ranks, few enough at a time, and hears when they are done. On rank 0.

    balancer : has the plan of each frame; None: the first one holds.
    plans : by number, those that frames were started by and that this rank has not adopted yet.
    """

    def __init__(
        self, job: Job, layout: Layout, transport: Transport | None, plan: Plan, balancer: Balancer | None = None
    ) -> None:
        self._job, self._transport, self._plan, self._balancer = job, transport, plan, balancer
        self.plans: dict[int, Plan] = {}
        self._others = [rank for rank in layout.workers if rank]
        self._display = layout.display
        self._ahead = job.frames_in_flight if self._others else 1 + job.frames_ahead
        self._starts: list[FrameStart] = []
        self._issued_s: list[float] = []
        self.latency_s: list[float] = []

    def start(self, i: int, progress: Progress) -> FrameStart:
        """Frame ``i`` as this rank is to do it, once it may start; as many others as may start have been started."""
        self._issue()
        while len(self._starts) <= i or self._has_done():
            self._hear(progress)
            self._issue()
        return self._starts[i]

    def finished(self, note: Mapping[str, Any]) -> None:
        """Take note that the display has finished the next frame."""
        self.latency_s.append(time.perf_counter() - self._issued_s[len(self.latency_s)])

    def finish(self, progress: Progress) -> None:
        """Hear of every frame that is still to be finished."""
        while len(self.latency_s) < len(self._job.frames):
            self._hear(progress)

    def _issue(self) -> None:
        frames = self._job.frames
        while len(self._starts) < min(len(frames), len(self.latency_s) + self._ahead):
            if self._balancer:
                self._change_to(self._balancer.plan_for(len(self._starts), self._plan))
            start = FrameStart(self._job.camera(frames[len(self._starts)]), self._plan.number)
            for rank in self._others:
                assert self._transport
                self._transport.send(rank, start)
            self._starts.append(start)
            self._issued_s.append(time.perf_counter())

    def _change_to(self, plan: Plan) -> None:
        if plan is self._plan:
            return
        self._plan = self.plans[plan.number] = plan
        for rank in self._others:
            assert self._transport
            self._transport.send_note(rank, Kind.PLAN, 0, plan.to_note())

    def _has_done(self) -> bool:
        return bool(self._display and self._transport and self._transport.has_note(self._display, Kind.FRAME_DONE))

    def _hear(self, progress: Progress) -> None:
        assert self._transport
        self._transport.receive_note(self._display, Kind.FRAME_DONE)
        self.finished({})
        progress("rendering", len(self.latency_s))
