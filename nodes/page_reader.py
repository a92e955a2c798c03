"""Points that stay on disk: how a scene's are read, page by page, coloured and filtered as resident ones would be."""

from __future__ import annotations

import numpy as np

from ..shared.colour import Colouring, word_reader
from ..shared.errors import StoreError
from ..shared.octree import Octree
from ..shared.store import Scene
from .point_filter import PointFilter
from .raster.paged_points import PagedPoints, Paging, ReadPoints, SetTable


def load_paged(scene: Scene, colouring: Colouring, point_filter: PointFilter, paging: Paging) -> PagedPoints:
    """The render rank's half of a scene, none of whose points is read yet.

    Raises StoreError naming the array that is damaged, or if positions are coded. Headers and sizes of the columns of
    points are checked, checksums are not.
    Cost: the cells and blocks are read; of the cells 13 bytes each stay.
    """
    if scene.info.coded:
        raise StoreError(f"{scene.path}: positions are {scene.info.positions}, expected float32, to be read by pages")
    one_colour = colouring.word if colouring.mode == "constant" else None
    block_first_point, block_origin = scene.blocks()
    return PagedPoints(
        scene.info.n_stored,
        read_points(scene, colouring.settled(scene), point_filter),
        one_colour,
        block_first_point,
        block_origin,
        set_table(scene.octree(), scene.info.n_stored),
        paging,
    )


def read_points(scene: Scene, colouring: Colouring, point_filter: PointFilter) -> ReadPoints:
    """Reads stored points and colours them; those that are filtered out get NaN as their x."""
    columns = [scene.column(axis) for axis in "xyz"]
    words = word_reader(scene, colouring)
    filtered_x = point_filter.reader(scene) if point_filter else None

    def read(first: int, x: np.ndarray, y: np.ndarray, z: np.ndarray, colour: np.ndarray | None) -> None:
        part = slice(first, first + len(x))
        for column, out in zip(columns, (x, y, z), strict=True):
            if isinstance(column, np.ndarray):
                out[:] = column[part]
            else:
                column.read_into(first, out)
        if filtered_x is not None:
            x[:] = filtered_x(first, x, y, z)
        if colour is not None:
            colour[:] = words(part)

    return read


def set_table(octree: Octree, n_stored: int) -> SetTable:
    """The sets of an octree's cells among ``n_stored`` points; of a share of a scene, those of its cells."""
    owners = octree.owners
    owners = owners[(octree.first_point[owners] >= 0) & (octree.first_point[owners] < n_stored)]
    place = np.full(len(octree) + 1, -1, np.int32)  # the last for the parent of the root
    place[owners] = np.arange(len(owners), dtype=np.int32)
    first = np.append(octree.first_point[owners], n_stored)
    return SetTable(first, place[octree.parent[owners]], octree.level[owners].copy())
