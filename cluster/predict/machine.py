"""What a run has: cores, and the links between hosts, as said or as measured by ranks on them."""

from __future__ import annotations

import json
import math
import os
import platform
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...shared.errors import SplatpipeError
from ...shared.files import write_json
from ...shared.messages import Kind
from ..launch import launch, record, say_failed

LINK_BYTES = (1 << 19, 1 << 21)
"""Sizes whose difference gives the bandwidth of a link: what a shaped or buffered link lets pass at once falls out."""
ROUND_TRIPS = 5


@dataclass(frozen=True)
class Machine:
    """Hosts that ranks are dealt to in turn.

    cores : that the ranks of a host share; of all hosts, where they share them.
    bandwidth_bytes_per_s : of messages between ranks of a host.
    speed : of a core, 1 being the measured one.
    hosts : with ranks on them; one more rank than hosts goes to the first again.
    link_bytes_per_s : of a host's link, each way; all its messages from and to other hosts pass it.
    link_latency_s : of a message between hosts, beyond the software latency of the ranks.
    shared_cores : hosts are names of one machine, as network namespaces are.
    """

    cores: int
    bandwidth_bytes_per_s: float = 10e9
    speed: float = 1.0
    hosts: int = 1
    link_bytes_per_s: float = math.inf
    link_latency_s: float = 0.0
    shared_cores: bool = False

    def host_of(self, rank: int) -> int:
        """Number of the host that a rank is on."""
        return rank % self.hosts

    def pool_of(self, rank: int) -> int:
        """Number of the pool of cores that a rank works on."""
        return 0 if self.shared_cores else self.host_of(rank)


def measured_machine(ranks: int) -> Machine:
    """The machine that ``ranks`` ranks of this launcher find themselves on, the link of its first two hosts measured.

    Raises SplatpipeError if a rank fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "machine.json"
        if launch(["machine-rank", str(out)], ranks, lambda _: None):
            raise SplatpipeError("measuring links: a rank failed")
        found = json.loads(out.read_text())
    hosts = list(dict.fromkeys(rank["host"] for rank in found["ranks"]))
    kernels = {rank["kernel"] for rank in found["ranks"]}
    cores = min(rank["cores"] for rank in found["ranks"])
    if found["link"] is None:
        return Machine(cores)
    return Machine(
        cores,
        hosts=len(hosts),
        link_bytes_per_s=found["link"]["bytes_per_s"],
        link_latency_s=found["link"]["latency_s"],
        shared_cores=len(kernels) == 1,
    )


def machine_rank(out: Path) -> None:
    """One rank's part of ``measured_machine``, which starts it; rank 0 writes ``out``. Collective."""
    from ..transport import Transport

    transport = Transport(120.0)
    rank = transport.rank
    record(rank=rank, role="measuring", pid=os.getpid())
    try:
        mine = {"host": platform.node(), "kernel": _kernel(), "cores": len(os.sched_getaffinity(0))}
        if rank:
            transport.send_note(0, Kind.STATISTICS, 0, mine)
            other = transport.receive_note(0, Kind.STATISTICS)[1]["other"]
        else:
            ranks = [mine] + [transport.receive_note(r, Kind.STATISTICS)[1] for r in range(1, transport.size)]
            other = next((r for r, of in enumerate(ranks) if of["host"] != mine["host"]), 0)
            for r in range(1, transport.size):
                transport.send_note(r, Kind.STATISTICS, 0, {"other": other})
        link = _link(transport, other if rank == 0 else 0, serve=rank == 0) if other and rank in (0, other) else None
        if rank == 0:
            write_json(out, {"ranks": ranks, "link": link})
        transport.finish()
    except BaseException as error:
        say_failed(f"rank {rank} (measuring): {error or type(error).__name__}", getattr(error, "exit_status", 1))
        transport.abort(getattr(error, "exit_status", 1))


def _kernel() -> str:
    """The same on all names of one machine, another after it has started again."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def _link(transport: Any, peer: int, *, serve: bool) -> dict[str, float]:
    """Latency and bandwidth of a link between two ranks, by round trips. Of several the fastest counts."""
    one_way = []
    for size in (0, *LINK_BYTES):
        payload = np.zeros(size, np.uint8)
        times = []
        for _ in range(ROUND_TRIPS):
            started = time.perf_counter()
            transport.bounce(peer, payload, serve=serve)
            times.append(time.perf_counter() - started)
        one_way.append(float(np.median(times)) / 2)
    empty, less, more = one_way
    return {"latency_s": empty, "bytes_per_s": (LINK_BYTES[1] - LINK_BYTES[0]) / max(more - less, 1e-9)}
