"""Application parameters (thesis Table 3-1 B) of a configuration: counted where possible, timed in a run of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from ...nodes.pooled_entries import PooledForms
from ...nodes.raster.reference import covered_pixels
from ...shared.config import load_config
from ...shared.messages import HEADER, RENDER_POINT, FrameStart, encode
from ...shared.octree import Octree
from ..job import Job
from ..measured import measured_run
from ..plan.topology import decide
from .parameters import NOT_APPLICABLE, Application, Quantity, RankLoad, Traffic, derived, measured, parameters
from .probes import Figure

FRAMES = 30
"""Frames of the instrumented run, spread over the whole camera path."""

_WORD_BYTES = 8
_POINT_BYTES = 16  # x, y, z, colour as they are resident
_STAGES = ("culling", "sampling", "render")


def instrumented_run(config: Path, overrides: list[str]) -> tuple[dict[str, Any], list[str]]:
    """The ``run.json`` of a short run of a configuration, and the overrides that made it.

    The topology is the one that the whole run would take. Raises InputError for a bad configuration.
    """
    job = Job(load_config(config, overrides))
    overrides = [
        *overrides,
        f"pipeline.topology={decide(job).topology}",
        f"output.frames={min(job.n_pictures, FRAMES)}",
    ]
    return measured_run(config, overrides), overrides


def measured_application(
    config: Path, overrides: list[str], run: dict[str, Any], found: dict[str, Any], frames_per_s: float
) -> Application:
    """The application parameters of a run.

    run, overrides : of ``instrumented_run``.  found : of ``measure_ranks``.
    """
    job = Job(load_config(config, overrides))
    octree = job.load_octree()
    per_frame = run["per_frame"]
    gpu = run["rasterizer"].startswith("gl")
    entries_bytes = max(per_frame["entries"]) * RENDER_POINT.itemsize
    bits_bytes = (len(octree) + 7) // 8
    framebuffer_bytes = job.views.width * job.views.height * _WORD_BYTES
    n_points = max(per_frame["points"])
    cpu_bytes = {
        "culling": _octree_bytes(octree) + bits_bytes,
        "sampling": _octree_bytes(octree) + bits_bytes + entries_bytes,
        "render": entries_bytes + framebuffer_bytes + (0 if gpu else n_points * _POINT_BYTES),
    }
    jumps = {"culling": 0, "sampling": len(octree), "render": max(per_frame["entries"])}
    loads = []
    for rank, machine in zip(run["ranks"], found["ranks"], strict=True):
        role = rank["role"]
        stages = _STAGES if role == "single" else (role,)
        draws = "render" in stages
        work_s = np.sum([per_frame[f"{stage}_s"] for stage in stages], axis=0)
        late_s = float(np.percentile(work_s, 95))
        data = sum(cpu_bytes[stage] for stage in stages)
        values: dict[str, Quantity] = {item.name: derived(0) for item in parameters(RankLoad)}
        values |= {
            "cpu_bytes": derived(data, "every array once"),
            "operations_per_byte": measured(
                late_s * machine["values"]["cpu_flop_per_s"] / data, f"95th percentile of {len(work_s)} frames"
            ),
            "jumps": derived(sum(jumps[stage] for stage in stages)),
            "vertices_per_s": NOT_APPLICABLE,
            "fragments_per_s": NOT_APPLICABLE,
        }
        if draws:
            values |= {
                "framebuffer_bytes": derived(framebuffer_bytes),
                "read_back_share": derived(1 if gpu else 0),
                "read_backs": derived(1 if gpu else 0),
                "vertices": measured(n_points, "the frame with most points"),
                "vertex_bytes": measured(entries_bytes if gpu else 0, "entries; points stay on the GPU"),
                "vertices_per_s": _rate(found["render"]["vertices_per_s"], run["rasterizer"]),
                "fragments": derived(_fragments(job, octree, int(np.argmax(per_frame["points"])))),
                "fragments_per_s": _rate(found["render"]["fragments_per_s"], run["rasterizer"]),
            }
        loads.append(RankLoad(role, **values))
    return Application(frames_per_s, tuple(loads), _traffic(run, job, bits_bytes, entries_bytes))


def _rate(figure: dict[str, Any], rasterizer: str) -> Quantity:
    return measured(figure["value"], f"{rasterizer}, {Figure(**figure).spread}")


def _octree_bytes(octree: Octree) -> int:
    arrays = [getattr(octree, item.name) for item in dataclasses.fields(octree)] + [octree.centers]
    return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))


def _fragments(job: Job, octree: Octree, frame: int) -> int:
    """Pixels that a frame's points cover; the frame is selected again, as the run did."""
    camera = job.camera(frame)
    chosen = job.sampling_node(octree).process(camera, job.culling_node(octree).process(camera))
    points = job.load_points(verify=False)
    return covered_pixels(points, camera, PooledForms.of(octree).as_ranges(octree, chosen.entries), job.point_size)


def _traffic(run: dict[str, Any], job: Job, bits_bytes: int, entries_bytes: int) -> tuple[Traffic, ...]:
    """Messages of the three-rank pipeline, a frame; headers included. One rank sends nothing."""
    role = {rank["role"]: rank["rank"] for rank in run["ranks"]}
    if len(role) == 1:
        return ()
    camera = sum(map(len, encode(FrameStart(job.camera(0)))))
    sent = {
        ("culling", "sampling"): (2, camera + HEADER.size + bits_bytes),
        ("culling", "render"): (1, camera),
        ("sampling", "render"): (1, HEADER.size + entries_bytes),
        ("render", "culling"): (1, HEADER.size),
    }
    return tuple(
        Traffic(role[sender], role[receiver], derived(count), measured(n_bytes))
        for (sender, receiver), (count, n_bytes) in sent.items()
    )
