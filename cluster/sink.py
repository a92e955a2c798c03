"""Where frames go: PNG files and a film, encoded beside the rendering, written whole or not at all."""

from __future__ import annotations

import os
import queue
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ..shared.errors import DeviceError
from ..shared.files import disk_error, write_whole

PNG_LEVEL = 1  # files 10 % larger than level 6 and five times as fast: the encoder must not be the slowest stage


class FrameSink:
    """Takes (height, width, 4) uint8 frames in order; a context manager that ends with every file whole.

    ``put`` waits while more than ``backlog`` frames are unencoded, which bounds memory. An error in an encoder is
    raised by the next ``put`` or at the end. A frame's file is written under another name and renamed; the film gets
    its name at the end.
    """

    def __init__(self, directory: Path, *, png: bool, mp4: bool, fps: float, workers: int = 2, backlog: int = 8):
        self.directory = directory
        self._png = png
        self._pool = ThreadPoolExecutor(workers, "png") if png else None
        self._room = threading.BoundedSemaphore(backlog)
        self._pending: list[Future[None]] = []
        self._film = _Film(directory / "film.mp4", fps) if mp4 else None
        self.times: dict[str, list[float]] = {}
        if png:
            self.times["png_s"] = []
        if self._film is not None:
            self.times["mp4_s"] = self._film.times

    def put(self, frame: int, rgba: np.ndarray) -> None:
        """Queue a frame. Raises what an encoder of an earlier frame ran into."""
        self._raise_failed()
        if self._film is not None:
            self._film.put(rgba)
        if self._pool is not None:
            self._room.acquire()
            self._pending.append(self._pool.submit(self._write_png, frame, rgba))

    def __enter__(self) -> FrameSink:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=error is not None)
        if self._film is not None:
            self._film.close(keep=error is None)
        if error is None:
            self._raise_failed()

    def _raise_failed(self) -> None:
        while self._pending and self._pending[0].done():
            self._pending.pop(0).result()

    def _write_png(self, frame: int, rgba: np.ndarray) -> None:
        started = time.perf_counter()
        try:
            from PIL import Image

            path = self.directory / frame_name(frame)
            opaque = bool((rgba[..., 3] == 255).all())
            image = Image.fromarray(rgba[..., :3] if opaque else rgba)
            write_whole(path, lambda part: image.save(part, format="PNG", compress_level=PNG_LEVEL))
            self.times["png_s"].append(time.perf_counter() - started)
        finally:
            self._room.release()


class _Film:
    """An H.264 film, encoded by one thread in frame order."""

    def __init__(self, path: Path, fps: float) -> None:
        try:
            import av
        except ImportError:
            raise DeviceError("output.mp4: PyAV is missing; install splatpipe[video]") from None
        self._av = av
        self._path = path
        self._part = path.with_name(f".{path.name}.part")
        self._rate = Fraction(fps).limit_denominator(1001)
        self._frames: queue.Queue[np.ndarray | None] = queue.Queue(maxsize=8)
        self.times: list[float] = []
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._encode, name="film")
        self._thread.start()

    def put(self, rgba: np.ndarray) -> None:
        if self._error is not None:
            raise self._error
        self._frames.put(rgba)

    def close(self, keep: bool) -> None:
        self._frames.put(None)
        self._thread.join()
        if keep and self._error is None:
            os.replace(self._part, self._path)
        else:
            self._part.unlink(missing_ok=True)
        if keep and self._error is not None:
            raise self._error

    def _encode(self) -> None:
        try:
            self._encode_all()
        except BaseException as error:  # handed to the thread that renders
            self._error = disk_error(error, self._path)
            while self._frames.get() is not None:
                pass

    def _encode_all(self) -> None:
        with self._av.open(str(self._part), "w", format="mp4") as container:
            stream: Any = None
            while (rgba := self._frames.get()) is not None:
                started = time.perf_counter()
                height, width = (side - side % 2 for side in rgba.shape[:2])  # 4:2:0 needs even sides
                if stream is None:
                    stream = container.add_stream("libx264", rate=self._rate)
                    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                    stream.options = {"preset": "veryfast", "crf": "20"}
                rgb = np.ascontiguousarray(rgba[:height, :width, :3])
                for packet in stream.encode(self._av.VideoFrame.from_ndarray(rgb, format="rgb24")):
                    container.mux(packet)
                self.times.append(time.perf_counter() - started)
            if stream is not None:
                for packet in stream.encode():
                    container.mux(packet)


def frame_name(frame: int) -> str:
    """File name of a frame's picture."""
    return f"frame_{frame:04d}.png"


def prepare_output(directory: Path) -> None:
    """Make the output directory and take away what an earlier run left there (its pictures, film and run.json).

    Raises InputError if it cannot be made or written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        write_whole(directory / "run.json", lambda part: part.write_bytes(b""))  # is it writable?
        for old in [*directory.glob("frame_*.png"), *directory.glob(".*.part"), directory / "film.mp4"]:
            old.unlink(missing_ok=True)
        (directory / "run.json").unlink()
    except OSError as error:
        raise disk_error(error, directory) from None
