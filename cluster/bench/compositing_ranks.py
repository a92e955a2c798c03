"""One rank's part of ``bench compositing``, which starts it: policies take turns frame by frame.

``python -m splatpipe.cluster.bench.compositing_ranks CASES``; CASES is JSON: ``sizes`` [[width, height], …],
``coverages``, ``policies``, ``radix``, ``frames``, ``n_drawing``, the number of ranks that have drawn something, and
``rates``, whether to measure links and merging as well.
Rank 0 sends the launcher the record ``rows``, and ``rates``.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

import numpy as np

from ...shared.framebuffer_runs import encode_runs, merge_runs
from ...shared.messages import FRAMEBUFFER_EMPTY, Kind
from ..compositing import make_compositor
from ..launch import record, say_failed
from ..record import spread_ms
from ..transport import Transport

RUN_PX = 16
"""Pixels of a run of drawn ones."""

_TIMEOUT_S = 60.0
_WARM_FRAMES = 2
_START_S = 2e-3
_REPEATS = 9


def drawn_words(rank: int, n_pixels: int, coverage: float) -> np.ndarray:
    """(n,) uint64: random runs of ``RUN_PX`` pixels on a share of the pixels, independent of other ranks."""
    rng = np.random.default_rng((rank, n_pixels))
    words = rng.integers(0, 2**62, n_pixels, np.uint64)
    is_drawn = rng.random(-(-n_pixels // RUN_PX)) < coverage
    words[~np.repeat(is_drawn, RUN_PX)[:n_pixels]] = FRAMEBUFFER_EMPTY
    return words


def main(cases: dict[str, Any]) -> None:
    """One rank's part. Collective."""
    transport = Transport(_TIMEOUT_S)
    record(rank=transport.rank, role="compositing", pid=os.getpid())
    try:
        rates = _measure_rates(transport, cases) if cases["rates"] else None
        rows = [
            row
            for width, height in cases["sizes"]
            for coverage in cases["coverages"]
            for row in _measure(transport, width, height, coverage, cases)
        ]
        transport.finish()
        if transport.rank == 0:
            record(rows=rows, rates=rates)
    except BaseException as error:
        status = getattr(error, "exit_status", 1)
        say_failed(f"rank {transport.rank} (compositing): {error or type(error).__name__}", status)
        transport.abort(status)


def _measure(
    transport: Transport, width: int, height: int, coverage: float, cases: dict[str, Any]
) -> list[dict[str, Any]]:
    """One row a policy, on rank 0; elsewhere rows without use."""
    ranks = range(transport.size)
    mine = coverage if transport.rank < cases["n_drawing"] else 0.0
    words = drawn_words(transport.rank, width * height, mine).reshape(height, width)
    compositors = {name: make_compositor(name, transport, ranks, radix=cases["radix"]) for name in cases["policies"]}
    times: dict[str, list[float]] = {name: [] for name in compositors}
    spent = {name: np.zeros(3) for name in compositors}
    pictures: dict[str, np.ndarray] = {}
    frame = 0
    for turn in range(_WARM_FRAMES + cases["frames"]):
        for name, compositor in compositors.items():
            started = _start_together(transport)
            before = _spent(transport)
            whole = compositor.composite(frame, words)
            times[name].append(time.perf_counter() - started)
            if turn >= _WARM_FRAMES:
                spent[name] += _spent(transport) - before
            frame += 1
            if whole is not None and turn == 0:
                pictures[name] = whole.copy()
    rows = []
    for name in compositors:
        each = transport.join(spent[name] / cases["frames"]).reshape(-1, 3)
        first = next(iter(pictures.values()), None)
        rows.append(
            {
                "ranks": transport.size,
                "n_drawing": cases["n_drawing"],
                "width": width,
                "height": height,
                "coverage": coverage,
                "policy": name,
                "ms": spread_ms(times[name][_WARM_FRAMES:]),
                "rank_bytes": float(each[:, 0].max()),
                "rank_messages": float(each[:, 1].max()),
                "all_bytes": float(each[:, 0].sum()),
                "cpu_ms": 1e3 * float(each[:, 2].sum()),
                "same_bits": first is None or np.array_equal(pictures[name], first),
            }
        )
    return rows


def _start_together(transport: Transport) -> float:
    """When all ranks, which share a host and its clock, begin. Collective."""
    transport.meet()
    start = float(transport.join(np.array([time.perf_counter() + _START_S])).max())
    time.sleep(max(start - time.perf_counter(), 0))
    return start


def _spent(transport: Transport) -> np.ndarray:
    """Bytes and number of the framebuffers that this rank has sent, and the CPU time it has taken, s."""
    of = transport.traffic().get(Kind.FRAMEBUFFER.name, {"bytes": 0, "count": 0})
    return np.array([of["bytes"], of["count"], time.process_time()])


def _measure_rates(transport: Transport, cases: dict[str, Any]) -> dict[str, float] | None:
    """The fields of ``Rates`` between ranks 0 and 1, and of rank 0 while the others sleep; None on other ranks."""
    from ..model.links import measure_links

    links = measure_links(transport)
    found = None
    if transport.rank == 0:
        (width, height), scanned, merged = cases["sizes"][0], [], []
        for coverage in cases["coverages"]:
            words = drawn_words(0, width * height, coverage)
            ours = drawn_words(1, width * height, coverage)
            runs = encode_runs(words)
            filled = int(np.count_nonzero(words != FRAMEBUFFER_EMPTY))
            scanned.append(len(words) / _median_s(lambda words=words: encode_runs(words)))
            if filled:
                merged.append(filled / _median_s(lambda runs=runs, ours=ours: merge_runs(runs.data, ours)))
        link = links[0]
        found = {
            "latency_s": link["one_way_s"]["polite"][0],
            "bytes_per_s": link["polite_bytes_per_s"],
            "message_s": link["software_latency_s"],
            "scan_per_s": float(np.mean(scanned)),
            "merge_per_s": float(np.mean(merged)),
        }
    transport.meet()
    return found


def _median_s(work: Any) -> float:
    work()
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
