"""Cameras whose matrix stretches, flattens or loses an axis, or leaves float32: what encoded cells are drawn with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...shared.camera import Camera

_ACROSS, _DOWN, _, _DEPTH = np.eye(4)

MATRICES = {
    "a hundred times as wide": np.diag([1e2, 1.0, 1.0, 1.0]),
    "a millionth as wide": np.diag([1e-6, 1.0, 1.0, 1.0]),
    "nearly singular": np.stack([_DOWN + 1e-12 * _ACROSS, _DOWN, np.eye(4)[2], _DEPTH]),
    "singular": np.stack([_DOWN, _DOWN, np.eye(4)[2], _DEPTH]),
    "no depth": np.diag([1.0, 1.0, 1.0, 0.0]),
    "1e30": 1e30 * np.eye(4),
    "1e-30": 1e-30 * np.eye(4),
    "beyond float32": 1e150 * np.eye(4),
}
"""Left factors of ``clip_from_world``."""

SEEN = ("a hundred times as wide", "a millionth as wide", "nearly singular", "singular", "1e30")
"""Those with which points are in the image."""


def through(camera: Camera, name: str) -> Camera:
    """The camera with its matrix taken through ``MATRICES``. The eye stays."""
    return replace(camera, clip_from_world=MATRICES[name] @ camera.clip_from_world)
