"""``splatpipe bench balance``: a scene with one hot octant and a camera that circles it, balanced and not.

Whole runs in turns, without output, so that a change of the machine's speed meets both. Every point is drawn, so that
work is where the points are. Where ranks share cores, frames/s say little of balance. Beside them stands the
processor time that the slowest rank takes for each frame: what a frame takes at least where each rank has a core of its
own.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ...shared.build import BuildSettings, build_scene
from ...shared.synth.hot_octant import HotOctant
from ..measured import measured_run
from ..record import machine_record

_CONFIG = """[scene]
path = "{scene}"
[camera]
width = {width}
height = {height}
[sampling]
pixel_threshold = 0
[render]
rasterizer = "cpu"
threads = 1
[output]
frames = {frames}
"""


def bench_balance(
    topology: str,
    ranks: int,
    overrides: Sequence[str],
    *,
    n_points: int,
    share: float,
    points_per_cell: int,
    width: int,
    height: int,
    frames: int,
    repeats: int,
    workdir: Path,
) -> dict[str, Any]:
    """Alternating runs with ``pipeline.balance`` off and measured; a JSON-able dict with ``rows`` and the machine.

    share : of the points that are in the hot octant.  points_per_cell : of the scene's leaves, at most: the fewer, the
    more is selection's work.  workdir : where the scene is built, and kept for the next time.
    Raises SplatpipeError with a run's own line if it fails, or where the topology has nothing to move.
    """
    workdir.mkdir(parents=True, exist_ok=True)
    scene = workdir / f"hot-{n_points}-{share:g}-{points_per_cell}"
    if not scene.exists():
        build_scene([HotOctant(n_points, share)], scene, settings=BuildSettings(points_per_cell=points_per_cell))
    config = workdir / "balance.toml"
    config.write_text(_CONFIG.format(scene=scene.resolve(), width=width, height=height, frames=frames))
    sets = [f"pipeline.topology={topology}", f"pipeline.ranks={ranks}", *overrides]
    runs: dict[str, list[dict[str, Any]]] = {"off": [], "measured": []}
    for _ in range(repeats):
        for balance, done in runs.items():
            done.append(measured_run(config, [*sets, f"pipeline.balance={balance}"]))
    return {
        "benchmark": "balance",
        "n_points": n_points,
        "share": share,
        "points_per_cell": points_per_cell,
        "width": width,
        "height": height,
        "frames": frames,
        "repeats": repeats,
        "topology": topology,
        "ranks": ranks,
        "overrides": list(overrides),
        "rows": [_row(balance, done) for balance, done in runs.items()],
        "machine": machine_record(),
    }


def _row(balance: str, runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    records = [run["balance"] for run in runs]
    busy = np.array([record["busy_s"] for record in records])
    return {
        "balance": balance,
        "frames_per_s": [run["frames_per_s"] for run in runs],
        "slowest_ms": [1e3 * float(np.mean(record["slowest_s"])) for record in records],
        "busy_s": np.median(busy, axis=0).tolist(),
        "imbalance": {
            name: float(np.median([record["imbalance"][name]["each"] for record in records]))
            for name in records[0]["imbalance"]
        },
        "changes": [len(record["changes"]) for record in records],
        "adopting_ms": [record["adopting_ms"] for record in records],
        "note_bytes": [
            sum(run["messages"].get(kind, {"bytes": 0})["bytes"] for kind in ("PLAN", "STAGE_TIMES")) for run in runs
        ],
    }


def print_balance(results: dict[str, Any], console: Console) -> None:
    """A line for each setting."""
    table = Table(
        "balance", "frames/s", "slowest rank, ms a frame", "slowest part / mean", "busy, s by rank",
        "changes", "adopting, ms",
    )  # fmt: skip
    for row in results["rows"]:
        adopting = [ms for ms in row["adopting_ms"] if ms is not None]
        table.add_row(
            row["balance"],
            _spread(row["frames_per_s"], 1),
            _spread(row["slowest_ms"], 2),
            ", ".join(f"{name} {value:.2f}" for name, value in row["imbalance"].items()),
            " ".join(f"{seconds:.2f}" for seconds in row["busy_s"]),
            _spread(row["changes"], 0),
            _spread(adopting, 2) if adopting else "–",
        )
    console.print(table)
    off, on = results["rows"]
    rates, slowest = ([np.median(row[key]) for row in (off, on)] for key in ("frames_per_s", "slowest_ms"))
    console.print(
        f"{results['topology']}, {results['ranks']} ranks on {results['machine']['cores']} cores, "
        f"{results['n_points']:,} points, {results['share']:.0%} in one octant: "
        f"frames/s × {rates[1] / rates[0]:.2f}, work of the slowest rank × {slowest[1] / slowest[0]:.2f}"
    )


def _spread(values: Sequence[float], digits: int) -> str:
    return f"{np.median(values):.{digits}f} ({min(values):.{digits}f}–{max(values):.{digits}f})"
