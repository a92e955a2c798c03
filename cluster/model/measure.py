"""Measuring on the ranks that will run: who starts them, and what each of them does.

One rank works at a time while the others sleep, so that nobody is measured while another takes the cores. Machine
probes run once a host: ranks that share one share the figures.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ...shared.config import load_config
from ...shared.files import write_json
from ...shared.messages import Kind
from ..job import Job
from ..launch import launch, record, say_failed
from . import probes
from .fit import fit_latency_and_rate
from .parameters import NOT_APPLICABLE, UNKNOWN, Link, Quantity, RankSystem, System, measured, parameters

_TIMEOUT_S = 120.0


def measure_ranks(config: Path, overrides: list[str], roles: list[str], rasterizer: str) -> dict[str, Any]:
    """What ranks of these roles measure: ``ranks`` (one dict each), ``render`` (rates), ``links`` (one a pair).

    rasterizer : the one that the run drew with. One rank needs no MPI: it is this process.
    Raises SystemExit if a rank fails, which has said why.
    """
    if len(roles) == 1:
        machine = _machine()
        return {"ranks": [machine], "render": _render(config, overrides, rasterizer), "links": []}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "measured.json"
        arguments = ["model-rank", str(config), str(out), rasterizer, str(roles.index("render"))]
        arguments += [part for item in overrides for part in ("--set", item)]
        status = launch(arguments, len(roles), lambda _: None)
        if status:
            sys.exit(status)  # the rank that failed has said why
        return json.loads(out.read_text())


def rank_command(config: Path, overrides: list[str], out: Path, rasterizer: str, render_rank: int) -> None:
    """One rank's part of ``measure_ranks``, called on each rank by ``mpiexec``; rank 0 writes ``out``. Collective."""
    from ..transport import Transport
    from .links import measure_links

    transport = Transport(_TIMEOUT_S)
    rank, last = transport.rank, transport.size - 1
    record(rank=rank, role="measuring", pid=os.getpid())
    try:
        # what has been measured goes round as a baton, so that one rank works at a time
        found: dict[str, Any] = transport.receive_note(rank - 1, Kind.STATISTICS)[1] if rank else {"ranks": []}
        same_host = (other for other in found["ranks"] if other["host"] == platform.node())
        found["ranks"].append(next(same_host, None) or _machine())
        if rank == render_rank:
            found["render"] = _render(config, overrides, rasterizer)
        transport.send_note(0 if rank == last else rank + 1, Kind.STATISTICS, 0, found)
        if rank == 0:
            found = transport.receive_note(last, Kind.STATISTICS)[1]
        links = measure_links(transport)
        if rank == 0:
            write_json(out, found | {"links": links})
        transport.finish()
    except BaseException as error:
        status = getattr(error, "exit_status", 1)
        say_failed(f"rank {rank} (measuring): {error or type(error).__name__}", status)
        transport.abort(status)


def measured_system(found: dict[str, Any], roles: list[str]) -> System:
    """The system parameters that ``measure_ranks`` found."""
    ranks = []
    for role, machine in zip(roles, found["ranks"], strict=True):
        values = {item.name: UNKNOWN for item in parameters(RankSystem)}
        for name, value in machine["values"].items():
            values[name] = measured(value, machine["notes"].get(name, ""))
        gpu, notes = found["render"]["gpu"] if role in ("render", "single") else ({}, {})
        for name in (name for name in values if name.startswith(("gpu_", "video_"))):
            values[name] = _or_unknown(gpu.get(name), notes.get(name, "")) if gpu else NOT_APPLICABLE
        ranks.append(RankSystem(role, **values))
    links = []
    for link in found["links"]:
        off = {kind: _off_the_line(share) for kind, share in link["worst_residual"].items()}
        notes = {"latency_s": off["raw"], "bytes_per_s": off["raw"], "polite_bytes_per_s": off["polite"]}
        values = {item.name: _or_unknown(link[item.name], notes.get(item.name, "")) for item in parameters(Link)}
        links.append(Link(link["sender"], link["receiver"], **values))
    return System(tuple(ranks), tuple(links))


def _or_unknown(value: float | None, note: str = "") -> Quantity:
    return UNKNOWN if value is None else measured(value, note)


def _machine() -> dict[str, Any]:
    """The host's own parameters."""
    uncached, cached = probes.uncached_bytes(), probes.CACHED_BYTES
    sizes = {"memory_": f"{uncached >> 20} MiB in use", "cache_": f"{cached >> 10} KiB in use"}
    figures = {
        "cpu_flop_per_s": probes.cpu_flop_per_s(np.float64),
        "cpu_float32_flop_per_s": probes.cpu_flop_per_s(np.float32),
        "memory_latency_s": probes.memory_latency_s(uncached),
        "memory_bytes_per_s": probes.memory_bytes_per_s(uncached),
        "cache_latency_s": probes.memory_latency_s(cached),
        "cache_bytes_per_s": probes.memory_bytes_per_s(cached),
    }
    values = {name: figure.value for name, figure in figures.items()}
    values |= {"memory_bytes": probes.memory_bytes(), "cache_bytes": probes.cache_bytes()}
    notes = {name: figure.spread for name, figure in figures.items()}
    for name in notes:
        notes[name] += "".join(f", {size}" for start, size in sizes.items() if name.startswith(start))
    return {"host": platform.node(), "values": values, "notes": notes}


def _render(config: Path, overrides: list[str], rasterizer: str) -> dict[str, Any]:
    """Rates of the rasterizer in use, its share of the machine, and its GPU's parameters where it has one."""
    job = Job(load_config(config, overrides))
    points = job.load_points(verify=False)
    camera, threads = job.camera(0), job.config.render.threads or None
    return {
        "vertices_per_s": probes.points_per_s(rasterizer, points, camera, threads)._asdict(),
        "fragments_per_s": probes.fragments_per_s(rasterizer, camera, threads)._asdict(),
        "gpu": _gpu() if rasterizer.startswith("gl") else ({}, {}),
    }


def _gpu() -> tuple[dict[str, float | None], dict[str, str]]:
    """The GPU's parameters by name, and notes on them."""
    from ...nodes.raster.gl_probe import SIZES_BYTES, flop_per_s, transfer_times

    found: dict[str, float | None] = {"gpu_flop_per_s": flop_per_s()}
    notes = {}
    for way, seconds in transfer_times().items():
        fit = fit_latency_and_rate(SIZES_BYTES, seconds)
        found |= {f"gpu_{way}_latency_s": fit.latency_s, f"gpu_{way}_bytes_per_s": fit.per_s}
        notes[f"gpu_{way}_bytes_per_s"] = _off_the_line(fit.worst_residual)
    return found, notes


def _off_the_line(residual: float) -> str:
    return f"a sample is {residual:.0%} off the line"
