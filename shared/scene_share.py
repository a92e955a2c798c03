"""A share of a scene: a range of whole cells of the point-array, for a rank that draws no other points.

Columns are the parts of mapped files, coded positions are decoded in the range alone: what lies outside is not touched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from .array_source import Column, ReadColumn
from .messages import RENDER_POINT
from .octree import Octree
from .store import PositionReader, Scene


def share_borders(octree: Octree, n: int) -> np.ndarray:
    """(n + 1,) int64: where n shares begin in the point-array, and its end; each of whole cells.

    Stored points are balanced as far as whole cells allow; where there are fewer cells than shares, some are empty.
    """
    owners = octree.owners
    first = octree.first_point[owners]
    borders = np.append(first, first[-1] + octree.n_points[owners[-1]]) if len(owners) else np.zeros(1, np.int64)
    wanted = borders[-1] * np.arange(n + 1) // n
    after = np.searchsorted(borders, wanted)
    before = np.maximum(after - 1, 0)
    return borders[np.where(wanted - borders[before] < borders[after] - wanted, before, after)]


def clip_entries(entries: np.ndarray, first: int, stop: int) -> np.ndarray:
    """(k,) RENDER_POINT of the points that (m,) entries name in first … stop − 1, offsets relative to ``first``.

    No entry may be of pooled points.  Cost: some passes over the entries, in NumPy.
    """
    offset, length, stride = (entries[name].astype(np.int64) for name in ("offset", "range", "stride"))
    skipped = np.maximum(-(-(first - offset) // stride), 0)  # points before the share
    begin, end = offset + skipped * stride, np.minimum(offset + length, stop)
    kept = begin < end
    out = np.empty(int(kept.sum()), RENDER_POINT)
    out["offset"], out["range"] = begin[kept] - first, (end - begin)[kept]
    out["stride"] = entries["stride"][kept]
    return out


class SceneShare(Scene):
    """The stored points ``first`` … ``stop`` − 1 of a scene as a scene of their own, numbered from 0.

    Its octree is the whole one with ranges numbered so; those of cells of other shares lie outside its points.

    checked_by : (i, n): ``check`` looks at every n-th array from the i-th alone, as n ranks check a scene together.
    """

    def __init__(self, whole: Scene, first: int, stop: int, checked_by: tuple[int, int] = (0, 1)) -> None:
        super().__init__(whole.path, replace(whole.info, n_stored=stop - first))
        self._whole = whole
        self._first = first
        self._part = slice(first, stop)
        self._checked_by = checked_by

    def octree(self, *, features: bool = False, pools: bool = False) -> Octree:
        """As of ``Scene``, ranges relative to the share."""
        octree = self._whole.octree(features=features, pools=pools)
        return replace(octree, first_point=octree.first_point - self._first)

    def positions(self, mmap: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As of ``Scene``, of the share."""
        if self.info.coded:
            return super().positions(mmap)
        x, y, z = self._whole.positions()
        return x[self._part], y[self._part], z[self._part]

    def position_reader(self) -> PositionReader:
        """As of ``Scene``, by the numbers of the share."""
        read = self._whole.position_reader()
        return lambda start, stop: read(start + self._first, stop + self._first)

    def attribute(self, name: str, mmap: bool = True) -> np.ndarray:
        """As of ``Scene``, of the share."""
        return self._whole.attribute(name, mmap)[self._part]

    def column(self, name: str) -> Column:
        """As of ``Scene``, of the share."""
        if self._whole.mapped:
            return self._whole.column(name)[self._part]
        n = self.info.n_stored
        return ReadColumn(self.path / f"{name}.npy", self._whole.info.arrays[name], self._first, n)

    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """As of ``Scene``, those that the share's points stand in; the first may begin before the share."""
        first, origin = self._whole.blocks()
        begin = int(np.searchsorted(first, self._first, side="right")) - 1
        end = max(int(np.searchsorted(first, self._part.stop)), begin + 1)
        return np.maximum(first[begin:end] - self._first, 0), origin[begin:end]

    def check(self, names: Iterable[str], progress: Callable[[str, int, int | None], None] | None = None) -> None:
        """As of ``Scene``, every n-th array from the i-th."""
        i, n = self._checked_by
        self._whole.check(list(names)[i::n], progress)
