"""When messages are coded (``pipeline.compression``): where a link is so slow that the bytes saved are worth the time.

``auto`` measures each pair of ranks that will talk once, at the start. Between hosts, a message is then coded where

    (raw bytes − coded bytes) / bandwidth > time to encode + time to decode,

whose two sides come from the messages themselves: of each link, kind and power of two of bytes the first few are coded
for trial, and one in ``_AGAIN`` later ones. Within a host, and on links faster than ``FASTEST_BYTES_PER_S``, nothing is
tried. ``on`` codes whatever becomes smaller. Nothing has to be agreed on: a header says whether its payload is coded.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from ..shared.config import PipelineSection
from ..shared.message_codecs import CODED_KINDS, form_of, has_zstd, pack, unpack
from ..shared.messages import Kind, header, parse_header
from .topologies import FRAME_PARALLEL, layout_of
from .transport import Transport

FASTEST_BYTES_PER_S = 2e9
"""Nothing pays on a faster link: break-even was below 0.9 GB/s for every message of ``splatpipe bench messages``."""
MOST_LINK_S = 50e-3
"""Longest that measuring a link takes; all links of a rank together at most 20 times as long."""
_TRIALS = 3
_AGAIN = 64
_SETTINGS = ("off", "auto", "on")
_FIRST_BYTES, _MOST_BYTES = 1 << 14, 1 << 22
_MOST_BURST = 4  # by so much a burst may mislead; a lower figure is a hiccup in one sample
_FEW_S, _FEW = 5e-3, 5  # a fast link is bounced over again, so often and no longer


@dataclass(frozen=True)
class Link:
    """The way from this rank to another.

    bytes_per_s, latency_s : one way, as measured or configured; None where nobody knows.
    shared_memory : whether both are on one host.
    zstd : whether both read the forms that need Zstandard.
    """

    bytes_per_s: float | None = None
    latency_s: float | None = None
    shared_memory: bool = False
    zstd: bool = True

    @property
    def why_raw(self) -> str:
        """Why nothing is tried on this link; empty where something is."""
        if self.bytes_per_s is None:
            return "raw: the link was not measured"
        if self.shared_memory:
            return f"raw: {_rate(self.bytes_per_s)}, shared memory of one host"
        if self.bytes_per_s >= FASTEST_BYTES_PER_S:
            return f"raw: {_rate(self.bytes_per_s)}; nothing is tried above {_rate(FASTEST_BYTES_PER_S)}"
        return ""


class Tried(NamedTuple):
    """A message that was coded: bytes before and after, seconds to encode and to decode."""

    raw: int
    coded: int
    encode_s: float
    decode_s: float


@dataclass
class Counts:
    """What has been sent of a kind to a rank.

    forms : messages by form.  encode_s : of all that was coded, trials included; decode_s : as measured here.
    """

    messages: int = 0
    raw_bytes: int = 0
    sent_bytes: int = 0
    encode_s: float = 0.0
    decode_s: float = 0.0
    forms: dict[str, int] = field(default_factory=dict)
    why: str = ""


class Choice:
    """Whether messages of one kind and size are coded on one link, as those before them say."""

    def __init__(self, link: Link) -> None:
        self._bytes_per_s = link.bytes_per_s or math.inf
        self._tried: deque[Tried] = deque(maxlen=_TRIALS)
        self._since_trial = 0
        self.codes = False
        self.why = link.why_raw
        self._tries = not self.why

    def wants(self) -> tuple[bool, bool]:
        """Whether the next message is to be coded, and whether it is to be decoded, too: for its time."""
        if not self._tries:
            return False, False
        self._since_trial += 1
        trial = len(self._tried) < _TRIALS or self._since_trial >= _AGAIN
        if trial:
            self._since_trial = 0
        return self.codes or trial, trial

    def learn(self, tried: Tried) -> None:
        """Take note of a message that was coded; sets ``codes`` and ``why``."""
        self._tried.append(tried)
        raw, coded, encode_s, decode_s = (median(values) for values in zip(*self._tried, strict=True))
        saved_s, spent_s = (raw - coded) / self._bytes_per_s, encode_s + decode_s
        self.codes = saved_s > spent_s
        even = (raw - coded) / max(spent_s, 1e-9)
        self.why = (
            f"{'coded' if self.codes else 'raw'}: {_rate(self._bytes_per_s)}; {raw:,.0f} → {coded:,.0f} bytes "
            f"save {_ms(saved_s)} and take {_ms(encode_s)} + {_ms(decode_s)}: pays below {_rate(even)}"
        )

    def decode_s(self, raw: int) -> float:
        """Seconds to decode a message of ``raw`` bytes, from those tried."""
        return raw * median(tried.decode_s / tried.raw for tried in self._tried) if self._tried else 0.0


class Coding:
    """Codes what a rank sends.

    links : by rank; others are not known.  always : code what becomes smaller, whatever the link.
    """

    def __init__(self, links: dict[int, Link], *, always: bool = False) -> None:
        self._links = links
        self._always = always
        self._choices: dict[tuple[int, Kind, int], Choice] = {}
        self._counts: dict[tuple[int, Kind], Counts] = {}

    def coded(self, dest: int, head: bytes, payload: memoryview) -> tuple[bytes, memoryview]:
        """A header and payload as they are to be sent to a rank.

        Cost: two look-ups, and where it is coded that, timed.
        """
        kind, frame, _ = parse_header(head)
        if kind not in CODED_KINDS or not len(payload):
            return head, payload
        counts = self._counts.setdefault((dest, kind), Counts())
        packed = self._packed(dest, kind, payload, counts)
        form = "raw"
        n_raw = len(payload)
        if packed is not None:
            form = form_of(packed.data)
            head, payload = header(kind, frame, len(packed), coded=True), packed.data
        counts.messages += 1
        counts.raw_bytes += n_raw
        counts.sent_bytes += len(payload)
        counts.forms[form] = counts.forms.get(form, 0) + 1
        return head, payload

    def _packed(self, dest: int, kind: Kind, payload: memoryview, counts: Counts) -> np.ndarray | None:
        link = self._links.get(dest, Link())
        if self._always:
            started = time.perf_counter()
            packed = pack(kind, payload, zstd=link.zstd)
            counts.encode_s += time.perf_counter() - started
            counts.why = "pipeline.compression is on: coded where that is smaller"
            return packed
        size = len(payload).bit_length()
        choice = self._choices.get((dest, kind, size))
        if choice is None:
            choice = self._choices[dest, kind, size] = Choice(link)
        code, trial = choice.wants()
        packed = None
        if code:
            started = time.perf_counter()
            packed = pack(kind, payload, zstd=link.zstd)
            encode_s = time.perf_counter() - started
            decode_s, n_coded = 0.0, len(payload)
            if packed is not None:
                n_coded = len(packed)
                decode_s = choice.decode_s(len(payload))
                if trial:
                    started = time.perf_counter()
                    unpack(kind, packed.data, len(payload))
                    decode_s = time.perf_counter() - started
            choice.learn(Tried(len(payload), n_coded, encode_s, decode_s))
            counts.encode_s += encode_s
            counts.decode_s += decode_s
        counts.why = choice.why
        return packed if choice.codes else None

    def record(self, rank: int) -> list[dict[str, Any]]:
        """JSON-able, one a rank that was written to: sender, receiver, the fields of ``Link``, ``Counts`` by kind."""
        found = []
        for dest in sorted({dest for dest, _ in self._counts}):
            kinds = {kind.name: asdict(counts) for (to, kind), counts in self._counts.items() if to == dest}
            found.append({"sender": rank, "receiver": dest, **asdict(self._links.get(dest, Link())), "kinds": kinds})
        return found


def pairs_that_talk(pipeline: PipelineSection, size: int) -> list[tuple[int, int]]:
    """Pairs of ranks, the lower first, between which messages cross that can be coded."""
    return [] if pipeline.topology == FRAME_PARALLEL else layout_of(pipeline, size).pairs


def start_coding(
    transport: Transport, pipeline: PipelineSection, pairs: Sequence[tuple[int, int]] | None = None
) -> Coding | None:
    """What ``transport.coding`` is to be; None where nothing is coded. Collective.

    pairs : of ranks that will talk, the same in the same order on every rank; None: as the topology says.
    Where ranks do not agree on the setting, the most careful holds.
    Cost: for ``auto`` at most ``MOST_LINK_S`` a link, and a second for all of a rank; once kernels that may be needed.
    """
    setting = _SETTINGS[min(transport.agree(_SETTINGS.index(pipeline.compression)))]
    if setting == "off" or transport.size == 1:
        return None
    hosts = transport.hosts()
    links = {
        rank: Link(shared_memory=hosts[rank] == hosts[transport.rank], zstd=bool(reads) and has_zstd())
        for rank, reads in enumerate(transport.agree(has_zstd()))
    }
    if setting == "auto":
        pairs = pairs_that_talk(pipeline, transport.size) if pairs is None else pairs
        for peer, (bytes_per_s, latency_s) in _measure(transport, pairs, 1e6 * pipeline.link_mb_per_s).items():
            shared_memory = links[peer].shared_memory and not pipeline.link_mb_per_s
            links[peer] = Link(bytes_per_s, latency_s, shared_memory, links[peer].zstd)
    coding = Coding(links, always=setting == "on")
    if setting == "on" or not all(link.why_raw for link in links.values()):
        _warm_up()
    transport.start_counting()  # what was measured is no message of the run
    return coding


def add_links(transport: Transport, result: dict[str, Any] | None) -> dict[str, Any] | None:
    """The statistics of a run with what was coded, on rank 0: ``links``, and ``raw_bytes`` of kinds. Collective."""
    coding = transport.coding
    if coding is None:
        return result
    links = coding.record(transport.rank)
    if transport.rank:
        transport.send_note(0, Kind.STATISTICS, 0, {"links": links})
    else:
        for rank in range(1, transport.size):
            links += transport.receive_note(rank, Kind.STATISTICS)[1]["links"]
    transport.finish()
    if result is None:
        return None
    messages = {kind: dict(counts) for kind, counts in result["messages"].items()}
    for kind, counts in messages.items():
        saved = sum(
            of["raw_bytes"] - of["sent_bytes"] for link in links for name, of in link["kinds"].items() if name == kind
        )
        if saved:
            counts["raw_bytes"] = counts["bytes"] + saved
    return result | {"messages": messages, "links": links}


def _measure(
    transport: Transport, pairs: Sequence[tuple[int, int]], bytes_per_s: float
) -> dict[int, tuple[float, float | None]]:
    """Bandwidth and latency, by the other rank, of this rank's pairs; as configured where ``bytes_per_s`` is not 0."""
    mine = [pair for pair in pairs if transport.rank in pair]
    if bytes_per_s:
        return {sum(pair) - transport.rank: (bytes_per_s, None) for pair in mine}
    most_at_one = max((sum(rank in pair for pair in pairs) for rank in {pair[0] for pair in pairs}), default=1)
    budget_s = min(MOST_LINK_S, 20 * MOST_LINK_S / most_at_one)
    found = {}
    for one, other in mine:
        serve = transport.rank == one
        peer = other if serve else one
        found[peer] = measure_link(transport, peer, budget_s, serve=serve)
    return found


def measure_link(transport: Transport, peer: int, budget_s: float, *, serve: bool) -> tuple[float, float]:
    """(bytes a second, seconds of latency) of the link to a rank that calls this, too, one of them with ``serve``.

    One growing payload there and back, as large as the budget allows; a shaped link lets a burst pass at full speed, so
    the two largest tell what it does beyond.
    Both ranks return the same figures.
    """
    transport.send_note(peer, Kind.STATISTICS, 0)  # both are here: until then they wait politely
    transport.receive_note(peer, Kind.STATISTICS)
    started = time.perf_counter()
    payload = np.zeros(_MOST_BYTES, np.uint8)
    sizes = [1, 1, 1, _FIRST_BYTES]
    samples: list[tuple[int, float]] = []
    while sizes:
        n_bytes = sizes.pop(0)
        begun = time.perf_counter()
        transport.bounce(peer, payload[:n_bytes], serve=serve)
        samples.append((n_bytes, (time.perf_counter() - begun) / 2))
        if not sizes:
            sizes = [_next_size(samples, budget_s - (time.perf_counter() - started))] if serve else [0]
            control = np.array(sizes, np.int64).view(np.uint8)
            transport.bounce(peer, control, serve=serve)
            sizes = [n for n in control.view(np.int64).tolist() if 0 < n <= _MOST_BYTES]
    seconds = {n: median(t for size, t in samples if size == n) for n in sorted({n for n, _ in samples})}
    (*_, (before, before_s), (largest, largest_s)) = seconds.items()
    latency_s = min(t for n, t in samples if n == 1)
    whole = largest / max(largest_s - latency_s, 1e-9)
    beyond_burst = (largest - before) / max(largest_s - before_s, 1e-9)
    told = np.array([max(min(whole, beyond_burst), whole / _MOST_BURST), latency_s])
    control = told.view(np.uint8)
    transport.bounce(peer, control, serve=serve)
    bytes_per_s, latency_s = control.view(np.float64).tolist()
    return bytes_per_s, latency_s


def _next_size(samples: list[tuple[int, float]], left_s: float) -> int:
    """Bytes of the next payload; 0 where there is no time for one that would tell more."""
    n_bytes, one_way_s = samples[-1]
    if n_bytes == _MOST_BYTES:
        done = [seconds for n, seconds in samples if n == n_bytes]
        return n_bytes if len(done) < _FEW and 2 * sum(done) < min(_FEW_S, left_s) else 0
    fits = int(n_bytes * left_s / (2 * one_way_s))
    return min(4 * n_bytes, fits, _MOST_BYTES) if fits > 1.5 * n_bytes else 0


def _warm_up() -> None:
    """Compile, or load, the kernels of all codecs."""
    for kind, n_bytes in ((Kind.VISIBILITY, 64), (Kind.RENDER_POINTS, 1024), (Kind.FRAMEBUFFER, 0)):
        payload = np.zeros(n_bytes, np.uint8)
        if kind is Kind.FRAMEBUFFER:
            from ..shared.framebuffer_runs import encode_runs

            payload = encode_runs(np.zeros(64, np.uint64))
        packed = pack(kind, payload.data, zstd=has_zstd())
        if packed is not None:
            unpack(kind, packed.data, len(payload))


def _rate(bytes_per_s: float) -> str:
    return f"{1e-9 * bytes_per_s:.1f} GB/s" if bytes_per_s >= 1e9 else f"{1e-6 * bytes_per_s:.3g} MB/s"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"
