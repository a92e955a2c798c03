"""Windows of a picture: the tiles that render ranks draw, each a rectangle of pixels.

A rasterizer projects into the whole picture whatever its window is, so that a point falls on the pixel that it falls on
where one rank draws everything; a window says which cells are worth looking at, and which words are kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Window(NamedTuple):
    """Columns x0 … x1 − 1 of rows y0 … y1 − 1, pixels, top-left origin; empty where x1 = x0 or y1 = y0."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def n_pixels(self) -> int:
        """Pixels inside."""
        return (self.x1 - self.x0) * (self.y1 - self.y0)

    def of(self, words: np.ndarray) -> np.ndarray:
        """(y1 − y0, x1 − x0): a view of the window's part of a picture's (height, width) words."""
        return words[self.y0 : self.y1, self.x0 : self.x1]

    def grown(self, margin: int, width: int, height: int) -> Window:
        """With a margin on each side, as far as a picture of this size reaches."""
        x0, y0, x1, y1 = self
        return Window(max(x0 - margin, 0), max(y0 - margin, 0), min(x1 + margin, width), min(y1 + margin, height))

    def scaled(self, factor: int) -> Window:
        """In a picture of ``factor`` times the width and height."""
        return Window(*(factor * side for side in self))

    def seen_from(self, other: Window) -> Window:
        """In what ``other`` cuts out."""
        return Window(self.x0 - other.x0, self.y0 - other.y0, self.x1 - other.x0, self.y1 - other.y0)


def tiles(width: int, height: int, weights: Sequence[float]) -> list[Window]:
    """Windows without overlap that fill a picture, one for each weight, their areas near the weights' shares.

    The picture is halved along its longer side, again and again, a half having half of the weights (a k-d tree). Tiles
    are whole pixels: of more weights than pixels some get an empty window.  Weights: ≥ 0, at least one.
    """
    out: list[Window] = []
    _divide(Window(0, 0, width, height), list(weights), out)
    return out


def _divide(window: Window, weights: list[float], out: list[Window]) -> None:
    if len(weights) == 1:
        out.append(window)
        return
    half = len(weights) // 2
    total = sum(weights)
    share = sum(weights[:half]) / total if total > 0 else half / len(weights)
    x0, y0, x1, y1 = window
    if x1 - x0 >= y1 - y0:
        cut = x0 + round(share * (x1 - x0))
        first, second = Window(x0, y0, cut, y1), Window(cut, y0, x1, y1)
    else:
        cut = y0 + round(share * (y1 - y0))
        first, second = Window(x0, y0, x1, cut), Window(x0, cut, x1, y1)
    _divide(first, weights[:half], out)
    _divide(second, weights[half:], out)
