"""Radix-k: rounds of direct-send within groups of k, the k being factors of the number of ranks; the root gathers.

Source: Peterka, Goodell, Ross, Shen, Thakur 2009; Kendall, Peterka, Huang, Shen, Ross, "Accelerating and Benchmarking
Radix-k Image Compositing at Large Scale", EGPGV 2010 (background left out, k-values chosen).
"""

from __future__ import annotations

from collections.abc import Sequence

from ..transport import Transport
from .rounds import Rounds, k_values


def radix_k(transport: Transport, ranks: Sequence[int], radix: int) -> Rounds:
    """Groups of at most ``radix`` ≥ 2. Cost: Σ (kᵢ − 1) messages a rank, then n − 1 to the root."""
    return Rounds(transport, ranks, k_values(len(ranks), radix))
