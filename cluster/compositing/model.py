"""What compositing costs, as pure functions: latency, bytes and merging of each policy, step by step.

A step takes a latency, then each rank that is busy in it sends, receives and merges one message after the other; the
slowest rank counts. Ranks draw on a random share of the pixels, independently of each other: what g of them have drawn
on is 1 − (1 − c)^g. An α-β-γ model, as is usual for collectives, with background left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ...shared.framebuffer_runs import HEAD_BYTES, RUN, WORD
from ...shared.messages import HEADER
from .rounds import k_values

POLICIES = ("direct", "direct-reduce", "binary-swap", "radix-k", "mpi-min")


@dataclass(frozen=True)
class Rates:
    """What links and ranks do.

    latency_s : from sending an empty message until its receiver goes on.  message_s : what each message takes of the
    ranks at its ends beside.  bytes_per_s : of the link, into or out of one rank.  merge_per_s : words merged a second.
    scan_per_s : pixels encoded a second.  at_once : ranks that can work at the same time, as cores of one host.
    """

    latency_s: float
    bytes_per_s: float
    merge_per_s: float
    scan_per_s: float
    message_s: float = 0.0
    at_once: float = math.inf


class Cost(NamedTuple):
    """Of a frame: seconds until the root has it; the most bytes and messages that a rank sends; those of all ranks."""

    seconds: float
    rank_bytes: float
    rank_messages: float
    all_bytes: float
    all_messages: float


def compositing_cost(
    policy: str,
    n_ranks: int,
    n_pixels: int,
    coverage: float,
    rates: Rates,
    *,
    radix: int = 8,
    run_px: float = 16.0,
    gather: bool = True,
) -> Cost:
    """Cost of a frame.

    policy : one of ``POLICIES``.  coverage : share of the pixels that a rank draws on, 0 to 1.  radix : of radix-k.
    run_px : mean length of a run of drawn pixels.  gather : whether the root gathers the parts that ranks hold in the
    end, or they stay where they are (not of direct and mpi-min).
    """
    if n_ranks == 1:
        return Cost(0.0, 0.0, 0.0, 0.0, 0.0)
    steps = _Steps(n_ranks, n_pixels, coverage, rates, run_px)
    if policy == "direct":
        steps.direct()
    elif policy == "mpi-min":
        steps.mpi_min()
    else:
        values = {"direct-reduce": (n_ranks,), "binary-swap": k_values(n_ranks, 2), "radix-k": k_values(n_ranks, radix)}
        steps.rounds(values[policy], gather=gather)
    return Cost(steps.seconds, steps.rank_bytes, steps.rank_messages, steps.all_bytes, steps.all_messages)


def cheapest(n_ranks: int, n_pixels: int, coverage: float, rates: Rates, radix: int = 8) -> str:
    """The policy that is done first; of equals the first of ``POLICIES``. ``mpi-min`` is a reference and not chosen."""
    return min(
        POLICIES[:-1],
        key=lambda policy: compositing_cost(policy, n_ranks, n_pixels, coverage, rates, radix=radix).seconds,
    )


class _Steps:
    """Adds up the steps of a policy."""

    def __init__(self, n_ranks: int, n_pixels: int, coverage: float, rates: Rates, run_px: float) -> None:
        self.n, self.pixels, self.coverage, self.rates, self.run_px = n_ranks, n_pixels, coverage, rates, run_px
        self.seconds = self.rank_bytes = self.rank_messages = self.all_bytes = self.all_messages = 0.0

    def direct(self) -> None:
        self._step(self.n - 1, scanned=self.pixels)
        self._send(self.n - 1, 1, self.pixels, 1)
        self._step(1, self.n - 1, self.pixels, 1)

    def rounds(self, values: Sequence[int], *, gather: bool) -> None:
        n_met = math.prod(values)
        extra, drawn = self.n - n_met, self.n / n_met
        if extra:
            self._step(extra, 1, self.pixels, 1, scanned=self.pixels)
            self._send(extra, 1, self.pixels, 1)
        part, met = float(self.pixels), 1.0 if not extra else drawn
        for k in values:
            part /= k
            self._step(n_met, k - 1, part, met, scanned=(k - 1) * part)
            self._send(n_met, k - 1, part, met)
            met *= k
        if gather:
            self._step(n_met - 1, scanned=part)
            self._send(n_met - 1, 1, part, self.n)
            self._step(1, n_met - 1, part, self.n)

    def mpi_min(self) -> None:
        """Reduce-scatter by halves, then a gather by doubling, both of whole words (Rabenseifner)."""
        moved = (self.n - 1) / self.n * self.pixels
        rounds = math.ceil(math.log2(self.n))
        seconds = 2 * WORD.itemsize * moved / self.rates.bytes_per_s + moved / self.rates.merge_per_s
        self.seconds += 2 * rounds * (self.rates.latency_s + self.rates.message_s) + seconds * self._shared(self.n)
        self.rank_bytes += 2 * WORD.itemsize * moved
        self.rank_messages += 2 * rounds
        self.all_bytes += 2 * WORD.itemsize * (self.n - 1) * self.pixels
        self.all_messages += 2 * rounds * self.n

    def _filled(self, met: float) -> float:
        return -math.expm1(met * math.log1p(-self.coverage)) if self.coverage < 1 else 1.0

    def _message_bytes(self, n_pixels: float, met: float) -> float:
        filled = n_pixels * self._filled(met)
        body = HEAD_BYTES + filled * (WORD.itemsize + RUN.itemsize / self.run_px) if filled else 0
        return HEADER.size + body

    def _shared(self, busy: int) -> float:
        return max(1.0, busy / self.rates.at_once)

    def _step(self, busy: int, messages: int = 0, n_pixels: float = 0, met: float = 1, *, scanned: float = 0) -> None:
        """``busy`` ranks each encode ``scanned`` pixels, take ``messages`` of ``n_pixels`` and merge them."""
        rates = self.rates
        seconds = scanned / rates.scan_per_s
        each = rates.message_s + self._message_bytes(n_pixels, met) / rates.bytes_per_s
        seconds += messages * (each + n_pixels * self._filled(met) / rates.merge_per_s)
        self.seconds += seconds * self._shared(busy) + (rates.latency_s if messages else 0)

    def _send(self, senders: int, messages: int, n_pixels: float, met: float) -> None:
        """Count what ``senders`` ranks send; they are taken to be the same ones in every step."""
        n_bytes = messages * self._message_bytes(n_pixels, met)
        self.rank_bytes += n_bytes
        self.rank_messages += messages
        self.all_bytes += senders * n_bytes
        self.all_messages += senders * messages
