"""A camera that circles a target, and how it moves: turned, panned, zoomed. In float64, defined at the poles too."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from .camera import look_at
from .camera_path import OrbitPath, orbit_radius
from .errors import InputError

DEFAULT_ELEVATION_RAD = math.radians(25)

NEAREST, FARTHEST = 1e-6, 1e4
"""Least and largest distance from the target, in those from which all of the scene is seen."""


@dataclass(frozen=True)
class Orbit:
    """Where such a camera is.

    target : (3,) float64, world, in the middle of the picture.  distance : of the eye from it, world units, > 0.
    up : (3,) float64, a unit axis (``camera_path.up_vector``).
    azimuth_rad, elevation_rad : of the eye seen from the target, as of ``OrbitPath``: counter-clockwise seen from
    above, and above the horizon, in [−π/2, π/2]. At ±π/2 the picture is a map that the azimuth turns.
    fov_y_rad : vertical field of view, in (0, π).  scale : distance from which all of the scene is seen, world units.
    """

    target: np.ndarray
    distance: float
    up: np.ndarray
    azimuth_rad: float
    elevation_rad: float
    fov_y_rad: float
    scale: float

    @classmethod
    def around(
        cls,
        lower: np.ndarray,
        upper: np.ndarray,
        up: np.ndarray,
        *,
        fov_y_rad: float,
        aspect: float,
        azimuth_rad: float = 0.0,
        elevation_rad: float = DEFAULT_ELEVATION_RAD,
    ) -> Orbit:
        """One that has the box lower … upper in the picture from every azimuth.  aspect : width over height."""
        lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        middle, elevation_rad = (lower + upper) / 2, _within_poles(elevation_rad)
        distance = orbit_radius(lower, upper, middle, up, elevation_rad, fov_y_rad, aspect)
        return cls(middle, distance, up, azimuth_rad, elevation_rad, fov_y_rad, distance)

    @classmethod
    def seen_from(
        cls, eye: np.ndarray, target: np.ndarray, up: np.ndarray, *, fov_y_rad: float, scale: float = 0.0
    ) -> Orbit:
        """The one whose eye is there; straight above or below the target, with azimuth 0.

        scale : 0: the distance.  Raises InputError if eye and target coincide or are not finite.
        """
        eye, target = np.asarray(eye, np.float64), np.asarray(target, np.float64)
        back = eye - target
        distance = math.hypot(*back)
        if not (0 < distance < math.inf):
            raise InputError(f"camera: found eye {eye.tolist()} and target {target.tolist()}, expected two places")
        back = back / distance
        front, rightwards = _horizon(up)
        across, ahead = float(back @ rightwards), float(back @ front)
        level = math.hypot(across, ahead)
        azimuth_rad = math.atan2(across, ahead) if level > 1e-12 else 0.0
        elevation_rad = math.atan2(float(back @ up), level)
        return cls(target, distance, up, azimuth_rad, elevation_rad, fov_y_rad, scale or distance)

    @property
    def eye(self) -> np.ndarray:
        """(3,) float64, world."""
        return self.pose()[:3, 3]

    def pose(self) -> np.ndarray:
        """(4, 4) float64 world_from_camera."""
        return OrbitPath(
            self.target, self.distance, self.up, self.fov_y_rad, self.elevation_rad, self.azimuth_rad
        ).pose(0.0)

    def turned(self, azimuth_rad: float, elevation_rad: float) -> Orbit:
        """Around the target by these angles; it stops at the poles."""
        return replace(
            self,
            azimuth_rad=math.remainder(self.azimuth_rad + azimuth_rad, 2 * math.pi),
            elevation_rad=_within_poles(self.elevation_rad + elevation_rad),
        )

    def panned(self, right: float, up: float) -> Orbit:
        """Eye and target moved across the view axis, so that what lies as deep as the target moves the other way by
        these shares of the picture's height.
        """
        pose, height = self.pose(), 2 * self.distance * math.tan(self.fov_y_rad / 2)
        return replace(self, target=self.target + height * (right * pose[:3, 0] + up * pose[:3, 1]))

    def zoomed(self, factor: float, right: float = 0.0, up: float = 0.0) -> Orbit:
        """``factor`` times as near, > 0, within ``NEAREST`` and ``FARTHEST``.

        right, up : of the picture's middle, in shares of its height: there, what lies as deep as the target stays.
        """
        distance = min(max(self.distance / factor, NEAREST * self.scale), FARTHEST * self.scale)
        stays = 1 - distance / self.distance
        return replace(self.panned(stays * right, stays * up), distance=distance)

    def flown(self, right: float, up: float, ahead: float) -> Orbit:
        """Eye and target moved by these shares of the distance along the axes of the view."""
        pose = self.pose()
        moved = right * pose[:3, 0] + up * pose[:3, 1] - ahead * pose[:3, 2]
        return replace(self, target=self.target + self.distance * moved)

    def aimed(self, target: np.ndarray) -> Orbit:
        """The eye where it is, the picture's middle at ``target``. Raises InputError if that is where the eye is."""
        return Orbit.seen_from(self.eye, target, self.up, fov_y_rad=self.fov_y_rad, scale=self.scale)


def up_of_pose(pose: np.ndarray, distance: float, up: np.ndarray) -> np.ndarray:
    """(3,) float64: what is up for ``look_at`` to give this pose: ``up`` where the pose is level, else its own.

    distance : of the target, world units.
    """
    level = look_at(np.zeros(3), -distance * pose[:3, 2], up)
    return up if np.allclose(level[:3, :3], pose[:3, :3], rtol=0, atol=1e-9) else pose[:3, 1]


def _horizon(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where azimuth 0 and a quarter turn lie, as of ``OrbitPath``."""
    rightwards = np.array([0.0, 1.0, 0.0] if up[0] else [1.0, 0.0, 0.0])
    return np.cross(rightwards, up), rightwards


def _within_poles(elevation_rad: float) -> float:
    return min(max(elevation_rad, -math.pi / 2), math.pi / 2)
