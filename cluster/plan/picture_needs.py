"""Parts behind the rasterizer: views, composition, outputs."""

from __future__ import annotations

from ..job import Job
from .costs import COSTS, draw_core_s
from .part import DEPTHS, FILM, LIGHTING, NORMALS, PNG, Part
from .workload import Workload


def picture_parts(job: Job, work: Workload) -> list[Part]:
    """Those of a run with an average frame like this; a frame is a view of a picture."""
    output = job.config.output
    composed = work.pixels * job.composed_share
    return [
        _views(job, work),
        _supersampling(job, work),
        _lighting(job, composed),
        _encoding(PNG, "output.png", output.png, COSTS.png_s * composed),
        _encoding(FILM, "output.mp4", output.mp4, COSTS.mp4_s * composed),
        _encoding(DEPTHS, "output.depth", output.depth, COSTS.depth_s * composed),
        _encoding(NORMALS, "output.normals", output.normals, COSTS.normals_s * composed),
        _sixteen_bits(job, composed),
    ]


def _views(job: Job, work: Workload) -> Part:
    view, n = job.config.camera.view, job.views.per_picture
    frame_ms = (work.culling_s + work.sampling_s + draw_core_s(job, work)) * 1e3
    if n == 1:
        return Part(
            "second eye, panorama", True, "camera.view is mono: one view a picture", frame_ms, "core-ms/picture"
        )
    why = f"camera.view is {view}: {n} views a picture"
    return Part("second eye, panorama", False, why, (n - 1) * frame_ms, "core-ms/picture")


def _supersampling(job: Job, work: Workload) -> Part:
    factor = job.config.render.supersampling
    pixel_ms = (COSTS.pixel_s + COSTS.average_s) * work.pixels * 1e3
    if factor == 1:
        why = "render.supersampling is 1: at 2, four pixels would be drawn and averaged for each"
        return Part("supersampling", True, why, 4 * pixel_ms, "core-ms/frame")
    why = f"render.supersampling is {factor}: {factor * factor} pixels are drawn and averaged for each"
    return Part("supersampling", False, why, pixel_ms, "core-ms/frame")


def _lighting(job: Job, composed: float) -> Part:
    strength = job.config.render.edl_strength
    return Part(
        LIGHTING, not strength, f"render.edl_strength is {strength:g}", COSTS.edl_s * composed * 1e3, "core-ms/frame"
    )


def _encoding(what: str, key: str, wanted: bool, cost_s: float) -> Part:
    return Part(what, not wanted, f"{key} is {str(wanted).lower()}", cost_s * 1e3, "core-ms/frame")


def _sixteen_bits(job: Job, composed: float) -> Part:
    bits = job.config.output.png_bits
    return Part("16-bit colours", bits == 8, f"output.png_bits is {bits}", 4 * composed, "bytes/frame", "counted")
