"""Camera paths: from a frame number to a camera.

A path gives, for a time in [0, 1], a pose (``world_from_camera``) and a vertical field of view; ``CameraPath`` adds
what all frames share. A closed path spreads its frames over [0, 1), so that the film loops; an open one over [0, 1].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from .camera import Camera, perspective_camera
from .errors import ConfigError
from .keyframes import Key, KeyframePath

if TYPE_CHECKING:
    from .config import CameraSection
    from .scene_info import SceneInfo

NEAR_SHARE = 1e-4
"""Default near plane as a share of the scene's radius: reversed depth does not suffer from a small one, and a camera
inside the scene sees what is close."""

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class Path(Protocol):
    """Where the camera is over time."""

    @property
    def is_closed(self) -> bool:
        """Whether time 1 is time 0 again."""
        ...

    def pose(self, time: float) -> np.ndarray:
        """(4, 4) float64 world_from_camera at a time in [0, 1]."""
        ...

    def fov_y_rad(self, time: float) -> float:
        """Vertical field of view at a time in [0, 1]."""
        ...

    def target_distance(self, time: float) -> float:
        """How far away is what the camera looks at, world units, > 0; at a time in [0, 1]."""
        ...


@dataclass(frozen=True)
class CameraPath:
    """The cameras of a film of ``n_frames`` frames; width and height in pixels, near in world units.

    up : (3,) float64 unit axis, what is up in the scene.
    """

    path: Path
    n_frames: int
    width: int
    height: int
    near: float
    up: np.ndarray

    def time(self, frame: int) -> float:
        """The time in [0, 1] of a frame in [0, n_frames)."""
        return frame / (self.n_frames if self.path.is_closed else max(self.n_frames - 1, 1))

    def camera(self, frame: int) -> Camera:
        """The camera of a frame in [0, n_frames)."""
        time = self.time(frame)
        return perspective_camera(
            frame=frame,
            world_from_camera=self.path.pose(time),
            fov_y_rad=self.path.fov_y_rad(time),
            width=self.width,
            height=self.height,
            near=self.near,
        )


def camera_path(settings: CameraSection, scene: SceneInfo, n_frames: int) -> CameraPath:
    """The path that a configuration asks for, around or through a scene.

    Raises ConfigError for keyframes or poses that make no path, InputError for a pose that is not rigid.
    """
    lower, upper = np.array(scene.lower), np.array(scene.upper)
    up = up_vector(scene) if settings.up == "scene" else axis_vector(settings.up)
    fov_rad = math.radians(settings.fov_deg)
    scene_radius = math.dist(lower, upper) / 2 or 1.0  # scaled: the squares of a tiny extent are 0
    match settings.path:
        case "orbit":
            center = (lower + upper) / 2 if settings.center is None else np.array(settings.center)
            elevation_rad = math.radians(settings.elevation_deg)
            aspect = settings.width / settings.height
            radius = settings.radius or orbit_radius(lower, upper, center, up, elevation_rad, fov_rad, aspect)
            path = OrbitPath(
                center,
                radius,
                up,
                fov_rad,
                elevation_rad,
                math.radians(settings.start_deg),
                math.radians(settings.sweep_deg),
            )
        case "keyframes":
            keys = [
                Key(k.time, np.array(k.eye), np.array(k.target), math.radians(k.fov_deg or settings.fov_deg))
                for k in settings.keyframes
            ]
            path = KeyframePath(tuple(keys), up)
        case "poses":
            path = PosesPath.checked(settings.poses, fov_rad, n_frames, (lower + upper) / 2, scene_radius)
    near = settings.near or NEAR_SHARE * scene_radius
    return CameraPath(path, n_frames, settings.width, settings.height, near, up)


def axis_vector(name: str) -> np.ndarray:
    """(3,) float64 unit vector of ``x``, ``y``, ``z`` or one of them with a minus sign."""
    axis = np.array(_AXES[name.removeprefix("-")])
    return -axis if name.startswith("-") else axis


def up_vector(scene: SceneInfo) -> np.ndarray:
    """(3,) float64 unit axis that points up in a scene.

    Where the scene does not say, z; but y for the vertices of a bare mesh (PLY files with normals and without colour),
    as is the custom in computer graphics.
    """
    if scene.up != "auto":
        return axis_vector(scene.up)
    from_ply = all(source.name.lower().endswith(".ply") for source in scene.sources)
    is_model = from_ply and "normal" in scene.attributes and "rgb" not in scene.attributes
    return axis_vector("y" if is_model else "z")


# --- orbit ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OrbitPath:
    """A circle around a centre, looking at it; defined at the poles too.

    center : (3,) float64, world.  radius : distance of the eye, world units.  up : (3,) float64, a unit axis.
    elevation_rad : height above the horizon, in [−π/2, π/2].  start_rad, sweep_rad : azimuth at time 0 and how far it
    turns, counter-clockwise seen from above. At azimuth 0, x points to the right of the image (y where x is up): a map
    is seen from the south, a model with y up from its front.
    """

    center: np.ndarray
    radius: float
    up: np.ndarray
    fov_rad: float
    elevation_rad: float = 0.0
    start_rad: float = 0.0
    sweep_rad: float = 2 * math.pi

    @property
    def is_closed(self) -> bool:
        """A whole number of turns, at least one."""
        turns = abs(self.sweep_rad) / (2 * math.pi)
        return round(turns) > 0 and math.isclose(turns, round(turns))

    def fov_y_rad(self, time: float) -> float:
        """Constant."""
        return self.fov_rad

    def target_distance(self, time: float) -> float:
        """That of the centre."""
        return self.radius

    def pose(self, time: float) -> np.ndarray:
        """(4, 4) float64 world_from_camera."""
        azimuth = self.start_rad + time * self.sweep_rad
        rightwards = axis_vector("y" if self.up[0] else "x")
        front = np.cross(rightwards, self.up)
        outwards = math.cos(azimuth) * front + math.sin(azimuth) * rightwards
        back = math.cos(self.elevation_rad) * outwards + math.sin(self.elevation_rad) * self.up
        right = math.cos(azimuth) * rightwards - math.sin(azimuth) * front
        return _rigid(np.column_stack([right, np.cross(back, right), back]), self.center + self.radius * back)


def orbit_radius(
    lower: np.ndarray,
    upper: np.ndarray,
    center: np.ndarray,
    up: np.ndarray,
    elevation_rad: float,
    fov_y_rad: float,
    aspect: float,
) -> float:
    """Least distance from which the box lower…upper is in the image from every azimuth, and in front of the eye with a
    thousandth of its depth to spare; 1 for a single point.

    Closed form for the cylinder that the box sweeps: over the azimuth θ and the upper and lower rim, the largest
    ``depth offset + |x| / tan(fov_x/2)`` and ``depth offset + |y| / tan(fov_y/2)``.
    """
    reach = np.maximum(upper - center, center - lower)
    half_height = float(np.abs(up) @ reach)
    rim = math.hypot(*(reach * (1 - np.abs(up))))  # scales: the extents' squares may be 0
    tan_y = math.tan(fov_y_rad / 2)
    tan_x = tan_y * aspect
    sin_e, cos_e = abs(math.sin(elevation_rad)), math.cos(elevation_rad)
    sideways = rim * math.hypot(cos_e, 1 / tan_x) + half_height * sin_e
    above = half_height * abs(sin_e + cos_e / tan_y) + rim * abs(cos_e - sin_e / tan_y)
    below = half_height * abs(sin_e - cos_e / tan_y) + rim * abs(cos_e + sin_e / tan_y)
    in_front = (half_height * sin_e + rim * cos_e) * 1.001  # a line along the view would reach the eye
    return max(sideways, above, below, in_front) or 1.0


# --- explicit poses ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PosesPath:
    """One given pose a frame: world_from_camera, (n, 4, 4) or (n, 3, 4) float64.

    scene_middle : (3,) float64, world; stands for the target, which a pose does not have.
    scene_radius : world units, > 0.
    """

    world_from_camera: np.ndarray
    fov_rad: float
    scene_middle: np.ndarray
    scene_radius: float
    is_closed: bool = False

    @classmethod
    def checked(
        cls,
        matrices: list[list[list[float]]],
        fov_rad: float,
        n_frames: int,
        scene_middle: np.ndarray,
        scene_radius: float,
    ) -> PosesPath:
        """Raises ConfigError unless there is one 4×4 or 3×4 matrix a frame."""
        if len(matrices) != n_frames:
            raise ConfigError(f"camera.poses: found {len(matrices)}, expected {n_frames}, one a frame (output.frames)")
        for i, matrix in enumerate(matrices):
            if len(matrix) not in (3, 4) or any(len(row) != 4 for row in matrix):
                raise ConfigError(
                    f"camera.poses[{i}]: found {[len(row) for row in matrix]} numbers, expected 4×4 or 3×4"
                )
        poses = np.array([matrix[:3] for matrix in matrices], np.float64)
        return cls(poses, fov_rad, scene_middle, scene_radius)

    def fov_y_rad(self, time: float) -> float:
        """Constant."""
        return self.fov_rad

    def target_distance(self, time: float) -> float:
        """Depth of the scene's middle, but not less than a tenth of the scene's radius."""
        pose = self.pose(time)
        return max(float((self.scene_middle - pose[:3, 3]) @ -pose[:3, 2]), self.scene_radius / 10)

    def pose(self, time: float) -> np.ndarray:
        """The pose of the frame nearest to a time."""
        return self.world_from_camera[round(time * (len(self.world_from_camera) - 1))]


def _rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose
