"""A leaf that does not fit into memory: millions of coincident points, or a flat region, written window by window."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numba import njit

from ..points import PointBatch
from ..set_order import permutation, place
from .cones import add_normals, start_cone, widen_cone
from .ingest import Columns
from .neighbours import SurfaceRule, add_surface
from .parallel import Workers
from .point_array import PointArrayWriter, block_level
from .runs import Partition, Runs
from .sets import RANDOM_AREA
from .settings import BuildSettings
from .subtree import LinkedCells


@njit(nogil=True, cache=True)
def _placed_in_window(first, n_batch, n, p, begin, end, source, target):
    found = 0
    for i in range(n_batch):
        j = place(first + i, n, p)
        if begin <= j < end:
            source[found], target[found] = i, j - begin
            found += 1
    return found


def append_streamed_leaf(
    leaf: Partition,
    runs: Runs,
    capacity: int,
    settings: BuildSettings,
    surface: SurfaceRule | None,
    array: PointArrayWriter,
    workers: Workers,
) -> tuple[LinkedCells, PointBatch]:
    """Append the points of an oversize leaf in the order of its permutation: (its cell, the first points of its set).

    surface : what is made of neighbours: a window is a random part of the leaf, so its spacings tell those of all.
    Cost: one pass over the leaf's points for every ``capacity`` points, and one more where there are normals.
    """
    n = leaf.n_points
    p = np.empty(6, np.uint64)
    permutation(leaf.level, leaf.code, n, p)
    one = np.zeros(1, np.int64)
    cell = LinkedCells(
        level=np.array([leaf.level], np.uint8),
        code=one + leaf.code,
        parent=one - 1,
        first_child=one - 1,
        n_children=one,
        count=one + n,
        start=one,
        first_point=one + array.n_stored,
        n_points=one + n,
        area=np.array([RANDOM_AREA]),
    )
    blocks = block_level(cell, settings.point_order, settings.points_per_cell)
    total, cone = np.zeros(3), np.zeros(4)
    first_set, complete = None, True
    n_windows = -(-n // capacity)
    for begin, end in pairwise(n * i // n_windows for i in range(n_windows + 1)):
        window = Columns(end - begin, runs.attributes).whole()
        read = 0
        for batch in runs.stream(leaf.level, leaf.code):
            source, target = np.empty((2, len(batch)), np.int64)
            found = _placed_in_window(read, len(batch), n, p, begin, end, source, target)
            source, target = source[:found], target[:found]
            window.positions[target] = batch.positions[source]
            for name, column in window.attributes.items():
                column[target] = batch.attributes[name][source]
            read += len(batch)
        if surface:
            window = add_surface(window, runs.keys(window), surface, workers, share=(end - begin) / n)
        in_order = np.arange(end - begin, dtype=np.uint32)
        size = np.array([end - begin])
        array.append(window, in_order, cell.level, cell.code, size, size, blocks, workers)
        if first_set is None:
            first_set = window.select(np.arange(min(settings.points_per_cell, end - begin)))
        if "normal" in runs.attributes and complete:
            complete = add_normals(window.attributes["normal"], in_order, 0, end - begin, total)
    assert first_set is not None
    complete = complete and "normal" in runs.attributes  # estimated ones are gone: any direction
    if start_cone(total if complete else np.zeros(3), cone):
        for batch in runs.stream(leaf.level, leaf.code):
            widen_cone(batch.attributes["normal"], np.arange(len(batch), dtype=np.uint32), 0, len(batch), cone)
    cell.normal_sum, cell.cone = (total if complete else np.zeros(3))[None], cone[None]
    return cell, first_set
