"""Linear groups drawn in plain NumPy: a projection for ``reference.reference_frame``."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...shared.camera import Camera
from ...shared.codecs.group_search import STEPS
from . import ResidentPoints
from .groups import GroupCells
from .reference import Projection


def project_groups(groups: GroupCells, number: type[np.floating[Any]] = np.float64) -> Projection:
    """The projection of all kept points of all cells, and behind them all inner points.

    number : float32 rounds each operation as the compiled kernels do, float64 says where the points are.
    """

    def project(_: ResidentPoints, camera: Camera, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rows = pixel_from_cells(groups, camera).astype(number)
        cell = np.repeat(np.arange(len(groups.step)), np.diff(groups.first_kept[groups.first_run]))
        x, y, z = (column.astype(number) for column in (groups.x, groups.y, groups.z))
        m = rows[cell]
        kept = np.stack([m[:, i, 0] * x + m[:, i, 1] * y + m[:, i, 2] * z + m[:, i, 3] for i in range(3)])
        run = np.repeat(groups.first_kept[:-1], np.diff(groups.first_group))
        v1, v2 = (np.repeat(run + v, groups.n_inner) for v in (groups.v1, groups.v2))
        t = groups.parameter.astype(number) * number(1 / STEPS)
        inner = kept[:, v1] + t * (kept[:, v2] - kept[:, v1])
        u, v, w = np.concatenate([kept, inner], axis=1)[:, index]
        with np.errstate(all="ignore"):
            return u / w, v / w, w

    return project


def pixel_from_cells(groups: GroupCells, camera: Camera) -> np.ndarray:
    """(c, 3, 4) float64: rows X, Y, W over the grid points of each cell."""
    m = camera.pixel_from_world
    rows = np.empty((len(groups.step), 3, 4))
    rows[:, :, :3] = m[:, :3] * groups.step[:, None, None]
    x, y, z = (groups.origin - camera.eye + 0.5 * groups.step[:, None]).T[:, :, None]
    rows[:, :, 3] = x * m[:, 0] + y * m[:, 1] + z * m[:, 2]
    return rows
