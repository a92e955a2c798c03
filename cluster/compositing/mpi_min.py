"""MPI_Reduce with MPI_MIN on whole framebuffers: the reference, and MPI's own way on shared memory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..transport import Transport


class MpiMin:
    """Cost: MPI's; every rank sends whole pictures, background too."""

    def __init__(self, transport: Transport, ranks: Sequence[int]) -> None:
        self._minimum = transport.minimum_of(ranks)

    def composite(self, frame: int, words: np.ndarray) -> np.ndarray | None:
        """See ``Compositor``; collectives of MPI keep their order, so ``frame`` is not needed."""
        least = self._minimum(words.reshape(-1))
        return None if least is None else least.reshape(words.shape)
