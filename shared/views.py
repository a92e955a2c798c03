"""The views that a picture is composed of: one, a stereo pair, or the six faces of a cube around the eye.

The pipeline draws views and numbers them; view ``v`` of picture ``p`` is frame ``p · per_picture + v``. Every rank
derives the camera of a frame from its number. ``nodes.picture`` composes what was drawn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from .camera import Camera, perspective_camera
from .camera_path import CameraPath, camera_path

if TYPE_CHECKING:
    from .config import CameraSection
    from .scene_info import SceneInfo

VIEWS_PER_PICTURE: Mapping[str, int] = {"mono": 1, "stereo": 2, "panorama": 6}
"""By ``camera.view``."""

STEREO_SHARE = 1 / 30
"""Default distance between the eyes as a share of the orbit's or scene's radius: the rule of stereo photographers for
the nearest thing in the picture."""

CUBE_FACES = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # ahead
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],  # right
        [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],  # behind
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],  # left
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],  # above; its top edge is that of the face behind
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # below; its top edge is the bottom edge of the face ahead
    ],
    np.float64,
)
"""(6, 3, 3): right, up and back axis (rows) of each face of a panorama, in the right, up and back of its middle."""


class Views(Protocol):
    """The cameras of a run."""

    @property
    def path(self) -> CameraPath:
        """What pictures are taken from."""
        ...

    @property
    def per_picture(self) -> int:
        """Views that a picture is composed of."""
        ...

    @property
    def width(self) -> int:
        """Of a view as it is drawn, pixels."""
        ...

    @property
    def height(self) -> int:
        """Of a view as it is drawn, pixels."""
        ...

    def camera(self, frame: int) -> Camera:
        """The camera of a frame, which is a view of a picture."""
        ...


def camera_views(settings: CameraSection, scene: SceneInfo, n_pictures: int, supersampling: int = 1) -> Views:
    """The views that a configuration asks for, drawn at ``supersampling`` times the width and height of the picture.

    Raises what ``camera_path`` raises.
    """
    path = camera_path(settings, scene, n_pictures)
    match settings.view:
        case "mono":
            return MonoViews(replace(path, width=path.width * supersampling, height=path.height * supersampling))
        case "stereo":
            path = replace(path, width=path.width * supersampling, height=path.height * supersampling)
            reach = (
                path.path.target_distance(0.0) if settings.path == "orbit" else math.dist(scene.lower, scene.upper) / 2
            )
            return StereoViews(path, settings.stereo_base or STEREO_SHARE * (reach or 1.0))
        case "panorama":
            side = cube_face_px(settings.width * supersampling, settings.height * supersampling)
            return PanoramaViews(replace(path, width=side, height=side))


@dataclass(frozen=True)
class MonoViews:
    """One view a picture."""

    path: CameraPath
    per_picture: int = 1

    @property
    def width(self) -> int:
        """Pixels."""
        return self.path.width

    @property
    def height(self) -> int:
        """Pixels."""
        return self.path.height

    def camera(self, frame: int) -> Camera:
        """That of the path."""
        return self.path.camera(frame)


@dataclass(frozen=True)
class StereoViews:
    """Left eye, right eye: parallel cameras whose frusta are sheared so that the target has no parallax.

    base : distance between the eyes, world units; the path's eye is in the middle.
    What is nearer than the target stands out of the picture, what is farther lies behind it. Parallel cameras leave
    no vertical parallax, which turned-in ones do (Bourke 1999, "Calculating stereo pairs").
    """

    path: CameraPath
    base: float
    per_picture: int = 2

    @property
    def width(self) -> int:
        """Pixels of one eye."""
        return self.path.width

    @property
    def height(self) -> int:
        """Pixels of one eye."""
        return self.path.height

    def camera(self, frame: int) -> Camera:
        """That of an eye."""
        picture, eye = divmod(frame, self.per_picture)
        path, time = self.path, self.path.time(picture)
        sideways = (eye - 0.5) * self.base
        pose = path.path.pose(time).copy()
        pose[:3, 3] += sideways * pose[:3, 0]
        fov_y_rad = path.path.fov_y_rad(time)
        camera = perspective_camera(
            frame=frame,
            world_from_camera=pose,
            fov_y_rad=fov_y_rad,
            width=path.width,
            height=path.height,
            near=path.near,
        )
        half_width = math.tan(fov_y_rad / 2) * path.width / path.height * path.path.target_distance(time)
        return camera.shifted(sideways / half_width)


@dataclass(frozen=True)
class PanoramaViews:
    """The six faces of a cube around the eye, each square, 90° across, in the order of ``CUBE_FACES``.

    What lies ahead on the path is in the middle of the panorama; its horizon is level whatever the camera's tilt. The
    path's field of view is not used.
    A face needs no margin: a point beside it whose square reaches in is drawn by culling's margin, and eye-dome
    lighting works on the whole panorama.
    """

    path: CameraPath
    per_picture: int = 6

    @property
    def width(self) -> int:
        """Pixels of a face."""
        return self.path.width

    @property
    def height(self) -> int:
        """Pixels of a face."""
        return self.path.width

    def camera(self, frame: int) -> Camera:
        """That of a face."""
        picture, face = divmod(frame, self.per_picture)
        pose = self.path.path.pose(self.path.time(picture))
        turned = np.eye(4)
        turned[:3, :3] = level_axes(pose, self.path.up) @ CUBE_FACES[face].T
        turned[:3, 3] = pose[:3, 3]
        return perspective_camera(
            frame=frame,
            world_from_camera=turned,
            fov_y_rad=math.pi / 2,
            width=self.width,
            height=self.height,
            near=self.path.near,
        )


def cube_face_px(width: int, height: int) -> int:
    """Side of a cube face that is nowhere coarser than a panorama of this size.

    A face is coarsest in its middle, with side / 2 pixels a radian; a panorama has width / 2π and height / π.
    """
    return math.ceil(max(width, 2 * height) / math.pi)


def level_axes(pose: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3, 3) float64 columns right, up, back of a camera turned about its right axis until its horizon is level.

    Seen straight down or up, ahead is where the top or the bottom of the picture points.
    """
    ahead = -pose[:3, 2]
    level = ahead - (ahead @ up) * up
    if np.linalg.norm(level) < 1e-6:
        level = -np.sign(ahead @ up) * pose[:3, 1]
        level -= (level @ up) * up
    back = -level / np.linalg.norm(level)
    return np.column_stack([np.cross(up, back), up, back])
