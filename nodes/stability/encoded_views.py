"""Views of encoded cells of any size and place: what drawing from pools and from linear groups is held against."""

from __future__ import annotations

import numpy as np

from ...shared.camera import Camera, look_at, perspective_camera

VIEWS = {
    "cell of 1e-9": (1e-9, 0.0, (0.5, -2.0, 1.5)),
    "cell of 1e9": (1e9, 0.0, (0.5, -2.0, 1.5)),
    "6.4e6 m away": (1.0, 6.4e6, (0.5, -2.0, 1.5)),
    "seen along the sheet": (1.0, 0.0, (0.5, -2.0, 0.5001)),
    "eye among the points": (1.0, 0.0, (0.5, 0.1, 0.6)),
}
"""Edge of the cell, shift of its lower corner on each axis, eye in edges from there."""

BOUNDS = dict.fromkeys(VIEWS, 0.01) | {"eye among the points": 0.05}
"""Pixels that float32 may move a point."""


def camera_on(edge: float, shift: float, eye: tuple[float, float, float]) -> Camera:
    """A camera that looks at the middle of the cell, 1920×1080."""
    up, target = np.array([0.0, 0.0, 1.0]), np.full(3, 0.5)
    pose = look_at(np.array(eye) * edge + shift, target * edge + shift, up)
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.9, width=1920, height=1080, near=0.01 * edge)
