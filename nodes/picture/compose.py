"""The views of a picture, one after the other → its colours, depths and normals.

A *panel* is what is lit and averaged as a whole: the one view, each eye of a stereo pair, or a whole panorama.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...shared.camera import Camera
from ...shared.colour import frame_to_rgba
from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.windows import Window


@dataclass(frozen=True)
class PictureSettings:
    """What pictures are to be.

    view : as ``camera.view``.  layout : of a stereo pair, as ``camera.stereo_layout``.
    width, height : of a panel, pixels.  supersampling : drawn pixels on the side of one of these.
    background : (4,) uint8 RGBA.  bits : a channel, 8 or 16.
    edl_strength, edl_radius_px : eye-dome lighting, pixels of the picture; strength 0: none.
    colours, depth, normals : which layers are wanted.
    threads : that compose.
    screen : what is composed of a mono picture, pixels of it; None: all. What is within ``reach_px`` is looked at.
    """

    view: Literal["mono", "stereo", "panorama"]
    layout: Literal["side-by-side", "over-under"]
    width: int
    height: int
    supersampling: int
    background: np.ndarray
    bits: int
    edl_strength: float
    edl_radius_px: float
    colours: bool
    depth: bool
    normals: bool
    threads: int
    screen: Window | None = None

    @property
    def reach_px(self) -> int:
        """How far from a pixel the words lie, at most, that it is composed of; pixels of the picture."""
        if self.normals:
            from .surface import LONGEST_RUN_PX

            return max(2 * LONGEST_RUN_PX + 2, self._lit_px)
        return self._lit_px

    @property
    def _lit_px(self) -> int:
        return math.ceil(self.edl_radius_px) + 1 if self.edl_strength else 0

    @property
    def is_plain(self) -> bool:
        """Whether one pass over the words is all that there is to do."""
        return self.view != "panorama" and self.supersampling == 1 and not self.edl_strength and not self.normals


@dataclass(frozen=True)
class Picture:
    """The layers of a picture, row 0 on top; None for one that is not wanted.

    rgba : (h, w, 4) uint8 or uint16, alpha not multiplied in.
    depth : (h, w) float32, world units along the view axis, in a panorama from the eye; 0 where nothing is.
    normals : (h, w, 4) uint8, (n + 1) / 2 in camera space and alpha; zeros where there is none.
    """

    rgba: np.ndarray | None = None
    depth: np.ndarray | None = None
    normals: np.ndarray | None = None

    def of_each(self, part: Callable[[np.ndarray], np.ndarray]) -> Picture:
        """A picture of what a function makes of each layer."""
        layers = (None if layer is None else part(layer) for layer in (self.rgba, self.depth, self.normals))
        return Picture(*layers)


class Composer:
    """Makes pictures of framebuffer words; a context manager that owns its threads.

    What settings do not ask for is neither imported nor computed.
    """

    def __init__(self, settings: PictureSettings) -> None:
        self._settings = s = settings
        self._done: list[Picture] = []
        if not s.is_plain:
            from .rows import Rows

            self._rows = Rows(s.threads)
        if s.edl_strength:
            from .edl import EyeDomeLighting

            radius_px = s.edl_radius_px * s.supersampling
            self._edl = EyeDomeLighting(s.edl_strength, radius_px, wrap=s.view == "panorama")
        if s.view == "panorama":
            from ...shared.views import cube_face_px
            from .panorama import CubeMap

            width, height = s.width * s.supersampling, s.height * s.supersampling
            self._cube = CubeMap(width, height, cube_face_px(width, height))

    def add(self, view: int, camera: Camera, words: np.ndarray) -> Picture | None:
        """Take the next view of a picture, in order from 0; the picture with its last one, else None.

        words : (camera.height, camera.width) uint64 framebuffer words; not kept.
        """
        s = self._settings
        words = words.view()
        words.flags.writeable = False  # a rasterizer's own or a copy, one type to the compiler
        match s.view:
            case "mono":
                return self._panel(words, camera)
            case "stereo":
                self._done[view:] = [self._panel(words, camera)]
                if view == 0:
                    return None
                return _side_by_side(self._done, axis=1 if s.layout == "side-by-side" else 0)
            case "panorama":
                self._cube.add(view, words, self._rows)
                return self._panel(self._cube.words, camera) if view == 5 else None

    def warm_up(self, cameras: list[Camera]) -> None:
        """Compile what composing needs, by composing the views of an empty picture."""
        if not self._settings.is_plain:
            for view, camera in enumerate(cameras):
                self.add(view, camera, np.full((camera.height, camera.width), FRAMEBUFFER_EMPTY))

    def _panel(self, words: np.ndarray, camera: Camera) -> Picture:
        s = self._settings
        if s.screen is None:
            return self._composed(words, camera, Window(0, 0, s.width, s.height))
        around = s.screen.grown(s.reach_px, s.width, s.height)
        part = np.ascontiguousarray(around.scaled(s.supersampling).of(words))
        part.flags.writeable = False
        return self._composed(part, camera, around).of_each(s.screen.seen_from(around).of)

    def _composed(self, words: np.ndarray, camera: Camera, window: Window) -> Picture:
        """The layers of a window of the panel, pixels of the picture, that the words are of."""
        s = self._settings
        rgba = self._colours(words) if s.colours else None
        depth = normals = None
        if s.depth or s.normals:
            from . import surface

            depth = surface.depths(words, s.supersampling)
            if s.normals:
                panorama = s.view == "panorama"
                rays = surface.Rays.of_panorama(s.width, s.height) if panorama else None
                rays = rays or surface.Rays.of_camera(camera, s.supersampling).within(window)
                normals = surface.normals(depth, rays, self._rows)
        return Picture(rgba, depth if s.depth else None, normals)

    def _colours(self, words: np.ndarray) -> np.ndarray:
        s = self._settings
        if s.supersampling == 1 and not s.edl_strength:
            rgba = frame_to_rgba(words, s.background)
            return rgba if s.bits == 8 else rgba.astype(np.uint16) * np.uint16(257)
        from .colour import colours

        shades = self._edl.shades(words, self._rows) if s.edl_strength else None
        return colours(words, shades, s.background, s.supersampling, s.bits, self._rows)

    def __enter__(self) -> Composer:
        return self

    def __exit__(self, *_: object) -> None:
        if not self._settings.is_plain:
            self._rows.close()


def _side_by_side(panels: list[Picture], axis: int) -> Picture:
    """One picture of several; axis 1: beside, 0: below each other."""
    layers = {}
    for name in ("rgba", "depth", "normals"):
        found = [getattr(panel, name) for panel in panels]
        layers[name] = None if found[0] is None else np.concatenate(found, axis=axis)
    return Picture(**layers)
