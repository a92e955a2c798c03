"""Borders of tiles move so that their ranks take even time.

The cost of a picture is held by a grid over it. What a tile takes is first thought to be even inside it; tiles that
move tell more, as with subtrees. The cuts of the k-d tree that made the tiles are then moved, from the whole picture
down, until the cost on both sides is as the numbers of ranks there. What a rank does for the whole picture (composing
it) stays with it, and its tile is smaller for that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...shared.windows import Window
from ..layout import Layout, Plan
from . import Seconds
from .subtrees import forgotten

GRID = 64
"""Most cells of the grid along a side."""
LARGEST_MOVE = 0.25
"""Of what it divides, that a cut moves at a time: the cost beyond it is not known well."""
LEAST_PX = 8
"""Columns or rows on either side of a cut, where there are as many: a tile without pixels tells nothing."""
MOVABLE = ("culling", "sampling", "render")


class TileBorders:
    """The tiles of render ranks; where lanes have a tile each, a lane takes as long as its slowest rank.

    width, height : of the picture, pixels.
    """

    name = "tiles"

    def __init__(self, layout: Layout, width: int, height: int) -> None:
        if len(layout.lanes) > 1:
            self._ranks = [sorted({*lane.culling, *lane.sampling, *lane.render}) for lane in layout.lanes]
        else:
            self._ranks = [[rank] for rank in layout.render]
        self._cost = CostGrid(width, height)

    def parts(self, seconds: Seconds) -> np.ndarray:
        """As of ``Policy``."""
        return self._costs(seconds).sum(axis=1)

    def proposal(self, plan: Plan, seconds: Seconds) -> tuple[Plan, np.ndarray]:
        """As of ``Policy``."""
        movable, fixed = self._costs(seconds).T
        self._cost.learn(plan.windows, movable)
        windows = moved_tiles(plan.windows, self._cost, fixed)
        return replace(plan, windows=tuple(windows)), self._cost.inside(windows) + fixed

    def _costs(self, seconds: Seconds) -> np.ndarray:
        """(n, 2): seconds of each tile, that move with it and that stay with its rank."""
        costs = []
        for ranks in self._ranks:
            of_ranks = [
                (sum(seconds[rank].get(stage, 0.0) for stage in MOVABLE), seconds[rank].get("picture", 0.0))
                for rank in ranks
            ]
            costs.append(max(of_ranks, key=sum))
        return np.array(costs)


class CostGrid:
    """Seconds by place in a picture: a grid of at most ``GRID`` × ``GRID``, even inside a cell of it."""

    def __init__(self, width: int, height: int) -> None:
        self._x = np.linspace(0, width, min(width, GRID) + 1)
        self._y = np.linspace(0, height, min(height, GRID) + 1)
        self._seconds = np.zeros((len(self._y) - 1, len(self._x) - 1))
        self._windows: tuple[Window, ...] = ()

    def learn(self, windows: Sequence[Window], seconds: np.ndarray) -> None:
        """Scale what is inside each window to the (n,) seconds that were measured there.

        Cost: n passes over the grid.
        """
        out = np.zeros_like(self._seconds)
        share = forgotten(self.inside(windows), seconds, tuple(windows) == self._windows)
        self._windows = tuple(windows)
        for window, measured in zip(windows, seconds, strict=True):
            if window.n_pixels:
                even = np.outer(self._rows(window), self._columns(window))
                shape = even * self._seconds
                spread = even * np.outer(np.diff(self._y), np.diff(self._x)) / window.n_pixels
                shape = shape / shape.sum() if shape.sum() > 0 else spread
                out += measured * ((1 - share) * shape + share * spread)
        self._seconds = out

    def inside(self, windows: Sequence[Window]) -> np.ndarray:
        """(n,) seconds inside of each window."""
        return np.array([self._rows(window) @ self._seconds @ self._columns(window) for window in windows])

    def along_x(self, window: Window) -> np.ndarray:
        """(x1 − x0 + 1,) seconds left of each border between the columns of a window."""
        return _up_to(np.arange(window.x0, window.x1 + 1), self._x, self._rows(window) @ self._seconds)

    def along_y(self, window: Window) -> np.ndarray:
        """(y1 − y0 + 1,) seconds above each border between the rows of a window."""
        return _up_to(np.arange(window.y0, window.y1 + 1), self._y, self._seconds @ self._columns(window))

    def _columns(self, window: Window) -> np.ndarray:
        return _covered(self._x, window.x0, window.x1)

    def _rows(self, window: Window) -> np.ndarray:
        return _covered(self._y, window.y0, window.y1)


def moved_tiles(windows: Sequence[Window], cost: CostGrid, fixed: np.ndarray) -> list[Window]:
    """Tiles of a picture with their cuts moved, their order and the axis of each cut kept.

    windows : as of ``shared.windows.tiles``.  fixed : (n,) seconds of each rank, wherever its tile is.
    Cost: O(n GRID²).
    """
    out: list[Window] = []
    _divide(_around(windows), list(windows), cost, fixed, out)
    return out


def _divide(into: Window, held: list[Window], cost: CostGrid, fixed: np.ndarray, out: list[Window]) -> None:
    if len(held) == 1:
        out.append(into)
        return
    half = len(held) // 2
    first, second, whole = _around(held[:half]), _around(held[half:]), _around(held)
    side_by_side = first[1::2] == second[1::2]
    if side_by_side and first[0::2] == second[0::2]:  # nothing left to tell by
        side_by_side = into.x1 - into.x0 >= into.y1 - into.y0
    axis = 0 if side_by_side else 1
    before = cost.along_x(into) if side_by_side else cost.along_y(into)
    n, n_first = len(held), half
    # per rank as much on one side as on the other: (before + fixed of first) (n − n_first) = (rest) n_first
    wanted = (n_first * (before[-1] - before[0] + fixed[half:].sum()) - (n - n_first) * fixed[:half].sum()) / n
    begin, end = into[axis], into[axis + 2]
    at = begin + int(np.abs(before - before[0] - wanted).argmin())
    reach = max(1, int(LARGEST_MOVE * (whole[axis + 2] - whole[axis])))
    held_at = first[axis + 2]
    at = min(max(at, held_at - reach), held_at + reach)
    least = min(LEAST_PX, (end - begin) // 2)
    at = min(max(at, begin + least), end - least)
    x0, y0, x1, y1 = into
    parts = (Window(x0, y0, at, y1), Window(at, y0, x1, y1))
    if not side_by_side:
        parts = (Window(x0, y0, x1, at), Window(x0, at, x1, y1))
    _divide(parts[0], held[:half], cost, fixed[:half], out)
    _divide(parts[1], held[half:], cost, fixed[half:], out)


def _around(windows: Sequence[Window]) -> Window:
    x0, y0, x1, y1 = zip(*windows, strict=True)
    return Window(min(x0), min(y0), max(x1), max(y1))


def _covered(edges: np.ndarray, begin: int, end: int) -> np.ndarray:
    """(g,) share of each cell of an axis that lies between two pixels."""
    inside = np.minimum(edges[1:], end) - np.maximum(edges[:-1], begin)
    return np.maximum(inside, 0) / np.diff(edges)


def _up_to(at: np.ndarray, edges: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    return np.interp(at, edges, np.append(0.0, np.cumsum(seconds)))
