"""A widget for notebooks: a scene to turn by hand, drawn in the notebook's process.

::

    from splatpipe.cluster.notebook import Widget
    Widget("survey.scene")

===========================  ==========================================================
drag                         turn
drag with right button,      pan
middle button or Shift
wheel                        zoom to the pointer
double click                 the point under the pointer becomes the middle; ``picked``
arrow keys (with Shift)      turn (pan)
``+``, ``-``                 zoom
w, s, a, d, q, e             fly ahead, back, left, right, down, up
r, Home                      all of the scene
===========================  ==========================================================
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jupyter_rfb import RemoteFrameBuffer

from ..shared.camera import Camera
from .api import open_scene
from .live.steering import Scale
from .scene_view import SceneView

FPS = 20.0
"""Pictures a second to hold while something moves, by a lower resolution."""

LEAST_SCALE = 0.25
STILL_S = 0.25
"""After the last motion the picture is drawn in full."""

_LEAST_PX, _MOST_PX = 16, 4096
_LOSSLESS = 100
_KEY_TURN_RAD = math.radians(5)
_KEY_PAN = 0.05
_KEY_FLY = 0.1
_KEY_ZOOM = 1.2
_ZOOM_PER_PX = 1.0015
_LEFT, _RIGHT, _MIDDLE = 1, 2, 3

_TURNS = {"ArrowLeft": (-1, 0), "ArrowRight": (1, 0), "ArrowUp": (0, 1), "ArrowDown": (0, -1)}
_FLIGHTS = {"w": (0, 0, 1), "s": (0, 0, -1), "a": (-1, 0, 0), "d": (1, 0, 0), "q": (0, -1, 0), "e": (0, 1, 0)}
_ZOOMS = {"+": _KEY_ZOOM, "=": _KEY_ZOOM, "-": 1 / _KEY_ZOOM}


class Widget(RemoteFrameBuffer):
    """A scene in a notebook.

    scene : a view of ``api.open_scene``, or a scene directory, which is opened with its defaults and closed with the
    widget.  moving_quality : of JPEG while something moves, 1…99; at rest pictures are PNG.
    Other keywords are traits of ``jupyter_rfb.RemoteFrameBuffer``.
    Raises what ``open_scene`` raises.
    """

    def __init__(self, scene: SceneView | Path | str, *, moving_quality: int = 75, **traits: Any) -> None:
        self._owns = not isinstance(scene, SceneView)
        self.view = scene if isinstance(scene, SceneView) else open_scene(scene, width=800, height=500)
        width, height = self.view.size
        super().__init__(**{"css_width": f"{width}px", "css_height": f"{height}px", **traits})
        self.orbit = self.view.first_orbit()
        self.picked: dict[str, Any] | None = None
        self._moving_quality = min(max(moving_quality, 1), _LOSSLESS - 1)
        self._scale = Scale(LEAST_SCALE)
        self._logical, self._ratio = (float(width), float(height)), 1.0
        self._held: tuple[float, float] | None = None
        self._moving = False
        self._timer: asyncio.TimerHandle | None = None

    @property
    def camera(self) -> Camera:
        """From where the picture at rest is taken."""
        return self._camera(1.0)

    def set(self, settings: Mapping[str, Any]) -> None:
        """Change settings of the view, as ``SceneView.set``."""
        self.view.set(settings)
        self._rest()

    def reset(self) -> None:
        """See all of the scene again."""
        self.orbit = self.view.first_orbit(size=self._pixels(1.0))
        self._rest()

    # --- what jupyter_rfb asks for ------------------------------------------------------------------------------------

    def get_frame(self) -> np.ndarray:
        """(h, w, 4) uint8: the next picture."""
        scale = self._scale.now if self._moving and self.view.keeps_sizes else 1.0
        begun = time.perf_counter()
        image = self.view.render(self._camera(scale))
        if self._moving:
            self._scale.took(time.perf_counter() - begun, 1 / FPS)
        self.quality = self._moving_quality if self._moving else _LOSSLESS
        return image

    def handle_event(self, event: dict[str, Any]) -> None:
        """Move the camera as the pointer and the keys say."""
        kind = event.get("type", event.get("event_type"))
        take = {
            "resize": self._resized,
            "pointer_down": self._pressed,
            "pointer_move": self._dragged,
            "pointer_up": self._released,
            "double_click": self._double_clicked,
            "wheel": self._wheeled,
            "key_down": self._typed,
            "close": self._closed,
        }.get(str(kind))
        if take is not None:
            take(event)

    # --- events -----------------------------------------------------------------------------------------------------

    def _resized(self, event: dict[str, Any]) -> None:
        self._logical = max(float(event["width"]), 1.0), max(float(event["height"]), 1.0)
        self._ratio = float(event.get("ratio", event.get("pixel_ratio", 1.0)))
        self._rest()

    def _pressed(self, event: dict[str, Any]) -> None:
        self._held = event["x"], event["y"]

    def _dragged(self, event: dict[str, Any]) -> None:
        buttons = event.get("buttons", ())
        if self._held is None or not buttons:
            return
        height = self._logical[1]
        right, down = ((event[axis] - held) / height for axis, held in zip("xy", self._held, strict=True))
        self._held = event["x"], event["y"]
        if _RIGHT in buttons or _MIDDLE in buttons or "Shift" in event.get("modifiers", ()):
            self.orbit = self.orbit.panned(-right, down)
        else:
            self.orbit = self.orbit.turned(-math.pi * right, math.pi * down)
        self._move()

    def _released(self, event: dict[str, Any]) -> None:
        if self._held is not None:
            self._held = None
            if self._moving:
                self._rest()

    def _double_clicked(self, event: dict[str, Any]) -> None:
        width, height = self._pixels(1.0)
        x, y = event["x"] / self._logical[0] * width, event["y"] / self._logical[1] * height
        self.picked = self.view.pick(x, y, self.camera)
        if self.picked:
            self.orbit = self.orbit.aimed(np.array(self.picked["position"]))
            self._rest()

    def _wheeled(self, event: dict[str, Any]) -> None:
        width, height = self._logical
        right, up = (event["x"] - width / 2) / height, (height / 2 - event["y"]) / height
        self.orbit = self.orbit.zoomed(_ZOOM_PER_PX ** min(max(-float(event["dy"]), -1e3), 1e3), right, up)
        self._move()

    def _typed(self, event: dict[str, Any]) -> None:
        key = str(event.get("key", ""))
        if key in _TURNS:
            right, up = _TURNS[key]
            if "Shift" in event.get("modifiers", ()):
                self.orbit = self.orbit.panned(_KEY_PAN * right, _KEY_PAN * up)
            else:
                self.orbit = self.orbit.turned(_KEY_TURN_RAD * right, _KEY_TURN_RAD * up)
        elif key in _ZOOMS:
            self.orbit = self.orbit.zoomed(_ZOOMS[key])
        elif key.lower() in _FLIGHTS:
            self.orbit = self.orbit.flown(*(_KEY_FLY * share for share in _FLIGHTS[key.lower()]))
        elif key in ("r", "R", "Home"):
            self.reset()
            return
        else:
            return
        self._move()

    def _closed(self, event: dict[str, Any]) -> None:
        self._stop_timer()
        if self._owns:
            self.view.close()

    # --- moving and at rest -------------------------------------------------------------------------------------------

    def _move(self) -> None:
        """Draw soon, quickly, and in full once nothing moves; at once where no event loop tells when that is."""
        self._stop_timer()
        try:
            self._timer = asyncio.get_running_loop().call_later(STILL_S, self._rest)
            self._moving = True
        except RuntimeError:
            self._moving = False
        self.request_draw()

    def _rest(self) -> None:
        self._stop_timer()
        self._moving = False
        self.request_draw()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _pixels(self, scale: float) -> tuple[int, int]:
        """Size of pictures at this scale."""
        width, height = (min(max(round(side * self._ratio * scale), _LEAST_PX), _MOST_PX) for side in self._logical)
        return width, height

    def _camera(self, scale: float) -> Camera:
        return self.view.camera_of(self.orbit, *self._pixels(scale))
