"""The render node: render-points array in, framebuffer out (thesis 5.2.1, node 3). It never sees the octree's cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..shared.camera import Camera
from ..shared.colour import Colouring, colour_words
from ..shared.errors import MessageError
from ..shared.messages import RENDER_POINT, RenderPoints
from ..shared.store import Scene
from .raster import Rasterizer, ResidentPoints


class RenderNode:
    """Draws frames with a rasterizer, which its maker closes."""

    def __init__(self, rasterizer: Rasterizer):
        self._rasterizer = rasterizer

    @property
    def description(self) -> str:
        """Rasterizer and device, for people."""
        return f"{self._rasterizer.name} ({self._rasterizer.device})"

    def warm_up(self, camera: Camera) -> None:
        """Compile what drawing needs, by drawing nothing."""
        self._rasterizer.draw(camera, np.empty(0, RENDER_POINT))

    def process(self, camera: Camera, chosen: RenderPoints) -> np.ndarray:
        """(height, width) uint64 framebuffer words of one frame; valid until the next call.

        Raises MessageError if camera and render-points are of different frames, or an entry is not in the point-array.
        """
        if camera.frame != chosen.frame:
            raise MessageError(f"render-points: found frame {chosen.frame}, expected frame {camera.frame}")
        return self._rasterizer.draw(camera, chosen.entries)


@dataclass(frozen=True)
class Wanted:
    """What a run needs of the points besides position and colour; nothing else is loaded.

    splats : normals and radii.  features : classes and quads of the cells.
    cells : blocks as single cells, with the spacing of their points.
    """

    splats: bool = False
    features: bool = False
    cells: bool = False


def load_points(scene: Scene, colouring: Colouring, wanted: Wanted = Wanted(), *, verify: bool) -> ResidentPoints:
    """The render rank's half of a scene, coloured. Positions (and rgb) are mapped from the files, not copied.

    verify : hold the checksums of the arrays it reads against the scene first: one read of each.
    Raises StoreError naming the array that is damaged or that the scene was built without.
    """
    if verify:
        scene.check(["x", "y", "z", *([f"attr_{colouring.attribute}"] if colouring.attribute else [])])
    block_first_point, block_origin = scene.blocks()
    return ResidentPoints(
        *scene.positions(),
        colour_words(scene, colouring),
        block_first_point,
        block_origin,
        root_edge=scene.info.edge,
    )
