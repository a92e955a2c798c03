"""Direct-send: each rank owns 1/n of the picture, which all others send to it; the root gathers what they merged."""

from __future__ import annotations

from collections.abc import Sequence

from ..transport import Transport
from .rounds import Rounds


def direct_reduce(transport: Transport, ranks: Sequence[int]) -> Rounds:
    """Cost: n − 1 messages of 1/n of a picture to each rank, then as many to the root."""
    return Rounds(transport, ranks, (len(ranks),))
