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


def common_attributes(sources: list[Source], wanted: tuple[str, ...] | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(kept, dropped): attributes that all inputs have, in the order of ``ATTRIBUTES``, and those only some have.

    Raises InputError if a wanted one is in no input.
    """
    present = [set(source.info.attributes) for source in sources]
    candidates = [a for a in ATTRIBUTES if (wanted is None or a in wanted) and any(a in p for p in present)]
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


def finite_batches(
    sources: list[Source], attributes: tuple[str, ...], max_points: int, strict: bool, tally: Tally
) -> Iterator[PointBatch]:
    """The finite points of all inputs in order, counted in ``tally``; none of the batches is empty.

    Raises InputError under ``strict`` for a point that is not finite, and for a batch that is not as documented.
    """
    with ThreadPoolExecutor(1) as ahead:
        for source in sources:
            tally.source_points.append(0)
            stream = source.batches(max_points, attributes)
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

    def clear(self) -> None:
        """Forget the points and keep the memory."""
        self.n_points = 0
