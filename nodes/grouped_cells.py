"""Linear groups of a scene, coloured, in the form they are drawn from: codes in, no position of a point kept."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..shared.codecs.linear_groups import read
from ..shared.coded_positions import CodedPositions, point_pieces
from ..shared.colour import Colouring, colour_words
from ..shared.errors import CodecError, StoreError
from ..shared.octree import Octree
from ..shared.store import Scene
from .cell_blocks import HEAD_POINTS, spacing_of_heads
from .raster.group_raster import ResidentGroups
from .raster.groups import GroupCell, group_cell, group_cells
from .render import Wanted

_PIECE_POINTS = 1 << 15
"""Points that a thread reads before it looks for more."""


def load_groups(scene: Scene, colouring: Colouring, wanted: Wanted, *, verify: bool) -> ResidentGroups:
    """The render rank's half of a scene in linear groups, coloured.

    wanted : ``groups`` is on; of the rest ``spacing`` counts.
    verify : hold the checksums of the arrays it reads against the scene first.
    Raises StoreError naming the array, and the cell whose code is damaged, or if the scene was built without groups.
    Cost: decoding a cell at a time on all cores, for the order in which its colours are stored. Memory: what
    ``ResidentGroups`` says, twice while cells are put together; colours that go by position decode all of them first.
    """
    wanted.check(scene)
    if verify:
        scene.check(name for name in ("position_codes", f"attr_{colouring.attribute}") if name in scene.info.arrays)
    coded, octree = scene.coded_positions(), scene.octree()
    colour = colour_words(scene, colouring)
    lower = octree.centers[coded.cells.cell] - coded.cells.edge[:, None] / 2
    n = len(coded.cells)
    held: list[GroupCell | None] = [None] * n
    heads = np.zeros((n, HEAD_POINTS, 3), np.uint16) if wanted.spacing else None

    def load(begin: int, end: int) -> None:
        for i in range(begin, end):
            held[i] = _load(coded, i, lower[i], colour, None if heads is None else heads[i])

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as executor:
        pieces = point_pieces(coded.cells.first_point, 0, n, _PIECE_POINTS)
        for done in [executor.submit(load, begin, end) for begin, end in pieces]:
            try:
                done.result()
            except CodecError as error:
                raise StoreError(f"{scene.path}/position_codes.npy: {error}") from error
    cells = group_cells([cell for cell in held if cell is not None])
    if colour.strides == (0,):  # one colour, and one word of it
        kept, inner = (np.broadcast_to(colour[:1], len(column)) for column in (cells.kept_colour, cells.inner_colour))
        cells = cells._replace(kept_colour=kept, inner_colour=inner)
    return ResidentGroups(cells, coded.cells.first_point, None if heads is None else _spacing(octree, coded, heads))


def _load(coded: CodedPositions, i: int, lower: np.ndarray, colour: np.ndarray, head: np.ndarray | None) -> GroupCell:
    """The i-th cell; its first points in stored order into ``head``."""
    cells, n = coded.cells, coded.cells.n_points(i)
    try:
        groups = read(coded.code(i), coded.bits, n)
        if len(groups) != n:
            raise CodecError(f"found {len(groups)} points, expected {n}")
        points = groups.grid_points()
        order = cells.stored_order(i, points, coded.bits, coded.point_order)
        own = np.empty(n, np.uint32)
        own[order] = colour[cells.first_point[i] : cells.first_point[i + 1]]
        if head is not None:
            head[:n] = points[order[:HEAD_POINTS]]
        return group_cell(groups, lower, float(np.ldexp(cells.edge[i], -coded.bits)), own)
    except CodecError as error:
        raise CodecError(f"cell {cells.cell[i]}: {error}") from error


def _spacing(octree: Octree, coded: CodedPositions, heads: np.ndarray) -> np.ndarray:
    """(c,) float32, as of ``cell_blocks.cell_spacing``, of (c, ``HEAD_POINTS``, 3) grid points."""
    step = np.ldexp(coded.cells.edge, -coded.bits).astype(np.float32)
    x, y, z = (np.ascontiguousarray(heads[:, :, axis] * step[:, None]).ravel() for axis in range(3))
    return spacing_of_heads(octree, coded.cells.cell, x, y, z, np.arange(len(heads)) * HEAD_POINTS)
