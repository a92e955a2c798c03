"""Keyframe paths: smooth curves through what a person set at a few times."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .camera import look_at
from .errors import ConfigError

_TANGENT_LIMIT = 1.5
"""Longest tangent at a key, in units of the slower of its two neighbouring chords. It makes the camera rest between
equal keys, and keeps interpolated quaternions away from zero: chords of at most 90° on the sphere stay above 0.07."""


@dataclass(frozen=True)
class Key:
    """Where the camera is at a time, what it looks at (both (3,) float64, world), and its vertical field of view."""

    time: float
    eye: np.ndarray
    target: np.ndarray
    fov_y_rad: float


@dataclass(frozen=True)
class KeyframePath:
    """A smooth path through keys: eye, orientation and focal length are continuously differentiable in time.

    At and between keys the camera looks from eye to target with the horizon level. Where the target's way comes close
    to the eye's, as between two keys that look in opposite directions, and where the view is nearly straight up or
    down, neither says where to look or what is up: there the keys' orientations are interpolated, which never flips.
    Between two equal keys the camera rests, as it does before the first and after the last. If the last key repeats
    the first, the path is closed and smooth there too.

    Raises ConfigError for no keys, times that do not ascend, or a key whose target is its eye.
    """

    keys: tuple[Key, ...]
    up: np.ndarray

    def __post_init__(self):
        if not self.keys:
            raise ConfigError("camera.keyframes: found none, expected at least one")
        for i, key in enumerate(self.keys):
            if i and not key.time > self.keys[i - 1].time:
                raise ConfigError(
                    f"camera.keyframes[{i}].time = {key.time}, expected more than {self.keys[i - 1].time}"
                )
            if np.array_equal(key.eye, key.target):
                raise ConfigError(f"camera.keyframes[{i}]: eye and target coincide at {np.asarray(key.eye).tolist()}")

    @property
    def is_closed(self) -> bool:
        """Whether the last key repeats the first."""
        first, last = self.keys[0], self.keys[-1]
        same = np.array_equal(first.eye, last.eye) and np.array_equal(first.target, last.target)
        return len(self.keys) > 2 and same and first.fov_y_rad == last.fov_y_rad

    def pose(self, time: float) -> np.ndarray:
        """(4, 4) float64 world_from_camera."""
        eye, turned = self._eye.at(time), _rotation(self._orientation.at(time))
        toward = self._target.at(time) - eye
        distance = float(np.linalg.norm(toward))
        after = int(np.searchsorted(self._eye.times, time))
        usual = float(self._lengths.take([after - 1, after], mode="clip").min())
        aimed = _smoothstep(2 * distance / usual)
        axis = aimed * toward / (distance or 1.0) - (1 - aimed) * turned[:, 2]
        axis /= np.linalg.norm(axis)
        level = _smoothstep(4 * float(np.linalg.norm(np.cross(axis, self.up))))  # from 14° off the vertical
        pose = look_at(np.zeros(3), axis, level * self.up + (1 - level) * turned[:, 1])
        pose[:3, 3] = eye
        return pose

    def fov_y_rad(self, time: float) -> float:
        """Interpolated in the logarithm of the focal length: a zoom at an even rate, never out of (0, π)."""
        return 2 * math.atan(math.exp(self._log_tan.at(time)[0]))

    def target_distance(self, time: float) -> float:
        """From eye to target, but not less than a hundredth of what the keys have: their ways may cross."""
        return max(float(np.linalg.norm(self._target.at(time) - self._eye.at(time))), float(self._lengths.min()) / 100)

    @cached_property
    def _eye(self) -> _Hermite:
        return self._curve([key.eye for key in self.keys])

    @cached_property
    def _target(self) -> _Hermite:
        return self._curve([key.target for key in self.keys])

    @cached_property
    def _lengths(self) -> np.ndarray:
        return np.linalg.norm([key.target - key.eye for key in self.keys], axis=1)

    @cached_property
    def _log_tan(self) -> _Hermite:
        return self._curve([[math.log(math.tan(key.fov_y_rad / 2))] for key in self.keys])

    @cached_property
    def _orientation(self) -> _Hermite:
        quaternions: list[np.ndarray] = []
        for rotation in self._rotations():
            q = _quaternion(rotation)
            quaternions.append(-q if quaternions and quaternions[-1] @ q < 0 else q)  # the shorter way round
        return self._curve(quaternions)

    def _rotations(self) -> list[np.ndarray]:
        """(3, 3) of each key. One that looks straight up or down keeps the heading of the nearest one that does not."""
        axes = [(key.target - key.eye) / np.linalg.norm(key.target - key.eye) for key in self.keys]
        vertical = [float(np.linalg.norm(np.cross(axis, self.up))) < 1e-6 for axis in axes]
        oblique = [i for i, is_vertical in enumerate(vertical) if not is_vertical]
        rotations = []
        for i, axis in enumerate(axes):
            up = self.up
            if vertical[i] and oblique:
                nearest = axes[min(oblique, key=lambda j: abs(j - i))]
                up = -np.sign(axis @ self.up) * (nearest - (nearest @ self.up) * self.up)
            rotations.append(look_at(np.zeros(3), axis, up)[:3, :3])
        return rotations

    def _curve(self, values: list) -> _Hermite:
        times = np.array([key.time for key in self.keys])
        return _Hermite.through(times, np.array(values, np.float64), self.is_closed)


@dataclass(frozen=True)
class _Hermite:
    """A C¹ cubic through (k, d) values at (k,) ascending times; constant outside them."""

    times: np.ndarray
    values: np.ndarray
    tangents: np.ndarray

    @classmethod
    def through(cls, times: np.ndarray, values: np.ndarray, is_closed: bool) -> _Hermite:
        """Tangents by Catmull and Rom for uneven times, limited as ``_TANGENT_LIMIT`` says; ends as closed asks."""
        if len(times) == 1:
            return cls(times, values, np.zeros_like(values))
        step = np.diff(times)[:, None]
        chord = np.diff(values, axis=0) / step
        sign = -1.0 if values[0] @ values[-1] < 0 else 1.0  # a full turn ends at the opposite quaternion
        before = np.vstack([sign * chord[-1:] if is_closed else chord[:1], chord])
        after = np.vstack([chord, sign * chord[:1] if is_closed else chord[-1:]])
        step_before, step_after = np.vstack([step[-1:], step]), np.vstack([step, step[:1]])
        tangents = (step_after * before + step_before * after) / (step_before + step_after)
        speed = np.minimum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1))
        length = np.linalg.norm(tangents, axis=1)
        limit = np.minimum(1.0, _TANGENT_LIMIT * speed / np.where(length > 0, length, 1.0))
        return cls(times, values, tangents * limit[:, None])

    def at(self, time: float) -> np.ndarray:
        """(d,) float64 value at a time."""
        if len(self.times) == 1:
            return self.values[0]
        time = min(max(time, self.times[0]), self.times[-1])
        i = min(int(np.searchsorted(self.times, time, side="right")) - 1, len(self.times) - 2)
        step = self.times[i + 1] - self.times[i]
        s = (time - self.times[i]) / step
        return (
            (1 + 2 * s) * (1 - s) ** 2 * self.values[i]
            + s * (1 - s) ** 2 * step * self.tangents[i]
            + s * s * (3 - 2 * s) * self.values[i + 1]
            - s * s * (1 - s) * step * self.tangents[i + 1]
        )


def _smoothstep(x: float) -> float:
    """0 up to x = 0, 1 from x = 1, with a continuous derivative."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3 - 2 * x)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """(4,) unit quaternion (x, y, z, w) of a (3, 3) rotation, of either sign. Source: Bar-Itzhack 2000."""
    r = rotation
    k = np.empty((4, 4))
    k[:3, :3] = r + r.T - np.trace(r) * np.eye(3)
    k[3, :3] = k[:3, 3] = (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])
    k[3, 3] = np.trace(r)
    return np.linalg.eigh(k)[1][:, -1]


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of a quaternion (x, y, z, w) of any length but zero."""
    q = quaternion / np.linalg.norm(quaternion)
    v, w = q[:3], q[3]
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross
