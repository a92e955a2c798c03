"""Every part of the program that a run can do without: needed or left out, why, and what leaving it out gains."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from ...nodes.raster.choose import resolve_rasterizer
from ...shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from ..job import Job
from .topology import COSTS, Decision
from .workload import Workload

MPI, OPENGL, PNG, FILM = "MPI", "OpenGL", "PNG encoding", "film encoding"
NO_NORMALS, BACK_FACE = "normals and back-face test", "back-face test"
LEVEL_OF_DETAIL, SPLAT_LOOP = "level of detail", "splat loop and attenuation"
COLOUR, COLOUR_MAPS, CHECKSUMS = "colour column", "colour maps", "checksums"

_MEASURED_UNITS = {CHECKSUMS: "ms of loading"}
_COLOUR_MAPPED = ("intensity", "elevation", "level")


@dataclass(frozen=True)
class Part:
    """One part of the program.

    left_out : whether this run does without it.  why : the fact that decides it.
    gain, unit : what leaving it out saves or, of a part that is kept, would save; None where nothing is known.
    basis : ``counted`` (bytes that are not there), ``predicted`` (counts × unit costs) or ``measured``.
    """

    what: str
    left_out: bool
    why: str
    gain: float | None
    unit: str
    basis: str = "predicted"

    def as_dict(self) -> dict[str, Any]:
        """For ``run.json``: what, why and gain."""
        return {"what": self.what, "why": self.why, "gain": self.gain, "unit": self.unit, "basis": self.basis}


def parts(job: Job, work: Workload, decision: Decision) -> list[Part]:
    """All parts, left out or kept, of a run with this topology and an average frame like this."""
    return [
        _mpi(decision),
        _compositing(work),
        _back_face_test(job, work),
        _level_of_detail(job, work),
        _render_point_stride(job, work),
        _splat_loop(job, work),
        _colour(job),
        *_attributes(job),
        _codec(),
        _flatness(job),
        _checksums(job),
        _opengl(job),
        _colour_maps(job),
        _encoding(job, work, PNG, "output.png", job.config.output.png, COSTS.png_s),
        _encoding(job, work, FILM, "output.mp4", job.config.output.mp4, COSTS.mp4_s),
    ]


def left_out(job: Job, work: Workload, decision: Decision) -> list[dict[str, Any]]:
    """The parts that a run leaves out, for ``run.json``."""
    return [part.as_dict() for part in parts(job, work, decision) if part.left_out]


def with_measured(found: Iterable[Part], saved_ms: Mapping[str, float]) -> list[Part]:
    """The parts with what an ablation measured, milliseconds by part, instead of what was predicted."""
    return [
        replace(part, gain=saved_ms[part.what], unit=_MEASURED_UNITS.get(part.what, "ms/frame"), basis="measured")
        if part.what in saved_ms and part.basis == "predicted"
        else part
        for part in found
    ]


def _mpi(decision: Decision) -> Part:
    single = decision.topology == "single"
    if decision.estimate is None:
        return Part(MPI, single, decision.reason, COSTS.message_s * 1e3, "ms/frame")
    return Part(MPI, single, decision.reason, -decision.estimate.saved_s, "s/run")


def _compositing(work: Workload) -> Part:
    sent = work.pixels * FRAMEBUFFER_EMPTY.nbytes
    return Part("compositing", True, "one render rank: no framebuffer is sent", sent, "bytes/frame", "counted")


def _back_face_test(job: Job, work: Workload) -> Part:
    cost_ms = COSTS.back_face_s * work.cells_visible * 1e3
    if "normal" not in job.scene.info.attributes:
        return Part(NO_NORMALS, True, "the scene has no normals", cost_ms, "ms/frame")
    if not job.backface:
        return Part(BACK_FACE, True, "culling.backface is false", cost_ms, "ms/frame")
    return Part(BACK_FACE, False, "culling.backface is true: closed surfaces", cost_ms, "ms/frame")


def _level_of_detail(job: Job, work: Workload) -> Part:
    cost_ms = COSTS.lod_s * work.cells_visible * 1e3
    if work.cells == 1:
        return Part(LEVEL_OF_DETAIL, True, "one cell: there is nothing to choose between", cost_ms, "ms/frame")
    if job.pixel_threshold == 0:
        why = "sampling.pixel_threshold = 0: every point is drawn"
        return Part(LEVEL_OF_DETAIL, True, why, cost_ms, "ms/frame")
    share = 1 - work.points / job.scene.info.n_points
    why = f"sampling.pixel_threshold = {job.pixel_threshold:g}: with culling it spares {share:.0%} of the points"
    return Part(LEVEL_OF_DETAIL, False, why, cost_ms, "ms/frame")


def _render_point_stride(job: Job, work: Workload) -> Part:
    stride_bytes = RENDER_POINT["stride"].itemsize * work.entries
    why = "points in leaves only: an inner cell is thinned by its stride"
    if job.scene.info.point_order == "layered":
        why = "always 1 in layered order, yet kept: one message for both point orders costs less than two"
    return Part("stride of render-points entries", False, why, stride_bytes, "bytes/frame", "counted")


def _splat_loop(job: Job, work: Workload) -> Part:
    cost_ms = COSTS.sized_s * work.points * 1e3
    if job.largest_point_px == 1:
        why = "points are one pixel: the kernel without sizes and inner loop is used"
        return Part(SPLAT_LOOP, True, why, cost_ms, "core-ms/frame")
    return Part(SPLAT_LOOP, False, f"points are up to {job.largest_point_px} px wide", cost_ms, "core-ms/frame")


def _colour(job: Job) -> Part:
    column_mb = 4e-6 * job.scene.info.n_stored
    if job.colouring.mode == "constant":
        return Part(COLOUR, True, "one colour for every point", column_mb, "MB resident", "counted")
    return Part(COLOUR, False, f"points differ in colour ({job.colouring.mode})", column_mb, "MB resident", "counted")


def _attributes(job: Job) -> list[Part]:
    info = job.scene.info
    unused = [name for name in info.attributes if name not in job.attributes_read]
    if not unused:
        return []
    size_mb = 1e-6 * sum(info.arrays[f"attr_{name}"].bytes for name in unused)
    why = "neither colour nor culling reads them"
    return [Part(f"attributes {', '.join(unused)}", True, why, size_mb, "MB read", "counted")]


def _codec() -> Part:
    return Part("codecs", True, "the scene holds plain float32 positions, drawn as they are", None, "ms/frame")


def _flatness(job: Job) -> Part:
    info = job.scene.info
    cost_s = COSTS.flatness_s * info.n_points
    if info.build.get("flatness"):
        return Part("flatness analysis", False, "the scene was built with it", cost_s, "s of building")
    return Part("flatness analysis", True, "the scene was built without --flatness", cost_s, "s of building")


def _checksums(job: Job) -> Part:
    info = job.scene.info
    cost_s = COSTS.checksum_s * (12 * info.n_stored + sum(info.arrays[f"attr_{n}"].bytes for n in job.attributes_read))
    if job.config.scene.verify:
        return Part(CHECKSUMS, False, "scene.verify is true: damage is named, not drawn", cost_s, "s of loading")
    return Part(CHECKSUMS, True, "scene.verify is false", cost_s, "s of loading")


def _opengl(job: Job) -> Part:
    rasterizer = resolve_rasterizer(job.config.render.rasterizer)
    cpu = rasterizer == "cpu"
    why = "rasterizer cpu: no import, context or shader" if cpu else f"rasterizer {rasterizer}"
    return Part(OPENGL, cpu, why, COSTS.opengl_s, "s of starting")


def _colour_maps(job: Job) -> Part:
    mapped = job.colouring.mode in _COLOUR_MAPPED
    why = f"colour {job.colouring.mode} " + ("goes through one" if mapped else "needs none: matplotlib is not imported")
    return Part(COLOUR_MAPS, not mapped, why, COSTS.colour_maps_s, "s of starting")


def _encoding(job: Job, work: Workload, what: str, key: str, wanted: bool, unit_s: float) -> Part:
    return Part(what, not wanted, f"{key} is {str(wanted).lower()}", unit_s * work.pixels * 1e3, "core-ms/frame")
