"""What every splat rasterizer agrees on: eye space, bounds, which cells are one quad, the light.

Eye space has the eye at 0 and the axes right, down (as image rows) and forward (depth w).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...shared.camera import Camera
from ...shared.errors import InputError
from ...shared.octree import FLAT
from . import CellFeatures, ResidentPoints

MAX_SPLAT_PX = 256
"""Bound of a splat's cost: radii are cut to this many pixels, and so is its reach from its centre along each axis."""

SCREEN_RADIUS_PX = 1.0
"""Radius of the screen term, so that no splat falls between pixels (Botsch et al. 2005, "High-quality surface
splatting on today's GPUs", section 4.3)."""

FALLOFF = 2.0
"""A fragment at the share ρ of a splat's radius has the weight exp(−FALLOFF · ρ²)."""

LIGHT = np.array([1.0, -1.0, -1.0]) / np.sqrt(3.0)
"""Direction to the light, eye space: from the right, above and behind the viewer (thesis Appendix C)."""

AMBIENT, SHININESS = 0.2, 32
"""Share of a colour that is there without light; exponent of the highlight (thesis Appendix C)."""


@dataclass(frozen=True)
class EyeFrame:
    """A camera as rotation and pinhole: image position = focal · (x, y) / w + center.

    rotation : (3, 3) float64, eye from world directions; rows right, down, forward.
    focal, center : (2,) float64, pixels, of columns and rows.
    """

    rotation: np.ndarray
    focal: np.ndarray
    center: np.ndarray

    @classmethod
    def of(cls, camera: Camera) -> EyeFrame:
        """The frame of a camera; its image axes are orthogonal to each other, the centre is where it looks."""
        to_pixel = camera.pixel_from_world[:, :3]
        forward = to_pixel[2]
        center = to_pixel[:2] @ forward
        across = to_pixel[:2] - np.outer(center, forward)
        focal = np.linalg.norm(across, axis=1)
        return cls(np.vstack([across / focal[:, None], forward]), focal, center)

    def eye_from_blocks(self, camera: Camera, block_origin: np.ndarray) -> np.ndarray:
        """(b, 3) float64: the origins of blocks in eye space; the eye is subtracted before anything is rotated."""
        return (block_origin - camera.eye) @ self.rotation.T


def splat_columns(points: ResidentPoints) -> tuple[np.ndarray, np.ndarray]:
    """((n,) normal words, (n,) radius codes) of points. Raises InputError where a scene was built without them."""
    if points.normal is None or points.radius is None:
        raise InputError("splats: found points without normals or radii, expected both (splatpipe build --splats)")
    return points.normal, points.radius


def flat_cells(features: CellFeatures | None) -> CellFeatures:
    """The cells that are one quad in the visibility pass. Raises InputError where a scene was built without."""
    if features is None:
        raise InputError("splats.features: found cells without features, expected them (splatpipe build --features)")
    flat = (features.feature == FLAT) & (features.n_points > 0)
    return CellFeatures(
        features.first_point[flat],
        features.n_points[flat],
        features.feature[flat],
        features.quad_center[flat],
        features.quad_axes[flat],
    )


def drawn_cells(cells: CellFeatures, entries: np.ndarray) -> np.ndarray:
    """(c,) bool: which cells' ranges share a point with those of (m,) RENDER_POINT entries.

    Cost: O(c + m log c); a stride counts as the whole of its range.
    """
    begin = entries["offset"].astype(np.int64)
    stop = begin + entries["range"]
    first_cell = np.searchsorted(cells.first_point + cells.n_points, begin, side="right")
    end_cell = np.searchsorted(cells.first_point, stop, side="left")
    drawn = (first_cell < end_cell) & (stop > begin)
    n_cells = len(cells.first_point)
    steps = np.bincount(first_cell[drawn], minlength=n_cells + 1) - np.bincount(end_cell[drawn], minlength=n_cells + 1)
    return np.cumsum(steps[:-1]) > 0
