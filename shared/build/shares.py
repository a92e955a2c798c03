"""Who does what of a build on several ranks: consecutive shares of the inputs, then of the partitions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..readers.source import Source

_BYTES_A_POINT = 30
"""Of a file that does not say how many points it has: of text, about."""
_LEAST_PARTITIONS = 64
_PARTITIONS_A_RANK = 4


def input_share(sources: Sequence[Source], rank: int, size: int) -> list[tuple[int, Source]]:
    """(index, source or part of it) of what a rank reads; those of all ranks, in order, are all the inputs.

    Shares have nearly as many points, as far as files can be divided (``Source.part_points``); a file that cannot goes
    to the rank that its middle falls to.
    """
    weights = [_weight(source) for source in sources]
    total, start, share = sum(weights), 0, []
    begin, end = total * rank // size, total * (rank + 1) // size
    for index, (source, n) in enumerate(zip(sources, weights, strict=True)):
        if source.part_points is None or source.info.n_points is None:
            if begin <= start + n // 2 < end:
                share.append((index, source))
        else:
            first, last = (_cut(at - start, n, source.part_points) for at in (begin, end))
            if first < last:
                share.append((index, source.part(first, last) if last - first < n else source))
        start += n
    return share


def _weight(source: Source) -> int:
    if source.info.n_points is not None:
        return max(1, source.info.n_points)
    return 1 + source.info.path.stat().st_size // _BYTES_A_POINT


def _cut(at: int, n: int, step: int) -> int:
    """The place among n points, nearest to ``at``, where a part starts best."""
    return n if at >= n else min(max(0, (at + step // 2) // step * step), n)


def wanted_points(n_points: int, size: int, least: int, capacity: int) -> int:
    """The most points of a partition: so few that ranks can share them evenly, but ``least``, and what fits.

    The same for 2 to 16 ranks, for 17 to 64, and so on: so are then all bits of the scene.
    """
    pieces = _LEAST_PARTITIONS
    while pieces < _PARTITIONS_A_RANK * size:
        pieces *= 4
    return min(capacity, max(least, -(-n_points // pieces)))


def consecutive(weights: np.ndarray, rank: int, size: int) -> slice:
    """Which of (n,) items are a rank's: consecutive ones, of nearly equal weight for all ranks."""
    middle = np.cumsum(weights) - np.asarray(weights) / 2
    total = float(np.sum(weights))
    first, last = np.searchsorted(middle, [total * rank / size, total * (rank + 1) / size])
    return slice(int(first), int(last))
