"""What an average frame of a run has to do."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from ..job import Job
from ..record import FrameCounts

LOOK_FRAMES = 5
LOOK_REPEATS = 3

T = TypeVar("T")


@dataclass(frozen=True)
class Workload:
    """Counts and seconds of an average frame.

    cells : of the octree.  cells_visible, entries, points : what culling lets through, what sampling asks for.
    pooled_points : of those, from pools.  objects : drawn of each layer.
    pixels : drawn.  culling_s, sampling_s : measured on this machine.
    render_s : measured where a run has drawn, else None.
    """

    cells: int
    cells_visible: float
    entries: float
    points: float
    pixels: int
    culling_s: float
    sampling_s: float
    render_s: float | None = None
    pooled_points: float = 0.0
    objects: tuple[float, ...] = ()

    @classmethod
    def of_look(cls, job: Job) -> Workload:
        """Of ``LOOK_FRAMES`` frames spread over the path, culled and sampled but not drawn. Loads no point.

        Cost: the octree loaded once, and those frames' culling and sampling.
        """
        octree = job.load_octree()
        culling, sampling = job.culling_node(octree), job.sampling_node(octree)
        sampling.process(job.camera(0), culling.process(job.camera(0)))  # compiles, or loads what was compiled
        layers = job.layer_nodes()
        counts, rows = FrameCounts(), []
        for frame in np.unique(np.linspace(0, job.n_frames - 1, LOOK_FRAMES).astype(int)):
            camera = job.camera(int(frame))
            culling_s, bits = _least(lambda camera=camera: culling.process(camera))
            sampling_s, chosen = _least(lambda camera=camera, bits=bits: sampling.process(camera, bits))
            counts.add(bits, chosen)
            counts.add_layers([node.process(camera, culled.process(camera)) for culled, node in layers])
            rows.append((culling_s, sampling_s))
        culling_s, sampling_s = np.mean(rows, axis=0).tolist()
        lists = counts.lists()
        objects = _of_layers(lists)
        mean = {name: float(np.mean(lists[name])) for name in lists if name != "objects"}
        return cls(
            cells=len(octree),
            pixels=_pixels(job),
            culling_s=culling_s,
            sampling_s=sampling_s,
            objects=objects,
            **mean,
        )

    @classmethod
    def of_run(cls, job: Job, per_frame: dict[str, Any]) -> Workload:
        """Of every frame of a run, from the lists of its ``run.json``."""
        names = ("cells_visible", "entries", "points", "pooled_points", "culling_s", "sampling_s", "render_s")
        mean = {name: float(np.mean(per_frame[name])) for name in names}
        return cls(cells=job.scene.info.n_cells, pixels=_pixels(job), objects=_of_layers(per_frame), **mean)


def _least(work: Callable[[], T]) -> tuple[float, T]:
    """Least seconds of ``LOOK_REPEATS`` calls, and what the last one gave: what else runs can only add."""
    seconds = []
    for _ in range(LOOK_REPEATS - 1):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    started = time.perf_counter()
    found = work()
    return min(*seconds, time.perf_counter() - started), found


def _of_layers(lists: dict[str, Any]) -> tuple[float, ...]:
    """Mean objects a frame of each layer."""
    return tuple(np.mean(lists["objects"], axis=0).tolist()) if "objects" in lists else ()


def _pixels(job: Job) -> int:
    return job.views.width * job.views.height
