"""How a run is laid out: topology, ranks, threads."""

from __future__ import annotations

from dataclasses import dataclass

from ...shared.config import PipelineSection, RunConfig
from ..compositing.choose import RADIX
from ..launch import mpi_available
from ..layout import Layout
from ..topologies import layout_of, ranks_to_start
from .workload import threads_of


@dataclass(frozen=True)
class Setting:
    """How a run is laid out.

    threads : of each render rank.
    ranks and what follows : as of the configuration's ``pipeline``; ranks 0: as many as the topology takes at least.
    """

    topology: str
    threads: int
    in_flight: int
    ranks: int = 0
    culling_ranks: int = 0
    sampling_ranks: int = 0
    render_ranks: int = 0
    render_split: str = "tiles"
    compositing: str = "auto"
    radix: int = RADIX

    @property
    def size(self) -> int:
        """Ranks that are started."""
        counts = (self.culling_ranks, self.sampling_ranks, self.render_ranks)
        least = {"single": 1, "pipelined": 3, "hybrid": max(3, sum(max(count, 1) for count in counts))}
        return self.ranks or least.get(self.topology, 1)

    def layout(self) -> Layout:
        """Which rank does what."""
        names = ("culling_ranks", "sampling_ranks", "render_ranks", "render_split")
        pipeline = {"topology": self.topology} | {name: getattr(self, name) for name in names}
        return layout_of(PipelineSection.model_validate(pipeline), self.size)

    @classmethod
    def of(cls, run: RunConfig, ranks: int = 0) -> Setting:
        """As a configuration asks for; on so many ranks where it leaves that to the launcher."""
        pipeline = run.pipeline
        topology = pipeline.topology
        if topology == "auto":
            topology = "pipelined" if mpi_available() else "single"
        size = 1 if topology == "single" else pipeline.ranks or ranks or ranks_to_start(pipeline, topology)
        return cls(
            topology,
            threads_of(run.render.threads),
            pipeline.frames_in_flight,
            size,
            pipeline.culling_ranks,
            pipeline.sampling_ranks,
            pipeline.render_ranks,
            pipeline.render_split,
            pipeline.compositing,
            pipeline.radix,
        )
