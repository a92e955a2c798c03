"""One scene of a sweep: its points in each order, the cameras, the reference frames, and the nodes of one point."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...nodes.culling import CullingNode
from ...nodes.pooled_entries import PooledForms
from ...nodes.raster import ResidentPoints
from ...nodes.raster.fixed_point import fixed_point
from ...nodes.render import RenderNode, Wanted, load_drawn, load_points
from ...nodes.sampling import SamplingNode
from ...shared.camera import Camera
from ...shared.errors import ConfigError
from ...shared.messages import RenderPoints, VisibilityBits
from ...shared.octree import Octree
from ...shared.rebuild import rebuild_in_order
from ...shared.store import Scene
from ..job import Job
from ..progress import FrameProgress
from .config import ErrorConfig, SceneEntry, SweepPoint, base_config, sweep_points
from .reference import References

if TYPE_CHECKING:
    from ...nodes.raster.group_raster import ResidentGroups

STAGES = ("culling", "sampling", "render")


@dataclass(frozen=True)
class Pipeline:
    """Culling, sampling and render node of one point, called one after the other in this process.

    forms : the pooled forms of its scene.  position_bytes : of a position as it is read, but from pools.
    attribute_bytes : of what else is read of a point.
    """

    culling: CullingNode
    sampling: SamplingNode
    render: RenderNode
    forms: PooledForms
    position_bytes: float
    attribute_bytes: int

    def draw(self, camera: Camera) -> tuple[VisibilityBits, RenderPoints, np.ndarray]:
        """The messages of a frame, and its words, which are valid until the next call."""
        bits = self.culling.process(camera)
        chosen = self.sampling.process(camera, bits)
        return bits, chosen, self.render.process(camera, chosen)

    def read_bytes(self, chosen: RenderPoints) -> float:
        """Bytes of points that drawing a frame reads."""
        return self.forms.read_bytes(chosen.entries, self.position_bytes + self.attribute_bytes)

    def timed_draw(self, camera: Camera) -> list[float]:
        """Seconds of each of ``STAGES`` for one frame."""
        started = time.perf_counter()
        bits = self.culling.process(camera)
        culled = time.perf_counter()
        chosen = self.sampling.process(camera, bits)
        sampled = time.perf_counter()
        self.render.process(camera, chosen)
        return [culled - started, sampled - culled, time.perf_counter() - sampled]


@dataclass(frozen=True)
class _Loaded:
    """The scene in one point order, in memory, with what some of the points of the sweep need of it."""

    scene: Scene
    octree: Octree
    forms: PooledForms
    points: ResidentPoints | ResidentGroups


class SweptScene:
    """One scene and the points of the sweep on it.

    Raises InputError for a scene that is missing or a setting that does not fit it.
    """

    def __init__(self, config: ErrorConfig, entry: SceneEntry, source: str) -> None:
        self.name = entry.name
        self.points = list(sweep_points(config, entry, source))
        self._job = Job(base_config(config, entry, source))
        self._folder = Path(self._job.output)
        self._colouring = self._job.colouring.settled(self._job.scene)
        self._loaded: dict[tuple[str, Wanted], _Loaded] = {}
        info = self._job.scene.info
        self.n_points = info.n_points
        self.radius = math.dist(info.lower, info.upper) / 2
        self.background = self._job.background
        self.cameras = [replace(self._job.camera(frame), frame=i) for i, frame in enumerate(config.frames)]

    def order_of(self, point: SweepPoint) -> str:
        """The point order that a point is drawn in."""
        return self._job.scene.info.point_order if point.order == "as built" else point.order

    def prepare(self, progress: FrameProgress) -> None:
        """Load the scene in each order that a point needs; one in the other order is built first."""
        own = self._job.scene
        needed = {(own.info.point_order, self._job.wanted)}
        needed |= {(self.order_of(point), Job(point.config).wanted) for point in self.points}
        scenes: dict[str, Scene] = {}
        for order, wanted in needed:
            if order not in scenes:
                path = self._folder / "scenes" / f"{self.name}-{order}.scene"
                scenes[order] = rebuild_in_order(own, order, path, progress.show)
            scene = scenes[order]
            if wanted.groups and scene is not own:
                raise ConfigError(
                    f"sweep: order = {order!r}: scenes that are built in another order hold float32 positions, "
                    "expected 'as built' for render.positions = 'coded'"
                )
            octree = scene.octree(features=wanted.features, pools=wanted.pools)
            points = load_drawn(scene, self._colouring, wanted, verify=self._job.config.scene.verify)
            self._loaded[order, wanted] = _Loaded(scene, octree, PooledForms.of(octree), points)

    @contextmanager
    def open(self, point: SweepPoint) -> Iterator[Pipeline]:
        """The nodes of one point. Raises DeviceError where this machine cannot draw it."""
        job = Job(point.config)
        loaded = self._loaded[self.order_of(point), job.wanted]
        points, bits = loaded.points, point.config.positions.bits_per_axis
        position_bytes = job.position_bytes
        if not isinstance(points, ResidentPoints):
            position_bytes = points.cells.position_bytes / len(points)
        elif bits:
            points, position_bytes = fixed_point(points, loaded.scene.info.edge, bits), 3 * bits / 8
        with job.make_rasterizer(points) as rasterizer:
            yield Pipeline(
                job.culling_node(loaded.octree),
                job.sampling_node(loaded.octree),
                RenderNode(rasterizer),
                loaded.forms,
                position_bytes,
                job.attribute_bytes,
            )

    def references(self, progress: FrameProgress) -> list[np.ndarray]:
        """(height, width) uint64 words of the reference frame of each camera."""
        loaded = self._loaded[self._job.scene.info.point_order, self._job.wanted]
        look = self._colouring, self._job.point_size, self._job.point_filter
        points = loaded.points
        if not isinstance(points, ResidentPoints):
            points = load_points(loaded.scene, self._colouring, self._job.wanted, verify=False)
        kept = References(self._folder / "references", loaded.scene, points, *look)
        return [
            kept.frame(camera, lambda done, i=i: progress.show(f"{self.name}: reference {i + 1}", done, self.n_points))
            for i, camera in enumerate(self.cameras)
        ]
