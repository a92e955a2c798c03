"""A compositor by the name of its policy; ``auto`` takes the policy that the model says is done first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...shared.errors import ConfigError
from ..transport import Transport
from .exchange import Compositor
from .model import POLICIES, Rates, cheapest

RADIX = 8
"""Of radix-k: few rounds, and few messages in each; which is best depends on the links (Kendall et al. 2010)."""

RATES = Rates(latency_s=150e-6, bytes_per_s=4e9, merge_per_s=900e6, scan_per_s=900e6, message_s=45e-6)
"""Between ranks of one host through ``Transport``, where nothing is measured (`splatpipe bench compositing`)."""

COVERAGE = 0.25
"""Share of the pixels that a rank is taken to draw on: what ranks draw differs, and all must choose alike."""


def make_compositor(
    policy: str, transport: Transport, ranks: Sequence[int], *, radix: int = RADIX, rates: Rates = RATES
) -> Compositor:
    """The compositor of ``ranks``, those that draw, in any order: the first is the root. Collective over them.

    policy : ``auto`` or one of ``model.POLICIES``.  radix : of radix-k, at least 2.  rates : what ``auto`` goes by, the
    same on all ranks.
    Raises ConfigError for another policy.
    """
    ranks = list(ranks)
    match policy:
        case "auto":
            return _Auto(transport, ranks, radix, rates)
        case "direct":
            from .direct import Direct

            return Direct(transport, ranks)
        case "direct-reduce":
            from .direct_reduce import direct_reduce

            return direct_reduce(transport, ranks)
        case "binary-swap":
            from .binary_swap import binary_swap

            return binary_swap(transport, ranks)
        case "radix-k":
            from .radix_k import radix_k

            return radix_k(transport, ranks, radix)
        case "mpi-min":
            from .mpi_min import MpiMin

            return MpiMin(transport, ranks)
    raise ConfigError(f"pipeline.compositing = {policy!r}: expected auto or one of {', '.join(POLICIES)}")


class _Auto:
    """Chooses at the first frame, whose size is the same on all ranks."""

    def __init__(self, transport: Transport, ranks: list[int], radix: int, rates: Rates) -> None:
        self._made_of = transport, ranks, radix
        self._rates = rates
        self._chosen: Compositor | None = None

    def composite(self, frame: int, words: np.ndarray) -> np.ndarray | None:
        """See ``Compositor``."""
        if self._chosen is None:
            transport, ranks, radix = self._made_of
            policy = cheapest(len(ranks), words.size, COVERAGE, self._rates, radix)
            self._chosen = make_compositor(policy, transport, ranks, radix=radix)
        return self._chosen.composite(frame, words)
