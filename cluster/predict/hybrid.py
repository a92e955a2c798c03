"""Which k : m : n ranks suit a scene: the stages divided, the messages multiplied, in closed form.

Subtrees go to k culling and m sampling ranks, points to n render ranks; every rank has a machine's core or cores of its
own, and subtrees are equally full. A selection rank still pays a frame's constant; a render rank still merges a whole
framebuffer and takes a message from each sampling rank. The n framebuffers are composited by binary swap: 2 log₂ n
messages a rank, 2 (n − 1) / n framebuffers of 8 bytes a pixel sent, as many words compared.
Source: thesis 5.3.1 and Figure 5-3; Ma, Painter, Hansen, Krogh 1994 (binary swap).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from .costs import STAGES, Costs, stage_columns
from .machine import Machine
from .workload import Workload

WORD_BYTES = 8
MERGED_PER_S = 1e9
"""Framebuffer words that a core compares in a second."""

INEQUALITIES = {
    "work": "(7) processor",
    "points": "(3) vertices",
    "pixels": "(6) fragments",
    "messages": "(2) external latency",
    "bytes": "(2) external bandwidth",
}
"""What limits a rank → the thesis's condition (3.3.1) that it breaks first."""


@dataclass(frozen=True)
class Split:
    """k culling, m sampling, n render ranks and what a frame costs each of them.

    parts_s : rank kind → part of its time → seconds.
    """

    k: int
    m: int
    n: int
    parts_s: dict[str, dict[str, float]]

    @property
    def ranks(self) -> int:
        """All of them."""
        return self.k + self.m + self.n

    @property
    def frames_per_s(self) -> float:
        """Rate of the slowest kind of rank."""
        return 1 / max(sum(parts.values()) for parts in self.parts_s.values())

    @property
    def limit(self) -> tuple[str, str]:
        """(kind of rank, inequality) that bounds the rate: the largest part of the slowest kind."""
        kind = max(self.parts_s, key=lambda name: sum(self.parts_s[name].values()))
        parts = self.parts_s[kind]
        return kind, INEQUALITIES[max(parts, key=lambda name: parts[name])]

    @property
    def latency_s(self) -> float:
        """A frame's way through one rank of each kind, nothing waiting."""
        return sum(sum(parts.values()) for parts in self.parts_s.values())


def split_costs(costs: Costs, load: Workload, machine: Machine, k: int, m: int, n: int) -> Split:
    """What k : m : n ranks of one thread each cost. Counts are the frames' means."""
    columns = stage_columns(load, 1)
    mean = {s: {f: float(c.mean()) * costs.stages[s].seconds[f] for f, c in columns[s].items()} for s in STAGES}
    speed, bandwidth, latency = machine.speed, machine.bandwidth_bytes_per_s, costs.message_s / machine.speed
    entry_bytes = float(load.render_points_bytes.mean())
    render = mean["render"]
    rounds = 2 * math.ceil(math.log2(n)) if n > 1 else 0
    swapped = 2 * (n - 1) / n * load.pixels
    parts = {
        "culling": {
            "work": (_divided(mean["culling"], k) + costs.loop_s) / speed,
            "messages": latency * (3 + math.ceil(m / k)),
            "bytes": load.visibility_bytes / max(k, m) / bandwidth,
        },
        "sampling": {
            "work": _divided(mean["sampling"], m) / speed,
            "messages": latency * (1 + math.ceil(k / m) + n),
            "bytes": entry_bytes / m / bandwidth,
        },
        "render": {
            "work": (render["frame"] + render["entry"] / n) / speed,
            "points": render["point"] / n / speed,
            "pixels": (render["covered pixel"] / n + render["merged pixel"] + swapped / MERGED_PER_S) / speed,
            "messages": latency * (2 + m + rounds),
            "bytes": (entry_bytes / n + swapped * WORD_BYTES) / bandwidth,
        },
    }
    return Split(k, m, n, parts)


def best_split(costs: Costs, load: Workload, machine: Machine, ranks: int) -> Split:
    """The fastest split of at most ``ranks`` ranks (≥ 3): powers of two to the selection, any number to render."""
    options = []
    sizes = [2**i for i in range(ranks.bit_length())]
    for k in sizes:
        for m in sizes:
            left = ranks - k - m
            if left >= 1:
                renders = {left, *(size for size in sizes if size < left)}
                options += [split_costs(costs, load, machine, k, m, n) for n in renders]
    return max(options, key=lambda split: (split.frames_per_s, -split.ranks))


def _divided(parts: dict[str, float], ranks: int) -> float:
    """Seconds on one of several ranks: all but the constant is divided."""
    return parts["frame"] + sum(seconds for name, seconds in parts.items() if name != "frame") / ranks
