"""Binary swap: in each of log₂ n rounds pairs of ranks exchange halves of what they hold; the root gathers.

Source: Ma, Painter, Hansen, Krogh, "Parallel Volume Rendering Using Binary-Swap Compositing", 1994. Ranks beyond a
power of two fold into the first ones beforehand.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..transport import Transport
from .rounds import Rounds, k_values


def binary_swap(transport: Transport, ranks: Sequence[int]) -> Rounds:
    """Cost: ⌊log₂ n⌋ messages a rank, of a half, a quarter, … of a picture, then n − 1 to the root."""
    return Rounds(transport, ranks, k_values(len(ranks), 2))
