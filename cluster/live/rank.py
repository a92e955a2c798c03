"""A rank's part of a live run: settings that change, pictures and metrics that go to the hub."""

from __future__ import annotations

import platform
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from ...nodes.picture.compose import Picture
from ...shared.messages import FrameStart
from ...shared.store import Scene
from ..job import Job
from ..record import FrameCounts, StageClock
from ..render_stage import RenderStage
from .metrics import Meter
from .pictures import Pictures
from .settings import configured

if TYPE_CHECKING:
    from ..layout import Layout, Plan
    from ..transport import Transport
    from .coordinator import LiveCoordinator
    from .sockets import RunLink

METRICS_S = 0.5


class LiveRank:
    """What the frame loop of a live run asks of this rank; a context manager.

    job : of the configuration as it was given.  link : to the hub.  role : what this rank is called.
    """

    def __init__(self, job: Job, link: RunLink, rank: int = 0, role: str = "all") -> None:
        self._given, self._job, self.link = job, job, link
        self._named = {"rank": rank, "role": role, "host": platform.node()}
        self._coordinator: LiveCoordinator | None = None
        self._share: Scene | None = None
        self._shown = False
        self._points: Any = None
        self._stage = ExitStack()
        self._pictures: Pictures | None = None

    def __enter__(self) -> LiveRank:
        return self

    def __exit__(self, *_: object) -> None:
        self._stage.close()  # of a rank that draws, closed by the frame loop already

    def coordinator(self, layout: Layout, transport: Transport | None, plan: Plan) -> LiveCoordinator:
        """The coordinator of this run, on rank 0."""
        from .coordinator import LiveCoordinator

        self._coordinator = LiveCoordinator(self._given, layout, transport, plan, self.link)
        return self._coordinator

    def measure(self, clocks: Iterable[StageClock], counts: FrameCounts, transport: Transport | None) -> None:
        """Tell the hub of times and counts from here on, twice a second, in a thread of its own: also at rest."""
        meter = Meter(clocks, counts, transport)
        over, begun = threading.Event(), time.monotonic()

        def tell() -> None:
            while not over.wait(METRICS_S):
                given = {"queue": self._coordinator.queue} if self._coordinator else {}
                if self._points is not None:
                    given["pixels"] = self._job.views.width * self._job.views.height
                values = meter.values(**given)
                said = {"kind": "metrics", **self._named, "t": time.monotonic() - begun, "values": values}
                self.link.send(said)

        thread = threading.Thread(target=tell, name="metrics")
        thread.start()
        self._stage.callback(thread.join)
        self._stage.callback(over.set)

    def changed(self, settings: Mapping[str, Any]) -> Job:
        """The job of other settings; the coordinator has seen to it that they are allowed."""
        job = self._given.with_config(configured(self._given.config, settings))
        job.threads = self._given.threads
        if self._share is not None and job.colouring.range_is_open:  # the ends of a colour map are those of all points
            job.colouring = job.colouring.settled(job.scene)
        return job

    @contextmanager
    def open_render(
        self, progress: Callable[[str, int], None], share: Scene | None, *, shown: bool
    ) -> Iterator[RenderStage]:
        """The render stage of the settings as they were given, with its points loaded."""
        self._share, self._shown = share, shown
        progress("loading points", 0)
        self._points = self._given.load_any(share, verify=self._given.config.scene.verify)
        with self._stage:
            if shown:
                self._pictures = self._stage.enter_context(Pictures(self.link, self._given.config.live.jpeg_quality))
            self._render_stack = self._stage.enter_context(ExitStack())
            yield self._open(self._given, progress)

    def render(self, job: Job) -> RenderStage:
        """The render stage of a job that ``changed`` gave; the one before is closed."""
        self._render_stack.close()
        self._points = job.load_after(self._job, self._points, self._share)
        return self._open(job, lambda *_: None)

    def show(self, start: FrameStart, picture: Picture) -> None:
        """Hand a picture to the encoder, in place of one that it has not begun."""
        assert self._pictures
        assert picture.rgba is not None
        self._pictures.put(start, picture.rgba)

    def _open(self, job: Job, progress: Callable[[str, int], None]) -> RenderStage:
        self._job = job
        opened = job.open_render(progress, self._share, shown=self._shown, points=self._points, writes=False)
        return self._render_stack.enter_context(opened)
