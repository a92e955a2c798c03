"""The framebuffer that layers are drawn to, and its words.

A fragment is a framebuffer word, its colour and the bits of its depth, so a layer is composited with points, whoever
drew those, by the minimum of words.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...shared.camera import Camera
from ...shared.layers.layer import Layer
from ...shared.messages import FRAMEBUFFER_EMPTY
from ..raster.gl_context import ContextOwner, check_errors

if TYPE_CHECKING:
    from ...shared.layer_config import LayerSection
    from .gl_layer import Drawn


class GlLayers(ContextOwner):
    """Draws layers; a context manager that owns their OpenGL context.

    layers, settings : what to draw and how, one each.  width, height : of the frames, pixels.
    device_index : in EGL's order; GLCONTEXT_DEVICE_INDEX wins.
    Raises DeviceError: no OpenGL 4.5, or not enough memory; InputError: the viewport is above the texture size.
    To be used from the thread that made it.
    """

    def __init__(
        self, layers: Sequence[Layer], settings: Sequence[LayerSection], width: int, height: int, device_index: int = 0
    ) -> None:
        import moderngl

        from .gl_kinds import gl_layer

        with self._set_up(device_index, width, height, "setting up layers"):
            self._image = np.full((height, width), FRAMEBUFFER_EMPTY)
            self._empty = self._image.copy()
            self._words = self._context.texture((width, height), 2, dtype="u4")
            depth = self._context.depth_texture((width, height))
            self._framebuffer = self._context.framebuffer([self._words], depth)
            # apart, because clearing integer colours is undefined
            self._depth_only = self._context.framebuffer(depth_attachment=depth)
            self._context.enable_only(moderngl.DEPTH_TEST)
            self._layers: list[Drawn] = [
                gl_layer(self._context, layer, setting) for layer, setting in zip(layers, settings, strict=True)
            ]

    def __len__(self) -> int:
        return len(self._layers)

    @property
    def resident_bytes(self) -> tuple[int, int]:
        """Device memory of all records and vertices, and how much of it is templates of instancing."""
        return sum(layer.resident_bytes for layer in self._layers), sum(layer.static_bytes for layer in self._layers)

    def timed_draw(self, camera: Camera, entries: Sequence[np.ndarray], *, rasterized: bool) -> float:
        """Seconds until the device has drawn the layers, nothing read back; else only made their geometry."""
        import moderngl

        with self._context:
            self._begin()
            self._context.finish()
            started = time.perf_counter()
            if not rasterized:
                self._context.enable(moderngl.RASTERIZER_DISCARD)
            for layer, chosen in zip(self._layers, entries, strict=True):
                layer.draw(camera, chosen)
            self._context.finish()
            seconds = time.perf_counter() - started
            if not rasterized:
                self._context.disable(moderngl.RASTERIZER_DISCARD)
            check_errors(self._context, "drawing layers")
        return seconds

    def _begin(self) -> None:
        self._words.write(self._empty)
        self._depth_only.clear(depth=1.0)
        self._framebuffer.use()

    def draw(self, camera: Camera, entries: Sequence[np.ndarray]) -> np.ndarray:
        """(height, width) uint64 framebuffer words; valid until the next call.

        entries : (m,) RENDER_POINT of each layer, counting objects; stride 1.
        Raises MessageError for an entry beyond the objects, DeviceError for an OpenGL error.
        """
        with self._context:
            self._begin()
            for layer, chosen in zip(self._layers, entries, strict=True):
                layer.draw(camera, chosen)
            self._words.read_into(self._image)
            check_errors(self._context, "drawing layers")
        return self._image
