"""``splatpipe run``: from a configuration to pictures, on as many ranks as the topology needs."""

from __future__ import annotations

import hashlib
import json
import os
import time
from dataclasses import asdict
from pathlib import Path
from statistics import mean
from typing import Any

from rich.console import Console

from ..shared.config import RunConfig, load_config
from ..shared.errors import ConfigError, InputError, SplatpipeError
from ..shared.files import write_json
from ..shared.layers.kinds import objects_of
from .job import Job
from .launch import EXPECTED_RANKS, inside_mpi, launch, mpi_available, record, say_failed
from .plan.needs import left_out
from .plan.topology import Decision, decide
from .plan.workload import Workload
from .progress import FrameProgress
from .record import RECORD_VERSION, machine_record
from .sink import prepare_output

PIPELINED_RANKS = 3
DECISION = "SPLATPIPE_DECISION"
"""Environment variable in which the launcher tells its ranks why they are."""


def run_command(config_path: Path, overrides: list[str], json_path: Path | None) -> int:
    """Draw what a configuration asks for; the exit status. Called by a person, or on each rank by ``mpiexec``."""
    if inside_mpi():
        return _run_rank(config_path, overrides, json_path)
    config = load_config(config_path, overrides)
    if config.pipeline.topology == "pipelined" and not mpi_available():
        raise ConfigError("pipeline.topology = 'pipelined': MPI is missing; install splatpipe[mpi] or choose 'single'")
    job = Job(config)  # everything that can be wrong with the input is said here, before anything starts
    prepare_output(job.output)
    with FrameProgress(job.n_frames) as progress:
        progress.show("planning", 0)
        decision = decide(job)
        if decision.topology == "single":
            from .pipeline import run_single

            summary = _finish(job, decision, run_single(job, progress.show), config_path, json_path)
        else:
            status = _run_ranks(config_path, overrides, json_path, decision, progress)
            if status:
                return status  # the rank that failed has said why
            summary = json.loads((job.output / "run.json").read_text())
    _tell(summary)
    return 0


def _run_ranks(
    config_path: Path, overrides: list[str], json_path: Path | None, decision: Decision, progress: FrameProgress
) -> int:
    """Start the ranks and show what they report; their exit status."""
    arguments = ["run", str(config_path)]
    for override in overrides:
        arguments += ["--set", override]
    if json_path is not None:
        arguments += ["--json", str(json_path)]
    return launch(
        arguments,
        PIPELINED_RANKS,
        lambda content: progress.show(content["doing"], content["done"]),
        {DECISION: decision.to_json()},
    )


def _run_rank(config_path: Path, overrides: list[str], json_path: Path | None) -> int:
    """Do this rank's part. What is wrong with the input is said once, by the first rank that finds something."""
    from .pipeline import RENDER, ROLES, receive_job, run_pipelined, run_single
    from .transport import Transport

    transport = Transport()
    role = ROLES[transport.rank] if transport.rank < len(ROLES) else "idle"
    record(rank=transport.rank, role=role, pid=os.getpid())
    config: RunConfig | None = None
    job: Job | None = None
    single = by_messages = False
    status, why = 0, ""
    try:
        expected = int(os.environ.get(EXPECTED_RANKS, 0))
        if expected and expected != transport.size:
            raise InputError(
                f"mpiexec: found a world of {transport.size} ranks, expected {expected}; "
                f"it belongs to another MPI than mpi4py's ({transport.library})"
            )
        config = load_config(config_path, overrides)
        transport.timeout_s = config.pipeline.timeout_s
        single = config.pipeline.topology == "single"
        needed = 1 if single else PIPELINED_RANKS
        if transport.size < needed:
            raise InputError(f"pipeline.topology: found {transport.size} ranks, expected {needed}: mpirun -n {needed}")
        by_messages = not single and config.scene.delivery == "messages"
        if not (by_messages and transport.rank == RENDER):
            job = Job(config)
            if transport.rank == 0:
                prepare_output(job.output)
    except SplatpipeError as error:
        status, why = error.exit_status, str(error)
    statuses = transport.agree(status)
    if not any(statuses) and len(set(transport.agree(by_messages))) > 1:
        statuses, why = [InputError.exit_status] * transport.size, "scene.delivery: not the same on every rank"
    if config is None or any(statuses):
        first = next(rank for rank in range(transport.size) if statuses[rank])
        if transport.rank == first:
            say_failed(f"rank {first} ({role}): {why}" if first else why, statuses[first])
        transport.meet()  # so that the line is out before a rank ends
        return max(statuses)
    try:
        if job is None:
            job = receive_job(config, transport)
            prepare_output(job.output)  # on a host of its own there may be no such folder yet
        with FrameProgress(job.n_frames, on_terminal=transport.rank == 0) as progress:

            def show(doing: str, done: int) -> None:
                record(doing=doing, done=done)
                progress.show(doing, done)

            if single:
                result = run_single(job, show) if transport.rank == 0 else None
                transport.meet()
            else:
                result = run_pipelined(job, transport, show)
        if result is not None:
            decision = _decided(single, transport.size)
            summary = _finish(job, decision, result | {"mpi": transport.library}, config_path, json_path)
            if EXPECTED_RANKS not in os.environ:
                _tell(summary)
    except BaseException as error:
        _abort(transport, role, error)
    return 0


def _decided(single: bool, ranks: int) -> Decision:
    """What the launcher decided; where there was none, what the person who started the ranks did."""
    if DECISION in os.environ:
        return Decision.from_json(os.environ[DECISION])
    return Decision("single" if single else "pipelined", f"started on {ranks} ranks by mpiexec")


def _abort(transport: Any, role: str, error: BaseException) -> None:
    """Say which rank failed and why, in one line, and end every rank."""
    if "SPLATPIPE_DEBUG" in os.environ:
        import traceback

        traceback.print_exception(error)
    cause = str(error) if isinstance(error, SplatpipeError) else f"{type(error).__name__}: {error}"
    status = getattr(error, "exit_status", 1)
    say_failed(f"rank {transport.rank} ({role}): {cause}", status)
    time.sleep(0.2)  # so that the line is relayed before mpiexec tears everything down
    transport.abort(status)


def _finish(
    job: Job, decision: Decision, result: dict[str, Any], config_path: Path, json_path: Path | None
) -> dict[str, Any]:
    """Write ``run.json`` (last, so that a killed run leaves none); what it holds, less the per-frame lists."""
    content = {
        "record_version": RECORD_VERSION,
        "topology": decision.topology,
        "plan": asdict(decision),
        "config_file": config_path.name,
        "config_sha256": hashlib.sha256(job.config.model_dump_json().encode()).hexdigest(),
        "config": job.config.model_dump(mode="json"),
        "scene": {"points": job.scene.info.n_points, "cells": job.scene.info.n_cells},
        "layers": [layer.told for layer in job.layers],
        "colour": job.colouring.mode,
        "frames": job.n_pictures,
        "views_per_picture": job.views.per_picture,
        "frames_per_s": job.n_pictures / result["rendered_s"],
        "seconds": result["finished_s"],
        **{key: result[key] for key in result if key not in ("rendered_s", "finished_s")},
        "output": job.outputs(),
        "left_out": left_out(job, Workload.of_run(job, result["per_frame"]), decision),
        "machine": machine_record(),
    }
    for path in filter(None, (job.output / "run.json", json_path)):
        write_json(path, content)
    return content


def _tell(summary: dict[str, Any]) -> None:
    console = Console(highlight=False, soft_wrap=True)
    stages = ", ".join(f"{name} {stage['work_ms']['median']:.1f} ms" for name, stage in summary["stages"].items())
    console.print(
        f"{summary['frames']} frames, {summary['frames_per_s']:.1f} frames/s, {summary['topology']}, "
        f"{summary['rasterizer']}; median {stages}"
    )
    for i, layer in enumerate(summary["layers"]):
        drawn = mean(of_layers[i] for of_layers in summary["per_frame"]["objects"])
        of = f"{layer['objects']:,} {objects_of(layer['kind'])}"
        console.print(f"  layer {layer['name']}: {drawn:,.0f} of {of} a frame")
    for path in summary["output"]:
        console.print(f"  wrote {path}")
    if summary["left_out"]:
        names = ", ".join(item["what"] for item in summary["left_out"])
        console.print(f"left out, because this run does not need it (why: run.json, splatpipe plan): {names}")
