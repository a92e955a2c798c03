"""A layout, its parts and costs → what each rank and link has to do of every frame, and after what.

**Ranks** pay the software latency of each message that they send or receive. The coordinator sends a camera to every
rank that has work. **Links** are hosts' links to the network, each way: a message between hosts occupies its sender's
and its receiver's for bytes / bandwidth, at the same time. Between ranks of one host it is under way for bytes /
bandwidth of memory.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ...shared.framebuffer_runs import RUN, WORD
from ..compositing.choose import COVERAGE, RATES
from ..compositing.model import cheapest, compositing_cost
from ..layout import Lane
from .costs import Costs, stage_columns
from .machine import Machine
from .parts import Kind, Part, Parts
from .setting import Setting
from .workload import Workload

INEQUALITIES = {
    "work": "(7) processor",
    "points": "(3) vertices",
    "pixels": "(6) fragments",
    "read back": "(1) framebuffer read-back",
    "messages": "(2) external latency",
    "bytes": "(2) external bandwidth",
}
"""What limits a rank or a link → the thesis's condition (3.3.1) that it breaks first."""

_OF_RENDER = {"point": "points", "cold point": "points", "covered pixel": "pixels", "merged pixel": "pixels"}

Seconds = np.ndarray
Amounts = Sequence[np.ndarray | float]


@dataclass
class Step:
    """Work of one rank, or a message's way over one link, in every frame.

    on : the rank's role or the link.  rank : None for a link.
    parts_s : what limits → (n_frames,) seconds, alone on the machine.
    after : numbers of the steps before it.  link_s : on the way to those after it.
    threads : that work; 0 where nothing is slowed by other ranks on the cores.
    draws : whether it is a render rank's drawing.
    """

    on: str
    rank: int | None
    after: tuple[int, ...]
    parts_s: dict[str, Seconds] = field(default_factory=dict)
    link_s: float = 0.0
    threads: int = 0
    draws: bool = False

    def add(self, part: str, seconds: Seconds | float) -> None:
        """More of a part, unless it is nothing."""
        if np.any(seconds):
            self.parts_s[part] = self.parts_s.get(part, 0.0) + np.asarray(seconds, np.float64)

    def seconds(self, n_frames: int, *, working: bool = True, waiting: bool = True) -> Seconds:
        """(n_frames,) seconds: of work, which other ranks on the cores slow down, and of messages and links."""
        wanted = [s for name, s in self.parts_s.items() if (waiting if name in ("messages", "bytes") else working)]
        return np.zeros(n_frames) + sum(wanted)


class _Arrival(NamedTuple):
    """What a rank waits for, and how many messages that are."""

    after: tuple[int, ...]
    messages: int


def stage_parts(costs: Costs, stage: str, load: Workload, threads: int) -> dict[str, Seconds]:
    """What limits → (n_frames,) seconds of one stage's work on a load, with so many threads."""
    parts: dict[str, Seconds] = {}
    seconds = costs.stages[stage].seconds
    for name, column in stage_columns(load, threads)[stage].items():
        part = _OF_RENDER.get(name, "work")
        parts[part] = parts.get(part, 0.0) + seconds[name] * column
    return parts


def largest_part(steps: Sequence[Step]) -> str:
    """The inequality of what takes most time in several steps."""
    parts: dict[str, float] = {}
    for step in steps:
        for name, seconds in step.parts_s.items():
            parts[name] = parts.get(name, 0.0) + float(np.sum(seconds))
    return INEQUALITIES[max(parts, key=lambda name: parts[name], default="work")]


class Steps:
    """The steps of a layout, in an order in which each comes after those that it waits for.

    threads : of each render rank.  named : whether ranks are called by their roles, which takes long for thousands.
    """

    def __init__(
        self, setting: Setting, parts: Parts, costs: Costs, machine: Machine, *, threads: int = 1, named: bool = True
    ) -> None:
        self.layout = layout = setting.layout()
        self._compositing, self._radix = setting.compositing, setting.radix
        self.steps: list[Step] = []
        self._parts = parts
        self._costs = costs
        self._machine = machine
        self._threads = threads
        self._message_s = costs.message_s / machine.speed
        self._known: dict[tuple[str, int], dict[str, Seconds]] = {}
        workers = layout.workers
        self._roles = {rank: layout.role_of(rank) if named else f"rank {rank}" for rank in workers}
        if len(workers) == 1:
            self._roles[0] = "single"
        self._others = sum(1 for rank in workers if rank)
        self._roles.setdefault(0, "coordinator")
        start = self._start()
        lanes, split = len(layout.lanes), "shares" if layout.split == "shares" else "tiles"
        self._of_lanes = parts.of(split, lanes) if lanes > 1 else []
        self._display([step for number, lane in enumerate(layout.lanes) for step in self._lane(number, lane, start)])

    def _start(self) -> tuple[int, int]:
        """After what rank 0 begins a frame, and after what the others do.

        A frame starts when few enough are unfinished, whatever rank 0 is at: it has told the others ahead. Telling them
        takes its time all the same, as does what comes outside the stages.
        """
        self.steps.append(Step("start", None, ()))
        self.steps.append(Step("told", None, (0,), link_s=self._message_s * self._others))
        own = self._new(0, (0,))
        self.steps[own].add("work", self._costs.loop_s / self._machine.speed)
        self.steps[own].add("messages", self._message_s * (self._others + (self.layout.display != 0)))
        return own, 1

    def _lane(self, number: int, lane: Lane, start: tuple[int, int]) -> list[int]:
        """Culling, sampling and render of one lane; the steps of its render ranks."""
        k, m, n = len(lane.culling), len(lane.sampling), len(lane.render)
        split: Kind = "shares" if self.layout.split == "shares" else "tiles"
        if len(self.layout.lanes) > 1:
            mine = self._of_lanes[number]
            culled, sampled, drawn = [mine], [mine], [mine]
        else:
            culled, sampled = self._parts.of("subtrees", k), self._parts.of("subtrees", m)
            drawn = self._parts.of(split, n)
        begin = [_Arrival((start[rank != 0],), int(rank != 0)) for rank in lane.culling]
        culling = self._stages("culling", lane.culling, culled, begin)
        pairs = [range(j * k // m, -(-(j + 1) * k // m)) for j in range(m)]  # as far as they have subtrees in common
        bits = [of.load.visibility_bytes for of in culled]
        arrived = self._send(lane.culling, culling, bits, lane.sampling, pairs, [max(bits)] * m)
        sampling = self._stages(
            "sampling", lane.sampling, sampled, self._with_camera(arrived, lane.sampling, lane.culling)
        )
        if n > 1 and len(self.layout.lanes) == 1:
            self._dealt(sampling, sampled, n)
        of_m = [of.load.render_points_bytes for of in sampled]
        of_n = [of.load.render_points_bytes for of in drawn]
        out, into = (of_m, [_sum(of_m)]) if n == 1 else ([_sum(of_n) / m] * m, of_n)
        arrived = self._send(lane.sampling, sampling, out, lane.render, [range(m)] * n, into)
        before = (*lane.culling, *lane.sampling)
        return self._stages("render", lane.render, drawn, self._with_camera(arrived, lane.render, before))

    def _dealt(self, steps: Sequence[int], parts: Sequence[Part], n: int) -> None:
        """What is sampled is looked through again for each of n tiles; for shares it is cut up, which costs little."""
        for step, part in zip(steps, parts, strict=True):
            seconds = self._costs.stages["sampling"].seconds
            again = n * seconds["cell"] * part.load.cells if self.layout.split == "tiles" else 0.0
            entries = seconds["entry"] * part.load.entries * (n if self.layout.split == "shares" else 1)
            self.steps[step].add("work", (again + entries) / self._machine.speed)

    def _with_camera(self, arrived: list[_Arrival], ranks: Sequence[int], earlier: Sequence[int]) -> list[_Arrival]:
        """The arrivals and a camera, for ranks that have not had it at an earlier stage; rank 0 needs none."""
        had = {0, *earlier}
        return [_Arrival(of.after, of.messages + (rank not in had)) for of, rank in zip(arrived, ranks, strict=True)]

    def _stages(self, stage: str, ranks: Sequence[int], parts: Sequence[Part], arrived: list[_Arrival]) -> list[int]:
        """The work of several ranks at one stage; their steps."""
        found = []
        for rank, part, of in zip(ranks, parts, arrived, strict=True):
            number = self._new(rank, of.after)
            step = self.steps[number]
            step.draws = stage == "render"
            step.threads = self._threads if step.draws else 1
            key = stage, id(part)
            if key not in self._known:
                self._known[key] = stage_parts(self._costs, stage, part.load, step.threads)
            for name, seconds in self._known[key].items():
                step.add(name, seconds / self._machine.speed)
            step.add("messages", self._message_s * of.messages)
            found.append(number)
        return found

    def _send(
        self,
        senders: Sequence[int],
        steps: Sequence[int],
        out_bytes: Amounts,
        receivers: Sequence[int],
        pairs: Sequence[range],
        in_bytes: Amounts,
    ) -> list[_Arrival]:
        """What each receiver waits for: receiver i takes a message from each sender whose number is in ``pairs[i]``.

        steps : of the senders.  out_bytes, in_bytes : of all messages that each sends, and that each receives.
        """
        machine = self._machine
        number_of = {rank: i for i, rank in enumerate(senders)}
        n_out, n_in = np.zeros(len(senders), int), []
        for rank, of in zip(receivers, pairs, strict=True):
            n_out[of.start : of.stop] += 1
            itself = number_of.get(rank, -1) in of
            n_in.append(len(of) - itself)
            if itself:
                n_out[number_of[rank]] -= 1
        hosts_in, hosts_out = (Counter(map(machine.host_of, ranks)) for ranks in (receivers, senders))
        ways = []
        for rank, step, sent, n in zip(senders, steps, out_bytes, n_out.tolist(), strict=True):
            self.steps[step].add("messages", self._message_s * n)
            host = machine.host_of(rank)
            others = len(receivers) - hosts_in[host]
            if n and not others:
                self.steps[step].link_s = float(np.mean(sent)) / machine.bandwidth_bytes_per_s
            ways.append(self._link("out of", host, (step,), sent * (others / len(receivers))) if others else step)
        joined: dict[tuple[int, int], tuple[int, ...]] = {}
        arrived = []
        for rank, of, received, n in zip(receivers, pairs, in_bytes, n_in, strict=True):
            span = of.start, of.stop
            if span not in joined:
                sent_by, passed = steps[of.start : of.stop], ways[of.start : of.stop]
                joined[span] = self._joined(sent_by), self._joined([*sent_by, *passed])
            ready, before = joined[span]
            host = machine.host_of(rank)
            near = hosts_out[host] if len(of) == len(senders) else sum(machine.host_of(senders[j]) == host for j in of)
            after = (before,)
            if near < len(of):
                after = before, self._link("into", host, (ready,), received * (1 - near / len(of)))
            arrived.append(_Arrival(after, n))
        return arrived

    def _display(self, drawn: Sequence[int]) -> None:
        """Framebuffers to the display rank, which makes them one; and the note that the frame is done."""
        layout, display = self.layout, self.layout.display
        last, n = drawn[0], len(drawn)
        if n > 1:
            shares = layout.split == "shares"
            pieces = self._parts.of("shares" if shares else "tiles", n)
            policy = self._policy(n, pieces[0].pixels) if shares else "direct"
            last = self._direct(drawn, pieces) if policy == "direct" else self._in_rounds(policy, drawn, pieces)
        if display:
            self.steps[last].add("messages", self._message_s)

    def _policy(self, n: int, pixels: float) -> str:
        """How shares are composited: as configured, or as the program chooses."""
        if self._compositing != "auto":
            return self._compositing
        return cheapest(n, int(pixels), COVERAGE, RATES, self._radix)

    def _direct(self, drawn: Sequence[int], pieces: Sequence[Part]) -> int:
        """Every render rank sends what it has to the display rank, which takes one after the other."""
        costs, speed, render = self._costs, self._machine.speed, self.layout.render
        before = [drawn[0]]
        for rank, step, piece in zip(render[1:], drawn[1:], pieces[1:], strict=True):
            encoded_s = costs.encode_pixel_s * piece.pixels + costs.encode_word_s * piece.filled
            self.steps[step].add("read back", encoded_s / speed)
            sent = [piece.filled_bytes]
            before += self._send([rank], [step], sent, [render[0]], [range(1)], sent)[0].after
        merged = costs.merge_word_s * _sum([piece.filled for piece in pieces[1:]])
        return self._shown(before, merged, len(drawn) - 1)

    def _in_rounds(self, policy: str, drawn: Sequence[int], pieces: Sequence[Part]) -> int:
        """Exchanges between the render ranks, of which each then has a part of the picture; the display rank gathers.

        Bytes and messages are those of the compositing model at the mean coverage; what is received is merged.
        """
        costs, machine, n = self._costs, self._machine, len(drawn)
        pixels, filled = pieces[0].pixels, _sum([piece.filled for piece in pieces]) / n
        coverage = float(np.mean(filled)) / pixels
        run_px = RUN.itemsize * float(np.mean(filled)) / max(self._run_bytes(pieces), 1.0)
        of = {
            gather: compositing_cost(
                policy, n, int(pixels), coverage, RATES, radix=self._radix, run_px=run_px or 1.0, gather=gather
            )
            for gather in (False, True)
        }
        each = of[False]
        words = each.rank_bytes / WORD.itemsize
        work_s = costs.encode_pixel_s * pixels + (costs.encode_word_s + costs.merge_word_s) * words
        ready = self._joined(drawn)
        before = []
        for rank in self.layout.render:
            step = self._new(rank, (ready,))
            self.steps[step].threads = 1
            self.steps[step].add("read back", work_s / machine.speed)
            self.steps[step].add("messages", self._message_s * 2 * each.rank_messages)
            before.append(step)
            if machine.hosts > 1:
                host = machine.host_of(rank)
                before += [self._link(way, host, (ready,), each.rank_bytes) for way in ("out of", "into")]
        gathered = of[True].all_bytes - each.all_bytes
        if machine.hosts > 1 and gathered:
            before.append(self._link("into", machine.host_of(self.layout.display), (self._joined(before),), gathered))
        merged_s = costs.merge_word_s * gathered / WORD.itemsize
        return self._shown(before, merged_s, n - 1 if gathered else 0)

    def _run_bytes(self, pieces: Sequence[Part]) -> float:
        """Mean bytes of a framebuffer that say where its words are."""
        filled, sent = (_sum(values) for values in ([p.filled for p in pieces], [p.filled_bytes for p in pieces]))
        return float(np.mean(sent - WORD.itemsize * filled)) / len(pieces)

    def _shown(self, before: Sequence[int], merged_s: Seconds | float, messages: int) -> int:
        """The display rank makes the picture of what it receives."""
        step = self._new(self.layout.display, (self._joined(before),))
        self.steps[step].threads = 1
        self.steps[step].add("read back", merged_s / self._machine.speed)
        self.steps[step].add("messages", self._message_s * messages)
        return step

    def _new(self, rank: int, after: tuple[int, ...]) -> int:
        self.steps.append(Step(self._roles[rank], rank, after))
        return len(self.steps) - 1

    def _link(self, way: str, host: int, after: tuple[int, ...], n_bytes: np.ndarray | float) -> int:
        step = Step(f"link {way} host {host + 1}", None, after, link_s=self._machine.link_latency_s)
        step.add("bytes", n_bytes / self._machine.link_bytes_per_s)
        self.steps.append(step)
        return len(self.steps) - 1

    def _joined(self, steps: Sequence[int]) -> int:
        """The only one of several steps, or a step that comes when all have been."""
        different = tuple(dict.fromkeys(steps))
        if len(different) == 1:
            return different[0]
        self.steps.append(Step(f"join {len(self.steps)}", None, different))
        return len(self.steps) - 1


def _sum(values: Sequence[np.ndarray]) -> np.ndarray:
    """Of many (n_frames,) values; the same object, which most of many parts are, is multiplied."""
    counts = Counter(map(id, values))
    return np.sum([counts[key] * value for key, value in {id(v): v for v in values}.items()], axis=0)
