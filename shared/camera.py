"""Cameras: perspective, right-handed world, image origin top-left, depth = distance along the view axis."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from .errors import InputError


@dataclass(frozen=True)
class Camera:
    """What one frame is seen through; also the message from the coordinator to every rank.

    frame : frame number, ≥ 0.
    clip_from_world : (4, 4) float64, column vectors. Row 3 gives w = depth (row 3 is the unit view axis), x/w and y/w
        are in [−1, 1] inside the image with y upwards, z/w = near/w (reversed, infinite far plane).
    eye : (3,) float64, world.
    width, height : viewport in pixels.
    near : points with w < near are not drawn, world units, > 0.
    """

    frame: int
    clip_from_world: np.ndarray
    eye: np.ndarray
    width: int
    height: int
    near: float

    @property
    def focal_px(self) -> float:
        """Pixels that a length of one world unit covers at depth one."""
        return float(np.linalg.norm(self.clip_from_world[1, :3])) * self.height / 2

    @property
    def pixel_from_world(self) -> np.ndarray:
        """(3, 4) float64: rows X, Y, W; the image position of a point is (X/W, Y/W) in pixels, top-left origin."""
        c = self.clip_from_world
        x = (c[0] + c[3]) * (self.width / 2)
        y = (c[3] - c[1]) * (self.height / 2)
        return np.stack([x, y, c[3]])

    @property
    def pinhole_px(self) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy): a point at x right, y up and depth d of the eye is at (cx + fx·x/d, cy − fy·y/d) px."""
        x, y, axis = self.pixel_from_world[:, :3]
        cx, cy = float(x @ axis), float(y @ axis)
        return float(np.linalg.norm(x - cx * axis)), float(np.linalg.norm(y - cy * axis)), cx, cy

    def shifted(self, half_widths: float) -> Camera:
        """The same camera with its image moved to the right: an off-axis frustum, its near plane unturned."""
        clip = self.clip_from_world.copy()
        clip[0] += half_widths * clip[3]
        return replace(self, clip_from_world=clip)


def perspective_camera(
    *,
    frame: int,
    world_from_camera: np.ndarray,
    fov_y_rad: float,
    width: int,
    height: int,
    near: float,
) -> Camera:
    """A camera from its pose.

    world_from_camera : (4, 4) or (3, 4) float64, rigid; camera x right, y up, looking along −z.
    fov_y_rad : vertical field of view, in (0, π).
    Raises InputError for a non-rigid or non-finite pose, a field of view, near plane or size out of range.
    """
    pose = np.asarray(world_from_camera, np.float64)
    if pose.shape not in ((4, 4), (3, 4)) or not np.isfinite(pose).all():
        raise InputError(f"camera pose: found shape {pose.shape}, expected a finite (3, 4) or (4, 4) matrix")
    r, eye = pose[:3, :3], pose[:3, 3]
    if not np.allclose(r.T @ r, np.eye(3), atol=1e-6) or np.linalg.det(r) < 0:
        raise InputError("camera pose: the 3×3 part is not a rotation")
    if not 0 < fov_y_rad < math.pi:
        raise InputError(f"camera fov: found {fov_y_rad} rad, expected a value in (0, π)")
    if not (near > 0 and math.isfinite(near)):
        raise InputError(f"camera near: found {near}, expected a number > 0")
    if width < 1 or height < 1:
        raise InputError(f"camera size: found {width}×{height}, expected at least 1×1")
    f = 1.0 / math.tan(fov_y_rad / 2)
    right, up, axis = r[:, 0], r[:, 1], -r[:, 2]
    clip = np.empty((4, 4))
    for row, (direction, scale) in enumerate([(right, f * height / width), (up, f), (None, 0.0), (axis, 1.0)]):
        if direction is None:
            clip[row] = (0.0, 0.0, 0.0, near)
        else:
            clip[row, :3] = direction * scale
            clip[row, 3] = -np.dot(direction, eye) * scale
    return Camera(frame, clip, eye.copy(), width, height, near)


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(4, 4) float64 world_from_camera that looks from ``eye`` at ``target``; any helper axis if ``up`` is parallel.

    Raises InputError if eye and target coincide.
    """
    eye, target, up = (np.asarray(v, np.float64) for v in (eye, target, up))
    if np.array_equal(eye, target):
        raise InputError(f"camera: eye and target coincide at {eye.tolist()}")
    axis, up = _unit(target - eye), _unit(up)
    right = np.cross(axis, up)
    if np.linalg.norm(right) < 1e-9:
        right = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    right = _unit(right)
    right = _unit(right - (right @ axis) * axis)  # what a short cross product has lost to rounding
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(right, axis), -axis, eye
    return pose


def _unit(vector: np.ndarray) -> np.ndarray:
    """A (3,) vector of length one in this direction, however long or short; zero stays zero."""
    largest = np.abs(vector).max()
    if largest == 0:
        return vector
    vector = vector / largest
    return vector / np.linalg.norm(vector)
