"""The topologies of a run, seen from outside: how many ranks, what they are called, what is refused."""

from __future__ import annotations

import os

from ..shared.config import PipelineSection, RunConfig, Topology
from ..shared.errors import ConfigError, InputError

FRAME_PARALLEL, SORT_LAST_ONLY = "frame-parallel", "sort-last-only"
EQUAL_RANKS = (FRAME_PARALLEL, SORT_LAST_ONLY)
"""Topologies in which every rank does the same work; they take any number of ranks."""
PIPELINE_ROLES = ("culling", "sampling", "render")


def check_topology(config: RunConfig) -> None:
    """Raise ConfigError for what the configured topology cannot do, in one line. Cost: none."""
    pipeline = config.pipeline
    topology = f"pipeline.topology = {pipeline.topology!r}"
    if pipeline.topology not in EQUAL_RANKS:
        if pipeline.ranks:
            raise ConfigError(f"pipeline.ranks = {pipeline.ranks}: {topology} sets them itself, expected 0")
        return
    if config.scene.delivery == "messages":
        raise ConfigError(f"scene.delivery = 'messages': {topology}: every rank opens the scene, expected 'files'")
    if pipeline.topology == FRAME_PARALLEL:
        if config.output.mp4 and not config.output.resume:  # then it is made of the pictures, at the end
            raise ConfigError(f"output.mp4 = true: {topology}: no rank has all pictures in order, expected false")
        return
    refused = {
        "layers": bool(config.layers),
        "render.style = 'splats'": config.render.style == "splats",
        "render.positions = 'coded'": config.render.positions == "coded",
        f"sampling.pools = {config.sampling.pools!r}": config.sampling.pools != "off",
    }
    for found in (name for name, is_refused in refused.items() if is_refused):
        raise ConfigError(f"{found}: {topology} draws stored points and nothing else")


def ranks_to_start(pipeline: PipelineSection, topology: str) -> int:
    """How many ranks the launcher starts for a topology that has ranks."""
    if topology not in EQUAL_RANKS:
        return len(PIPELINE_ROLES)
    return pipeline.ranks or len(os.sched_getaffinity(0))


def check_world(pipeline: PipelineSection, size: int) -> None:
    """Raise InputError if a world of ``size`` ranks, started by ``mpirun``, is not what the configuration asks for."""
    if pipeline.topology in EQUAL_RANKS:
        wanted = pipeline.ranks or size
        if size != wanted:
            raise InputError(f"pipeline.ranks: found {size} ranks, expected {wanted}: mpirun -n {wanted}")
        return
    needed = 1 if pipeline.topology == "single" else len(PIPELINE_ROLES)
    if size < needed:
        raise InputError(f"pipeline.topology: found {size} ranks, expected {needed}: mpirun -n {needed}")


def topology_of_survivors(config: RunConfig, size: int) -> Topology:
    """The topology in which ``size`` ranks go on when others have died; it needs no more memory a rank than before."""
    topology = config.pipeline.topology
    if topology in EQUAL_RANKS or size >= len(PIPELINE_ROLES):
        return topology
    return "single"


def role_of(pipeline: PipelineSection, rank: int) -> str:
    """What a rank is called where it is named."""
    match pipeline.topology:
        case "frame-parallel":
            return "pictures"
        case "sort-last-only":
            return "share"
    return PIPELINE_ROLES[rank] if rank < len(PIPELINE_ROLES) else "idle"
