"""What the pipeline costs: three ranks against the slowest of the three stages alone.

A perfect pipeline goes as fast as its slowest stage. Both sides are whole runs of the same configuration without
output: ``single`` gives the work of each stage with nothing beside it, ``pipelined`` the rate with everything at once.
Runs alternate, so that a change of the machine's speed meets both. Two figures come out: the rate against what the
slowest stage reaches alone, which on fewer cores than ranks holds what the ranks take from each other; and the share of
the time that the slowest stage works, which is what messages and waiting leave.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ..measured import measured_run
from ..record import machine_record


def bench_pipeline(config: Path, overrides: list[str], repeats: int) -> dict[str, Any]:
    """Alternating runs of a configuration as ``single`` and as ``pipelined``; rates, stages and their ratio."""
    runs: dict[str, list[dict[str, Any]]] = {"single": [], "pipelined": []}
    for _ in range(repeats):
        for topology, done in runs.items():
            done.append(measured_run(config, [*overrides, f"pipeline.topology={topology}"]))
    stages = {
        name: float(np.median([run["stages"][name]["work_s"] / run["frames"] for run in runs["single"]]))
        for name in runs["single"][0]["stages"]
    }
    slowest = max(stages, key=lambda name: stages[name])
    rates = {topology: [run["frames_per_s"] for run in done] for topology, done in runs.items()}
    pipelined = float(np.median(rates["pipelined"]))
    return {
        "config": config.name,
        "overrides": overrides,
        "frames": runs["single"][0]["frames"],
        "stage_ms_alone": {name: 1e3 * seconds for name, seconds in stages.items()},
        "slowest_stage": slowest,
        "slowest_stage_frames_per_s": 1 / stages[slowest],
        "frames_per_s": rates,
        "share_of_slowest_stage": pipelined * stages[slowest],
        "share_of_time_it_works": float(
            np.median(
                [run["stages"][slowest]["work_s"] * run["frames_per_s"] / run["frames"] for run in runs["pipelined"]]
            )
        ),
        "latency_ms": {topology: done[-1]["latency_ms"]["median"] for topology, done in runs.items()},
        "messages": runs["pipelined"][-1]["messages"],
        "machine": machine_record(),
        "cores_for_three_ranks": len(os.sched_getaffinity(0)),
    }


def print_pipeline(results: dict[str, Any], console: Any) -> None:
    """The result in a few lines."""
    for name, milliseconds in results["stage_ms_alone"].items():
        console.print(f"{name:10} {milliseconds:8.2f} ms a frame alone")
    for topology, rates in results["frames_per_s"].items():
        console.print(
            f"{topology:10} {np.median(rates):8.1f} frames/s (min {min(rates):.1f}, max {max(rates):.1f}, "
            f"{len(rates)} runs), latency {results['latency_ms'][topology]:.1f} ms"
        )
    console.print(
        f"pipelined reaches {results['share_of_slowest_stage']:.1%} of what {results['slowest_stage']} reaches alone, "
        f"three ranks on {results['cores_for_three_ranks']} cores; "
        f"it works {results['share_of_time_it_works']:.1%} of the time, the rest is the pipeline"
    )
