"""What a job would draw for a camera, selected in this process: to be drawn here, or to pick in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..nodes.picking import TOLERANCE_PX, Picker
from ..shared.camera import Camera
from ..shared.messages import RenderPoints
from ..shared.octree import Octree
from .job import Job

if TYPE_CHECKING:
    from collections.abc import Mapping


class Selected:
    """Culling and sampling of a job, and picking in what they choose. One call at a time.

    octree : of the scene, as ``Job.load_octree`` gives it.
    """

    def __init__(self, job: Job, octree: Octree) -> None:
        self._job, self.octree = job, octree
        self._culling, self._sampling = job.culling_node(octree), job.sampling_node(octree)
        self._picker: Picker | None = None

    def suits(self, job: Job) -> bool:
        """Whether the octree will do for a job of other settings of the same scene."""
        return job.same_octree(self._job)

    def points(self, camera: Camera) -> RenderPoints:
        """The points of a frame."""
        return self._sampling.process(camera, self._culling.process(camera))

    def pick(self, camera: Camera, x: float, y: float) -> dict[str, Any]:
        """The point that the picture of a camera shows at (x, y), pixels of the picture from its upper left corner.

        camera : of the picture's size; it is drawn at ``render.supersampling`` times that.
        Returns ``found``, and if so ``position`` (three float64, world) and ``attributes``: ``index`` in the
        point-array, ``depth`` along the view axis, and all that the scene holds of the point.
        """
        job, drawn = self._job, self._job.config.render.supersampling
        if self._picker is None:
            self._picker = Picker(job.scene, self.octree, job.point_size, job.point_filter, job.splats)
        camera = enlarged(camera, drawn)
        at = (
            drawn * (min(max(int(p), 0), side // drawn - 1) + 0.5)
            for p, side in ((x, camera.width), (y, camera.height))
        )
        found = self._picker.pick(camera, self.points(camera).entries, *at, tolerance_px=drawn * TOLERANCE_PX)
        if found is None:
            return {"found": False}
        about: Mapping[str, Any] = {"index": found.index, "depth": found.depth, **found.attributes}
        return {"found": True, "position": list(found.position), "attributes": dict(about)}


def enlarged(camera: Camera, times: int) -> Camera:
    """The same view in a picture of so many times the width and height."""
    if times == 1:
        return camera
    return Camera(
        camera.frame, camera.clip_from_world, camera.eye, times * camera.width, times * camera.height, camera.near
    )
