"""The render node of layers: render-points over objects in, framebuffer out, composited with that of the points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..shared.camera import Camera
from ..shared.errors import MessageError
from ..shared.messages import RENDER_POINT, RenderPoints
from .layers.gl_canvas import GlLayers


class LayerRenderNode:
    """Draws the layers of a frame over its points; the maker of the canvas closes it."""

    def __init__(self, canvas: GlLayers) -> None:
        self._canvas = canvas
        self._words = np.empty(0, np.uint64)

    @property
    def description(self) -> str:
        """What draws, for people."""
        return f"layers ({self._canvas.device})"

    def warm_up(self, camera: Camera) -> None:
        """Make the driver compile the shaders, by drawing nothing."""
        self._canvas.draw(camera, [np.empty(0, RENDER_POINT)] * len(self._canvas))

    def process(self, camera: Camera, chosen: Sequence[RenderPoints], words: np.ndarray) -> np.ndarray:
        """(height, width) uint64 words: the nearer of points and layers in each pixel; valid until the next call.

        chosen : of each layer, counting objects.  words : those of the points, not modified.
        Raises MessageError if the frames differ, or for an entry beyond the objects.
        """
        for layer in chosen:
            if layer.frame != camera.frame:
                raise MessageError(f"render-points of a layer: found frame {layer.frame}, expected {camera.frame}")
        if self._words.shape != words.shape:
            self._words = np.empty_like(words)
        return np.minimum(words, self._canvas.draw(camera, [layer.entries for layer in chosen]), out=self._words)
