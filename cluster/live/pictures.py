"""Pictures of a live run, on the display rank: encoded beside the rendering, the latest first, and sent to the hub."""

from __future__ import annotations

import io
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from ...shared.messages import FrameStart, Use

if TYPE_CHECKING:
    from .sockets import RunLink

PNG_LEVEL = 1
_RETRY_S = 0.005


class Pictures:
    """A thread that encodes pictures; a context manager.

    Of those that only follow a moving camera, the latest takes the place of one that has not been begun; a still one
    is never left out but for a later one, a screenshot never.
    """

    def __init__(self, link: RunLink, jpeg_quality: int) -> None:
        self._link, self._quality = link, jpeg_quality
        self._waiting: deque[tuple[FrameStart, np.ndarray, float]] = deque()
        self._there = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="pictures")
        self._thread.start()

    def put(self, start: FrameStart, rgba: np.ndarray) -> None:
        """Take a (h, w, 4) uint8 picture, which nobody changes any more."""
        with self._there:
            while self._waiting and self._waiting[-1][0].use is not Use.SCREENSHOT:
                self._waiting.pop()
            self._waiting.append((start, rgba, time.monotonic()))
            self._there.notify()

    def __enter__(self) -> Pictures:
        return self

    def __exit__(self, *_: object) -> None:
        with self._there:
            self._closed = True
            self._there.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._there:
                while not self._waiting and not self._closed:
                    self._there.wait()
                if self._closed:
                    return
                start, rgba, composed = self._waiting.popleft()
            begun = time.monotonic()
            header, data = encoded(start, rgba, self._quality)
            header |= {"composed_at": composed, "encoding_at": begun, "sent_at": time.monotonic()}
            while not self._link.send(header, data) and not self._closed:
                if start.use is Use.MOVING and self._waiting:
                    break
                time.sleep(_RETRY_S)


def encoded(start: FrameStart, rgba: np.ndarray, jpeg_quality: int) -> tuple[dict[str, Any], bytes]:
    """Header and file of a (h, w, 4) uint8 picture: JPEG while the camera moves, else PNG."""
    from PIL import Image

    file = io.BytesIO()
    height, width = rgba.shape[:2]
    image = Image.frombuffer("RGBX", (width, height), rgba, "raw", "RGBX", 0, 1)
    if start.use is Use.MOVING:
        encoding = "jpeg"
        image.save(file, "JPEG", quality=jpeg_quality)
    else:
        encoding = "png"
        opaque = bool((rgba[..., 3] == 255).all())
        image = image.convert("RGB") if opaque else Image.frombuffer("RGBA", (width, height), rgba, "raw", "RGBA", 0, 1)
        image.save(file, "PNG", compress_level=PNG_LEVEL)
    kind = "screenshot" if start.use is Use.SCREENSHOT else "picture"
    header = {"kind": kind, "frame": start.frame, "width": width, "height": height, "encoding": encoding}
    return header, file.getvalue()
