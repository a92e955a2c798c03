"""What a build is told and what it reports."""

from __future__ import annotations

import os
import resource
from dataclasses import dataclass, field
from pathlib import Path

from ..codecs import MAX_STREAM_BITS
from ..codecs.positions import most_position_bits
from ..errors import InputError
from ..octree import MAX_LEVEL
from ..points import ATTRIBUTES
from ..process_memory import resident_bytes
from ..scene_info import POINT_ORDERS, POSITIONS, UP_AXES

NORMALS = ("keep", "estimate")


@dataclass(frozen=True)
class BuildSettings:
    """How a scene is built.

    point_order : ``layered`` or ``depth-first``, see ``octree.Octree``.
    points_per_cell : a cell with more points than this is subdivided; also the most an inner cell owns when layered.
    max_depth : deepest level, 0 … 21.
    flatness : cells whose λ0 / (λ0 + λ1 + λ2) is below this stay leaves whatever they hold; 0: not tested.
    memory_bytes : peak memory of the process; None for half of what is available.
    strict : refuse coordinates that are not finite, instead of dropping the point.
    overwrite : replace an existing scene, once the new one is whole.
    up : axis that points up, stored in the scene: one of ``UP_AXES``.
    attributes : the ones to keep; None for all.
    normals : ``keep`` those of the inputs, where all have them, or ``estimate`` them from neighbours, see
        ``neighbours``.
    splats : store what splats need: radii, and normals, estimated where not all inputs have them.
    features : store which cells are flat, edges and corners, see ``features``; splats with them.
    positions : form in which positions are stored, one of ``scene_info.POSITIONS``; codecs other than float32 round
        them to a grid of ``position_bits`` bits an axis in the cube of their cell.
    group_epsilon : ε of ``groups``, as a share of the longest side of the scene's bounds.
    group_detail : ε is also at most this share of the extent of the points that are grouped together; 0: as it is.
    pools : store cells that gain by it in pooled form (``codecs.streams``) beside their points.
    pool_bits : bits an axis of the pooled form's grid; 0: as suits ``points_per_cell``.
    n_pools : most pools of a cell.
    threads : None for one a core.

    Raises InputError for a value out of range.
    """

    point_order: str = "layered"
    points_per_cell: int = 4096
    max_depth: int = MAX_LEVEL
    flatness: float = 0.0
    memory_bytes: int | None = None
    strict: bool = False
    overwrite: bool = False
    up: str = "auto"
    attributes: tuple[str, ...] | None = None
    normals: str = "keep"
    splats: bool = False
    features: bool = False
    positions: str = "float32"
    position_bits: int = 12
    group_epsilon: float = 0.001
    group_detail: float = 0.0
    pools: bool = False
    pool_bits: int = 0
    n_pools: int = 2
    threads: int | None = None

    def __post_init__(self) -> None:
        most_bits = most_position_bits(self.positions)
        unknown = [a for a in self.attributes or () if a not in ATTRIBUTES]
        for holds, key, expected in (
            (self.point_order in POINT_ORDERS, "point_order", f"one of {', '.join(POINT_ORDERS)}"),
            (1 <= self.points_per_cell <= 1 << 24, "points_per_cell", "1 … 16777216"),
            (0 <= self.max_depth <= MAX_LEVEL, "max_depth", f"0 … {MAX_LEVEL}"),
            (0 <= self.flatness <= 1 / 3, "flatness", "a number in [0, 1/3]"),
            (self.memory_bytes is None or self.memory_bytes > 0, "memory_bytes", "a number > 0"),
            (self.up in UP_AXES, "up", f"one of {', '.join(UP_AXES)}"),
            (not unknown, "attributes", f"names of {', '.join(ATTRIBUTES)}"),
            (self.normals in NORMALS, "normals", f"one of {', '.join(NORMALS)}"),
            (self.positions in POSITIONS, "positions", f"one of {', '.join(POSITIONS)}"),
            (1 <= self.position_bits <= most_bits, "position_bits", f"1 … {most_bits} for {self.positions}"),
            (0 <= self.group_epsilon <= 1, "group_epsilon", "a number in [0, 1]"),
            (0 <= self.group_detail <= 1, "group_detail", "a number in [0, 1]"),
            (0 <= self.pool_bits <= MAX_STREAM_BITS, "pool_bits", f"0 … {MAX_STREAM_BITS}"),
            (1 <= self.n_pools <= 16, "n_pools", "1 … 16"),
            (self.threads is None or self.threads >= 1, "threads", "at least 1"),
        ):
            if not holds:
                raise InputError(f"build: {key} = {getattr(self, key)!r}, expected {expected}")

    @property
    def radii(self) -> bool:
        """Whether points get splat radii: quads of flat cells are held against them."""
        return self.splats or self.features


@dataclass
class BuildReport:
    """What a build did.

    n_dropped : points left out because a coordinate was not finite.
    dropped_attributes : in some of the inputs, but not in all of them.
    n_partitions : subtrees that were built one after the other; 1 if the input fitted into memory.
    spilled_bytes : written to sorted runs and read again; 0 if the input fitted into memory.
    bytes : of the scene's arrays.  position_bytes : of those that hold positions.
    peak_bytes : most memory the process held so far, or one of the ``n_ranks`` that built together.
    stage_s : seconds in each stage; of rank 0.
    """

    path: Path
    n_points: int
    n_stored: int
    n_cells: int
    n_dropped: int
    dropped_attributes: tuple[str, ...]
    n_partitions: int
    spilled_bytes: int
    bytes: int
    position_bytes: int
    peak_bytes: int
    n_ranks: int = 1
    stage_s: dict[str, float] = field(default_factory=dict)


def available_memory_bytes() -> int:
    """Memory this process may still take: the least of what the machine and its control groups leave."""
    available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        for line in meminfo.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                available = int(line.split()[1]) * 1024
    return min([available, *_control_group_limits()])


def _control_group_limits() -> list[int]:
    """Bytes left below each memory limit of the process's control groups (versions 2 and 1)."""
    left = []
    for limit, used in (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")):
        for root in (Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/memory"), *_own_control_groups()):
            try:
                left.append(int((root / limit).read_text()) - int((root / used).read_text()))
            except (OSError, ValueError):  # no such group, or the word "max"
                continue
    return [n for n in left if n > 0]


def _own_control_groups() -> list[Path]:
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return []
    groups = []
    for line in lines:
        _, controllers, name = line.split(":", 2)
        group = Path("/sys/fs/cgroup", "memory" if "memory" in controllers else "", name.lstrip("/"))
        groups += [group, *(p for p in group.parents if p.is_relative_to("/sys/fs/cgroup"))]
    return groups


def peak_resident_bytes() -> int:
    """The most memory the process has held.

    From ``/proc`` where there is one: ``getrusage`` counts what the parent held when it started this process.
    """
    try:
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) * 1024
    except (OSError, IndexError, ValueError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@dataclass(frozen=True)
class MemoryPlan:
    """How many points are held at a time. capacity : points of a partition.  batch : points asked of a reader."""

    capacity: int
    batch: int


_FIXED_BYTES = 64 << 20
"""Counters of the counting sort, chunks on their way to files, cells: what does not grow with the points held."""
_KEY_BYTES = 8
_SORT_BYTES = 4 + 4 + 10
"""A point's index, a second index while cells are refined, and two and a half stored indices (layered)."""
NEIGHBOUR_BYTES = 248
"""A point while neighbours are searched: order, position in that order, tree, neighbours, results."""
CODING_BYTES = 300
"""A point while the positions of its cell are coded, and decoded again: grid point, keys, order, nodes of a codec."""
_READER_BYTES = 320
"""A point in a reader: file bytes, decoded columns and temporaries, one batch ahead."""
_MIN_CAPACITY = 1 << 16
_MAX_BATCH = 1 << 18


def plan_memory(settings: BuildSettings, attributes: tuple[str, ...], neighbours: bool = False) -> MemoryPlan:
    """Divide the memory that the process does not hold yet between readers and points.

    attributes : of the stored points.  neighbours : whether neighbours are searched, before points are sorted.
    Raises InputError if it is too little for a partition of a few cells.
    """
    budget = settings.memory_bytes or available_memory_bytes() // 2
    working = max(_SORT_BYTES, NEIGHBOUR_BYTES * neighbours, CODING_BYTES * (settings.positions != "float32"))
    point_bytes = 24 + sum(ATTRIBUTES[a].itemsize for a in attributes) + _KEY_BYTES + working
    left = budget - resident_bytes() - _FIXED_BYTES
    capacity = min(left * 3 // 4 // point_bytes, 2**32 - 1)
    needed = max(_MIN_CAPACITY, 2 * settings.points_per_cell)
    if capacity < needed:
        at_least = budget - left + needed * point_bytes * 4 // 3
        raise InputError(f"build: memory_bytes = {budget}, expected at least {at_least} for this process")
    return MemoryPlan(capacity, max(1, min(left // 4 // _READER_BYTES, _MAX_BATCH)))
