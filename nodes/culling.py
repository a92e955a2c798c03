"""The culling node: camera in, visibility bit-array out (thesis 4.3.3 and 5.2.1, node 1).

One pass over the sequential octree. Breadth-first order means that a parent is decided before its children,
so each cell starts from what its parent left undecided: a set of half-spaces (and the normal cone) that cut
through the parent's cube. A cell wholly inside a half-space passes that on, a cell wholly outside one is
invisible with all below it, and neither is tested again.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ..shared.camera import Camera
from ..shared.messages import VisibilityBits
from ..shared.octree import Octree
from ..shared.windows import Window
from .frustum import N_PLANES, frustum_planes, padded_half_edges
from .point_filter import PointFilter

_PLANES = np.uint8((1 << N_PLANES) - 1)
_CONE = np.uint8(1 << N_PLANES)
_OUTSIDE = np.uint8(1 << 7)

_CONE_SLACK = 1e-6
"""Cosines shrink by this much: cones are float32, and near one a rounded cosine is a large angle off."""


class CullingNode:
    """Tells which cells may be seen.

    octree : cells in breadth-first order; its point ranges are not used.
    backface : leave out cells whose normals all face away; without effect on an octree that has no cones.
    margin_px : how far outside the image a point's centre may lie and still colour a pixel: half the largest
        point side, plus the rasterizer's rounding. ≥ 0.
    point_filter : its boxes leave out cells too.
    """

    def __init__(
        self,
        octree: Octree,
        *,
        backface: bool,
        margin_px: float = 1.0,
        point_filter: PointFilter = PointFilter(),  # noqa: B008 (frozen)
    ):
        self._centers = octree.centers
        self._level = octree.level
        self._parent = octree.parent
        self._half_edge = padded_half_edges(octree)
        use_cone = backface and octree.cone is not None
        self._cone = octree.cone if use_cone else np.empty((0, 4), np.float32)
        self._undecided = np.empty(len(octree), np.uint8)
        self._left = point_filter.cells_left(octree, self._half_edge)
        self.margin_px = margin_px

    def process(self, camera: Camera, window: Window | None = None) -> VisibilityBits:
        """The bits of one frame: 1 where a cell may be seen; the ancestors of such a cell are 1 too.

        window : of the picture, where no more than that is drawn.
        Conservative: a cell is 0 only if no point below it is left by the boxes, nearer than ``near`` allows, falls
        within ``margin_px`` of the image or window and faces the eye.  Cost: O(cells), about 2–5 ns each.
        """
        planes = frustum_planes(camera, self.margin_px, window)
        _cull(
            self._centers,
            self._level,
            self._parent,
            self._half_edge,
            self._cone,
            camera.eye,
            planes,
            self._undecided,
        )
        visible = self._undecided != _OUTSIDE
        if self._left is not None:
            visible &= self._left
        return VisibilityBits.pack(camera.frame, visible)


@njit(nogil=True, cache=True)
def _cull(centers, level, parent, half_edge, cone, eye, planes, undecided):
    """Fill ``undecided``: per cell the tests that cut through its cube as a bit set, or ``_OUTSIDE``."""
    start = _PLANES | _CONE if len(cone) else _PLANES
    reach = np.abs(planes[:, :3]).sum(axis=1)  # of a cube of half edge 1, along the plane's normal
    for cell in range(len(parent)):
        tests = start if cell == 0 else undecided[parent[cell]]
        if tests == 0 or tests == _OUTSIDE:
            undecided[cell] = tests
            continue
        half = half_edge[level[cell]]
        x = centers[cell, 0] - eye[0]
        y = centers[cell, 1] - eye[1]
        z = centers[cell, 2] - eye[2]
        for i in range(N_PLANES):
            if tests >> i & 1:
                distance = planes[i, 0] * x + planes[i, 1] * y + planes[i, 2] * z - planes[i, 3]
                if distance < -half * reach[i]:
                    tests = _OUTSIDE
                    break
                if distance >= half * reach[i]:
                    tests &= ~np.uint8(1 << i)
        if tests != _OUTSIDE and tests & _CONE:
            facing = _facing(cone[cell], x, y, z, half)
            if facing < 0:
                tests = _OUTSIDE
            elif facing > 0:
                tests &= ~_CONE
        undecided[cell] = tests


@njit(nogil=True, cache=True)
def _facing(cone, x, y, z, half):
    """−1: every normal of the cone faces away from the eye, wherever in the cube; 1: every one towards; 0: mixed.

    (x, y, z) is the cube's centre seen from the eye. With the cone's half angle α and the angular radius β of
    the cube's bounding sphere, "away" is angle(axis, centre) + α + β ≤ 90°, without an inverse cosine.
    Source: Grossman and Dally 1998 (visibility cones); thesis 4.3.3.
    """
    distance_2 = x * x + y * y + z * z
    radius_2 = 3.0 * half * half
    cos_a = cone[3] - _CONE_SLACK
    if distance_2 <= radius_2 or cos_a <= 0.0:
        return 0
    tangent = np.sqrt(distance_2 - radius_2)  # distance · cos β
    radius = np.sqrt(radius_2)  # distance · sin β
    sin_a = np.sqrt(1.0 - cos_a * cos_a)
    if cos_a * tangent <= sin_a * radius:  # α + β ≥ 90°
        return 0
    along = cone[0] * x + cone[1] * y + cone[2] * z
    bound = sin_a * tangent + cos_a * radius  # distance · sin(α + β)
    if along >= bound:
        return -1
    if along <= -bound:
        return 1
    return 0
