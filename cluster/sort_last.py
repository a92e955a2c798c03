"""Sort-last only: each rank holds a share of the points, draws it, and the framebuffers meet on rank 0.

Every rank culls and samples the whole octree for itself, which is the same on all of them, and keeps of the entries
what lies in its share (thesis 3.3: the baseline without functional distribution). A share is a range of whole cells
of the point-array, balanced by stored points; no rank loads a point of another. Minimum is commutative and
associative, so the picture has the bits of one rank's.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from ..shared.messages import RENDER_POINT, Kind, RenderPoints
from ..shared.scene_share import SceneShare, share_borders
from .compositing.direct import composite
from .job import Job
from .pipeline import Progress
from .record import FrameCounts, StageClock, rank_record, spread_ms
from .topologies import role_of
from .transport import Transport


def clip_entries(entries: np.ndarray, first: int, stop: int) -> np.ndarray:
    """(k,) RENDER_POINT of the points that (m,) entries name in first … stop − 1, offsets relative to ``first``.

    No entry may be of pooled points.  Cost: some passes over the entries, in NumPy.
    """
    offset, length, stride = (entries[name].astype(np.int64) for name in ("offset", "range", "stride"))
    skipped = np.maximum(-(-(first - offset) // stride), 0)  # points before the share
    begin, end = offset + skipped * stride, np.minimum(offset + length, stop)
    kept = begin < end
    out = np.empty(int(kept.sum()), RENDER_POINT)
    out["offset"], out["range"] = begin[kept] - first, (end - begin)[kept]
    out["stride"] = entries["stride"][kept]
    return out


def run_sort_last(job: Job, transport: Transport, progress: Progress) -> dict[str, Any] | None:
    """Do this rank's part; the statistics of the run on rank 0, None elsewhere. Collective."""
    loading = time.perf_counter()
    rank, size = transport.rank, transport.size
    culled, sampled, rendered, met, shown = clocks = [
        StageClock(stage) for stage in ("culling", "sampling", "render", "compositing", "picture")
    ]
    counts = FrameCounts()
    octree = job.load_octree()
    culling, sampling = job.culling_node(octree), job.sampling_node(octree)
    sampling.process(job.camera(0), culling.process(job.camera(0)))  # compiles, or loads what was compiled
    first, stop = share_borders(octree, size)[rank : rank + 2].tolist()
    share = SceneShare(job.scene, first, stop, checked_by=(rank, size))
    if job.colouring.range_is_open:
        sample = job.colouring.range_sample(share, first, job.scene.info.n_stored)
        job.colouring = job.colouring.with_range_of(transport.join(sample))
    with job.open_render(progress, share, shown=rank == 0) as render:
        transport.meet()
        started = time.perf_counter()
        loading_s = started - loading
        for frame in range(job.n_frames):
            camera = job.camera(frame)
            with culled.working():
                bits = culling.process(camera)
            with sampled.working():
                chosen = sampling.process(camera, bits)
                mine = RenderPoints(frame, clip_entries(chosen.entries, first, stop))
            with rendered.working():
                drawn = render.rasterize(camera, mine)
            with met.working():
                words = composite(frame, drawn, transport)
            if words is not None:
                with shown.working():
                    picture = render.compose(camera, words)
                with shown.waiting():
                    render.show(frame, picture)
                progress("rendering", frame + 1)
            counts.add(bits, chosen)
            counts.add_residency(render.residency)
        rendered_s = time.perf_counter() - started
    record = rank_record(role_of(job.config.pipeline, rank), rank) | {
        "first_point": first,
        "points": stop - first,
        "stages": {clock.stage: clock.summary() for clock in clocks if clock.work_s},
        "loading_s": loading_s,
    }
    messages = transport.traffic().get(Kind.FRAMEBUFFER.name, {"count": 0, "bytes": 0})
    told = [{"rank": record, "messages": messages}]
    if rank:
        transport.send_note(0, Kind.STATISTICS, job.n_frames, told[0])
    else:
        told += [transport.receive_note(other, Kind.STATISTICS)[1] for other in range(1, size)]
    transport.finish()
    if rank:
        return None
    return {
        "rasterizer": render.description,
        "ranks": [of["rank"] for of in told],
        "stages": record["stages"],
        "messages": {
            Kind.FRAMEBUFFER.name: {unit: sum(of["messages"][unit] for of in told) for unit in ("count", "bytes")}
        },
        "latency_ms": spread_ms([sum(times) for times in zip(*(clock.work_s for clock in clocks), strict=True)]),
        "per_frame": {f"{clock.stage}_s": clock.work_s for clock in clocks} | counts.lists() | render.times(),
        "loading_s": loading_s,
        "rendered_s": rendered_s,
        "finished_s": time.perf_counter() - started,
    }
