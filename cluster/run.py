"""``splatpipe run``: from a configuration to pictures, on as many ranks as the topology needs."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

from rich.console import Console

from ..shared.config import PipelineSection, RunConfig, load_config
from ..shared.errors import ConfigError, InputError, SplatpipeError
from ..shared.files import write_json
from .job import Job
from .launch import (
    EXPECTED_RANKS,
    check_started,
    fail_rank,
    inside_mpi,
    launch,
    mpi_available,
    record,
    say_failed,
    say_refused,
    started_rank,
)
from .plan.needs import left_out
from .plan.topology import Decision, decide
from .plan.workload import Workload
from .progress import FrameProgress
from .record import RECORD_VERSION, machine_record
from .resume import drawn_as, drawn_by, finished, prepare
from .sink import film_of_pictures, make_output
from .topologies import FRAME_PARALLEL, check_world, layout_of, ranks_to_start, role_of

if TYPE_CHECKING:
    from .survival import Survival
    from .transport import Transport

DECISION = "SPLATPIPE_DECISION"
"""Environment variable in which the launcher tells its ranks why they are."""


def run_command(config_path: Path, overrides: list[str], json_path: Path | None) -> int:
    """Draw what a configuration asks for; the exit status. Called by a person, or on each rank by ``mpiexec``."""
    if inside_mpi():
        return _run_rank(config_path, overrides, json_path)
    config = load_config(config_path, overrides)
    wanted = config.pipeline.topology
    if wanted not in ("auto", "single") and not mpi_available():
        raise ConfigError(f"pipeline.topology = {wanted!r}: MPI is missing; install splatpipe[mpi] or choose 'single'")
    job = Job(config)  # everything that can be wrong with the input is said here, before anything starts
    if not prepare(job):
        return _tell_finished(job, json_path)
    with FrameProgress(len(job.frames)) as progress:
        progress.show("planning", 0)
        decision = decide(job)
        if decision.topology == "single":
            from .pipeline import run_single

            summary = _finish(job, decision, run_single(job, progress.show), config_path, json_path)
        else:
            ranks = ranks_to_start(config.pipeline, decision.topology)
            status = _run_ranks(config_path, overrides, json_path, ranks, decision, progress, config.pipeline)
            if status:
                return status  # the rank that failed has said why
            summary = json.loads((job.output / "run.json").read_text())
    _tell(summary)
    return 0


def _run_ranks(
    config_path: Path,
    overrides: list[str],
    json_path: Path | None,
    ranks: int,
    decision: Decision,
    progress: FrameProgress,
    pipeline: PipelineSection,
) -> int:
    """Start the ranks and show what they report; their exit status."""
    arguments = ["run", str(config_path)]
    for override in overrides:
        arguments += ["--set", override]
    if json_path is not None:
        arguments += ["--json", str(json_path)]
    return launch(
        arguments,
        ranks,
        lambda content: progress.show(content["doing"], content["done"]),
        {DECISION: decision.to_json()},
        timeout_s=pipeline.timeout_s,
        survive=pipeline.survive,
    )


def _run_rank(config_path: Path, overrides: list[str], json_path: Path | None) -> int:
    """Do this rank's part; the exit status."""
    from .survival import Survival
    from .transport import Transport

    try:
        transport = Transport()
    except SplatpipeError as error:
        if started_rank() == 0:
            say_failed(str(error), error.exit_status)
        return error.exit_status
    survival = Survival(transport)
    try:
        return survival.run(lambda: _attempt(config_path, overrides, json_path, transport, survival))
    except BaseException as error:
        fail_rank(transport, "starting", error)
    return 1


def _attempt(
    config_path: Path, overrides: list[str], json_path: Path | None, transport: Transport, survival: Survival
) -> int:
    """Do this rank's part. What is wrong with the input is said once, by the first rank that finds something."""
    from .compression import add_links, start_coding
    from .pipeline import RENDER, receive_job

    config: RunConfig | None = None
    job: Job | None = None
    by_messages = False
    status, why, role = 0, "", "starting"
    try:
        config = survival.settled(load_config(config_path, overrides))
        role = role_of(config.pipeline, transport.rank, transport.size)
        record(rank=transport.rank, role=role, pid=os.getpid())
        if not survival.lost:
            check_started(transport.size, transport.library)
            check_world(config.pipeline, transport.size)
        transport.timeout_s = config.pipeline.timeout_s * (2 if transport.survives else 1)  # the launcher comes first
        transport.patience_s = config.pipeline.loading_timeout_s
        by_messages = config.pipeline.topology != "single" and config.scene.delivery == "messages"
        if not (by_messages and transport.rank == RENDER):
            job = Job(config)
            if transport.rank == 0:
                prepare(job)
    except SplatpipeError as error:
        status, why = error.exit_status, str(error)
    statuses = transport.agree(status)
    if not any(statuses) and len(set(transport.agree(by_messages))) > 1:
        statuses, why = [InputError.exit_status] * transport.size, "scene.delivery: not the same on every rank"
    if config is None or any(statuses):
        return say_refused(transport, statuses, f"rank {transport.rank} ({role})", why)
    pictures = transport.join(job.pictures if job and transport.rank == 0 else []).astype(int).tolist()
    begun_with = survival.pictures = pictures if survival.pictures is None else survival.pictures
    try:
        transport.coding = start_coding(transport, config.pipeline)
        if job is None:
            job = receive_job(config, transport)
            make_output(job.output)  # on a host of its own there may be no such folder yet
        job.draw_only(pictures)
        with FrameProgress(len(job.frames), on_terminal=transport.rank == 0) as progress:

            def show(doing: str, done: int) -> None:
                if transport.rank == 0:
                    record(doing=doing, done=done)
                    progress.show(doing, done)

            result = add_links(transport, _run_topology(job, transport, show))
        if result is not None:
            decision = _decided(config.pipeline, transport.size, survival.lost)
            result |= {"mpi": transport.library, "lost": survival.lost} | drawn_by(job, begun_with)
            summary = _finish(job, decision, result, config_path, json_path)
            if EXPECTED_RANKS not in os.environ:
                _tell(summary)
    except BaseException as error:
        if transport.survives and transport.lost_a_rank(error) and not by_messages:
            raise
        fail_rank(transport, role, error)
    return 0


def _run_topology(job: Job, transport: Transport, show: Callable[[str, int], None]) -> dict[str, Any] | None:
    """Do this rank's part of the run's topology; the statistics of the run on rank 0, None elsewhere. Collective."""
    pipeline = job.config.pipeline
    if pipeline.topology == "single":
        from .pipeline import run_single

        result = run_single(job, show) if transport.rank == 0 else None
        transport.meet()
        return result
    layout = layout_of(pipeline, transport.size)
    renders = pipeline.topology == FRAME_PARALLEL or transport.rank in layout.render
    if pipeline.topology == FRAME_PARALLEL or len(layout.render) > 1:  # not where a rank waits for the scene of another
        renders_here = transport.count_here(renders)
        if not job.config.render.threads:
            job.threads = max(1, job.threads // max(renders_here, 1))
    if renders:
        job.output.mkdir(parents=True, exist_ok=True)  # on a host of its own there may be no such folder yet
    if pipeline.topology == FRAME_PARALLEL:
        from .frame_parallel import run_frame_parallel

        return run_frame_parallel(job, transport, show)
    from .pipeline import run_layout

    return run_layout(job, layout, transport, show)


def _decided(pipeline: PipelineSection, ranks: int, lost: list[dict[str, Any]]) -> Decision:
    """What the launcher decided; where there was none, what the person who started the ranks did, or a death."""
    topology = "pipelined" if pipeline.topology == "auto" else pipeline.topology
    if lost:
        return Decision(topology, f"{len(lost)} of {ranks + len(lost)} ranks died: what the others can do")
    if DECISION in os.environ:
        return Decision.from_json(os.environ[DECISION])
    return Decision(topology, f"started on {ranks} ranks by mpiexec")


def _finish(
    job: Job, decision: Decision, result: dict[str, Any], config_path: Path, json_path: Path | None
) -> dict[str, Any]:
    """Write ``run.json`` (last, so that a killed run leaves none); what it holds, less the per-frame lists."""
    if job.film_afterwards:
        film_of_pictures(job.output, job.n_pictures, job.config.output.fps)
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
        "drawn_as": drawn_as(job),
        "frames": job.n_pictures,
        **drawn_by(job, job.pictures),
        "views_per_picture": job.views.per_picture,
        "frames_per_s": len(job.pictures) / result["rendered_s"],
        "seconds": result["finished_s"],
        **{key: result[key] for key in result if key not in ("rendered_s", "finished_s")},
        "output": job.outputs(),
        "left_out": left_out(job, Workload.of_run(job, result["per_frame"]), decision),
        "machine": machine_record(),
    }
    for path in filter(None, (job.output / "run.json", json_path)):
        write_json(path, content)
    finished(job)
    return content


def _tell_finished(job: Job, json_path: Path | None) -> int:
    """Say that nothing is left to draw; the exit status."""
    if json_path is not None:
        write_json(json_path, json.loads((job.output / "run.json").read_text()))
    print(f"all {job.n_pictures} frames are there; {job.output / 'run.json'} says how they were drawn")
    return 0


def _tell(summary: dict[str, Any]) -> None:
    console = Console(highlight=False, soft_wrap=True)
    stages = ", ".join(f"{name} {stage['work_ms']['median']:.1f} ms" for name, stage in summary["stages"].items())
    for lost in summary.get("lost", []):
        who = f"rank {lost['rank']} ({lost['role']}, pid {lost['pid']}, {lost['host']})"
        console.print(f"{who} died {lost['when']}; the others drew what it had not")
    kept = f" ({summary['kept']} of them were there)" if summary["kept"] else ""
    console.print(
        f"{summary['frames']} frames{kept}, {summary['frames_per_s']:.1f} frames/s, {summary['topology']}, "
        f"{summary['rasterizer']}; median {stages}"
    )
    if missing := summary["per_frame"].get("missing"):
        shares = f"{mean(missing):.1%} of a frame's points missing, at most {max(missing):.1%}"
        read = sum(summary["per_frame"]["loaded_bytes"])
        console.print(f"  paged: {shares}, none in {missing.count(0.0)} frames; {read / 1e6:,.0f} MB read")
    if summary["layers"]:
        from ..shared.layers.kinds import objects_of
    for i, layer in enumerate(summary["layers"]):
        drawn = mean(of_layers[i] for of_layers in summary["per_frame"]["objects"])
        of = f"{layer['objects']:,} {objects_of(layer['kind'])}"
        console.print(f"  layer {layer['name']}: {drawn:,.0f} of {of} a frame")
    for path in summary["output"]:
        console.print(f"  wrote {path}")
    if summary["left_out"]:
        names = ", ".join(item["what"] for item in summary["left_out"])
        console.print(f"left out, because this run does not need it (why: run.json, splatpipe plan): {names}")
