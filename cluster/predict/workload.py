"""How much each frame of a run has of everything that costs time: counted, not drawn.

Selection alone decides it, so the culling and sampling nodes are run over the camera path and nothing is rendered;
the counts are exact and the same on every machine.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from ...nodes.cell_blocks import cell_blocks, cell_spacing
from ...nodes.pooled_entries import PooledForms
from ...nodes.sampling import POOLED_POINT_COST
from ...shared.camera import Camera
from ...shared.config import refuse_layers
from ...shared.messages import HEADER, encode, points_of
from ...shared.octree import Octree
from ..job import Job
from ..record import FrameCounts

NO_LAYERS = "predictions count points alone"

COLD_POINTS = 256
"""Points at the start of an entry that are read before the memory's prefetchers have caught up with it: the four
columns of an entry start on pages of their own."""

SAMPLED_POINTS = 4096
"""Points whose size on the screen stands for all of a frame's, where size depends on distance."""


@dataclass(frozen=True)
class Workload:
    """Counts of one run. Arrays are (n_frames,) float64; a frame is a view of a picture.

    cells : of the octree.
    cells_visible, entries, points : a frame's bits set, render-points entries, points drawn, a pooled one as
    ``POOLED_POINT_COST`` points.
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
    """The workload of a job. Raises ConfigError for one with layers.

    Cost: culling and sampling of each frame, a few milliseconds.
    """
    refuse_layers(job.config, NO_LAYERS)
    octree = job.load_octree()
    forms = PooledForms.of(octree)
    culling, sampling = job.culling_node(octree), job.sampling_node(octree)
    by_distance = job.point_size.world or job.point_size.adaptive
    columns = job.scene.positions() if by_distance else None  # held, so that coded ones are decoded once
    spacing = _Spacing(job, octree) if job.point_size.adaptive else None
    counts = FrameCounts()
    points, cold, covered, sizes = np.zeros((4, job.n_frames))
    for frame in range(job.n_frames):
        camera = job.camera(frame)
        bits = culling.process(camera)
        chosen = sampling.process(camera, bits)
        counts.add(bits, chosen)
        cold[frame] = np.minimum(points_of(chosen.entries), COLD_POINTS).sum()
        points[frame] = chosen.n_points + (POOLED_POINT_COST - 1) * chosen.n_pooled
        covered[frame] = points[frame] * _pixels_per_point(
            job, columns, spacing, camera, forms.as_ranges(octree, chosen.entries)
        )
        head, payload = encode(chosen)
        sizes[frame] = len(head) + len(payload)
    pixels = job.views.width * job.views.height
    bits_bytes = HEADER.size + (len(octree) + 7) // 8
    counted = {name: np.array(counts.lists()[name], np.float64) for name in ("cells_visible", "entries")}
    return Workload(
        cells=len(octree),
        pixels=pixels,
        points=points,
        cold=cold,
        covered=covered,
        visibility_bytes=bits_bytes,
        render_points_bytes=sizes,
        **counted,
    )


def threads_of(render_threads: int) -> int:
    """Threads of the cpu rasterizer for ``render.threads``."""
    return render_threads or len(os.sched_getaffinity(0))


class _Spacing:
    """How far apart the points of each cell are, by point."""

    def __init__(self, job: Job, octree: Octree) -> None:
        self._first, _, cells = cell_blocks(job.scene, octree)
        self._spacing = cell_spacing(job.scene, octree, cells)

    def of_points(self, index: np.ndarray) -> np.ndarray:
        """(n,) float32, world units, of (n,) indices into the point-array."""
        return self._spacing[np.searchsorted(self._first, index, side="right") - 1]


def _pixels_per_point(
    job: Job,
    columns: tuple[np.ndarray, np.ndarray, np.ndarray] | None,
    spacing: _Spacing | None,
    camera: Camera,
    entries: np.ndarray,
) -> float:
    """Mean square of the points' sides, pixels²; from an even sample of them where sides depend on distance."""
    size = job.point_size
    if columns is None or not len(entries):
        return float(size.pixels**2)
    index = _sample(entries)
    x, y, z = (np.asarray(column[index], np.float64) for column in columns)
    first, origin = job.scene.blocks()
    world = origin[np.searchsorted(first, index, side="right") - 1] + np.column_stack([x, y, z])
    depth = (world - camera.eye) @ camera.pixel_from_world[2, :3]
    world_side = np.maximum(size.world, spacing.of_points(index)) if spacing else size.world
    side = np.clip(world_side * camera.focal_px / np.maximum(depth, camera.near), size.pixels, size.maximum)
    inside = depth > camera.near
    return float(np.where(inside, np.rint(side) ** 2, 0).mean())


def pixels_per_point(job: Job, octree: Octree, camera: Camera, entries: np.ndarray) -> float:
    """Mean pixels that a point of (m,) RENDER_POINT covers in a picture of a camera."""
    by_distance = job.point_size.world or job.point_size.adaptive
    columns = job.scene.positions() if by_distance else None
    spacing = _Spacing(job, octree) if job.point_size.adaptive else None
    return _pixels_per_point(job, columns, spacing, camera, PooledForms.of(octree).as_ranges(octree, entries))


def _sample(entries: np.ndarray) -> np.ndarray:
    """Indices into the point-array of up to ``SAMPLED_POINTS`` of the points of ranges, evenly spread over them."""
    counts = points_of(entries)
    ends = np.cumsum(counts)
    n_points = int(ends[-1])
    ordinal = np.linspace(0, n_points - 1, min(n_points, SAMPLED_POINTS)).astype(np.int64)
    entry = np.searchsorted(ends, ordinal, side="right")
    stride = entries["stride"][entry].astype(np.int64)
    return entries["offset"][entry].astype(np.int64) + (ordinal - (ends - counts)[entry]) * stride
