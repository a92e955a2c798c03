"""The conditions (1)–(8) of thesis 3.3.1 in their time form: ``k·l + D/B ≤ 1/F``.

k messages of latency l and D units at rate B need that long in each frame. The thesis's own form, (1 − F·k·l)·B/F > D,
divides by F and changes sign where F·k·l reaches 1; the time form is a sum of terms that are never negative, so it
rounds once a term whatever their ratio, and no input makes it raise or become NaN.

Each condition stands alone (worst case, thesis 3.3.1): a rank that meets all of them may still be late with their sum.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from .parameters import Application, Quantity, RankLoad, RankSystem, Source, System


@dataclass(frozen=True)
class Need:
    """Time needed in a frame: ``count`` latencies and ``data`` units at a rate; all finite and ≥ 0.

    No data needs no time, even at rate 0; data at rate 0 needs for ever.
    """

    count: float
    latency_s: float
    data: float
    rate_per_s: float

    @property
    def seconds(self) -> float:
        """Time needed a frame; ``inf`` where the rate is 0."""
        return self.count * self.latency_s + self._transfer_s

    @property
    def largest_frames_per_s(self) -> float:
        """The highest frame rate it allows: ``inf`` for no need, 0 for one that is never met."""
        return 1 / self.seconds if self.seconds > 0 else math.inf

    def largest_data(self, frames_per_s: float) -> float:
        """Data a frame that would just be in time; 0 where the latencies alone take longer."""
        left_s = 1 / frames_per_s - self.count * self.latency_s
        return left_s * self.rate_per_s if left_s > 0 and self.rate_per_s > 0 else 0.0

    @property
    def _transfer_s(self) -> float:
        if self.data == 0:
            return 0.0
        return self.data / self.rate_per_s if self.rate_per_s > 0 else math.inf


@dataclass(frozen=True)
class Condition:
    """One condition at one rank.

    number : of the thesis's equation; 2′ is (2) with the waiting of the program's own messages.
    where : role of the rank, or sender → receiver.
    need : None where ``absent`` says why the condition cannot be evaluated.
    """

    number: str
    what: str
    unit: str
    rank: int
    where: str
    frames_per_s: float
    need: Need | None
    absent: Source | None = None

    @property
    def budget_s(self) -> float:
        """Time of a frame, 1/F."""
        return 1 / self.frames_per_s

    @property
    def margin_s(self) -> float | None:
        """Time left over; negative where the condition is violated."""
        return None if self.need is None else self.budget_s - self.need.seconds

    @property
    def verdict(self) -> str:
        """Holds, violated, or why it is neither."""
        if self.need is None:
            return str(self.absent)
        return "holds" if self.need.seconds <= self.budget_s else "violated"


def conditions(system: System, application: Application) -> list[Condition]:
    """Every condition of every rank, and (2) of every pair that sends. Ranks of both must correspond."""
    out = []
    frames_per_s = application.frames_per_s
    for rank, (machine, load) in enumerate(zip(system.ranks, application.ranks, strict=True)):
        for number, what, unit, need in _of_rank(machine, load):
            out.append(_condition(number, what, unit, rank, load.role, frames_per_s, need))
    for traffic in application.traffic:
        link = system.link(traffic.sender, traffic.receiver)
        where = f"{application.ranks[traffic.sender].role} → {application.ranks[traffic.receiver].role}"
        raw = polite = Source.UNKNOWN
        if link is not None:
            raw = _need(
                traffic.messages, _sum(link.latency_s, link.software_latency_s), traffic.bytes, link.bytes_per_s
            )
            polite = _need(traffic.messages, link.polite_latency_s, traffic.bytes, link.polite_bytes_per_s)
        for number, what, need in (("2", "transmission", raw), ("2′", "transmission, polite waiting", polite)):
            out.append(_condition(number, what, "bytes", traffic.sender, where, frames_per_s, need))
    return sorted(out, key=lambda c: (c.rank, c.number, c.where))


def bottleneck(found: list[Condition]) -> Condition | None:
    """The condition that allows the lowest frame rate; None if none limits it."""
    limiting = [c for c in found if c.need is not None and c.need.seconds > 0]
    return min(limiting, key=lambda c: c.need.largest_frames_per_s if c.need else math.inf, default=None)


def _of_rank(machine: RankSystem, load: RankLoad) -> Iterator[tuple[str, str, str, Need | Source]]:
    zero, one = (Quantity(n, Source.DERIVED) for n in (0.0, 1.0))
    once = one if load.vertex_bytes.value else load.vertex_bytes  # no data, no trip
    singly = load.vertex_bytes if load.primitives.value else load.primitives
    yield (
        "1",
        "framebuffer read-back",
        "bytes",
        _need(
            load.read_backs,
            machine.gpu_up_latency_s,
            _product(load.read_back_share, load.framebuffer_bytes),
            machine.gpu_up_bytes_per_s,
        ),
    )
    yield "3", "vertices", "points", _need(zero, zero, load.vertices, load.vertices_per_s)
    yield (
        "4",
        "vertex arrays to the GPU",
        "bytes",
        _need(once, machine.gpu_down_latency_s, load.vertex_bytes, machine.gpu_down_bytes_per_s),
    )
    yield (
        "5",
        "immediate mode",
        "bytes",
        _need(load.primitives, machine.gpu_down_latency_s, singly, machine.gpu_down_bytes_per_s),
    )
    yield "6", "fragments", "pixels", _need(zero, zero, load.fragments, load.fragments_per_s)
    operations = _product(load.cpu_bytes, load.operations_per_byte)
    yield "7", "computation on the CPU", "flop", _need(zero, zero, operations, machine.cpu_flop_per_s)
    yield (
        "8",
        "main memory",
        "bytes",
        _need(load.jumps, machine.memory_latency_s, load.cpu_bytes, machine.memory_bytes_per_s),
    )


def _condition(
    number: str, what: str, unit: str, rank: int, where: str, frames_per_s: float, need: Need | Source
) -> Condition:
    if isinstance(need, Source):
        return Condition(number, what, unit, rank, where, frames_per_s, None, need)
    return Condition(number, what, unit, rank, where, frames_per_s, need)


def _need(count: Quantity, latency_s: Quantity, data: Quantity, rate_per_s: Quantity) -> Need | Source:
    """The need, or why there is none. What is multiplied by nothing need not be known."""
    values = []
    for amount, cost in ((count, latency_s), (data, rate_per_s)):
        if amount.value is None:
            return amount.source
        if amount.value and cost.value is None:
            return cost.source
        values += [amount.value, cost.value or 0.0]
    return Need(*values)


def _product(a: Quantity, b: Quantity) -> Quantity:
    if a.value == 0 or b.value == 0:
        return Quantity(0.0, Source.DERIVED)
    if a.value is None or b.value is None:
        return a if a.value is None else b
    return Quantity(a.value * b.value, Source.DERIVED)


def _sum(a: Quantity, b: Quantity) -> Quantity:
    if a.value is None or b.value is None:
        return a if a.value is None else b
    return Quantity(a.value + b.value, Source.DERIVED)
