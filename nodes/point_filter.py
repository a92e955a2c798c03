"""Which points of a scene a run draws at all: classes and clip boxes, fixed for the whole run.

So they are applied once, where points are loaded: a point that is filtered out gets NaN as its x. Render-points name
ranges of the point-array, hence points cannot be taken out of it; and of the values that x could have, NaN alone is
safe. Whatever the camera, it makes w, u and v NaN, and no comparison with NaN holds. A huge finite x is drawn: at the
vanishing point of the x axis where that is in the picture, and anywhere where the camera's row for w has a zero there.
So is an infinite one, once 0 · ∞ is taken for 0. GLSL does not promise NaN (4.60, section 4.7.1), so shaders look at
the bits of x, which no arithmetic touches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, Protocol

import numpy as np
from numba import njit

from ..shared.errors import ConfigError
from ..shared.octree import FEATURES, Octree
from ..shared.store import Scene
from .raster import CellFeatures
from .raster.threads import read_only

Corner = tuple[float, float, float]


class _Box(Protocol):
    """A box of the configuration."""

    @property
    def lower(self) -> Corner: ...
    @property
    def upper(self) -> Corner: ...
    @property
    def keep(self) -> Literal["inside", "outside"]: ...


@dataclass(frozen=True)
class ClipBox:
    """An axis-aligned box in world coordinates, faces included, and whether what lies inside it is kept or the rest."""

    lower: Corner
    upper: Corner
    keep_inside: bool = True


@dataclass(frozen=True)
class PointFilter:
    """A point is drawn if its class is one of ``classes`` (none: any class) and every box keeps it."""

    classes: tuple[int, ...] = ()
    boxes: tuple[ClipBox, ...] = ()

    def __bool__(self) -> bool:
        """Whether there is anything to filter."""
        return bool(self.classes or self.boxes)

    @classmethod
    def choose(cls, scene: Scene, classes: Iterable[int], boxes: Iterable[_Box]) -> PointFilter:
        """The filter that a configuration asks for.

        Raises ConfigError for classes of a scene without them, or a box whose lower corner is above its upper one.
        """
        chosen = tuple(sorted(set(classes)))
        if chosen and "classification" not in scene.info.attributes:
            found = ", ".join(scene.info.attributes) or "no attribute"
            raise ConfigError(f"filter.classes = {list(chosen)}: the scene has {found}, expected classification")
        clip = []
        for i, box in enumerate(boxes):
            for axis, lower, upper in zip("xyz", box.lower, box.upper, strict=True):
                if not lower <= upper:
                    raise ConfigError(f"filter.boxes[{i}]: found lower {axis} = {lower:g}, expected at most {upper:g}")
            clip.append(ClipBox(box.lower, box.upper, box.keep == "inside"))
        return cls(chosen, tuple(clip))

    def cells_left(self, octree: Octree, half_edges: np.ndarray) -> np.ndarray | None:
        """(n_cells,) bool: 0 where the boxes leave no point of the cell's cube nor of those below; None: no boxes.

        half_edges : (MAX_LEVEL + 1,) float64, of the cubes of each level, grown by whatever points may lie outside.
        A cell that is 1 has ancestors that are 1.  Cost: O(cells · boxes).
        """
        if not self.boxes:
            return None
        half = half_edges[octree.level][:, None]
        low, high = octree.centers - half, octree.centers + half
        left = np.ones(len(octree), bool)
        for box in self.boxes:
            if box.keep_inside:
                left &= ((low <= box.upper) & (high >= box.lower)).all(axis=1)
            else:
                left &= ~((low >= box.lower) & (high <= box.upper)).all(axis=1)
        borders = np.searchsorted(octree.level, np.arange(1, int(octree.level[-1]) + 2))
        for begin, end in pairwise(borders):  # level by level, parents before children
            left[begin:end] &= left[octree.parent[begin:end]]
        return left

    def keeps(self, positions: np.ndarray, classes: np.ndarray | None) -> np.ndarray:
        """(n,) bool of (n, 3) float64 world positions and (n,) class codes, which may be None where none are chosen.

        Bit by bit what ``filtered_x`` keeps; for a few points.
        """
        kept = np.ones(len(positions), bool)
        if self.classes and classes is not None:
            kept &= np.isin(classes, self.classes)
        for box in self.boxes:
            kept &= ((positions >= box.lower) & (positions <= box.upper)).all(axis=1) == box.keep_inside
        return kept

    def filtered_x(self, scene: Scene, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """(n,) float32: a copy of ``x`` with NaN for each point that is filtered out.

        x, y, z : (n,) float32, the scene's stored positions. Boxes cut world coordinates in float64, block origin plus
        offset, so they are exact however far the scene is from the world's origin.
        Cost: one compiled pass over the columns, mapped from the files; memory 4 bytes a point.
        """
        return self.reader(scene)(0, x, y, z)

    def reader(self, scene: Scene) -> Callable[[int, np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """``filtered_x`` of any range of stored points: called with its first point and the (k,) columns of the range.

        Cost: of the scene's blocks, once.
        """
        first, origin = scene.blocks()
        codes = scene.column("attr_classification") if self.classes else None
        keep_class = np.zeros(256, bool)
        keep_class[list(self.classes)] = True
        corners = np.array([(box.lower, box.upper) for box in self.boxes], np.float64).reshape(-1, 2, 3)
        keep_inside = np.array([box.keep_inside for box in self.boxes], bool)

        def filtered(start: int, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
            stop = start + len(x)
            begin, end = int(np.searchsorted(first, start, side="right")) - 1, int(np.searchsorted(first, stop))
            borders = np.append(np.maximum(first[begin:end], start), stop) - start
            part = np.empty(0, np.uint8) if codes is None else codes[start:stop]
            out = np.empty(len(x), np.float32)
            x, y, z, part = map(read_only, (x, y, z, part))
            _filter(x, y, z, part, keep_class, borders[:-1], borders[1:], origin[begin:end], corners, keep_inside, out)
            return out

        return filtered


def features_left(features: CellFeatures, x: np.ndarray) -> CellFeatures:
    """The same but for cells that lost a point, which become cells of no feature: a quad would show what was cut away.

    x : (n,) float32, filtered.  Cost: one pass over x; memory 1 byte a point while working.
    """
    lost = np.logical_or.reduceat(np.isnan(x), features.first_point)
    return replace(features, feature=np.where(lost, np.uint8(FEATURES.index("none")), features.feature))


@njit(nogil=True, cache=True)
def _filter(x, y, z, codes, keep_class, first, ends, origin, corners, keep_inside, out):
    """Fill ``out`` with x, or NaN. Block i holds the points first[i] … ends[i] − 1. No codes: all classes are kept."""
    for block in range(len(first)):
        for i in range(first[block], ends[block]):
            kept = len(codes) == 0 or keep_class[codes[i]]
            if len(corners):
                px = origin[block, 0] + np.float64(x[i])
                py = origin[block, 1] + np.float64(y[i])
                pz = origin[block, 2] + np.float64(z[i])
                for k in range(len(corners)):
                    inside = corners[k, 0, 0] <= px <= corners[k, 1, 0]
                    inside &= corners[k, 0, 1] <= py <= corners[k, 1, 1]
                    inside &= corners[k, 0, 2] <= pz <= corners[k, 1, 2]
                    kept &= inside == keep_inside[k]
            out[i] = x[i] if kept else np.nan
