"""Reading the inputs: one batch ahead in a thread, finite points only, into columns of bounded size."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from ..errors import InputError
from ..points import ATTRIBUTES, PointBatch
from ..readers.source import Source
from .morton import bounds
from .settings import BuildSettings


def planned_attributes(
    sources: list[Source], settings: BuildSettings
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """(read, stored, dropped): what is read of all inputs, that and what is made of neighbours, and what is left out
    because only some inputs have it.

    Raises InputError if a wanted one is in no input.
    """
    given = settings.normals == "keep" and all("normal" in source.info.attributes for source in sources)
    made = {"normal": settings.normals == "estimate" or (settings.radii and not given), "radius": settings.radii}
    wanted = settings.attributes
    if wanted is not None:
        wanted = tuple(a for a in wanted if not made.get(a)) + (("normal",) if settings.radii and given else ())
    kept, dropped = common_attributes(sources, wanted)
    read = tuple(a for a in kept if not made.get(a))
    stored = tuple(a for a in ATTRIBUTES if a in read or made.get(a))
    return read, stored, tuple(a for a in dropped if not made.get(a))


def common_attributes(sources: list[Source], wanted: tuple[str, ...] | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(kept, dropped): attributes that all inputs have, in the order of ``ATTRIBUTES``, and those only some have.

    Radii are never read: they are made for one root cube.
    Raises InputError if a wanted one is in no input.
    """
    present = [set(source.info.attributes) for source in sources]
    candidates = [
        a for a in ATTRIBUTES if a != "radius" and (wanted is None or a in wanted) and any(a in p for p in present)
    ]
    for name in wanted or ():
        if name not in candidates:
            raise InputError(f"attributes: {name} is in none of the inputs")
    kept = tuple(a for a in candidates if all(a in p for p in present))
    return kept, tuple(a for a in candidates if a not in kept)


@dataclass
class Tally:
    """What has been read so far. lower, upper : (3,) float64 tight bounds; inf and −inf before the first point."""

    lower: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))
    upper: np.ndarray = field(default_factory=lambda: np.full(3, -np.inf))
    n_dropped: int = 0
    source_points: list[int] = field(default_factory=list)

    @property
    def n_points(self) -> int:
        """Points kept."""
        return sum(self.source_points)


_BATCH_POINTS = 1 << 16
"""Asked of a reader at a time: few enough that a batch is copied on while it lies in the cache."""
_COMPRESSED_BATCH_POINTS = 1 << 18
"""The same of LAZ, whose chunks of 50 000 points are decompressed side by side."""

Bounds = tuple[np.ndarray, np.ndarray]
_BOUNDS_TOLERANCE = 2.0**-10


def declared_bounds(sources: list[Source]) -> Bounds | None:
    """(lower, upper) that holds the bounds of all headers, or None if one of them states none that is finite."""
    bounds = []
    for info in (source.info for source in sources):
        if info.lower is None or info.upper is None:
            return None
        bounds.append((info.lower, info.upper))
    lower, upper = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
    return (lower, upper) if np.isfinite([lower, upper]).all() and (lower <= upper).all() else None


def root_bounds(declared: Bounds | None, tally: Tally) -> Bounds:
    """The bounds that the root cube is made from: the headers', if the points agree with them, else the points'.

    Headers agree if they hold the points (but for rounding) and are not wider by more than a thousandth of the largest
    extent: the cube is then known before the points are read, and is the same whether or not they fit into memory.
    """
    tight = tally.lower, tally.upper
    if declared is None:
        return tight
    rounding = 4 * np.spacing(np.max(np.abs(tight)))
    with np.errstate(over="ignore"):  # an extent beyond float64 is refused by ``root_cube``
        tolerance = _BOUNDS_TOLERANCE * np.max(tally.upper - tally.lower)
        wider = np.array([tally.lower - declared[0], declared[1] - tally.upper])
    return declared if ((wider >= -rounding) & (wider <= tolerance)).all() else tight


def finite_batches(
    sources: list[Source], attributes: tuple[str, ...], max_points: int, strict: bool, tally: Tally
) -> Iterator[PointBatch]:
    """The finite points of all inputs in order, counted in ``tally``; none of the batches is empty.

    Raises InputError under ``strict`` for a point that is not finite, and for a batch that is not as documented.
    """
    with ThreadPoolExecutor(1) as ahead:
        for source in sources:
            tally.source_points.append(0)
            few = _COMPRESSED_BATCH_POINTS if source.info.format in ("laz", "copc") else _BATCH_POINTS
            stream = source.batches(min(max_points, few), attributes)
            coming = ahead.submit(next, stream, None)
            while (batch := coming.result()) is not None:
                coming = ahead.submit(next, stream, None)
                batch.check()
                n_bad = bounds(batch.positions, tally.lower, tally.upper)
                if n_bad:
                    if strict:
                        raise InputError(f"{source.info.path}: found {n_bad} points that are not finite, expected none")
                    tally.n_dropped += n_bad
                    batch = batch.select(np.isfinite(batch.positions).all(axis=1))
                tally.source_points[-1] += len(batch)
                if len(batch):
                    yield batch


class Columns:
    """Preallocated columns that fill up batch by batch. Pages are taken when they are written, not before."""

    def __init__(self, capacity: int, attributes: tuple[str, ...]) -> None:
        self._columns = PointBatch(
            np.empty((capacity, 3)), {name: np.empty(capacity, ATTRIBUTES[name]) for name in attributes}
        )
        self.n_points = 0

    @property
    def room(self) -> int:
        """Points that still fit."""
        return len(self._columns) - self.n_points

    def add(self, batch: PointBatch) -> None:
        """Append a batch that fits."""
        where = slice(self.n_points, self.n_points + len(batch))
        self._columns.positions[where] = batch.positions
        for name, column in self._columns.attributes.items():
            column[where] = batch.attributes[name]
        self.n_points += len(batch)

    def points(self) -> PointBatch:
        """What has been added: views."""
        return self._columns.select(slice(0, self.n_points))

    def whole(self) -> PointBatch:
        """All of the memory, to be filled by the caller."""
        return self._columns

    def clear(self) -> None:
        """Forget the points and keep the memory."""
        self.n_points = 0
