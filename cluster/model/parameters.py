# ruff: noqa: RUF009 - _parameter is dataclasses.field, with metadata that every parameter must have
"""System and application parameters of thesis Table 3-1, each with its symbol, its unit and where its value is from.

The fields of these classes are the one place that states a parameter: the file format, the report and the checks are
made from them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import Field, dataclass, field, fields
from enum import StrEnum
from typing import Any


class Source(StrEnum):
    """Where a value comes from, or why there is none."""

    MEASURED = "measured"
    FILE = "file"
    DERIVED = "derived"  # from the configuration, the scene or other parameters
    NOT_APPLICABLE = "not applicable"  # this run has no such device or does no such thing
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Quantity:
    """A value ≥ 0, in the unit of its parameter; None where its source says why there is none."""

    value: float | None
    source: Source
    note: str = ""


NOT_APPLICABLE = Quantity(None, Source.NOT_APPLICABLE)
UNKNOWN = Quantity(None, Source.UNKNOWN)


def measured(value: float, note: str = "") -> Quantity:
    """A measured value."""
    return Quantity(float(value), Source.MEASURED, note)


def derived(value: float, note: str = "") -> Quantity:
    """A value that follows from configuration, scene or other parameters."""
    return Quantity(float(value), Source.DERIVED, note)


def _parameter(symbol: str, unit: str, meaning: str) -> Any:
    return field(metadata={"symbol": symbol, "unit": unit, "meaning": meaning})


def parameters(owner: Any) -> Iterator[Field[Quantity]]:
    """The fields of a class (or an instance) here that are parameters, in the order of the thesis's table."""
    return (item for item in fields(owner) if "symbol" in item.metadata)


@dataclass(frozen=True)
class RankSystem:
    """What a rank's machine can do: Table 3-1 A, 1–7. CPU and memory rates are of one core."""

    role: str
    cpu_flop_per_s: Quantity = _parameter("S_CPU", "flop/s", "float64 multiply-adds of one core, two operations each")
    cpu_float32_flop_per_s: Quantity = _parameter("S_CPU float32", "flop/s", "the same in float32")
    gpu_flop_per_s: Quantity = _parameter("S_GPU", "flop/s", "multiply-adds on the GPU")
    memory_bytes: Quantity = _parameter("Mem_mm", "bytes", "main memory")
    cache_bytes: Quantity = _parameter("Mem_ca", "bytes", "last-level cache")
    video_memory_bytes: Quantity = _parameter("Mem_vdo", "bytes", "memory of the graphics card")
    gpu_down_latency_s: Quantity = _parameter("l_d", "s", "latency CPU → GPU")
    gpu_down_bytes_per_s: Quantity = _parameter("B_d", "bytes/s", "bandwidth CPU → GPU")
    gpu_up_latency_s: Quantity = _parameter("l_u", "s", "latency GPU → CPU")
    gpu_up_bytes_per_s: Quantity = _parameter("B_u", "bytes/s", "bandwidth GPU → CPU")
    memory_latency_s: Quantity = _parameter("l_m", "s", "dependent read from main memory (uncached)")
    memory_bytes_per_s: Quantity = _parameter("B_m", "bytes/s", "reading main memory (uncached)")
    cache_latency_s: Quantity = _parameter("l_m cached", "s", "dependent read from the caches")
    cache_bytes_per_s: Quantity = _parameter("B_m cached", "bytes/s", "reading the caches")


@dataclass(frozen=True)
class Link:
    """What messages between two ranks cost: Table 3-1 A-8 and B-10."""

    sender: int
    receiver: int
    latency_s: Quantity = _parameter("l_e", "s", "one message of no bytes, MPI alone")
    bytes_per_s: Quantity = _parameter("B_e", "bytes/s", "bandwidth, MPI alone")
    software_latency_s: Quantity = _parameter("l_es", "s", "time in send and receive of an empty message that is there")
    polite_latency_s: Quantity = _parameter("l_e polite", "s", "one empty message to a rank that has waited for 10 ms")
    polite_bytes_per_s: Quantity = _parameter("B_e polite", "bytes/s", "bandwidth to a rank that sleeps as it waits")


@dataclass(frozen=True)
class System:
    """The cluster: one ``RankSystem`` a rank (P_n of them) and the links between them."""

    ranks: tuple[RankSystem, ...]
    links: tuple[Link, ...]

    def link(self, one: int, other: int) -> Link | None:
        """The link from one rank to another, else the one back; None if nobody measured either."""
        links = {(link.sender, link.receiver): link for link in self.links}
        return links.get((one, other)) or links.get((other, one))


@dataclass(frozen=True)
class RankLoad:
    """What a rank does in a frame, at most: Table 3-1 B."""

    role: str
    framebuffer_bytes: Quantity = _parameter("D_FB", "bytes", "framebuffer")
    read_back_share: Quantity = _parameter("η", "1", "share of the framebuffer read back from the GPU")
    read_backs: Quantity = _parameter("N_FB", "1/frame", "read-backs of the framebuffer")
    cpu_bytes: Quantity = _parameter("D_CP", "bytes/frame", "data processed on the CPU")
    operations_per_byte: Quantity = _parameter(
        "O_CPU", "flop/byte", "work on the CPU a byte of D_CP, as multiply-adds of S_CPU that take as long"
    )
    jumps: Quantity = _parameter("N_m", "1/frame", "reads of memory that do not follow the one before")
    vertices: Quantity = _parameter("D_VP", "1/frame", "points drawn")
    vertex_bytes: Quantity = _parameter("D_VP", "bytes/frame", "data sent to the GPU to draw them")
    vertices_per_s: Quantity = _parameter("O_VP", "1/s", "points drawn one pixel large, by the rasterizer in use")
    fragments: Quantity = _parameter("D_FP", "1/frame", "pixels that points cover, hidden ones included")
    fragments_per_s: Quantity = _parameter("O_FP", "1/s", "pixels filled by large squares, by the rasterizer in use")
    primitives: Quantity = _parameter("N_D", "1/frame", "primitives sent one by one (immediate mode)")


@dataclass(frozen=True)
class Traffic:
    """What one rank sends to another in a frame, at most: Table 3-1 B-9."""

    sender: int
    receiver: int
    messages: Quantity = _parameter("N_e", "1/frame", "messages")
    bytes: Quantity = _parameter("D_e", "bytes/frame", "data, headers included")


def is_frame_rate(value: float) -> bool:
    """Whether a frame rate and the time of a frame are both finite and above 0."""
    return 0 < value < math.inf and 1 / value < math.inf


@dataclass(frozen=True)
class Application:
    """What is asked of the cluster: the frame rate F and each rank's and link's load."""

    frames_per_s: float
    ranks: tuple[RankLoad, ...]
    traffic: tuple[Traffic, ...]
