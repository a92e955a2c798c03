"""How much each frame of a run has of everything that costs time: counted, not drawn.

Selection alone decides it, so the culling and sampling nodes are run over the camera path and nothing is rendered;
the counts are exact and the same on every machine.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...shared.camera import Camera
from ...shared.messages import HEADER, RenderPoints, encode
from ..job import Job

COLD_POINTS = 256
"""Points at the start of an entry that are read before the memory's prefetchers have caught up with it: the four
columns of an entry start on pages of their own."""

SAMPLED_POINTS = 4096
"""Points whose size on the screen stands for all of a frame's, where size depends on distance."""


@dataclass(frozen=True)
class Workload:
    """Counts of one run. Arrays are (n_frames,) float64; a frame is a view of a picture.

    cells : of the octree.
    cells_visible, entries, points : a frame's bits set, render-points entries, points drawn.
    cold : of the points, those among the first ``COLD_POINTS`` of an entry.
    covered : pixels that the frame's points write, each as often as it is written.
    pixels : drawn a frame.
    visibility_bytes, render_points_bytes : message sizes, header included.
    """

    cells: float
    pixels: float
    cells_visible: np.ndarray
    entries: np.ndarray
    points: np.ndarray
    cold: np.ndarray
    covered: np.ndarray
    visibility_bytes: float
    render_points_bytes: np.ndarray

    @property
    def n_frames(self) -> int:
        """Frames of the run."""
        return len(self.points)

    def scaled(self, factor: float) -> Workload:
        """The workload of a scene with ``factor`` times the points, seen the same way: cells and entries grow too."""
        grown = (
            "cells",
            "cells_visible",
            "entries",
            "points",
            "cold",
            "covered",
            "visibility_bytes",
            "render_points_bytes",
        )
        return replace(self, **{name: getattr(self, name) * factor for name in grown})


def count_workload(job: Job) -> Workload:
    """The workload of a job. Cost: culling and sampling of each frame, a few milliseconds."""
    octree = job.scene.octree()
    culling, sampling = job.culling_node(octree), job.sampling_node(octree)
    visible, entries, points, cold, covered, sizes = np.zeros((6, job.n_frames))
    for frame in range(job.n_frames):
        camera = job.camera(frame)
        bits = culling.process(camera)
        chosen = sampling.process(camera, bits)
        visible[frame] = np.bitwise_count(bits.bits).sum()
        entries[frame], points[frame] = len(chosen.entries), chosen.n_points
        cold[frame] = np.minimum(_counts(chosen.entries), COLD_POINTS).sum()
        covered[frame] = chosen.n_points * _pixels_per_point(job, camera, chosen)
        head, payload = encode(chosen)
        sizes[frame] = len(head) + len(payload)
    pixels = job.views.width * job.views.height
    bits_bytes = HEADER.size + (len(octree) + 7) // 8
    return Workload(len(octree), pixels, visible, entries, points, cold, covered, bits_bytes, sizes)


def threads_of(render_threads: int) -> int:
    """Threads of the cpu rasterizer for ``render.threads``."""
    return render_threads or len(os.sched_getaffinity(0))


def _pixels_per_point(job: Job, camera: Camera, chosen: RenderPoints) -> float:
    """Mean square of the points' sides, pixels²; from an even sample of them where sides depend on distance."""
    size = job.point_size
    if not size.world or not chosen.n_points:
        return float(size.pixels**2)
    index = _sample(chosen.entries, chosen.n_points)
    x, y, z = (np.asarray(column[index], np.float64) for column in job.scene.positions())
    first, origin = job.scene.blocks()
    world = origin[np.searchsorted(first, index, side="right") - 1] + np.column_stack([x, y, z])
    depth = (world - camera.eye) @ camera.pixel_from_world[2, :3]
    side = np.clip(size.world * camera.focal_px / np.maximum(depth, camera.near), size.pixels, size.maximum)
    inside = depth > camera.near
    return float(np.where(inside, np.rint(side) ** 2, 0).mean())


def _sample(entries: Any, n_points: int) -> np.ndarray:
    """Indices into the point-array of up to ``SAMPLED_POINTS`` of the chosen points, evenly spread over them."""
    ordinal = np.linspace(0, n_points - 1, min(n_points, SAMPLED_POINTS)).astype(np.int64)
    counts = _counts(entries)
    ends = np.cumsum(counts)
    entry = np.searchsorted(ends, ordinal, side="right")
    stride = entries["stride"][entry].astype(np.int64)
    return entries["offset"][entry].astype(np.int64) + (ordinal - (ends - counts)[entry]) * stride


def _counts(entries: Any) -> np.ndarray:
    """(m,) int64: points that each of (m,) RENDER_POINT entries draws."""
    return -(-entries["range"].astype(np.int64) // entries["stride"].astype(np.int64))
