"""``splatpipe bench compositing``: policies beside each other on the ranks that can be started here, and the model.

Ranks draw nothing: their words are random runs. Policies take turns frame by frame; a frame lasts from when all ranks
begin until the root has the picture. The model goes by links, merging and encoding measured in the same run, is held
against what was measured, and says what 32 768 processes of a Blue Gene/P would take.

Source: Kendall, Peterka, Huang, Shen, Ross, "Accelerating and Benchmarking Radix-k Image Compositing at Large Scale",
EGPGV 2010, abstract.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...shared.errors import InputError
from ...shared.files import write_whole
from ..compositing.choose import COVERAGE, RATES
from ..compositing.model import POLICIES, Rates, cheapest, compositing_cost
from ..launch import inside_mpi, launch
from ..progress import FrameProgress
from ..record import machine_record
from .compositing_ranks import RUN_PX

PAPER = {"processes": 32_768, "pixels": 64 * 10**6, "seconds": 0.08}
"""Of radix-k with bounds and run lengths: 64 megapixels in 0.08 s on 32 K processes."""

BLUE_GENE_P = {"latency_s": 3e-6, "message_s": 1e-6, "bytes_per_s": 425e6}
"""Assumed, not measured: a link of the torus carries 425 MB/s a way; latency and overhead are round figures."""

MOST_RANKS = 64
_MOST_PX = 16384
_SCALES = tuple(2**e for e in range(1, 18))


def bench_compositing(
    *,
    ranks: Sequence[int] = (2, 4),
    sizes: Sequence[tuple[int, int]] = ((1280, 720),),
    coverages: Sequence[float] = (0.1, 0.5),
    policies: Sequence[str] = POLICIES,
    radix: int = 8,
    frames: int = 15,
    empty: float = 0.0,
) -> dict[str, Any]:
    """Measure on ranks started here.

    ranks : numbers of ranks, each at least 2.  sizes : width and height, pixels.  coverages : shares of the pixels that
    a rank has drawn on, above 0.  frames : timed frames of each policy.  empty : share of the ranks, the last ones,
    that have drawn nothing; the model takes all to have drawn less.

    Returns a JSON-able dict: ``rows``, one for each number of ranks, size, coverage and policy; ``rates`` of the model;
    ``extrapolated``; the machine. Raises InputError within mpiexec, DeviceError without MPI, SystemExit where a rank
    has failed and said why.
    """
    if inside_mpi():
        raise InputError("mpiexec: found, expected splatpipe bench to be started without: it starts its own ranks")
    cases: dict[str, Any] = {"sizes": sizes, "coverages": coverages, "policies": list(policies)}
    cases |= {"radix": radix, "frames": frames}
    rows: list[dict[str, Any]] = []
    at_once = len(os.sched_getaffinity(0))
    with FrameProgress(len(ranks) + 1) as progress:
        progress.show("links and merging", 0)
        told = _run_ranks(2, cases | {"sizes": sizes[:1], "policies": [], "rates": True, "n_drawing": 2})
        rates = Rates(**told["rates"], at_once=at_once)
        for done, n in enumerate(ranks):
            progress.show(f"{n} ranks", 1 + done)
            rows += _run_ranks(n, cases | {"rates": False, "n_drawing": n - int(n * empty)})["rows"]
    for row in rows:
        n, n_pixels = row["ranks"], row["width"] * row["height"]
        coverage = row["coverage"] * row["n_drawing"] / n
        cost = compositing_cost(row["policy"], n, n_pixels, coverage, rates, radix=radix, run_px=RUN_PX)
        row["model"] = cost._asdict() | {"ms": 1e3 * cost.seconds}
        row["auto"] = row["policy"] == cheapest(n, n_pixels, COVERAGE, RATES, radix)
    return {
        "benchmark": "compositing",
        "radix": radix,
        "frames": frames,
        "run_px": RUN_PX,
        "rows": rows,
        "rates": dataclasses.asdict(rates),
        "extrapolated": extrapolated(rates, radix),
        "paper": PAPER,
        "machine": machine_record(),
    }


def parse_cases(ranks: str, sizes: str, percent: Sequence[float], policies: str) -> dict[str, Any]:
    """Arguments of ``bench_compositing`` from those of the command line; InputError for what is none."""
    numbers = [_whole(part, "--ranks", 2, MOST_RANKS) for part in ranks.split(",")]
    pictures = []
    for part in sizes.split(","):
        width, cross, height = part.partition("x")
        if not cross:
            raise InputError(f"--sizes {part!r}: expected WIDTHxHEIGHT")
        pictures.append((_whole(width, "--sizes", 1, _MOST_PX), _whole(height, "--sizes", 1, _MOST_PX)))
    if max(percent) > 100:
        raise InputError(f"--coverages: found {max(percent):g}, expected at most 100")
    chosen = policies.split(",") if policies else list(POLICIES)
    for policy in chosen:
        if policy not in POLICIES:
            raise InputError(f"--policies {policy!r}: expected one of {', '.join(POLICIES)}")
    return {"ranks": numbers, "sizes": pictures, "coverages": [share / 100 for share in percent], "policies": chosen}


def _whole(text: str, option: str, least: int, most: int) -> int:
    if not (text.strip().isdecimal() and least <= int(text) <= most):
        raise InputError(f"{option} {text!r}: expected a whole number, {least} to {most}")
    return int(text)


def extrapolated(rates: Rates, radix: int) -> list[dict[str, Any]]:
    """The paper's case by the model: links of a Blue Gene/P as assumed, merging and encoding as measured here.

    Twice: each process draws on all pixels, and on n^(-2/3) of them, as blocks of a volume cut into n cubes cover. One
    dict for each coverage and policy: ``parts_s`` until each process holds its part, ``bounded_s`` the same without the
    passes over pixels that find what is drawn, as where bounds are known (both None where a policy makes no parts),
    ``root_s`` until one process has all.
    """
    there = dataclasses.replace(rates, **BLUE_GENE_P, at_once=float("inf"))
    unscanned = dataclasses.replace(there, scan_per_s=float("inf"))
    n, n_pixels = PAPER["processes"], PAPER["pixels"]
    rows = []
    for coverage in (1.0, n ** (-2 / 3)):
        for policy in POLICIES:
            whole, parts, bounded = (
                compositing_cost(policy, n, n_pixels, coverage, rates, radix=radix, gather=gather, run_px=RUN_PX)
                for rates, gather in ((there, True), (there, False), (unscanned, False))
            )
            has_parts = policy not in ("direct", "mpi-min")
            rows.append(
                {
                    "policy": policy,
                    "coverage": coverage,
                    "parts_s": parts.seconds if has_parts else None,
                    "bounded_s": bounded.seconds if has_parts else None,
                    "root_s": whole.seconds,
                    "rank_bytes": whole.rank_bytes,
                    "rank_messages": whole.rank_messages,
                }
            )
    return rows


def _run_ranks(n: int, cases: dict[str, Any]) -> dict[str, Any]:
    told: dict[str, Any] = {}
    status = launch([json.dumps(cases)], n, told.update, module="splatpipe.cluster.bench.compositing_ranks")
    if status:
        sys.exit(status)
    return told


def print_compositing(found: dict[str, Any], console: Any) -> None:
    """What was measured beside the model, and the paper's case."""
    from rich.table import Table

    table = Table(title=f"Compositing, {found['frames']} frames of each policy taking turns, radix {found['radix']}")
    for name in (
        "ranks",
        "pixels",
        "drawn",
        "policy",
        "ms (min – p95)",
        "model ms",
        "model",
        "CPU ms",
        "MB a rank",
        "messages",
    ):
        table.add_column(name, justify="left" if name == "policy" else "right")
    case = None
    for row in found["rows"]:
        ms, counted = row["ms"], row["policy"] != "mpi-min"
        sent = row if counted else row["model"]
        same = tuple(row[key] for key in ("ranks", "width", "height", "coverage"))
        if case not in (None, same):
            table.add_section()
        case = same
        table.add_row(
            str(row["ranks"]) + (f" ({row['n_drawing']} drew)" if row["n_drawing"] < row["ranks"] else ""),
            f"{row['width']}×{row['height']}",
            f"{row['coverage']:.0%}",
            row["policy"] + (" ← auto" if row["auto"] else "") + ("" if row["same_bits"] else ": OTHER BITS"),
            f"{ms['median']:.2f} ({ms['min']:.2f} – {ms['p95']:.2f})",
            f"{row['model']['ms']:.2f}",
            f"× {row['model']['ms'] / ms['median']:.2f}",
            f"{row['cpu_ms']:.2f}",
            f"{sent['rank_bytes'] / 1e6:.2f}" + ("" if counted else " *"),
            f"{sent['rank_messages']:.0f}" + ("" if counted else " *"),
        )
    console.print(table)
    rates = found["rates"]
    console.print(
        f"measured here: {rates['latency_s'] * 1e6:.0f} µs until a message is taken, {rates['message_s'] * 1e6:.0f} µs "
        f"of work on it, {rates['bytes_per_s'] / 1e9:.2f} GB/s, {rates['merge_per_s'] / 1e6:.0f} M words/s merged, "
        f"{rates['scan_per_s'] / 1e6:.0f} M pixels/s encoded, {rates['at_once']:g} ranks at once; CPU: of all ranks, "
        "which other load changes little; MB and messages: the most that a rank sends; *: by the model"
    )
    paper = found["paper"]
    table = Table(
        title=f"By the model: {paper['processes']:,} processes, {paper['pixels'] / 1e6:.0f} Mpixel, BG/P links"
    )
    for name in ("drawn", "policy", "parts, s", "paper", "bounds known, s", "at the root, s", "MB a rank", "messages"):
        table.add_column(name, justify="left" if name == "policy" else "right")
    for row in found["extrapolated"]:
        parts = row["parts_s"]
        table.add_row(
            f"{row['coverage']:.2%}",
            row["policy"],
            "–" if parts is None else f"{parts:.3f}",
            f"{paper['seconds']} (× {parts / paper['seconds']:.2f})" if row["policy"] == "radix-k" else "–",
            "–" if parts is None else f"{row['bounded_s']:.3f}",
            f"{row['root_s']:.3f}",
            f"{row['rank_bytes'] / 1e6:.2f}",
            f"{row['rank_messages']:,.0f}",
        )
    console.print(table)
    console.print(
        f"assumed: links of {BLUE_GENE_P['bytes_per_s'] / 1e6:.0f} MB/s, latency {BLUE_GENE_P['latency_s'] * 1e6:g} "
        f"µs, {BLUE_GENE_P['message_s'] * 1e6:g} µs of work a message, no contention; merging and encoding as here "
        "(its cores were slower); the paper's time is taken to be that of parts; bounds known: pixels outside those "
        "that a rank has drawn on are not looked at"
    )
    machine = found["machine"]
    console.print(f"{machine['cpu']}, {machine['cores']} cores, commit {machine['commit'] or 'unknown'}")


def plot_compositing(found: dict[str, Any], path: Path) -> None:
    """Measured against modelled times, and the model from 2 to 131 072 ranks with the paper's figure, as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    there = dataclasses.replace(Rates(**found["rates"]), **BLUE_GENE_P, at_once=float("inf"))
    for policy in POLICIES:
        rows = [row for row in found["rows"] if row["policy"] == policy]
        (line,) = left.plot([r["ms"]["median"] for r in rows], [r["model"]["ms"] for r in rows], "o", label=policy)
        if policy in ("direct", "mpi-min"):
            continue
        seconds = [
            compositing_cost(
                policy, n, PAPER["pixels"], n ** (-2 / 3), there, radix=found["radix"], gather=False, run_px=RUN_PX
            ).seconds
            for n in _SCALES
        ]
        right.plot(_SCALES, seconds, "-", color=line.get_color(), label=policy)
    ends = [f(v) for f in (min, max) for v in [[r["ms"]["median"] for r in found["rows"]]]]
    left.plot(ends, ends, "k:", linewidth=1)
    left.set(title="here", xlabel="measured, ms", ylabel="model, ms", xscale="log", yscale="log")
    right.plot(PAPER["processes"], PAPER["seconds"], "k*", markersize=11, label="Kendall et al. 2010")
    right.set(title="64 Mpixel, links of a BG/P (assumed)", xlabel="ranks", ylabel="s", xscale="log", yscale="log")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    write_whole(path, lambda part: figure.savefig(part, format="png", dpi=120))
