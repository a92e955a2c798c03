"""Pictures of a live run, on the display rank: encoded beside the rendering, the latest first, and sent to the hub."""

from __future__ import annotations

import io
import platform
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from ...shared.errors import SplatpipeError
from ...shared.messages import FrameStart, Use

if TYPE_CHECKING:
    from .sockets import RunLink

MAX_SCREENSHOTS = 2
"""That wait for the encoder: each may have some 130 MB."""
PNG_LEVEL = 1
_RETRY_S = 0.005


class Pictures:
    """A thread that encodes pictures; a context manager.

    A picture takes the place of an earlier one that has not been begun, whatever the use of both; a screenshot neither
    takes a place nor loses its own.
    """

    def __init__(self, link: RunLink, jpeg_quality: int) -> None:
        self._link, self._quality = link, jpeg_quality
        self._waiting: deque[tuple[FrameStart, np.ndarray, float]] = deque()
        self._there = threading.Condition()
        self._closed = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="pictures")
        self._thread.start()

    def put(self, start: FrameStart, rgba: np.ndarray) -> None:
        """Take a (h, w, 4) uint8 picture, which nobody changes any more; waits while ``MAX_SCREENSHOTS`` wait.

        Raises SplatpipeError where the thread has failed.
        """
        with self._there:
            if start.use is Use.SCREENSHOT:
                self._there.wait_for(lambda: self._failure is not None or self._n_screenshots < MAX_SCREENSHOTS)
            else:
                kept = [waiting for waiting in self._waiting if waiting[0].use is Use.SCREENSHOT]
                self._waiting = deque(kept)
            if self._failure is not None:
                raise SplatpipeError(f"encoding pictures: {type(self._failure).__name__}: {self._failure}")
            self._waiting.append((start, rgba, time.monotonic()))
            self._there.notify_all()

    @property
    def _n_screenshots(self) -> int:
        return sum(start.use is Use.SCREENSHOT for start, _, _ in self._waiting)

    def __enter__(self) -> Pictures:
        return self

    def __exit__(self, *_: object) -> None:
        with self._there:
            self._closed = True
            self._there.notify_all()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._encode_all()
        except Exception as error:  # told to the rank, which else would draw on for nobody
            with self._there:
                self._failure = error
                self._there.notify_all()

    def _encode_all(self) -> None:
        while True:
            with self._there:
                while not self._waiting and not self._closed:
                    self._there.wait()
                if self._closed:
                    return
                start, rgba, composed = self._waiting.popleft()
                self._there.notify_all()
            begun = time.monotonic()
            header, data = encoded(start, rgba, self._quality)
            header |= {"composed_at": composed, "encoding_at": begun, "sent_at": time.monotonic()}
            header["host"] = platform.node()
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
