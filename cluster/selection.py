"""What a rank culls and samples: its part of its lane's octree, and who gets what of it.

A lane's octree is the whole, or where the lane has a share of the points, the cells that own those. Its subtrees are
dealt to the culling ranks and to the sampling ranks by the borders of the plan. Bits cross by the cells that a culling
and a sampling part have in common, in stored order; both ends derive these from the plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from ..nodes.culling import CullingNode
from ..nodes.sampling import SamplingNode
from ..shared.camera import Camera
from ..shared.messages import RenderPoints, VisibilityBits
from ..shared.octree import Octree
from ..shared.octree_parts import Subtrees, balanced_borders, cells_of_range, part_of
from ..shared.scene_share import clip_entries, share_borders
from ..shared.windows import Window, tiles
from .job import Job
from .layout import Lane, Layout, Plan
from .wall import screen_windows

SUBTREES_PER_RANK = 16
"""Least subtrees for each rank that they are dealt to: enough for even parts, few enough for few shared ancestors."""


class LaneCells:
    """The octree of a lane and its subtrees; the same on every rank of it.

    share : (first, stop) of the lane's points; None: all.
    """

    def __init__(self, lane: Lane, whole: Octree, share: tuple[int, int] | None) -> None:
        self.parts = len(lane.culling), len(lane.sampling)
        self.octree = whole if share is None else part_of(whole, cells_of_range(whole, *share))
        self._whole = np.arange(len(self.octree)), self.octree, None

    @cached_property
    def subtrees(self) -> Subtrees:
        """What is dealt; looked for where there is more than one rank to deal it to."""
        return Subtrees.of(self.octree, SUBTREES_PER_RANK * max(self.parts))

    def borders(self, n: int) -> tuple[int, ...]:
        """Borders of n parts of evenly many cells."""
        return even_borders(self.dealt, n)

    def part(self, borders: Sequence[int], i: int) -> tuple[np.ndarray, Octree, np.ndarray | None]:
        """(cells, octree, own) of the i-th part, as of ``Subtrees.part``; one part is the lane's octree itself."""
        return self._whole if len(borders) == 2 else self.subtrees.part(*borders[i : i + 2])

    def cells_of(self, borders: Sequence[int], i: int) -> np.ndarray:
        """The cells of the i-th part alone."""
        return self._whole[0] if len(borders) == 2 else self.subtrees.cells_of(*borders[i : i + 2])

    @property
    def dealt(self) -> np.ndarray:
        """(s,) number of cells of each subtree; where there is one rank a stage, one number."""
        return self.subtrees.cells if max(self.parts) > 1 else np.array([len(self.octree)])


def even_borders(cells: np.ndarray, n: int) -> tuple[int, ...]:
    """Borders of n parts of evenly many cells. cells : (s,) of each subtree."""
    return (0, 1) if n == 1 else tuple(balanced_borders(cells, n).tolist())


def shares_of(layout: Layout, whole: Octree) -> list[tuple[int, int]]:
    """(first, stop) of the points of each render rank; none where points are not shared."""
    if layout.split != "shares":
        return []
    borders = share_borders(whole, len(layout.render)).tolist()
    return list(pairwise(borders))


def with_borders(plan: Plan, layout: Layout, cells: Sequence[np.ndarray]) -> Plan:
    """A first plan with the borders that a rank without octree could not know. cells : as of ``dealt``, by lane."""
    parts = zip(layout.lanes, cells, strict=True)
    culling, sampling = zip(
        *((even_borders(of, len(lane.culling)), even_borders(of, len(lane.sampling))) for lane, of in parts),
        strict=True,
    )
    return replace(plan, culling=culling, sampling=sampling)


def first_plan(job: Job, layout: Layout, lanes: Sequence[LaneCells]) -> Plan:
    """The plan to begin with: even cells, even tiles, or the screens of a wall.

    lanes : none on a rank that selects nothing, which need not know who does.
    """
    windows: list[Window] = []
    if layout.split == "tiles":
        windows = screen_windows(job, layout)
        windows = windows or tiles(job.views.width, job.views.height, [1.0] * len(layout.render))
    return Plan(
        0,
        tuple(cells.borders(cells.parts[0]) for cells in lanes),
        tuple(cells.borders(cells.parts[1]) for cells in lanes),
        tuple(windows),
    )


class CullingPart:
    """A culling rank's part of a lane, under plans of the same borders of subtrees, without a window at first.

    whole : bits of all its cells, of the frame processed last.
    """

    def __init__(self, job: Job, layout: Layout, lane: int, cells: LaneCells, plan: Plan, i: int) -> None:
        mine, octree, _ = cells.part(plan.culling[lane], i)
        self._node: CullingNode = job.culling_node(octree)
        self._window: Window | None = None
        sampling = layout.lanes[lane].sampling
        self._common: list[np.ndarray | None] = [
            common_cells(mine, cells.cells_of(plan.sampling[lane], j)) for j in range(len(sampling))
        ]

    def look_through(self, layout: Layout, lane: int, plan: Plan) -> None:
        """Take the window of a plan that has the borders of this part."""
        self._window = lane_window(layout, lane, plan)

    def process(self, camera: Camera) -> list[VisibilityBits]:
        """The bits of a frame, for each sampling part of the lane."""
        self.whole = bits = self._node.process(camera, self._window)
        if all(common is None for common in self._common):
            return [bits] * len(self._common)
        visible = bits.unpack()
        return [
            bits if common is None else VisibilityBits.pack(camera.frame, visible[common]) for common in self._common
        ]


class SamplingPart:
    """A sampling rank's part of a lane, under plans of the same borders of subtrees, without windows at first.

    n_cells : of the bits that come from each culling part.
    """

    def __init__(
        self,
        job: Job,
        layout: Layout,
        lane: int,
        cells: LaneCells,
        plan: Plan,
        i: int,
        shares: Sequence[tuple[int, int]],
    ) -> None:
        mine, octree, own = cells.part(plan.sampling[lane], i)
        self._node: SamplingNode = job.sampling_node(octree, own)
        culling = layout.lanes[lane].culling
        self._common = [common_cells(mine, cells.cells_of(plan.culling[lane], j)) for j in range(len(culling))]
        self._n = len(octree)
        self.n_cells = [self._n if common is None else len(common) for common in self._common]
        renders = layout.renders_of(lane)
        self._windows: list[Window] = []
        self._shares = [shares[j] for j in renders] if shares else []
        self._n_renders = len(renders)

    def look_through(self, layout: Layout, lane: int, plan: Plan) -> None:
        """Take the windows of a plan that has the borders of this part."""
        split = plan.windows and not lane_window(layout, lane, plan)
        self._windows = [plan.windows[j] for j in layout.renders_of(lane)] if split else []

    def process(self, camera: Camera, received: Sequence[VisibilityBits]) -> tuple[RenderPoints, list[RenderPoints]]:
        """(everything chosen of the lane's points; what each render rank of the lane draws of it)."""
        chosen = self._node.process(camera, self._merged(camera.frame, received))
        if self._windows:
            return chosen, self._node.within(camera, self._windows)
        if self._shares:
            of_shares = [RenderPoints(camera.frame, clip_entries(chosen.entries, *of)) for of in self._shares]
            mine = np.concatenate([of.entries for of in of_shares])  # cells above a lane's own points are others'
            return RenderPoints(camera.frame, mine), of_shares
        return chosen, [chosen] * self._n_renders

    def _merged(self, frame: int, received: Sequence[VisibilityBits]) -> VisibilityBits:
        if len(received) == 1 and self._common[0] is None:
            return received[0]
        visible = np.zeros(self._n, np.uint8)
        for bits, common in zip(received, self._common, strict=True):
            visible[slice(None) if common is None else common] |= bits.unpack()
        return VisibilityBits.pack(frame, visible)


def common_cells(mine: np.ndarray, theirs: np.ndarray) -> np.ndarray | None:
    """(c,) int64: where, in this part's (p,) ascending cells, those of another part stand; None: they are the same."""
    if len(mine) == len(theirs) and (mine is theirs or np.array_equal(mine, theirs)):
        return None
    return np.flatnonzero(np.isin(mine, theirs, assume_unique=True))


def lane_window(layout: Layout, lane: int, plan: Plan) -> Window | None:
    """The tile that a whole lane draws; None where it draws the picture, or its render ranks a tile each."""
    renders = layout.renders_of(lane)
    return plan.windows[renders[0]] if plan.windows and len(renders) == 1 else None


def merged_entries(frame: int, received: Sequence[RenderPoints]) -> RenderPoints:
    """What several sampling parts chose, in the order in which one would have: ascending, pooled points last."""
    if len(received) == 1:
        return received[0]
    entries = np.concatenate([chosen.entries for chosen in received])
    return RenderPoints(frame, entries[np.lexsort((entries["offset"], entries["stride"] == 0))])
