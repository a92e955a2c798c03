"""One rank or three: what both would take, and the choice with its reason.

On one rank a frame takes culling + sampling + render. On three ranks it takes the slowest of the three and the
messages' share; but where all ranks share the cores of one machine, never less than the work of all of them spread
over the cores. So three ranks save at most the time in which the cores would otherwise not all be busy, and a scene
whose culling and sampling take next to nothing is faster on one rank, as the thesis's bunny is (Table 6-1).
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass

from ...shared.messages import RENDER_POINT
from ..job import Job
from ..launch import mpi_available
from ..topologies import CHAIN, FRAME_PARALLEL, layout_of, ranks_to_start
from ..wall import writes_screens
from .costs import COSTS, UnitCosts, compose_core_s, draw_core_s
from .workload import Workload


@dataclass(frozen=True)
class Estimate:
    """Seconds of an average frame by topology, and what they are made of.

    busy_s : work of all stages and encoders, on one core.
    saved_s : of the whole run on three ranks instead of one, what starting them takes subtracted.
    """

    culling_s: float
    sampling_s: float
    render_s: float
    busy_s: float
    message_s: float
    single_s: float
    pipelined_s: float
    saved_s: float
    cores: int


@dataclass(frozen=True)
class Decision:
    """The topology of a run and why; estimates where they decided."""

    topology: str
    reason: str
    estimate: Estimate | None = None

    def to_json(self) -> str:
        """As text, for the ranks that carry the decision out."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Decision:
        """What ``to_json`` wrote."""
        content = json.loads(text)
        estimate = content.pop("estimate")
        return cls(**content, estimate=Estimate(**estimate) if estimate else None)


def estimate(job: Job, work: Workload, cores: int, costs: UnitCosts = COSTS) -> Estimate:
    """What an average frame takes on one rank and on three that share ``cores``."""
    output = job.config.output
    composed = work.pixels * job.composed_share
    shown = output.png or output.mp4 or output.depth or output.normals
    alone_s = costs.entry_s * work.entries + costs.picture_s * work.pixels * shown  # on one core, others wait
    threads = min(job.config.render.threads or cores, cores)
    render_core_s = draw_core_s(job, work, costs) + compose_core_s(job, work, costs) * shown
    gpu_s = 0.0 if job.rasterizer == "cpu" else costs.gl_point_s * work.points
    render_s = render_core_s / threads + gpu_s + alone_s
    encode_s = (costs.png_s * output.png + costs.mp4_s * output.mp4) * composed
    busy_s = work.culling_s + work.sampling_s + render_core_s + alone_s + encode_s
    stages = work.culling_s, work.sampling_s, render_s
    single_s = max(sum(stages), busy_s / cores)
    sent_bytes = work.cells / 8 + RENDER_POINT.itemsize * work.entries
    message_s = costs.message_s + costs.message_byte_s * sent_bytes
    pipelined_s = max(*stages, busy_s / cores) + message_s
    saved_s = (single_s - pipelined_s) * job.n_frames - costs.start_s
    return Estimate(*stages, busy_s, message_s, single_s, pipelined_s, saved_s, cores)


def choose_topology(job: Job, work: Workload, costs: UnitCosts = COSTS) -> Decision:
    """The topology that is done first, starting the ranks included; one rank where they are even."""
    found = estimate(job, work, len(os.sched_getaffinity(0)), costs)
    gain_s = found.single_s - found.pipelined_s
    selection_s = found.culling_s + found.sampling_s
    said = f"culling and sampling take {_ms(selection_s)} of an estimated {_ms(found.single_s)} a frame"
    if job.layers:
        said = f"without the layers {said}"
    if gain_s <= 0:
        saved_s = max(0.0, gain_s + found.message_s)
        return Decision(
            "single",
            f"{said}: three ranks on {found.cores} cores would save {_ms(saved_s)} "
            f"({saved_s / found.single_s:.1%}) and spend {_ms(found.message_s)} on messages",
            found,
        )
    total = f"{_ms(gain_s)} a frame, {gain_s * job.n_frames:.2g} s in {job.n_frames} frames"
    if found.saved_s <= 0:
        why = f"{said}: three ranks would save {total}, and take {costs.start_s:.2g} s longer to start"
        return Decision("single", why, found)
    return Decision("pipelined", f"{said}: three ranks save {total}, and take {costs.start_s:.2g} s to start", found)


def decide(job: Job) -> Decision:
    """The topology of a run: as the configuration says; for ``auto`` what an estimate says, where there is a choice.

    Cost: nothing, or for ``auto`` that of ``Workload.of_look``.
    """
    wanted = job.config.pipeline.topology
    if wanted != "auto":
        return Decision(wanted, f"pipeline.topology = {wanted!r}{_said(job, wanted)}")
    if not mpi_available():
        return Decision("single", "MPI is not installed: splatpipe[mpi]")
    return choose_topology(job, Workload.of_look(job))


def _said(job: Job, topology: str) -> str:
    """What a topology does with any number of ranks; nothing for the others."""
    if topology in (*CHAIN, "single"):
        return ""
    pipeline = job.config.pipeline
    ranks = ranks_to_start(pipeline, topology)
    if topology == FRAME_PARALLEL:
        film = "; rank 0 makes the film" if job.config.output.mp4 else ""
        return f": each of {ranks} ranks opens the whole scene, and draws and writes whole pictures in turn{film}"
    layout = layout_of(pipeline, ranks)
    culling, sampling = (len({r for lane in layout.lanes for r in getattr(lane, s)}) for s in ("culling", "sampling"))
    said = f": {ranks} ranks, {culling} cull, {sampling} sample, {len(layout.render)} render"
    if layout.split == "shares":
        share = job.scene.info.n_stored / len(layout.render)
        return f"{said} about {share:,.0f} of the stored points each; rank {layout.display} composites"
    if writes_screens(job, layout):
        return f"{said} a screen of the wall each, and write it"
    return said + (f" a tile each; rank {layout.display} has the picture" if layout.split == "tiles" else "")


def _ms(seconds: float) -> str:
    milliseconds = seconds * 1e3
    return f"{milliseconds:.0f} ms" if milliseconds >= 10 else f"{milliseconds:.2g} ms"
