"""Where pictures go: PNG and TIFF files and a film, encoded beside the rendering, written whole or not at all.

A layer of a picture is a file of its own: ``png`` (colours), ``depth`` and ``normals``.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..nodes.picture.compose import Picture
from ..shared.errors import DeviceError, InputError
from ..shared.files import disk_error, write_whole

PNG_LEVEL = 1  # files 10 % larger than level 6 and five times as fast: the encoder must not be the slowest stage


LAYERS = {"png": ("frame", "png"), "depth": ("depth", "tiff"), "normals": ("normal", "png")}
"""Layer → prefix and suffix of its files."""


class Film(Protocol):
    """Takes the pictures of a film in their order, in the thread that draws."""

    times: list[float]
    """Seconds that each picture took to encode."""

    def put(self, rgba: np.ndarray) -> None:
        """Take the next (h, w, 4) uint8 or uint16 picture; waits while too many are unencoded."""
        ...

    def close(self, keep: bool) -> None:
        """End the film; not ``keep``: and take it away."""
        ...


class FrameSink:
    """Takes pictures in order; a context manager that ends with every file whole.

    png : write the colours of each, with as many bits as they have.  mp4 : make a film of them, 8 bits.
    Depths and normals are written where a picture has them.  make_film : by path and pictures a second.

    ``put`` waits while more than ``backlog`` files are unencoded, which bounds memory. An error in an encoder is
    raised by the next ``put`` or at the end. A file is written under another name and renamed; the film gets its name
    at the end.
    """

    def __init__(
        self,
        directory: Path,
        *,
        png: bool,
        mp4: bool,
        fps: float,
        make_film: Callable[[Path, float], Film] | None = None,
        workers: int = 2,
        backlog: int = 8,
    ) -> None:
        self.directory = directory
        self._png = png
        self._pool = ThreadPoolExecutor(workers, "encode")
        self._room = threading.BoundedSemaphore(backlog)
        self._pending: list[Future[None]] = []
        self._film = (make_film or H264Film)(directory / "film.mp4", fps) if mp4 else None
        self.times: dict[str, list[float]] = {}
        if self._film is not None:
            self.times["mp4_s"] = self._film.times

    def put(self, number: int, picture: Picture, screen: str = "") -> None:
        """Queue a picture, or what a screen of a wall shows of it. Raises what an earlier one ran into."""
        self._raise_failed()
        if self._film is not None and picture.rgba is not None:
            self._film.put(picture.rgba)
        for layer, image in (
            ("png", picture.rgba if self._png else None),
            ("depth", picture.depth),
            ("normals", picture.normals),
        ):
            if image is not None:
                times = self.times.setdefault(f"{layer}_s", [])
                self._room.acquire()
                self._pending.append(self._pool.submit(self._write, layer_name(layer, number, screen), image, times))

    def __enter__(self) -> FrameSink:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=error is not None)
        if self._film is not None:
            self._film.close(keep=error is None)
        if error is None:
            self._raise_failed()

    def _raise_failed(self) -> None:
        while self._pending and self._pending[0].done():
            self._pending.pop(0).result()

    def _write(self, name: str, image: np.ndarray, times: list[float]) -> None:
        started = time.perf_counter()
        try:
            write = {"float32": _write_tiff, "uint8": _write_png, "uint16": _write_png_16}[image.dtype.name]
            write_whole(self.directory / name, lambda part: write(part, image))
            times.append(time.perf_counter() - started)
        finally:
            self._room.release()


def _write_png(path: Path, rgba: np.ndarray) -> None:
    from PIL import Image

    opaque = bool((rgba[..., 3] == 255).all())
    Image.fromarray(rgba[..., :3] if opaque else rgba).save(path, format="PNG", compress_level=PNG_LEVEL)


def _write_png_16(path: Path, rgba: np.ndarray) -> None:
    """With pypng: Pillow has no images of three or four channels of 16 bits."""
    import png

    height, width = rgba.shape[:2]
    opaque = bool((rgba[..., 3] == 65535).all())
    rows = np.ascontiguousarray(rgba[..., :3] if opaque else rgba, ">u2").reshape(height, -1)
    greyscale: Any = False  # declared as something else, and true if left out
    writer = png.Writer(width, height, greyscale=greyscale, alpha=not opaque, bitdepth=16, compression=PNG_LEVEL)
    with path.open("wb") as file:
        writer.write_packed(file, (row.tobytes() for row in rows))


def _write_tiff(path: Path, depth: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray(depth).save(path, format="TIFF")


class H264Film:
    """An H.264 film, encoded by one thread in frame order. Raises DeviceError where PyAV is missing."""

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
        """As of ``Film``."""
        if self._error is not None:
            raise self._error
        self._frames.put(rgba)

    def close(self, keep: bool) -> None:
        """As of ``Film``. Raises what encoding ran into."""
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
                rgb = film_rgb(rgba)
                if stream is None:
                    stream = container.add_stream("libx264", rate=self._rate)
                    stream.height, stream.width, stream.pix_fmt = *rgb.shape[:2], "yuv420p"
                    stream.options = {"preset": "veryfast", "crf": "20"}
                for packet in stream.encode(self._av.VideoFrame.from_ndarray(rgb, format="rgb24")):
                    container.mux(packet)
                self.times.append(time.perf_counter() - started)
            if stream is not None:
                for packet in stream.encode():
                    container.mux(packet)


def film_rgb(picture: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8, C-contiguous: what a film shows of (h, w, 3 or 4) uint8 or uint16; 4:2:0 needs even sides."""
    height, width = film_size(*picture.shape[:2])
    rgb = picture[:height, :width, :3]
    return np.ascontiguousarray(rgb if rgb.dtype == np.uint8 else rgb >> 8, np.uint8)


def film_size(height: int, width: int) -> tuple[int, int]:
    """Of a film of pictures of this size."""
    return height - height % 2, width - width % 2


def film_of_pictures(directory: Path, n_pictures: int, fps: float) -> None:
    """Make ``film.mp4`` of the PNG files of all pictures. Raises InputError if one is unreadable or the disk full."""
    from PIL import Image

    film, whole = H264Film(directory / "film.mp4", fps), False
    try:
        for number in range(n_pictures):
            with Image.open(directory / layer_name("png", number)) as image:
                film.put(np.asarray(image.convert("RGB")))  # of 16 bits the upper 8, as in a film of a whole run
        whole = True
    except OSError as error:
        raise InputError(f"{directory / layer_name('png', number)}: {error}") from None
    finally:
        film.close(keep=whole)


def layer_name(layer: str, number: int, screen: str = "") -> str:
    """File name of a layer of a picture, or of what a screen of a wall shows of it."""
    prefix, suffix = LAYERS[layer]
    return f"{prefix}_{number:04d}{screen and f'_{screen}'}.{suffix}"


def make_output(directory: Path) -> None:
    """Make the output directory. Raises InputError if it cannot be made or written."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        probe = directory / ".writable.part"
        probe.touch()
        probe.unlink(missing_ok=True)  # ranks may try at the same time
    except OSError as error:
        raise disk_error(error, directory) from None


def prepare_output(directory: Path, keep: Collection[str] | None = None) -> None:
    """Make the output directory and take away what an earlier run left there (its pictures, film and records).

    keep : names of pictures that stay, and with them the record of what they are (``resume``).
    Raises InputError if it cannot be made or written.
    """
    make_output(directory)
    layers = [f"{prefix}_*.{suffix}" for prefix, suffix in LAYERS.values()]
    records = ["run.json", "run.partial.json"] if keep is None else ["run.json"]
    try:
        for pattern in [*records, *layers, ".*.part", "film.mp4"]:  # records before what they are about
            for old in directory.glob(pattern):
                if old.name not in (keep or ()):
                    old.unlink(missing_ok=True)
    except OSError as error:
        raise disk_error(error, directory) from None
