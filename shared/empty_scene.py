"""A scene without points: what a run stands on that draws layers alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from .build.morton import root_cube
from .octree import Octree
from .scene_info import ArrayInfo, SceneInfo, expected_arrays
from .store import Scene


class EmptyScene(Scene):
    """No point in a box, given by (3,) float64 corners, world frame, z up. In memory; no file belongs to it."""

    def __init__(self, lower: np.ndarray, upper: np.ndarray) -> None:
        origin, edge = root_cube(lower, upper)
        self._origin = origin
        info = SceneInfo(
            point_order="layered",
            origin=_triple(origin),
            edge=edge,
            lower=_triple(lower),
            upper=_triple(upper),
            n_points=0,
            n_stored=0,
            n_cells=1,
            n_blocks=1,
            n_dropped=0,
            attributes=(),
            block_levels=0,
            up="z",
            crs=None,
            sources=(),
            build={},
            arrays={},
        )
        empty = {
            name: ArrayInfo(dtype.str, shape, math.prod(shape) * dtype.itemsize, 0)
            for name, (dtype, shape) in expected_arrays(info).items()
        }
        super().__init__(Path("no scene"), replace(info, arrays=empty))

    def octree(self, *, features: bool = False, pools: bool = False) -> Octree:
        """One cell that holds nothing."""
        none = np.zeros(1, np.int64)
        return Octree(
            origin=self._origin,
            edge=self.info.edge,
            level=np.zeros(1, np.uint8),
            code=np.zeros(1, np.uint64),
            parent=np.full(1, -1, np.int32),
            first_child=np.full(1, -1, np.int32),
            n_children=np.zeros(1, np.uint8),
            first_point=none,
            n_points=none,
            n_below=none,
            cone=None,
            point_order="layered",
        )

    def positions(self, mmap: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Three empty columns."""
        x, y, z = np.empty((3, 0), np.float32)
        return x, y, z

    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """One block without points."""
        return np.zeros(1, np.int64), self._origin[None]

    def check(self, names: Iterable[str], progress: Callable[[str, int, int | None], None] | None = None) -> None:
        """Nothing to check."""


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
