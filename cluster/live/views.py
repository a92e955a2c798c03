"""Views and cameras."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ...shared.camera import Camera, perspective_camera
from ...shared.camera_path import up_vector
from ...shared.keyframes import look_at
from .protocol import View

if TYPE_CHECKING:
    from ..job import Job


def camera_of(view: View, width: int, height: int, frame: int, near: float) -> Camera:
    """The camera of a view. Raises InputError."""
    pose = look_at(np.array(view.eye), np.array(view.target), np.array(view.up))
    return perspective_camera(
        frame=frame, world_from_camera=pose, fov_y_rad=math.radians(view.fov_deg), width=width, height=height, near=near
    )


def view_of(job: Job) -> View:
    path = job.views.path.path
    pose = path.pose(0.0)
    eye = pose[:3, 3]
    target = eye - pose[:3, 2] * path.target_distance(0.0)
    up = up_vector(job.scene.info)
    return View(
        eye=tuple(eye.tolist()),
        target=tuple(target.tolist()),
        up=tuple(up.tolist()),
        fov_deg=math.degrees(path.fov_y_rad(0.0)),
    )
