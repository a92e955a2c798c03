"""A rank's part of a live run: settings that change, pictures and metrics that go to the hub."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from ...nodes.picture.compose import Picture
from ...shared.messages import FrameStart
from ...shared.store import Scene
from ..job import Job, RenderStage
from .pictures import Pictures
from .settings import configured

if TYPE_CHECKING:
    from ..layout import Layout, Plan
    from ..transport import Transport
    from .coordinator import LiveCoordinator
    from .sockets import RunLink


class LiveRank:
    """What the frame loop of a live run asks of this rank; a context manager.

    job : of the configuration as it was given.  link : to the hub.
    """

    def __init__(self, job: Job, link: RunLink) -> None:
        self._given, self._job, self.link = job, job, link
        self._share: Scene | None = None
        self._shown = False
        self._points: Any = None
        self._stage = ExitStack()
        self._pictures: Pictures | None = None

    def __enter__(self) -> LiveRank:
        return self

    def __exit__(self, *_: object) -> None:
        self._stage.close()

    def coordinator(self, layout: Layout, transport: Transport | None, plan: Plan) -> LiveCoordinator:
        """The coordinator of this run, on rank 0."""
        from .coordinator import LiveCoordinator

        return LiveCoordinator(self._given, layout, transport, plan, self.link)

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
