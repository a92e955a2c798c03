"""Six cube faces → one equirectangular frame of words.

Column c of w looks to the longitude (c + ½) / w · 360° − 180°, from left to right with what lies ahead in the middle;
row r of h to the latitude 90° − (r + ½) / h · 180°. Each pixel takes the word of the face pixel that its direction
falls on. The depth in the word becomes the distance from the eye, so that it is continuous over the edges of the cube.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.views import CUBE_FACES
from .rows import Rows

_EMPTY = np.uint64(FRAMEBUFFER_EMPTY)
_LOW = np.uint64(0xFFFF_FFFF)
_HIGH = np.uint64(32)


class CubeMap:
    """Where each pixel of a panorama finds its word; computed once.

    width, height : of the panorama, pixels.  face_px : side of a face.
    Memory: 9 bytes a pixel.
    """

    def __init__(self, width: int, height: int, face_px: int) -> None:
        self.words = np.full((height, width), FRAMEBUFFER_EMPTY)
        self._face = np.empty((height, width), np.uint8)
        self._source = np.empty((height, width), np.int32)
        self._stretch = distance_per_depth(face_px)
        for row, direction in enumerate(directions(width, height)):
            self._face[row], self._source[row] = face_pixels(direction, face_px)

    def add(self, face: int, words: np.ndarray, rows: Rows) -> None:
        """Take (face_px, face_px) uint64 words of a face into ``words``. Cost: one pass over the panorama's rows."""
        rows.run(len(self.words), _take_rows, self._face, self._source, face, words.ravel(), self._stretch, self.words)


def directions(width: int, height: int):
    """For each row, (w, 3) float64 unit vectors to the right, up and back that the pixels of a panorama look along."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * math.pi
    for row in range(height):
        latitude = (0.5 - (row + 0.5) / height) * math.pi
        level = math.cos(latitude)
        up = np.full(width, math.sin(latitude))
        yield np.column_stack([level * np.sin(longitude), up, -level * np.cos(longitude)])


def face_pixels(direction: np.ndarray, face_px: int) -> tuple[np.ndarray, np.ndarray]:
    """(n,) face and (n,) flat index of the pixel in it that each of (n, 3) directions falls on."""
    face = (direction @ -CUBE_FACES[:, 2].T).argmax(axis=1)
    right, up, back = np.einsum("nij,nj->in", CUBE_FACES[face], direction)
    column, row = (np.floor((1 + sign * v / -back) / 2 * face_px) for sign, v in ((1, right), (-1, up)))
    column, row = (np.clip(index.astype(np.int64), 0, face_px - 1) for index in (column, row))
    return face, row * face_px + column


def distance_per_depth(face_px: int) -> np.ndarray:
    """(face_px²,) float32: distance from the eye of what is at depth 1 in the middle of each pixel of a face."""
    slope = (np.arange(face_px) + 0.5) / face_px * 2 - 1
    return np.sqrt(1 + slope**2 + slope[:, None] ** 2).astype(np.float32).ravel()


@njit(nogil=True, cache=True)
def _take_rows(face_of, source, face, words, stretch, out, first, end):
    """Fill the pixels of ``out`` that look at a face."""
    scaled = np.empty(1, np.float32)
    bits = scaled.view(np.uint32)
    for row in range(first, end):
        for column in range(out.shape[1]):
            if face_of[row, column] == face:
                index = source[row, column]
                word = words[index]
                if word != _EMPTY:
                    bits[0] = np.uint32(word >> _HIGH)
                    scaled[0] *= stretch[index]
                    word = np.uint64(bits[0]) << _HIGH | word & _LOW
                out[row, column] = word
