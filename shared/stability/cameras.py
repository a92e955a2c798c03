"""Matrices and poses of cameras against 50 digits, and keyframe paths where interpolation is stiff."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..camera import look_at, perspective_camera
from ..keyframes import Key, KeyframePath
from .case import case, cases, expect, fifty_digits

_WIDTH, _HEIGHT = 1920, 1080


def _exact_pixel(pose: np.ndarray, fov_y_rad: float, point: np.ndarray) -> tuple[Any, Any, Any]:
    """u, v, w of a float64 point by the definition of a pinhole camera, to 50 digits."""
    mp = fifty_digits()
    offset = [mp.mpf(float(p)) - mp.mpf(float(e)) for p, e in zip(point, pose[:3, 3], strict=True)]
    right, up, back = ([mp.mpf(float(c)) for c in pose[:3, k]] for k in range(3))
    x, y, w = (sum(a * b for a, b in zip(axis, offset, strict=True)) for axis in (right, up, [-b for b in back]))
    focal = mp.mpf(_HEIGHT) / 2 / mp.tan(mp.mpf(fov_y_rad) / 2)
    return mp.mpf(_WIDTH) / 2 + focal * x / w, mp.mpf(_HEIGHT) / 2 - focal * y / w, w


@cases("camera/matrix at a field of view of", bounds=dict.fromkeys((1e-3, 1.0, 60.0, 179.0, 179.999), 1e-7), unit="px")
def matrix(degrees: float) -> float:
    """Image position of 30 points in the image from ``pixel_from_world`` in float64, the eye subtracted first, against
    the pinhole's definition in 50 digits; scene 6.4e6 m from the origin.
    """
    rng = np.random.default_rng(47)
    worst = 0.0
    fov = math.radians(degrees)
    for _ in range(30):
        eye = 6.4e6 + rng.normal(size=3) * 100
        pose = look_at(eye, eye + rng.normal(size=3), rng.normal(size=3))
        half = math.tan(fov / 2)
        sideways = rng.uniform(-1, 1, 2) * [half * _WIDTH / _HEIGHT, half]
        point = eye + (pose[:3, :3] @ [*sideways, -1.0]) * rng.uniform(1, 1000)
        camera = perspective_camera(
            frame=0, world_from_camera=pose, fov_y_rad=fov, width=_WIDTH, height=_HEIGHT, near=1e-3
        )
        x, y, w = camera.pixel_from_world[:, :3] @ (point - camera.eye)
        u, v, _ = _exact_pixel(pose, fov, point)
        worst = max(worst, abs(x / w - float(u)), abs(y / w - float(v)))
    return worst


_UPS = {
    "along up": ([0.0, 0.0, 5.0], [0.0, 0.0, 1.0]),
    "against up": ([0.0, 0.0, -1.0], [0.0, 0.0, 1.0]),
    "1e-6 rad off up": ([1e-6, 0.0, 1.0], [0.0, 0.0, 1.0]),
    "1e-8 rad off up": ([1e-8, 2e-9, 1.0], [0.0, 0.0, 1.0]),
    "1e-8 rad off an oblique up": ([0.6 + 1e-8, 0.64, 0.48], [0.6, 0.64, 0.48]),
    "1e-12 rad off an oblique up": ([0.6 + 1e-12, 0.64, 0.48], [0.6, 0.64, 0.48]),
    "1e-300 away": ([2e-301, 1e-300, 3e-300], [0.0, 0.0, 1.0]),
    "1e300 away": ([2e299, 1e300, 3e300], [0.0, 0.0, 1.0]),
    "a denormal up": ([1.0, 2.0, 3.0], [0.0, 5e-324, 1e-320]),
    "no up": ([1.0, 2.0, 3.0], [0.0, 0.0, 0.0]),
}


@cases("camera/look_at", bounds=dict.fromkeys(_UPS, 1e-12), unit="")
def looking(name: str) -> float:
    """Departure from orthonormality, and of the view axis from the direction to the target, of poses that look along or
    nearly along the up vector, or at targets very near and very far.
    """
    toward, up = (np.array(v) for v in _UPS[name])
    rotation = look_at(np.zeros(3), toward, up)[:3, :3]
    axis = toward / np.abs(toward).max()
    axis /= np.linalg.norm(axis)
    return max(_departure(rotation), float(np.abs(rotation[:, 2] + axis).max()))


def _departure(rotation: np.ndarray) -> float:
    """Largest entry of RᵀR − 1; a mirror or a number that is none gives infinity."""
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    return error if np.linalg.det(rotation) > 0 and math.isfinite(error) else math.inf


def _key(time: float, eye: Any, target: Any, fov: float = 0.9) -> Key:
    return Key(time, np.array(eye, float), np.array(target, float), fov)


_Z = np.array([0.0, 0.0, 1.0])
_PATHS: dict[str, list[Key]] = {
    "antipodal views": [_key(0, [0, 0, 0], [1, 0, 0]), _key(1, [0, 0, 0], [-1, 0, 0])],
    "nearly antipodal views": [_key(0, [0, 0, 0], [1, 0, 0]), _key(1, [0, 0, 0], [-1, 1e-12, 0])],
    "straight up to straight down": [_key(0, [0, 0, 0], [0, 0, 1]), _key(1, [0, 0, 0], [0, 0, -1])],
    "over the top": [_key(0, [0, 0, 0], [1, 0, 1]), _key(0.5, [0, 0, 0], [0, 0, 1]), _key(1, [0, 0, 0], [-1, 0, 1])],
    "equal keys": [_key(0, [1, 2, 3], [4, 5, 6]), _key(0.5, [1, 2, 3], [4, 5, 6]), _key(1, [1, 2, 3], [4, 5, 6])],
    "equal, then on": [_key(0, [1, 2, 3], [4, 5, 6]), _key(0.5, [1, 2, 3], [4, 5, 6]), _key(1, [9, 2, 3], [4, 9, 6])],
    "keys 1e-9 apart in time": [
        _key(0, [0, 0, 0], [5, 0, 0]),
        _key(0.5, [1, 0, 0], [5, 0, 0]),
        _key(0.5 + 1e-9, [1, 0, 0], [5, 1e-9, 0]),
        _key(1, [2, 0, 0], [5, 2, 0]),
    ],
    "a turn in four antipodal steps": [
        _key(t, [0, 0, 0], [math.cos(a), math.sin(a), 0])
        for t, a in ((0, 0.0), (0.25, math.pi), (0.5, 0.0), (0.75, math.pi), (1, 0.0))
    ],
    "6.4e6 m away": [
        _key(0, [6.4e6, 6.4e6, 100], [6.4e6 + 1, 6.4e6, 100]),
        _key(1, [6.4e6 + 50, 6.4e6, 100], [6.4e6 + 49, 6.4e6, 100]),
    ],
    "fields of view from 1e-3 to 179 degrees": [
        _key(0, [0, 0, 0], [1, 0, 0], math.radians(1e-3)),
        _key(1, [0, 0, 0], [1, 1, 0], math.radians(179)),
    ],
}
_N_FRAMES = 401


def _turns(rotations: np.ndarray) -> np.ndarray:
    """(n − 1,) angles between neighbours of (n, 3, 3) rotations, radians; exact for small ones too."""
    apart = np.linalg.norm(np.diff(rotations, axis=0), axis=(1, 2))
    return 2 * np.arcsin(np.minimum(apart / math.sqrt(8), 1.0))


def _rotations(name: str, times: np.ndarray) -> np.ndarray:
    """(n, 3, 3) of the cameras at these times, each made as a run makes it."""
    path = KeyframePath(tuple(_PATHS[name]), _Z)
    rotations = []
    for time in times:
        pose = path.pose(time)
        camera = perspective_camera(
            frame=0, world_from_camera=pose, fov_y_rad=path.fov_y_rad(time), width=_WIDTH, height=_HEIGHT, near=0.1
        )
        expect(np.isfinite(camera.clip_from_world).all(), "the camera's matrix is finite")
        rotations.append(pose[:3, :3])
    return np.array(rotations)


@cases("path/orthonormal", bounds=dict.fromkeys(_PATHS, 1e-12), unit="")
def orthonormal(name: str) -> float:
    """Largest departure of a rotation from orthonormality over 401 frames of a keyframe path."""
    return max(map(_departure, _rotations(name, np.linspace(0.0, 1.0, _N_FRAMES))))


@cases("path/jump", bounds=dict.fromkeys(_PATHS, 0.05), unit="of the turn")
def jump(name: str) -> float:
    """Between the two of 401 frames with the largest turn, the share of it that is left between frames 200 times
    closer: a smooth path leaves a few two-hundredths, a flip all of it.
    """
    times = np.linspace(0.0, 1.0, _N_FRAMES)
    turns = _turns(_rotations(name, times))
    at = int(turns.argmax())
    if turns[at] < 1e-6:
        return 0.0
    closer = _turns(_rotations(name, np.linspace(times[at], times[at + 1], 201)))
    return float(closer.max() / turns[at])


@cases("path/fastest turn", bounds=dict.fromkeys(_PATHS, math.pi / 2), unit="rad a frame")
def fastest(name: str) -> float:
    """Largest turn between neighbouring frames of 401; fast where a level horizon asks for a roll at the zenith."""
    return float(_turns(_rotations(name, np.linspace(0.0, 1.0, _N_FRAMES))).max())


@case("path/equal keys rest", bound=1e-14, unit="")
def resting() -> float:
    """Largest change of a pose between two equal keys, coordinates up to 3."""
    path = KeyframePath(tuple(_PATHS["equal, then on"]), _Z)
    poses = np.array([path.pose(time) for time in np.linspace(0.0, 0.5, 101)])
    return float(np.abs(poses - poses[0]).max())
