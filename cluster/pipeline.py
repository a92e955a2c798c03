"""The frame loop: culling → sampling → render → display, on the ranks of a layout.

Every rank goes through the frames in order and does its stages of each; what a stage makes for another rank is sent,
what it makes for this one is handed on. On three ranks frame *i* is drawn while *i + 1* is sampled and *i + 2* culled
(thesis 5.2). The coordinator, rank 0, starts a frame only while fewer than ``frames_in_flight`` are unfinished, so
nothing piles up. A live run has no last frame: its coordinator (``live``) says when it is over, and settings change
with plans. Each rank opens only its half of the scene: the selection ranks never load a point, the render rank
no octree unless it has a share of the points. Where the scene is delivered by messages, the sampling rank reads the
render rank's half for it and sends it (``delivery``).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ..shared.config import RunConfig
from ..shared.messages import (
    FRAME_START_BYTES,
    RENDER_POINT,
    FrameStart,
    Kind,
    Message,
    RenderPoints,
    Use,
    VisibilityBits,
    decode_frame_start,
    decode_render_points,
    decode_visibility,
)
from ..shared.scene_share import SceneShare
from .balance import can_balance, is_on
from .compositing import make_compositor
from .compositing.tiles import Tiles
from .coordinator import Coordinator, Progress
from .delivery import receive_scene, serve_scene
from .drawn import STAGES, Drawn, merged, told_of
from .job import Job
from .layout import ALONE, Layout, Plan
from .record import KEPT_FRAMES, FrameCounts, StageClock, rank_record
from .render_stage import RenderStage
from .selection import CullingPart, LaneCells, SamplingPart, first_plan, merged_entries, shares_of, with_borders
from .transport import Transport
from .wall import screen_windows, writes_screens

if TYPE_CHECKING:
    from ..shared.camera import Camera
    from ..shared.octree import Octree
    from .balance.balancer import Balancer
    from .balance.times import StageTimes, TimesTeller
    from .live.rank import LiveRank

CULLING, SAMPLING, RENDER = range(3)
"""Ranks of a chain of three, where a scene is delivered by messages."""


def run_single(job: Job, progress: Progress) -> dict[str, Any]:
    """All stages in this process, frame after frame; the statistics of the run. Imports no MPI."""
    drawn = FrameLoop(job, ALONE, None, progress).run()
    return drawn.record() | {"ranks": [rank_record("single", 0)], "messages": {}}


def run_layout(job: Job, layout: Layout, transport: Transport, progress: Progress) -> dict[str, Any] | None:
    """Do this rank's part of a layout; the statistics of the run on rank 0, None elsewhere. Collective."""
    loop = FrameLoop(job, layout, transport, progress)
    drawn = loop.run()
    told = told_of(layout, drawn, transport)
    screens = bool(screen_windows(job, layout))
    if can_balance(layout, screens):
        told |= {"taken_s": loop.taken_s(), "adopting_s": loop.adopting_s}
    result = None
    if transport.rank == 0:
        others = [rank for rank in layout.workers if rank]
        all_told = [told, *(transport.receive_note(rank, Kind.STATISTICS)[1] for rank in others)]
        result = merged(drawn, all_told)
        if can_balance(layout, screens) and len(job.frames):
            from .balance.summary import balance_record

            result["balance"] = balance_record(layout, all_told, loop.balancer, screens)
    elif transport.rank in layout.workers:
        transport.send_note(0, Kind.STATISTICS, len(job.frames), told)
    transport.finish()
    return result


def receive_job(config: RunConfig, transport: Transport) -> Job:
    """The render rank's job on the scene that the sampling rank sends. Raises MessageError, InputError."""
    scene, colour = receive_scene(transport, SAMPLING)
    settled = {"render": config.render.model_copy(update={"colour": colour})}
    return Job(config.model_copy(update=settled), scene)


class Frames(Protocol):
    """Starts the frames of a run and hears when they are done; ``coordinator`` or ``live.coordinator``. On rank 0.

    plans : by number, those that frames were started by and that this rank has not adopted yet.
    latency_s : of each frame that is done.
    """

    plans: dict[int, Plan]
    latency_s: list[float]

    def start(self, i: int, progress: Progress) -> FrameStart:
        """Frame ``i`` as this rank is to do it, once it may start."""
        ...

    def finished(self, note: Mapping[str, Any]) -> None:
        """Take note that the display has finished the next frame. note : busy_s, how long it took the display."""
        ...

    def finish(self, progress: Progress) -> None:
        """Hear of every frame that is still to be finished."""
        ...


class FrameLoop:
    """One rank's way through the frames of a job.

    transport : None where there is one rank.  ready : called when all is loaded, before the first frame; by default
    the ranks meet.  live : this rank's part of a live run, where frames come until it is over.
    """

    def __init__(
        self,
        job: Job,
        layout: Layout,
        transport: Transport | None,
        progress: Progress,
        ready: Callable[[], object] | None = None,
        live: LiveRank | None = None,
    ) -> None:
        self._job, self._layout, self._transport, self._progress = job, layout, transport, progress
        self._rank = transport.rank if transport else 0
        self._ready = ready or (transport.meet if transport else lambda: None)
        self._lane = layout.lane_of(self._rank)
        stages = layout.lanes[self._lane].stages_of(self._rank) if self._lane is not None else []
        self._culls, self._samples, self._renders = (stage in stages for stage in STAGES[:3])
        self._shows = self._rank == layout.display
        keep = KEPT_FRAMES if live else None
        self._clocks = {name: StageClock(name, keep=keep) for name in STAGES}
        self._waits_in = self._clocks[stages[0] if stages else "culling"]
        self._counts = FrameCounts(keep=keep)
        self._numbers = count()
        self._handed: dict[tuple[Kind, int], deque[Any]] = {}  # from a stage of this rank to the next
        self._held: dict[str, Any] = {}
        self._plan = Plan(-1, (), (), ())
        self._culling: CullingPart | None = None
        self._sampling: SamplingPart | None = None
        self.adopting_s: list[float] = []
        self._live = live
        self._render: RenderStage | None = None
        self._balances = not live and is_on(job.config.pipeline, layout, bool(screen_windows(job, layout)))
        self.balancer: Balancer | None = None

    def run(self) -> Drawn:
        """Load what this rank's stages need, and do its part of every frame of the job."""
        loading = time.perf_counter()
        with ExitStack() as stack:
            self._open_selection()
            self._render = self._open_render(stack)
            self._warm_up_selection()
            self._progress("loading the scene", 0)
            self._ready()
            tell = self._open_balance() if self._balances else None
            started = time.perf_counter()
            frames = self._open_frames() if self._rank == 0 else None
            for i, (start, chosen, of_layers) in enumerate(self._coming(frames)):
                if chosen:
                    self._draw(start, chosen, of_layers)
                if self._shows:
                    self._finished(start, frames)
                if tell:
                    tell.done(i)
            if frames:
                frames.finish(self._progress)
            drawn = time.perf_counter()
            if self.balancer:
                self.balancer.finish()
        return Drawn(
            [clock for clock in self._clocks.values() if clock.work_s],
            self._counts,
            self._render.times() if self._render else {},
            self._render.description if self._render else "",
            self._held,
            frames.latency_s if frames else [],
            started - loading,
            started,
            drawn,
        )

    def _open_frames(self) -> Frames:
        if self._live:
            return self._live.coordinator(self._layout, self._transport, self._plan)
        return Coordinator(self._job, self._layout, self._transport, self._plan, self.balancer)

    # --- before the first frame --------------------------------------------------------------------------------------

    def _open_selection(self) -> None:
        """The octree and this rank's parts of it, if it selects or has a share of the points."""
        job, layout = self._job, self._layout
        if self._samples and self._transport and not self._shows and job.config.scene.delivery == "messages":
            serve_scene(job.scene, job.colour, self._transport, layout.display)
        self._shares: list[tuple[int, int]] = []
        self._lanes: list[LaneCells] = []
        selects = self._culls or self._samples
        if selects or (self._renders and layout.split == "shares"):
            whole = job.load_octree()
            self._shares = shares_of(layout, whole)
            if selects:
                self._lanes = self._lanes_of(whole)
        self._adopt(first_plan(job, layout, self._lanes))
        first = layout.lanes[0]
        culls, samples = self._rank == first.culling[0], self._rank == first.sampling[0]
        layers = job.layer_nodes() if culls or samples else []
        self._layer_culling = [node for node, _ in layers] if culls else []
        self._layer_sampling = [node for _, node in layers] if samples else []

    def _lanes_of(self, whole: Octree) -> list[LaneCells]:
        lanes, shares = self._layout.lanes, self._shares
        own = shares and len(shares) == len(lanes) > 1
        return [LaneCells(lane, whole, shares[i] if own else None) for i, lane in enumerate(lanes)]

    def _adopt(self, plan: Plan) -> None:
        """Make this rank's parts what a plan says."""
        begun = time.process_time()
        held = self._plan
        if not plan.culling:  # of a coordinator that knows no borders
            plan = replace(plan, culling=held.culling, sampling=held.sampling)
        self._plan = plan
        is_changed = self._live is not None and plan.settings != held.settings
        if self._live and is_changed:
            before, self._job = self._job, self._live.changed(plan.settings)
            self._render = self._render and self._live.render(self._job)
            if self._lanes and not self._job.same_octree(before):
                self._lanes = self._lanes_of(self._job.load_octree())
        if self._lane is not None and (self._culls or self._samples):
            if is_changed or (held.culling, held.sampling) != (plan.culling, plan.sampling):
                self._make_parts(self._lane, plan)
            for part in filter(None, (self._culling, self._sampling)):
                part.look_through(self._layout, self._lane, plan)
        if not self._live:  # in which nobody asks, and for days
            self.adopting_s.append(time.process_time() - begun)

    def _make_parts(self, lane: int, plan: Plan) -> None:
        ranks, cells = self._layout.lanes[lane], self._lanes[lane]
        if self._culls:
            part = ranks.culling.index(self._rank)
            self._culling = CullingPart(self._job, self._layout, lane, cells, plan, part)
        if self._samples:
            part = ranks.sampling.index(self._rank)
            self._sampling = SamplingPart(self._job, self._layout, lane, cells, plan, part, self._shares)

    def _open_balance(self) -> TimesTeller:
        """Begin to tell rank 0 of stage times; on rank 0, to hear of them."""
        from .balance.balancer import Balancer, make_policies, receive_cells, send_cells
        from .balance.times import TimesTeller

        transport, layout = self._transport, self._layout
        assert transport
        cells = [lane.dealt for lane in self._lanes]
        by_processor = self._job.rasterizer == "cpu"
        rank_0_selects = layout.lanes[0].stages_of(0) != ["render"]
        if self._rank == 0:
            if not rank_0_selects:
                cells = receive_cells(layout, transport)
                self._plan = with_borders(self._plan, layout, cells)
            views, screens = self._job.views, bool(screen_windows(self._job, layout))
            policies = make_policies(layout, cells, views.width, views.height, screens)
            self.balancer = Balancer(layout, transport, policies, self._job.frames)
            return TimesTeller(self._clocks, by_processor, self.adopting_s, self.balancer.hear)
        if not rank_0_selects and self._rank == layout.lanes[0].culling[0]:
            send_cells(cells, transport)

        def tell(times: StageTimes) -> None:
            transport.send_note(0, Kind.STAGE_TIMES, times.first, times.to_note())

        return TimesTeller(self._clocks, by_processor, self.adopting_s, tell)

    def taken_s(self) -> dict[str, list[float]]:
        """By stage, seconds of each frame as load is balanced by."""
        from .balance import BUSY_STAGES
        from .balance.times import taken

        by_processor = self._job.rasterizer == "cpu"
        clocks = (self._clocks[stage] for stage in BUSY_STAGES)
        return {clock.stage: taken(clock, by_processor).tolist() for clock in clocks if clock.work_s}

    def _open_render(self, stack: ExitStack) -> RenderStage | None:
        """The render stage of this rank, on its share of the points; None for a rank that draws nothing."""
        job, number = self._job, self._layout.render.index(self._rank) if self._renders else 0
        share, sample = None, np.empty(0)
        transport = self._transport if self._layout.split == "shares" else None
        if transport and self._renders:
            first, stop = self._shares[number]
            share = SceneShare(job.scene, first, stop, checked_by=(number, len(self._shares)))
            self._held = {"first_point": first, "points": stop - first}
            if job.colouring.range_is_open:
                sample = job.colouring.range_sample(share, first, job.scene.info.n_stored)
        if transport and job.colouring.range_is_open:  # the ends of a colour map are those of all points
            job.colouring = job.colouring.with_range_of(transport.join(sample))
        if not self._renders:
            return None
        screen = job.wall.screens[number] if job.wall and writes_screens(job, self._layout) else None
        self._waits_for_screens = self._transport if screen else None
        self._meet = None if screen else self._meeting()
        shown = self._shows or screen is not None
        if self._live:
            return stack.enter_context(self._live.open_render(self._progress, share, shown=shown))
        return stack.enter_context(job.open_render(self._progress, share, shown=shown, screen=screen))

    def _meeting(self) -> Callable[[int, np.ndarray], np.ndarray | None] | None:
        """What takes a frame's number and the words of all render ranks to those of the picture, on the display rank;
        None where one rank has it all.
        """
        ranks, transport, pipeline = self._layout.render, self._transport, self._job.config.pipeline
        if transport is None or len(ranks) == 1:
            return None
        if self._layout.split == "tiles":
            side_by_side = Tiles(transport, ranks)
            return lambda frame, words: side_by_side.assemble(frame, words, self._plan.windows)
        return make_compositor(pipeline.compositing, transport, ranks, radix=pipeline.radix).composite

    def _warm_up_selection(self) -> None:
        """Compile what selecting needs, or load what was compiled."""
        camera = self._job.camera(self._job.frames[0]) if len(self._job.frames) else self._job.camera(0)
        if self._culling:
            self._culling.process(camera)
        if self._sampling:
            self._sampling.process(
                camera, [VisibilityBits.pack(camera.frame, np.zeros(n, bool)) for n in self._sampling.n_cells]
            )

    # --- a frame -----------------------------------------------------------------------------------------------------

    def _coming(self, frames: Frames | None) -> Iterator[tuple[FrameStart, RenderPoints | None, list[RenderPoints]]]:
        """Frames in turn, selected as far as that is this rank's part: start, points and objects to draw.

        Where points are paged, up to ``frames_ahead`` more are selected, or received if they are there, before it is
        the turn of one, so that theirs are loaded meanwhile. None where plans change: they say how a frame is drawn.
        """
        if self._lane is None:
            return
        if self._live:
            self._live.measure(self._clocks.values(), self._counts, self._transport)
            while (frame := self._begin(next(self._numbers), frames))[0].use is not Use.END:
                yield frame
            return
        render = self._render
        n_ahead = render.frames_ahead if render and not self._balances else 0
        n_frames, begun = len(self._job.frames), 0
        ahead: deque[tuple[FrameStart, RenderPoints | None, list[RenderPoints]]] = deque()
        for i in range(n_frames):
            while begun < n_frames and (begun == i or (begun - i <= n_ahead and self._can_begin(frames))):
                ahead.append(self._begin(begun, frames))
                chosen = ahead[-1][1]
                if n_ahead and render and chosen:
                    render.expect(chosen)
                begun += 1
            yield ahead.popleft()

    def _can_begin(self, frames: Frames | None) -> bool:
        """Whether to begin another frame before it is its turn: this rank selects it, or somebody has."""
        if self._culls or self._samples or self._lane is None or not self._transport:
            return True
        sampled = (
            self._transport.has_note(rank, Kind.RENDER_POINTS) for rank in self._layout.lanes[self._lane].sampling
        )
        return bool(frames or self._transport.has_note(0, Kind.FRAME_START)) and all(sampled)

    def _begin(self, i: int, frames: Frames | None) -> tuple[FrameStart, RenderPoints | None, list[RenderPoints]]:
        """Do what comes before drawing of frame ``i``; without points for a rank that does not draw."""
        with self._waits_in.waiting():
            start = frames.start(i, self._progress) if frames else self._receive_start()
        if start.use is Use.END:
            return start, None, []
        self._follow(start.plan, frames)
        self._select(start.camera)
        if not self._renders:
            return start, None, []
        lane, info = self._layout.lanes[self._lane or 0], self._job.scene.info
        most = info.n_cells + info.n_stored // 2**31 + 1  # a longer range is split
        with self._clocks["render"].waiting():
            received = [self._take_entries(rank, most) for rank in lane.sampling]
            layers = self._job.layers if self._shows else []
            of_layers = [self._take_entries(self._layout.lanes[0].sampling[0], len(layer.octree)) for layer in layers]
        return start, merged_entries(start.camera.frame, received), of_layers

    def _receive_start(self) -> FrameStart:
        assert self._transport
        patient = self._live is not None  # nobody may move the camera for hours
        return decode_frame_start(*self._transport.receive(0, Kind.FRAME_START, FRAME_START_BYTES, patient=patient))

    def _follow(self, number: int, frames: Frames | None) -> None:
        """Adopt plans until the one of a number holds. Rank 0 may have started frames by later ones."""
        while self._plan.number < number:
            if frames:
                plan = frames.plans.pop(self._plan.number + 1)
            else:
                assert self._transport
                plan = Plan.from_note(self._transport.receive_note(0, Kind.PLAN)[1])
            self._adopt(plan)

    def _select(self, camera: Camera) -> None:
        """Do this rank's part of culling and sampling, and hand it to whoever samples and renders it."""
        if self._lane is None:
            return
        lane, first = self._layout.lanes[self._lane], self._layout.lanes[0]
        if self._culling:
            with self._clocks["culling"].working():
                bits = self._culling.process(camera)
                of_layers = [node.process(camera) for node in self._layer_culling]
            for part, message in zip(self._culling.receivers, bits, strict=True):
                self._hand(lane.sampling[part], Kind.VISIBILITY, message)
            for message in of_layers:
                self._hand(first.sampling[0], Kind.VISIBILITY, message)
            self._counts.add(self._culling.whole)
        if self._sampling:
            with self._clocks["sampling"].waiting():
                received = [
                    self._take_bits(lane.culling[part], n)
                    for part, n in zip(self._sampling.senders, self._sampling.n_cells, strict=True)
                ]
                bits_of_layers = [
                    self._take_bits(first.culling[0], len(layer.octree))
                    for layer in self._job.layers[: len(self._layer_sampling)]
                ]
            with self._clocks["sampling"].working():
                chosen, by_render = self._sampling.process(camera, received)
                of_layers = [
                    node.process(camera, seen) for node, seen in zip(self._layer_sampling, bits_of_layers, strict=True)
                ]
            for rank, message in zip(lane.render, by_render, strict=True):
                self._hand(rank, Kind.RENDER_POINTS, message)
            for message in of_layers:
                self._hand(self._layout.display, Kind.RENDER_POINTS, message)
            self._counts.add(chosen)

    def _draw(self, start: FrameStart, chosen: RenderPoints, of_layers: list[RenderPoints]) -> None:
        """Rasterize this rank's part, and on the display rank make the picture of all parts."""
        render, camera, clock = self._render, start.camera, self._clocks["render"]
        assert render
        with clock.working():
            words = render.rasterize(camera, chosen)
            picture = None if self._meet else render.compose(camera, words, of_layers)
        if self._meet:
            with self._clocks["compositing"].working():
                whole = self._meet(camera.frame, words)
            if whole is not None:
                with self._clocks["picture"].working():
                    picture = render.compose(camera, whole, of_layers)
        with clock.waiting():
            if self._live and picture is not None:
                self._live.show(start, picture)
            else:
                render.show(camera.frame, picture)
            if self._waits_for_screens:
                self._meet_screens(self._waits_for_screens, camera.frame)
        self._counts.add_layers(of_layers)
        self._counts.add_residency(render.residency)

    def _finished(self, start: FrameStart, frames: Frames | None) -> None:
        """On the display rank: let the coordinator know."""
        note = {"busy_s": sum(clock.work_s[-1] for clock in self._clocks.values() if clock.work_s)}
        if frames:
            frames.finished(note)
            self._progress("rendering", len(frames.latency_s))
        elif self._transport:
            self._transport.send_note(0, Kind.FRAME_DONE, start.frame, note if self._live else None)

    def _meet_screens(self, transport: Transport, frame: int) -> None:
        """On the display rank: wait for every other screen's part of a frame, so that it is done when all are."""
        display, *others = self._layout.render
        if self._rank != display:
            transport.send_note(display, Kind.FRAME_DONE, frame)
            return
        for rank in others:
            transport.receive_note(rank, Kind.FRAME_DONE)

    # --- between stages ----------------------------------------------------------------------------------------------

    def _hand(self, rank: int, kind: Kind, message: Message) -> None:
        if rank == self._rank:
            self._handed.setdefault((kind, rank), deque()).append(message)
        elif self._transport:
            self._transport.send(rank, message)

    def _take_bits(self, rank: int, n_cells: int) -> VisibilityBits:
        if rank == self._rank:
            return self._handed[Kind.VISIBILITY, rank].popleft()
        assert self._transport
        return decode_visibility(*self._transport.receive(rank, Kind.VISIBILITY, (n_cells + 7) // 8), n_cells)

    def _take_entries(self, rank: int, most: int) -> RenderPoints:
        if rank == self._rank:
            return self._handed[Kind.RENDER_POINTS, rank].popleft()
        assert self._transport
        limit = most * RENDER_POINT.itemsize
        return decode_render_points(*self._transport.receive(rank, Kind.RENDER_POINTS, limit))
