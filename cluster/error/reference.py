"""The frames that errors are measured against: every input point, float64, no level of detail, no rounding.

Positions are those of the scene, float32 offsets from float64 block origins, carried on in float64: they differ from
the source's by at most 2**-25 of their block's edge an axis. Only the depth that the frame keeps is rounded to float32
at the end. The drawing itself is ``nodes.raster.reference``; here it is done a bounded number of points at a time,
which changes nothing since the nearest point wins by a minimum, and kept on disk.
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ...nodes.point_filter import PointFilter
from ...nodes.raster import PointSize, ResidentPoints
from ...nodes.raster.reference import reference_frame
from ...shared.camera import Camera
from ...shared.colour import Colouring
from ...shared.files import write_whole
from ...shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT, FrameStart, encode
from ...shared.rebuild import leaf_ranges
from ...shared.scene_info import SCENE_FILE
from ...shared.store import Scene

POINTS_AT_A_TIME = 1 << 18
"""Bounds memory to about 50 MB."""

_VERSION = 2  # of what a kept frame holds


class References:
    """Reference frames of one scene, kept in ``folder`` by what they depend on: points, colours, camera, size, filter.

    points : of that scene, filtered.
    """

    def __init__(
        self,
        folder: Path,
        scene: Scene,
        points: ResidentPoints,
        colouring: Colouring,
        size: PointSize,
        point_filter: PointFilter,
    ) -> None:
        self._folder = folder
        self._points = points
        self._ranges = leaf_ranges(scene)
        self._size = size
        scene_json = (scene.path / SCENE_FILE).read_bytes()  # holds the checksum of every array
        self._key = hashlib.sha256(repr((_VERSION, colouring, size, point_filter)).encode() + scene_json)

    def frame(self, camera: Camera, progress: Callable[[int], object]) -> np.ndarray:
        """(height, width) uint64 framebuffer words; drawn once, then read.

        progress : called with the number of points drawn so far.
        Cost: about 1 µs a point the first time, more where points are larger than a pixel.
        """
        key = self._key.copy()
        key.update(b"".join(encode(FrameStart(camera))))
        path = self._folder / f"{key.hexdigest()[:24]}.npz"
        frame = _kept(path, (camera.height, camera.width))
        if frame is None:
            frame = self._drawn(camera, progress)
            self._folder.mkdir(parents=True, exist_ok=True)
            write_whole(path, lambda part: _keep(part, frame))
        return frame

    def _drawn(self, camera: Camera, progress: Callable[[int], object]) -> np.ndarray:
        frame = np.full((camera.height, camera.width), FRAMEBUFFER_EMPTY)
        n_drawn = 0
        for entries in _pieces(self._ranges):
            np.minimum(frame, reference_frame(self._points, camera, entries, self._size), out=frame)
            n_drawn += int(entries["range"].sum())
            progress(n_drawn)
        return frame


def _pieces(ranges: list[tuple[int, int]]) -> Iterator[np.ndarray]:
    """RENDER_POINT arrays of at most ``POINTS_AT_A_TIME`` points that together draw the ranges."""
    piece: list[tuple[int, int, int]] = []
    room = POINTS_AT_A_TIME
    for first, end in ranges:
        while first < end:
            count = min(end - first, room)
            piece.append((first, count, 1))
            first += count
            room -= count
            if room == 0:
                yield np.array(piece, RENDER_POINT)
                piece, room = [], POINTS_AT_A_TIME
    if piece:
        yield np.array(piece, RENDER_POINT)


def _keep(path: Path, frame: np.ndarray) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, words=frame)


def _kept(path: Path, shape: tuple[int, int]) -> np.ndarray | None:
    """The frame in a file; None if there is none, or it is damaged and has to be drawn again."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            frame = archive["words"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return frame if frame.shape == shape and frame.dtype == np.uint64 else None
