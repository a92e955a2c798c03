"""A topology as data: which rank culls, samples and draws what.

A *lane* is a chain of culling, sampling and render ranks. In one lane the subtrees of the octree are dealt to several
culling and sampling ranks, and tiles of the picture or shares of the points to several render ranks (functionality
first, then data: thesis Figures 3-3 and 5-3). Several lanes have a tile or a share each (data first, then
functionality: Figure 3-4). The frame loop (``pipeline``) knows layouts and no topology.

Who has which subtrees and which tile is a *plan*, which may change from one frame to the next (``balance``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Any, Literal

from ..shared.windows import Window

Split = Literal["none", "tiles", "shares"]

FEW_RENDERS = 8
"""Render ranks of which any two may exchange framebuffers while it is cheap to measure all links between them."""


@dataclass(frozen=True)
class Lane:
    """Ranks of each stage, in the order of their parts; a rank may be in several stages."""

    culling: tuple[int, ...]
    sampling: tuple[int, ...]
    render: tuple[int, ...]

    def stages_of(self, rank: int) -> list[str]:
        """Names of the stages that a rank has here."""
        return [stage for stage in ("culling", "sampling", "render") if rank in getattr(self, stage)]


@dataclass(frozen=True)
class Layout:
    """All lanes. split : what a render rank has of a picture: all of it, a tile, or a share of the points.

    ranks : that have work, of those there are; the others wait for the end.
    """

    lanes: tuple[Lane, ...]
    split: Split = "none"

    @property
    def render(self) -> tuple[int, ...]:
        """The render ranks of all lanes, in the order of tiles or shares."""
        return tuple(rank for lane in self.lanes for rank in lane.render)

    @property
    def display(self) -> int:
        """The rank that has whole pictures: the first render rank."""
        return self.render[0]

    @property
    def workers(self) -> tuple[int, ...]:
        """Ranks with a stage, ascending."""
        return tuple(sorted({r for lane in self.lanes for r in (*lane.culling, *lane.sampling, *lane.render)}))

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Ranks that send each other bits, entries or framebuffers, the lower first, ascending.

        Of many render ranks that composite, only those with the display: which others talk is up to the policy.
        """
        apart = [lane for lane in self.lanes if lane.culling != lane.sampling]  # else each has its own part's bits
        found = {(a, b) for lane in apart for a in lane.culling for b in lane.sampling}
        found |= {(a, b) for lane in self.lanes for a in lane.sampling for b in lane.render}
        meeting = self.render if self.split == "shares" and len(self.render) <= FEW_RENDERS else (self.display,)
        found |= {(a, b) for a in meeting for b in self.render}
        return sorted({(min(pair), max(pair)) for pair in found if pair[0] != pair[1]})

    def lane_of(self, rank: int) -> int | None:
        """Number of the lane that a rank is in; None for one without work."""
        return next((i for i, lane in enumerate(self.lanes) if lane.stages_of(rank)), None)

    def renders_of(self, lane: int) -> range:
        """Numbers, among all render ranks, of those of a lane."""
        first = list(accumulate((len(of.render) for of in self.lanes), initial=0))
        return range(first[lane], first[lane + 1])

    def role_of(self, rank: int) -> str:
        """What a rank is called where it is named."""
        lane = self.lane_of(rank)
        if lane is None:
            return "idle"
        stages = self.lanes[lane].stages_of(rank)
        if len(self.workers) > 1 and stages == ["culling", "sampling", "render"]:
            return f"{self.split.removesuffix('s')} {lane}" if self.split != "none" else "all"
        name = "+".join(stages)
        of_stage = getattr(self.lanes[lane], stages[0])
        if len(of_stage) > 1:
            return f"{name} {of_stage.index(rank)}"
        return name if len(self.lanes) == 1 else f"{name} of {self.split.removesuffix('s')} {lane}"


@dataclass(frozen=True)
class Plan:
    """What holds from a frame on.

    number : 0, 1, …  culling, sampling : by lane, borders of the parts among the lane's subtrees.
    windows : the tile of each render rank; empty where pictures are not split into tiles.
    settings : keys of the configuration that hold in place of the run's, with their values; of a live run.
    """

    number: int
    culling: tuple[tuple[int, ...], ...]
    sampling: tuple[tuple[int, ...], ...]
    windows: tuple[Window, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)

    def to_note(self) -> dict[str, Any]:
        """JSON-able."""
        borders = {"culling": self.culling, "sampling": self.sampling, "windows": self.windows}
        return {"number": self.number, **borders, "settings": dict(self.settings)}

    @classmethod
    def from_note(cls, note: Mapping[str, Any]) -> Plan:
        """What ``to_note`` gave."""

        def borders(name: str) -> tuple[tuple[int, ...], ...]:
            return tuple(tuple(map(int, lane)) for lane in note[name])

        windows = tuple(Window(*map(int, window)) for window in note["windows"])
        return cls(int(note["number"]), borders("culling"), borders("sampling"), windows, dict(note["settings"]))


ALONE = Layout((Lane((0,), (0,), (0,)),))
"""Everything on rank 0."""


def chain(ranks: range) -> Lane:
    """A lane on one, two or three ranks: of two, the first does the whole selection."""
    first, last = ranks[0], ranks[-1]
    return Lane((first,), (ranks[1] if len(ranks) > 2 else first,), (last,))


def chains(size: int, longest: int) -> tuple[Lane, ...]:
    """As few lanes of at most ``longest`` ranks as ``size`` ranks fill, as even as they can be."""
    n = -(-size // longest)
    borders = [size * i // n for i in range(n + 1)]
    return tuple(chain(range(a, b)) for a, b in pairwise(borders))


def master_slave(size: int) -> Layout:
    """Rank 0 renders what the others select, each in its own subtrees (thesis 3.3.2, Figure 3-2)."""
    slaves = tuple(range(1, size)) or (0,)
    return Layout((Lane(slaves, slaves, (0,)),))


def hybrid(size: int, culling: int, sampling: int, render: int, split: Split) -> Layout:
    """Of k culling, m sampling and n render ranks (thesis 5.3.1, Figure 5-3); the zeros among k, m, n are chosen.

    Fewer than three ranks are a chain.
    """
    if size < 3:
        return Layout((chain(range(size)),))
    left = size - culling - sampling - render
    each = left // 3 if not render else left // max((not culling) + (not sampling), 1)
    k = culling or max(1, each)
    m = sampling or (size - k - render if render else max(1, each))
    n = render or size - k - m
    return Layout((Lane(*(tuple(range(a, b)) for a, b in ((0, k), (k, k + m), (k + m, k + m + n)))),), split)
