"""Views and cameras."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from pydantic import ValidationError

from ...shared.camera import Camera, look_at, perspective_camera
from ...shared.errors import InputError
from ...shared.orbit import up_of_pose
from .protocol import View

if TYPE_CHECKING:
    from ..job import Job


def camera_of(view: View, width: int, height: int, frame: int, near: float) -> Camera:
    """The camera of a view; any up will do where it is along the view, or nothing.

    Raises InputError if eye and target coincide, or lie so far away that there is no camera.
    """
    with np.errstate(all="ignore"):
        pose = look_at(np.array(view.eye), np.array(view.target), np.array(view.up))
        camera = perspective_camera(
            frame=frame,
            world_from_camera=pose,
            fov_y_rad=math.radians(view.fov_deg),
            width=width,
            height=height,
            near=near,
        )
        finite = np.isfinite(camera.pixel_from_world).all() and math.isfinite(camera.focal_px)
    if not finite:
        raise InputError(f"camera: found eye {list(view.eye)} and {view.fov_deg}°, which give no finite matrix")
    return camera


def view_of(job: Job) -> View:
    """Where the first picture of a job is taken from: the same pose, whatever is up in it. Raises InputError where no
    viewer may be (``protocol.Coordinate``).
    """
    path = job.views.path
    pose, distance = path.path.pose(0.0), path.path.target_distance(0.0)
    eye = pose[:3, 3]
    try:
        return View.model_validate({
            "eye": tuple(eye.tolist()),
            "target": tuple((eye - pose[:3, 2] * distance).tolist()),
            "up": tuple(up_of_pose(pose, distance, path.up).tolist()),
            "fov_deg": math.degrees(path.path.fov_y_rad(0.0)),
        })  # fmt: skip
    except ValidationError:
        raise InputError(f"camera: found eye {eye.tolist()}, too far away for a live run") from None
