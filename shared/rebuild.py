"""A scene read back as a source of points, so that it can be built again in another way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from .build import BuildSettings, build_scene
from .camera_path import axis_vector, up_vector
from .points import PointBatch
from .readers import Source, SourceInfo
from .scene_info import UP_AXES
from .store import Scene

Progress = Callable[[str, int, int | None], None]


class SceneSource(Source):
    """The input points of a scene: those of its leaves, without the level-of-detail copies.

    Positions are the stored ones in float64, so each differs from the input's by at most 2**-25 of its block's edge
    an axis; coded ones by what their codec rounds off, and some may lie outside the bounds of the input by as much.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        info = scene.info
        self.info = SourceInfo(
            path=scene.path,
            format="scene",
            n_points=info.n_points,
            attributes=info.attributes,
            lower=np.array(info.lower),
            upper=np.array(info.upper),
            crs=info.crs,
        )

    def _read(self, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        read = self._scene.position_reader()
        kept = {name: self._scene.attribute(name) for name in attributes}
        first, origin = self._scene.blocks()
        for start, stop in leaf_ranges(self._scene):
            for begin in range(start, stop, max_points):
                part = slice(begin, min(begin + max_points, stop))
                block = np.searchsorted(first, np.arange(part.start, part.stop), side="right") - 1
                positions = read(part.start, part.stop).T + origin[block]
                yield PointBatch(positions, {name: np.asarray(column[part]) for name, column in kept.items()})


def leaf_ranges(scene: Scene) -> list[tuple[int, int]]:
    """(first, end) of the ranges of the point-array that hold the input points, ascending; neighbours are joined."""
    octree = scene.octree()
    first = np.sort(octree.first_point[octree.is_leaf])
    end = np.sort((octree.first_point + octree.n_points)[octree.is_leaf])
    gap = first[1:] != end[:-1]
    return list(zip(first[np.r_[True, gap]].tolist(), end[np.r_[gap, True]].tolist(), strict=True))


def rebuild_in_order(scene: Scene, point_order: str, path: Path, progress: Progress) -> Scene:
    """The scene itself if it has that point order, else one built in it from the same points at ``path``."""
    info = scene.info
    if info.point_order == point_order:
        return scene
    up = up_vector(info)
    kept = ("points_per_cell", "max_depth", "flatness", "splats", "features", "pools", "pool_bits", "n_pools")
    settings = BuildSettings(
        point_order=point_order,
        **{key: info.build[key] for key in kept if isinstance(info.build.get(key), int | float)},
        up=next(name for name in UP_AXES if name != "auto" and np.array_equal(axis_vector(name), up)),
        overwrite=True,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    build_scene([SceneSource(scene)], path, settings=settings, progress=progress)
    return Scene.open(path)
