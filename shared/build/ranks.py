"""What a build on several ranks asks of them, and steps that end on all of them when they fail on one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import numpy as np

from ..errors import SplatpipeError


class FailedElsewhere(SplatpipeError):
    """Another rank failed, and says why."""

    def __init__(self, exit_status: int = 1) -> None:
        super().__init__("another rank failed")
        self.exit_status = exit_status


class Ranks(Protocol):
    """A process's place among those that build a scene together. All but ``warn`` and ``warned`` are collective."""

    rank: int
    size: int

    def ranks_here(self) -> int:
        """How many share this rank's host."""
        ...

    def agree(self, status: int) -> list[int]:
        """A small number of every rank."""
        ...

    def join(self, values: np.ndarray) -> np.ndarray:
        """(sum of n,) float64: the (n,) values of every rank, in the order of ranks."""
        ...

    def total(self, counts: np.ndarray) -> np.ndarray:
        """Int64 sums over all ranks of an array that has the same shape on each."""
        ...

    def gather(self, data: bytes) -> list[bytes]:
        """The bytes that each rank gives."""
        ...

    def warn(self) -> None:
        """Let the others know that this rank has failed, so that they need not finish their step."""
        ...

    def warned(self) -> bool:
        """Whether another rank has. Cheap enough to be asked for every batch; from any thread."""
        ...


@contextmanager
def step(ranks: Ranks) -> Iterator[None]:
    """A part of the work without collective calls, after which the ranks meet. Collective.

    Raises, where it failed on any, what went wrong on the first rank that found something, and FailedElsewhere with
    its exit status on the others.
    """
    failure: Exception | None = None
    status = 0
    try:
        yield
    except FailedElsewhere as error:
        failure, status = error, -1
    except Exception as error:
        failure, status = error, getattr(error, "exit_status", 1)
        ranks.warn()
    statuses = ranks.agree(status)
    found = [rank for rank in range(ranks.size) if statuses[rank] > 0]
    if not found:
        return
    if failure is not None and ranks.rank == found[0]:
        if isinstance(failure, SplatpipeError):
            raise failure
        raise SplatpipeError(f"{type(failure).__name__}: {failure}") from failure
    raise FailedElsewhere(statuses[found[0]]) from failure
