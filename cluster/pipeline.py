"""The frame loop: culling → sampling → render, on one rank or on three.

On three ranks frame *i* is drawn while *i + 1* is sampled and *i + 2* culled (thesis 5.2). The coordinator, which is
also the culling rank, starts a frame only while fewer than ``frames_in_flight`` are unfinished, so nothing piles up.
Each rank opens only its half of the scene: the selection ranks never load a point, the render rank no octree. Where
the scene is delivered by messages, the sampling rank reads the render rank's half for it and sends it (``delivery``).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from ..shared.camera import Camera
from ..shared.config import RunConfig
from ..shared.messages import (
    RENDER_POINT,
    Kind,
    RenderPoints,
    decode_camera,
    decode_render_points,
    decode_visibility,
)
from .delivery import receive_scene, serve_scene
from .job import Job
from .paging import told_ahead
from .record import FrameCounts, StageClock, rank_record, spread_ms
from .topologies import PIPELINE_ROLES as ROLES
from .transport import Transport

CULLING, SAMPLING, RENDER = range(3)
_MAX_CAMERA_BYTES = 1 << 10

Progress = Callable[[str, int], None]
"""Called with what is going on and how many frames are done."""


@dataclass(frozen=True)
class Drawn:
    """What a rank that does everything itself has to say of its frames.

    clocks : of culling, sampling and render.  times : of encoding, by kind of output.
    started, drawn : when the first frame began and the last one was drawn (``time.perf_counter``).
    """

    clocks: list[StageClock]
    counts: FrameCounts
    times: dict[str, list[float]]
    rasterizer: str
    loading_s: float
    started: float
    drawn: float

    def record(self) -> dict[str, Any]:
        """The statistics of a run of these frames, but for its ranks and messages."""
        return {
            "rasterizer": self.rasterizer,
            "stages": {clock.stage: clock.summary() for clock in self.clocks},
            "latency_ms": spread_ms([sum(t) for t in zip(*(clock.work_s for clock in self.clocks), strict=True)]),
            "per_frame": {f"{clock.stage}_s": clock.work_s for clock in self.clocks} | self.counts.lists() | self.times,
            "loading_s": self.loading_s,
            "rendered_s": self.drawn - self.started,
            "finished_s": time.perf_counter() - self.started,
        }


def run_single(job: Job, progress: Progress) -> dict[str, Any]:
    """All three nodes in this process, frame after frame; the statistics of the run. Imports no MPI."""
    drawn = draw_alone(job, range(job.n_frames), progress, lambda: None)
    return drawn.record() | {"ranks": [rank_record("single", 0)], "messages": {}}


def draw_alone(job: Job, frames: Sequence[int], progress: Progress, ready: Callable[[], None]) -> Drawn:
    """Draw frames, views of whole pictures, with all three nodes in this process, and write the pictures.

    ready : called when all is loaded, before the first frame.
    """
    loading = time.perf_counter()
    clocks = [StageClock(role) for role in ROLES]
    counts = FrameCounts()
    octree = job.load_octree()
    culling, sampling = job.culling_node(octree), job.sampling_node(octree)
    layers = job.layer_nodes()
    sampling.process(job.camera(0), culling.process(job.camera(0)))  # compiles, or loads what was compiled
    with job.open_render(progress) as render:
        ready()
        started = time.perf_counter()
        loading_s = started - loading

        def select(frame: int) -> tuple[Camera, RenderPoints, list[RenderPoints]]:
            camera = job.camera(frame)
            with clocks[CULLING].working():
                bits = culling.process(camera)
                bits_of_layers = [layer_culling.process(camera) for layer_culling, _ in layers]
            with clocks[SAMPLING].working():
                chosen = sampling.process(camera, bits)
                of_layers = [node.process(camera, seen) for (_, node), seen in zip(layers, bits_of_layers, strict=True)]
            counts.add(bits, chosen)
            return camera, chosen, of_layers

        selected = told_ahead(map(select, frames), render.frames_ahead, lambda frame: render.expect(frame[1]))
        for done, (camera, chosen, of_layers) in enumerate(selected, 1):
            with clocks[RENDER].working():
                picture = render.draw(camera, chosen, of_layers)
            with clocks[RENDER].waiting():
                render.show(camera.frame, picture)
            counts.add_layers(of_layers)
            counts.add_residency(render.residency)
            progress("rendering", done)
        drawn = time.perf_counter()
    return Drawn(clocks, counts, render.times(), render.description, loading_s, started, drawn)


def run_pipelined(job: Job, transport: Transport, progress: Progress) -> dict[str, Any] | None:
    """Do this rank's part of the pipeline; the statistics of the run on rank 0, None elsewhere.

    Ranks beyond the third have no part in this topology and only wait for the end. Collective.
    """
    match transport.rank:
        case 0:
            result = _coordinate(job, transport, progress)
        case 1:
            result = _sample(job, transport)
        case 2:
            result = _render(job, transport)
        case _:
            transport.meet()
            result = None
    transport.finish()
    return result


def _coordinate(job: Job, transport: Transport, progress: Progress) -> dict[str, Any]:
    loading = time.perf_counter()
    clock = StageClock("culling")
    culling = job.culling_node(job.scene.octree())
    culling.process(job.camera(0))
    layers = [layer_culling for layer_culling, _ in job.layer_nodes()]
    progress("loading the scene", 0)
    transport.meet()
    counts = FrameCounts()
    issued_s: list[float] = []
    latency_s: list[float] = []

    def frame_done() -> None:
        frame, _ = transport.receive_note(RENDER, Kind.FRAME_DONE)
        latency_s.append(time.perf_counter() - issued_s[frame])
        progress("rendering", frame + 1)

    started = time.perf_counter()
    loading_s = started - loading
    for frame in range(job.n_frames):
        with clock.waiting():
            while frame - len(latency_s) >= job.frames_in_flight or transport.has_note(RENDER, Kind.FRAME_DONE):
                frame_done()
        camera = job.camera(frame)
        issued_s.append(time.perf_counter())
        for rank in (SAMPLING, RENDER):
            transport.send(rank, camera)
        with clock.working():
            bits = culling.process(camera)
            bits_of_layers = [layer_culling.process(camera) for layer_culling in layers]
        for message in (bits, *bits_of_layers):
            transport.send(SAMPLING, message)
        counts.add(bits)
    while len(latency_s) < job.n_frames:
        frame_done()
    rendered_s = time.perf_counter() - started
    of_sampling, of_render = (transport.receive_note(rank, Kind.STATISTICS)[1] for rank in (SAMPLING, RENDER))
    ranks = [_statistics(transport, clock, counts), of_sampling, of_render]
    return {
        "rasterizer": of_render["rasterizer"],
        "ranks": [rank["rank"] for rank in ranks],
        "stages": {rank["stage"]: rank["summary"] for rank in ranks},
        "messages": {kind: count for rank in ranks for kind, count in rank["messages"].items()},
        "latency_ms": spread_ms(latency_s),
        "per_frame": {name: values for rank in ranks for name, values in rank["per_frame"].items()},
        "loading_s": loading_s,
        "rendered_s": rendered_s,
        "finished_s": time.perf_counter() - started,
    }


def receive_job(config: RunConfig, transport: Transport) -> Job:
    """The render rank's job on the scene that the sampling rank sends. Raises MessageError, InputError."""
    scene, colour = receive_scene(transport, SAMPLING)
    settled = {"render": config.render.model_copy(update={"colour": colour})}
    return Job(config.model_copy(update=settled), scene)


def _sample(job: Job, transport: Transport) -> None:
    clock = StageClock("sampling")
    if job.config.scene.delivery == "messages":
        serve_scene(job.scene, job.colour, transport, RENDER)
    octree = job.load_octree()
    sampling = job.sampling_node(octree)
    sampling.process(job.camera(0), job.culling_node(octree).process(job.camera(0)))
    transport.meet()
    layers = [node for _, node in job.layer_nodes()]
    n_cells = [len(octree), *(len(layer.octree) for layer in job.layers)]
    for _ in range(job.n_frames):
        with clock.waiting():
            camera = decode_camera(*transport.receive(CULLING, Kind.CAMERA, _MAX_CAMERA_BYTES))
            bits, *bits_of_layers = [
                decode_visibility(*transport.receive(CULLING, Kind.VISIBILITY, (n + 7) // 8), n) for n in n_cells
            ]
        with clock.working():
            chosen = [sampling.process(camera, bits)]
            chosen += [node.process(camera, seen) for node, seen in zip(layers, bits_of_layers, strict=True)]
        for message in chosen:
            transport.send(RENDER, message)
    transport.send_note(CULLING, Kind.STATISTICS, job.n_frames, _statistics(transport, clock, FrameCounts()))


def _render(job: Job, transport: Transport) -> None:
    clock = StageClock("render")
    counts = FrameCounts()
    info = job.scene.info
    most_entries = [info.n_cells + info.n_stored // 2**31 + 1]  # a longer range is split
    most_entries += [len(layer.octree) for layer in job.layers]
    with job.open_render(lambda *_: None) as render:
        transport.meet()
        ahead: deque[tuple[Camera, RenderPoints, list[RenderPoints]]] = deque()

        def receive() -> None:
            camera = decode_camera(*transport.receive(CULLING, Kind.CAMERA, _MAX_CAMERA_BYTES))
            chosen, *of_layers = [
                decode_render_points(*transport.receive(SAMPLING, Kind.RENDER_POINTS, n * RENDER_POINT.itemsize))
                for n in most_entries
            ]
            ahead.append((camera, chosen, of_layers))
            if render.frames_ahead:
                render.expect(chosen)

        for frame in range(job.n_frames):
            with clock.waiting():
                if not ahead:
                    receive()
                while len(ahead) <= render.frames_ahead and transport.has_note(SAMPLING, Kind.RENDER_POINTS):
                    receive()  # frames that are sampled already
            camera, chosen, of_layers = ahead.popleft()
            with clock.working():
                picture = render.draw(camera, chosen, of_layers)
            with clock.waiting():
                render.show(frame, picture)
            counts.add(chosen)
            counts.add_layers(of_layers)
            counts.add_residency(render.residency)
            transport.send_note(CULLING, Kind.FRAME_DONE, frame)
    statistics = _statistics(transport, clock, counts)
    statistics["per_frame"] |= render.times()
    statistics["rasterizer"] = render.description
    transport.send_note(CULLING, Kind.STATISTICS, job.n_frames, statistics)


def _statistics(transport: Transport, clock: StageClock, counts: FrameCounts) -> dict[str, Any]:
    return {
        "stage": clock.stage,
        "summary": clock.summary(),
        "rank": rank_record(clock.stage, transport.rank),
        "messages": transport.traffic(),
        "per_frame": {f"{clock.stage}_s": clock.work_s} | counts.lists(),
    }
