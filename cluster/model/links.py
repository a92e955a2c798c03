"""What messages between two ranks cost: ping-pong over several sizes, fitted as latency + bytes / bandwidth.

Twice: with MPI alone, and through the program's ``Transport``, whose ranks sleep while they wait and so answer later.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ...shared.messages import Kind, VisibilityBits
from ..transport import Transport
from .fit import fit_latency_and_rate

SIZES_BYTES = (0, 1 << 10, 1 << 14, 1 << 17, 1 << 20, 1 << 22)
_REPEATS = 30
_SIZE_S = 0.15
"""A size stops after this long, but not before three round trips."""
_SOFTWARE_REPEATS = 30
_PATIENT_REPEATS = 15
_PATIENCE_S = 10e-3


def measure_links(transport: Transport) -> list[dict[str, Any]]:
    """Every pair of ranks, one pair after the other while the others wait politely; on rank 0, elsewhere empty.

    Collective. Returns one dict a pair: sender, receiver, the fields of ``Link`` and the samples.
    """
    found = []
    for one in range(transport.size):
        for other in range(one + 1, transport.size):
            transport.meet()
            link = None
            if transport.rank in (one, other):
                link = _measure_pair(transport, other if transport.rank == one else one, serve=transport.rank == one)
            if transport.rank == one and one > 0:
                transport.send_note(0, Kind.STATISTICS, 0, link)
            if transport.rank == 0:
                found.append(link if one == 0 else transport.receive_note(one, Kind.STATISTICS)[1])
    transport.meet()
    return found if transport.rank == 0 else []


def _measure_pair(transport: Transport, peer: int, *, serve: bool) -> dict[str, Any]:
    samples: dict[str, list[float]] = {"raw": [], "polite": []}
    for n_bytes in SIZES_BYTES:
        payload = np.zeros(n_bytes, np.uint8)

        def raw(payload: np.ndarray = payload) -> None:
            transport.bounce(peer, payload, serve=serve)

        def polite(payload: np.ndarray = payload) -> None:
            message = VisibilityBits(0, 8 * len(payload), payload)
            if serve:
                transport.send(peer, message)
            transport.receive(peer, Kind.VISIBILITY, len(payload))
            if not serve:
                transport.send(peer, message)

        for name, exchange in (("raw", raw), ("polite", polite)):
            samples[name].append(_one_way_s(transport, peer, exchange, serve=serve))
    fits = {name: fit_latency_and_rate(SIZES_BYTES, seconds) for name, seconds in samples.items()}
    return {
        "sender": transport.rank,
        "receiver": peer,
        "latency_s": fits["raw"].latency_s,
        "bytes_per_s": fits["raw"].per_s,
        "software_latency_s": _software_latency_s(transport, peer, serve=serve),
        "polite_latency_s": _patient_latency_s(transport, peer, samples["polite"][0], serve=serve),
        "polite_bytes_per_s": fits["polite"].per_s,
        "sizes_bytes": list(SIZES_BYTES),
        "one_way_s": samples,
        "worst_residual": {name: fit.worst_residual for name, fit in fits.items()},
    }


def _one_way_s(transport: Transport, peer: int, exchange: Callable[[], None], *, serve: bool) -> float:
    """Half the median round trip. Both ranks must do as many, so the server says how many after a trial."""
    start = time.perf_counter()
    for _ in range(3):
        exchange()
    if serve:
        trial_s = (time.perf_counter() - start) / 3
        repeats = int(min(max(_SIZE_S / trial_s, 3), _REPEATS))
        transport.send_note(peer, Kind.FRAME_DONE, repeats)
    else:
        repeats = transport.receive_note(peer, Kind.FRAME_DONE)[0]
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        exchange()
        times.append(time.perf_counter() - start)
    return float(np.median(times)) / 2


def _patient_latency_s(transport: Transport, peer: int, prompt_s: float, *, serve: bool) -> float:
    """Seconds until a rank that has waited for ``_PATIENCE_S`` takes an empty message: it sleeps longer by then.

    prompt_s : the same for a rank that has just begun to wait, as for the answer.
    """
    times = []
    for _ in range(_PATIENT_REPEATS):
        if serve:
            time.sleep(_PATIENCE_S)
            start = time.perf_counter()
            transport.send_note(peer, Kind.FRAME_DONE, 0)
            transport.receive_note(peer, Kind.FRAME_DONE)
            times.append(time.perf_counter() - start)
        else:
            transport.receive_note(peer, Kind.FRAME_DONE)
            transport.send_note(peer, Kind.FRAME_DONE, 0)
    return max(float(np.median(times)) - prompt_s, prompt_s) if serve else 0.0


def _software_latency_s(transport: Transport, peer: int, *, serve: bool) -> float:
    """Median time in ``send`` plus median time in ``receive`` of an empty message that has arrived."""
    times = []
    for sends in (serve, not serve):  # both ranks do both, the server first
        spent = []
        for _ in range(_SOFTWARE_REPEATS):
            if sends:
                start = time.perf_counter()
                transport.send_note(peer, Kind.FRAME_DONE, 0)
                spent.append(time.perf_counter() - start)
                transport.receive_note(peer, Kind.STATISTICS)  # taken: the next may be sent
            else:
                while not transport.has_note(peer, Kind.FRAME_DONE):
                    time.sleep(50e-6)
                start = time.perf_counter()
                transport.receive_note(peer, Kind.FRAME_DONE)
                spent.append(time.perf_counter() - start)
                transport.send_note(peer, Kind.STATISTICS, 0)
        times.append(float(np.median(spent)))
    return sum(times)
