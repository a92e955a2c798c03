"""What draws the frames of a run on one rank: its render node, and what becomes of the words that this makes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..nodes.picture.compose import Composer, Picture
from ..nodes.render import RenderNode
from ..shared.camera import Camera
from ..shared.messages import RenderPoints
from .sink import FrameSink

if TYPE_CHECKING:
    from ..nodes.layer_render import LayerRenderNode
    from ..nodes.raster.paged_points import Residency


class RenderStage:
    """Render node, composition and output of one run."""

    def __init__(
        self,
        node: RenderNode,
        layers: LayerRenderNode | None,
        composer: Composer | None,
        sink: FrameSink | None,
        per_picture: int,
        seen: Callable[[Picture], list[tuple[str, Picture]]],
        frames_ahead: int = 0,
    ) -> None:
        self._node = node
        self._layers = layers
        self._composer = composer
        self._sink = sink
        self._per_picture = per_picture
        self.frames_ahead = frames_ahead
        self._seen = seen
        self.description = " + ".join(part.description for part in (node, layers) if part)

    def rasterize(self, camera: Camera, chosen: RenderPoints) -> np.ndarray:
        """(height, width) uint64 framebuffer words of a frame's points; valid until the next call."""
        return self._node.process(camera, chosen)

    def expect(self, chosen: RenderPoints) -> None:
        """Say what a frame that follows will draw; asked for up to ``frames_ahead`` frames, in order."""
        self._node.expect(chosen)

    @property
    def residency(self) -> Residency | None:
        """What the last frame found of paged points; None where points are resident."""
        return self._node.residency

    def compose(self, camera: Camera, words: np.ndarray, of_layers: Sequence[RenderPoints] = ()) -> Picture | None:
        """The picture that a frame completes, its layers drawn over the words of its points; None before its last view
        or where nobody wants it.
        """
        if self._layers is not None:
            words = self._layers.process(camera, of_layers, words)
        if self._composer is None:
            return None
        return self._composer.add(camera.frame % self._per_picture, camera, words)

    def show(self, frame: int, picture: Picture | None) -> None:
        """Hand the picture to the output; waits while that is behind."""
        if self._sink is not None and picture is not None:
            for screen, part in self._seen(picture):
                self._sink.put(frame // self._per_picture, part, screen)

    def times(self) -> dict[str, list[float]]:
        """Seconds of encoding, picture by picture, by kind of output; complete once the output is closed."""
        return self._sink.times if self._sink is not None else {}
