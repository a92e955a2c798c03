"""The topologies of a run, seen from outside: their layouts, how many ranks they take, what they refuse."""

from __future__ import annotations

import os

from ..shared.config import PipelineSection, RunConfig
from ..shared.errors import ConfigError, InputError
from .layout import ALONE, Layout, Split, chain, chains, hybrid, master_slave

FRAME_PARALLEL = "frame-parallel"
CHAIN = ("auto", "pipelined")
"""Topologies of at most three ranks."""
SPLIT: dict[str, Split] = {
    "sort-first": "tiles",
    "sort-first-only": "tiles",
    "sort-last": "shares",
    "sort-last-only": "shares",
}
"""Topologies of lanes that have a tile or a share each."""


def layout_of(pipeline: PipelineSection, size: int) -> Layout:
    """The layout of a topology on ``size`` ranks. ``frame-parallel`` has none: each of its ranks is alone."""
    topology = pipeline.topology
    if topology in ("single", FRAME_PARALLEL):
        return ALONE
    if topology in CHAIN:
        return Layout((chain(range(min(size, 3))),))
    if topology == "master-slave":
        return master_slave(size)
    if topology == "hybrid":
        return hybrid(size, *_counts(pipeline), pipeline.render_split)
    return Layout(chains(size, 1 if topology.endswith("-only") else 3), SPLIT[topology])


def check_topology(config: RunConfig) -> None:
    """Raise ConfigError for what the configured topology cannot do, in one line. Cost: none."""
    pipeline = config.pipeline
    topology = f"pipeline.topology = {pipeline.topology!r}"
    counts = dict(zip(("culling_ranks", "sampling_ranks", "render_ranks"), _counts(pipeline), strict=True))
    if pipeline.topology != "hybrid":
        for name, count in counts.items():
            if count:
                raise ConfigError(f"pipeline.{name} = {count}: {topology}, expected 'hybrid'")
    elif pipeline.ranks and all(counts.values()) and sum(counts.values()) != pipeline.ranks:
        said = " + ".join(map(str, counts.values()))
        raise ConfigError(f"pipeline.ranks = {pipeline.ranks}, expected {said} = {sum(counts.values())}")
    if pipeline.topology == "single" and pipeline.ranks > 1:
        raise ConfigError(f"pipeline.ranks = {pipeline.ranks}: {topology} has one")
    if pipeline.topology in CHAIN and pipeline.ranks > 3:
        raise ConfigError(f"pipeline.ranks = {pipeline.ranks}: {topology} has three at most")
    if pipeline.topology not in (*CHAIN, "single") and config.scene.delivery == "messages":
        raise ConfigError(f"scene.delivery = 'messages': {topology}: every rank opens the scene, expected 'files'")
    if pipeline.topology in CHAIN and pipeline.ranks in (1, 2) and config.scene.delivery == "messages":
        raise ConfigError(f"pipeline.ranks = {pipeline.ranks}: scene.delivery = 'messages' takes three")
    splits = SPLIT.get(pipeline.topology, pipeline.render_split if pipeline.topology == "hybrid" else "none")
    refused = {
        "render.style = 'splats'": splits != "none" and config.render.style == "splats",
        "render.positions = 'coded'": splits == "shares" and config.render.positions == "coded",
        f"sampling.pools = {config.sampling.pools!r}": (splits != "none" or pipeline.topology == "master-slave")
        and config.sampling.pools != "off",
    }
    for found in (name for name, is_refused in refused.items() if is_refused):
        raise ConfigError(f"{found}: {topology} draws stored points and nothing else")


def ranks_to_start(pipeline: PipelineSection, topology: str) -> int:
    """How many ranks the launcher starts for a topology that has ranks."""
    cores = len(os.sched_getaffinity(0))
    if topology in CHAIN:
        return pipeline.ranks or 3
    counts = _counts(pipeline)
    if topology == "hybrid" and not pipeline.ranks:
        return max(sum(max(count, 1) for count in counts), 0 if all(counts) else cores)
    return pipeline.ranks or cores


def check_world(pipeline: PipelineSection, size: int) -> None:
    """Raise InputError if a world of ``size`` ranks, started by ``mpirun``, is not what the configuration asks for."""
    wanted = pipeline.ranks or size
    counts = _counts(pipeline)
    if pipeline.topology == "hybrid" and any(counts):
        least = sum(max(count, 1) for count in counts)
        if all(counts) and size != least:
            wanted = least
        elif size < least:
            raise InputError(f"pipeline: found {size} ranks, expected at least {least}: mpirun -n {least}")
    if size != wanted and not (pipeline.topology in CHAIN and size > wanted):
        raise InputError(f"pipeline.ranks: found {size} ranks, expected {wanted}: mpirun -n {wanted}")


def _counts(pipeline: PipelineSection) -> tuple[int, int, int]:
    return pipeline.culling_ranks, pipeline.sampling_ranks, pipeline.render_ranks


def role_of(pipeline: PipelineSection, rank: int, size: int) -> str:
    """What a rank of ``size`` is called where it is named."""
    return "pictures" if pipeline.topology == FRAME_PARALLEL else layout_of(pipeline, size).role_of(rank)
