"""What the performance model (``predict``) expects of a frame with the counts that the present one has.

``measure_costs`` draws a few frames of the run's own camera path where it is called, alone on the machine: those of the
calibration that ``predict`` makes of whole runs, without ranks. ``expected`` then costs nothing worth mentioning. The
model is that of ``predict``: the ``cpu`` rasterizer, without layers.

    costs = measure_costs(job)  # best while the run rests; None: no model
    ranks = expected(costs, setting_of(job.config, n_ranks), counts)
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...shared.camera import Camera
from ...shared.config import RunConfig
from ...shared.messages import FRAME_START_BYTES, HEADER, RENDER_POINT, RenderPoints
from ...shared.octree import Octree
from ...shared.scene_share import SceneShare, clip_entries
from ..job import Job
from ..layout import Lane, Layout
from ..plan.costs import COSTS
from ..predict.calibrate import calibration_points, with_point
from ..predict.costs import Costs, Measured, fit_costs
from ..predict.forecast import Forecast, forecast, inflation
from ..predict.machine import Machine
from ..predict.parts import EvenParts, Part
from ..predict.setting import Setting
from ..predict.steps import stage_parts
from ..predict.workload import COLD_POINTS, Workload, pixels_per_point
from ..topologies import FRAME_PARALLEL

FRAMES = 4
"""Frames of each setting that are measured, spread over the camera path."""
REPEATS = 3
"""Of each; the fastest counts, since what else runs only ever slows one down."""
MOST_POINTS = 1 << 23
"""Of larger scenes as many points of the beginning, which are those of the coarse cells, are drawn."""
RESIDENT = {"render.rasterizer": "cpu", "memory.residency": "mapped"}
"""Settings of what is measured: what a paged run draws costs as much, once it is there."""
STEADY_FRAMES = 24
"""Alike, which a forecast is made of: enough for the pipeline to be full."""
DONE_BYTES = 31
"""Of the note that a frame is done: how long the display was busy, as JSON."""
MESSAGES = 4
"""Of a frame on three ranks, over which the model's cost of messages is spread."""


@dataclass(frozen=True)
class LiveCosts:
    """What this machine takes for the frames of one run.

    unit : as ``predict`` fits it.  picture_pixel_s : making a pixel of the picture of framebuffer words.
    cells : of the octree.  pixels : of a frame at full size.
    pixels_per_point : that a point covers, mean, at full size; by_distance : whether with the size of the picture.
    threads : of a render rank that has the machine to itself.
    """

    unit: Costs
    picture_pixel_s: float
    cells: int
    pixels: int
    pixels_per_point: float
    by_distance: bool
    threads: int

    def load(self, counts: Mapping[str, float], n_frames: int = 1) -> Workload:
        """So many frames, all with these counts: ``cells`` (visible), ``entries``, ``points``, ``pixels``."""
        pixels = max(counts.get("pixels", self.pixels), 1.0)
        grown = max(1.0, self.pixels_per_point * pixels / self.pixels) if self.by_distance else self.pixels_per_point
        one = np.ones(n_frames)
        points, entries = max(counts["points"], 0.0), max(counts["entries"], 0.0)
        return Workload(
            cells=self.cells,
            pixels=pixels,
            cells_visible=one * counts["cells"],
            entries=one * entries,
            points=one * points,
            cold=one * min(points, COLD_POINTS * entries),
            covered=one * points * grown,
            visibility_bytes=HEADER.size + self.cells / 8,
            render_points_bytes=one * (HEADER.size + RENDER_POINT.itemsize * entries),
        )


def setting_of(run: RunConfig, ranks: int) -> Setting:
    """How a run on so many ranks of this host is laid out: render ranks share its cores (``run``)."""
    setting = Setting.of(run, ranks)
    renders = 1 if setting.topology == FRAME_PARALLEL else len(setting.layout().render)
    return setting if run.render.threads else replace(setting, threads=max(1, setting.threads // renders))


def expected(
    costs: LiveCosts, setting: Setting, counts: Mapping[str, float], machine: Machine | None = None
) -> list[dict[str, Any]]:
    """``ranks`` of a ``prediction``: rank, role, values by the names of ``metrics``.

    counts : of the present frame, all ranks together: ``cells``, ``entries``, ``points``; ``pixels`` drawn (full size),
    and ``frames_per_s`` as measured, by which ranks are in each other's way; both may be missing.
    machine : None: all ranks share this host's cores.
    Values: ``STAGE.work_ms`` of culling, sampling and render, of several render ranks' display ``picture.work_ms``;
    ``frames_per_s`` that the run could reach; ``sent_bytes_per_s``, ``received_bytes_per_s`` at the rate that it has.
    Nothing where a count is missing or the topology deals whole pictures.  Cost: some ms.
    """
    if setting.topology == FRAME_PARALLEL or any(name not in counts for name in ("cells", "entries", "points")):
        return []
    machine = machine or Machine(cores=len(os.sched_getaffinity(0)))
    layout = setting.layout()
    parts = EvenParts(costs.load(counts, STEADY_FRAMES))
    found = forecast(costs.unit, parts, setting, machine)
    reached = found.schedule.steady_frames_per_s
    rate = min(counts.get("frames_per_s") or reached, reached)
    busy = _busy(found, rate)
    values: dict[int, dict[str, float]] = {rank: {"frames_per_s": reached} for rank in layout.workers}
    pixels = parts.whole.pixels
    for rank, stage, part in _work(layout, parts):
        threads = setting.threads if stage == "render" else 1
        others = sum(
            of for other, of in busy.items() if other != rank and machine.pool_of(other) == machine.pool_of(rank)
        )
        slower = inflation(threads + others, costs.unit.contention, machine.cores) / machine.speed
        seconds = sum(float(np.mean(s)) for s in stage_parts(costs.unit, stage, part.load, threads).values())
        if stage == "render" and len(layout.render) == 1:
            seconds += costs.picture_pixel_s * pixels
        elif stage == "render" and rank == layout.display:
            values[rank]["picture.work_ms"] = 1e3 * costs.picture_pixel_s * pixels * slower
        values[rank][f"{stage}.work_ms"] = 1e3 * seconds * slower
    for rank, (sent, received) in _bytes(layout, parts).items():
        values[rank] |= {"sent_bytes_per_s": sent * rate, "received_bytes_per_s": received * rate}
    return [{"rank": rank, "role": layout.role_of(rank), "values": values[rank]} for rank in layout.workers]


def _busy(found: Forecast, rate: float) -> dict[int, float]:
    """Rank → cores that it keeps busy at so many frames a second."""
    busy: dict[int, float] = {}
    for step, stage in zip(found.steps, found.schedule.stages, strict=True):
        if step.rank is not None:
            busy[step.rank] = busy.get(step.rank, 0.0) + float(stage.cost_s.mean()) * rate * step.threads
    return busy


def _work(layout: Layout, parts: EvenParts) -> Iterator[tuple[int, str, Part]]:
    """Every stage of every rank, and its part of the frame."""
    several, split = len(layout.lanes) > 1, "shares" if layout.split == "shares" else "tiles"
    of_lanes = parts.of(split, len(layout.lanes))
    for lane, of_lane in zip(layout.lanes, of_lanes, strict=True):
        for stage in ("culling", "sampling", "render"):
            ranks = getattr(lane, stage)
            kind = split if stage == "render" else "subtrees"
            dealt = [of_lane] if several else parts.of(kind, len(ranks))
            for rank, part in zip(ranks, dealt, strict=True):
                yield rank, stage, part


def _bytes(layout: Layout, parts: EvenParts) -> dict[int, tuple[float, float]]:
    """Rank → bytes of a frame that it sends and receives, uncoded: cameras, bits, entries, framebuffers."""
    sent, received = (dict.fromkeys(layout.workers, 0.0) for _ in range(2))

    def cross(a: int, b: int, n_bytes: float) -> None:
        if a != b:
            sent[a] += n_bytes
            received[b] += n_bytes

    for rank in layout.workers:
        cross(0, rank, HEADER.size + FRAME_START_BYTES)
    for lane in layout.lanes:
        _cross_selection(lane, parts.whole, len(layout.lanes), cross)
    framebuffers = parts.of("shares" if layout.split == "shares" else "tiles", len(layout.render))
    for rank, part in zip(layout.render[1:], framebuffers[1:], strict=True):
        cross(rank, layout.display, HEADER.size + float(np.mean(part.filled_bytes)))
    cross(layout.display, 0, HEADER.size + DONE_BYTES)
    return {rank: (sent[rank], received[rank]) for rank in layout.workers}


def _cross_selection(lane: Lane, whole: Workload, lanes: int, cross: Any) -> None:
    """Bits to the sampling ranks that have the same subtrees, entries to all render ranks."""
    k, m, n = len(lane.culling), len(lane.sampling), len(lane.render)
    for j, sampling in enumerate(lane.sampling):
        senders = range(j * k // m, -(-(j + 1) * k // m))
        for i in senders:
            cross(lane.culling[i], sampling, HEADER.size + whole.cells / 8 / max(m, k))
        for render in lane.render:
            entries = float(whole.entries.mean()) / m / (n if lanes == 1 else lanes)
            cross(sampling, render, HEADER.size + RENDER_POINT.itemsize * entries)


# --- unit costs ------------------------------------------------------------------------------------------------------


def measure_costs(job: Job, seconds: float = 1.5) -> LiveCosts | None:
    """Fit the costs of a run on frames of its camera path, drawn in this process; None where there is no model.

    seconds : of measuring; loading points and compiled kernels comes on top, about as much for 2 million points.
    Memory: the octree, up to ``MOST_POINTS`` points and two framebuffers, until it returns.
    """
    if job.rasterizer != "cpu" or job.layers or (job.pools != "off" and job.scene.info.n_stored > MOST_POINTS):
        return None
    points = [point for point in calibration_points(job.config) if point["pipeline.topology"] == "single"]
    octree = job.load_octree()
    views = job.views
    frames = np.unique(np.linspace(0, job.n_frames - 1, FRAMES).astype(int)).tolist()
    covered = [_pixels_per_point(job, octree, job.camera(frame)) for frame in frames[:: max(len(frames) // 3, 1)]]
    by_distance = bool(job.point_size.world or job.point_size.adaptive)
    blank = LiveCosts(
        Costs({}, 0.0, 0.0, 0.0),
        0.0,
        len(octree),
        views.width * views.height,
        float(np.mean(covered)),
        by_distance,
        job.threads,
    )
    stop = min(job.scene.info.n_stored, MOST_POINTS)
    share = None if stop == job.scene.info.n_stored else SceneShare(job.scene, 0, stop)
    drawn = job.load_drawn(share, verify=False)
    runs, pictures_s = [], []
    for i, point in enumerate(points):
        run = with_point(job.config, point | RESIDENT)
        varied = Job(run, job.scene)
        begun = time.perf_counter()
        mine: dict[int, tuple[Any, ...]] = {}
        with varied.make_rasterizer(drawn) as rasterizer:
            culling, sampling = varied.culling_node(octree), varied.sampling_node(octree)
            rasterizer.draw(varied.camera(frames[0]), np.empty(0, RENDER_POINT))
            for frame in frames * REPEATS:  # each a while after it was drawn before: a rank finds its caches cold, too
                camera = varied.camera(frame)
                culling_s, bits = _timed(culling.process, camera)
                sampling_s, chosen = _timed(sampling.process, camera, bits)
                entries = chosen.entries if share is None else clip_entries(chosen.entries, 0, stop)
                render_s, words = _timed(rasterizer.draw, camera, entries)
                if i == 0:
                    pictures_s.append(_picture_s(varied, camera, words))
                took = culling_s, sampling_s, render_s
                if frame in mine:
                    took = tuple(map(min, took, mine[frame][:3]))
                mine[frame] = (*took, bits, RenderPoints(frame, entries))
                if time.perf_counter() - begun > seconds / len(points) and len(mine) == len(frames):
                    break
        runs.append(_as_measured(run, blank, varied, list(mine.values())))
    unit = replace(fit_costs(runs), message_s=COSTS.message_s / MESSAGES)
    return replace(blank, unit=unit, picture_pixel_s=min(pictures_s) / blank.pixels)


def _pixels_per_point(job: Job, octree: Octree, camera: Camera) -> float:
    chosen = job.sampling_node(octree).process(camera, job.culling_node(octree).process(camera))
    return pixels_per_point(job, octree, camera, chosen.entries)


def _picture_s(job: Job, camera: Camera, words: np.ndarray) -> float:
    """Seconds that a picture of words takes; 0 for one of several views."""
    from ...nodes.picture.compose import Composer

    if job.views.per_picture > 1:
        return 0.0
    with Composer(replace(job.picture_settings, colours=True, depth=False, normals=False)) as composer:
        return _timed(composer.add, 0, camera, words)[0]


def _as_measured(run: RunConfig, costs: LiveCosts, job: Job, frames: Sequence[tuple[Any, ...]]) -> Measured:
    """Timed frames as the record of a run, from which ``predict`` fits its costs."""
    culling_s, sampling_s, render_s, bits, chosen = zip(*frames, strict=True)
    pixels = job.views.width * job.views.height
    loads = [
        costs.load(
            {
                "cells": float(np.bitwise_count(of.bits).sum()),
                "entries": len(points.entries),
                "points": points.n_points,
                "pixels": pixels,
            }
        )
        for of, points in zip(bits, chosen, strict=True)
    ]
    names = ("cells_visible", "entries", "points", "cold", "covered", "render_points_bytes")
    load = replace(loads[0], **{name: np.concatenate([getattr(of, name) for of in loads]) for name in names})
    total_s = sum(culling_s) + sum(sampling_s) + sum(render_s)
    per_frame = {"culling_s": culling_s, "sampling_s": sampling_s, "render_s": render_s}
    record = {"topology": "single", "frames_per_s": len(frames) / total_s, "per_frame": per_frame}
    return Measured(run, load, [record])


def _timed(work: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Seconds of a call, and what it gave."""
    started = time.perf_counter()
    found = work(*arguments)
    return time.perf_counter() - started, found
