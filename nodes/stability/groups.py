"""Frames drawn from linear groups: cells of any size and place, eyes among the points, matrices that flatten."""

from __future__ import annotations

import numpy as np

from ...shared.codecs.linear_groups import LinearGroupCodec
from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.stability.case import cases, expect
from ..raster import ResidentPoints
from ..raster.group_raster import CpuGroupRasterizer, ResidentGroups
from ..raster.groups import GroupCells, group_cell, group_cells
from ..raster.groups_reference import project_groups
from ..raster.reference import reference_frame
from .chain import every_point
from .encoded_views import BOUNDS, VIEWS, camera_on
from .matrices import MATRICES, SEEN, through


@cases("linear groups/image position", bounds=BOUNDS, unit="px")
def image_position(name: str) -> float:
    """Image position of points whose ends were projected and that were interpolated, in float32 as the kernel rounds,
    against float64; 1920×1080.
    """
    edge, shift, eye = VIEWS[name]
    groups, camera = _sheet(edge, shift), camera_on(edge, shift, eye)
    points = _without_positions(groups)
    index = np.arange(len(points))
    exact_u, exact_v, w = project_groups(groups)(points, camera, index)
    u, v, _ = project_groups(groups, np.float32)(points, camera, index)
    seen = (w >= camera.near) & (exact_u >= 0) & (exact_u < 1920) & (exact_v >= 0) & (exact_v < 1080)
    expect(seen.sum() > 500, "points are in the image")
    return float(np.hypot(u - exact_u, v - exact_v)[seen].max())


@cases("linear groups/drawn matrix", bounds=dict.fromkeys(MATRICES, 0.0), unit="pixels")
def drawn_matrix(name: str) -> float:
    """Pixels of a frame from linear groups that differ from the NumPy twin's, the camera's matrix stretched, flattened,
    without depth, or too large for float32.
    """
    groups, camera = _sheet(1.0, 0.0), through(camera_on(1.0, 0.0, (0.5, -2.0, 1.5)), name)
    points = _without_positions(groups)
    held = ResidentGroups(groups, np.array([0, len(points)]))
    with CpuGroupRasterizer(held, camera.width, camera.height, threads=1) as rasterizer:
        found = rasterizer.draw(camera, every_point(points))
        with np.errstate(all="ignore"):
            expected = reference_frame(
                points, camera, every_point(points), projection=project_groups(groups, np.float32)
            )
        expect((expected != FRAMEBUFFER_EMPTY).any() == (name in SEEN), "points are in the image, or none can be")
        return int((found != expected).sum())


def _sheet(edge: float, shift: float) -> GroupCells:
    """A wavy sheet in a cell of this edge, its lower corner at ``shift`` on each axis."""
    u, v = np.random.default_rng(73).uniform(0, 1, (2, 4000))
    sheet = np.column_stack([u, v, 0.5 + 0.01 * np.sin(5 * u) * np.cos(4 * v)])
    cell, _ = LinearGroupCodec(100.0).group((sheet * 2**16).astype(np.int64), 16)
    expect(len(cell.parameter) > 1000, "many points are grouped")
    return group_cells([group_cell(cell, np.full(3, shift), edge / 2**16, np.zeros(len(cell), np.uint32))])


def _without_positions(groups: GroupCells) -> ResidentPoints:
    """What stands for the points where their projection says where they are; all of one colour."""
    none = np.zeros(len(groups.x) + len(groups.parameter), np.uint32)
    return ResidentPoints(none, none, none, none, np.zeros(1, np.int64), np.zeros((1, 3)))
