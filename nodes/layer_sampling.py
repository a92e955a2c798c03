"""The sampling node of a layer: visibility bits in, render-points over its objects out.

Objects have no level-of-detail copies: a visible cell draws its own objects, and those of the cells below it follow
where it is large enough on the screen. How an object itself gets simpler with distance is its shader's business.
"""

from __future__ import annotations

import numpy as np

from ..shared.camera import Camera
from ..shared.errors import MessageError
from ..shared.messages import RENDER_POINT, RenderPoints, VisibilityBits
from ..shared.octree import Octree


class LayerSamplingNode:
    """Tells which objects of a layer to draw.

    octree : of point order "additive".
    detail_px : objects of cells whose cube is smaller than this on the screen are left out; 0: none.
    """

    def __init__(self, octree: Octree, *, detail_px: float) -> None:
        self._octree = octree
        self._detail_px = detail_px

    def process(self, camera: Camera, bits: VisibilityBits) -> RenderPoints:
        """The entries of one frame, ascending, adjacent ranges merged; stride 1, counting objects.

        Raises MessageError if the bits belong to another frame or another octree.  Cost: some passes over the cells.
        """
        tree = self._octree
        if bits.frame != camera.frame or bits.n_cells != len(tree):
            raise MessageError(
                f"visibility bits: found frame {bits.frame} of {bits.n_cells} cells,"
                f" expected frame {camera.frame} of {len(tree)}"
            )
        drawn = bits.unpack().astype(bool)
        if self._detail_px:
            half = tree.half_edges
            gap = np.maximum(np.abs(tree.centers - camera.eye) - half[:, None], 0)
            distance = np.maximum(np.linalg.norm(gap, axis=1), camera.near)
            drawn &= 2 * half * camera.focal_px >= self._detail_px * distance  # at least halves from a cell to a child
        cells = np.flatnonzero(drawn & (tree.n_points > 0))
        first, end = tree.first_point[cells], tree.first_point[cells] + tree.n_points[cells]
        starts = np.flatnonzero(np.r_[True, first[1:] != end[:-1]]) if len(cells) else cells
        entries = np.empty(len(starts), RENDER_POINT)
        entries["offset"], entries["stride"] = first[starts], 1
        entries["range"] = np.r_[end[starts[1:] - 1], end[-1:]] - first[starts] if len(cells) else 0
        return RenderPoints(camera.frame, entries)
