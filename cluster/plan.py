"""What a run leaves out because its scene or configuration does not need it, and why."""

from __future__ import annotations

from .job import Job


def left_out(job: Job, topology: str, rasterizer: str) -> list[dict[str, str]]:
    """Parts of the program that this run does without: ``what`` and ``why``, one entry each."""
    config, info = job.config, job.scene.info
    items: list[tuple[bool, str, str]] = [
        (topology == "single", "MPI", "one rank: nodes call each other, no message is sent"),
        ("normal" not in info.attributes, "normals and back-face test", "the scene has no normals"),
        ("normal" in info.attributes and not job.backface, "back-face test", "culling.backface is false"),
        (not rasterizer.startswith("gl"), "OpenGL", f"rasterizer {rasterizer}: no context, no shader"),
        (
            config.sampling.pixel_threshold == 0,
            "level of detail",
            "sampling.pixel_threshold = 0: every point is drawn",
        ),
        (config.render.point_size_world == 0, "attenuation", "render.point_size_world = 0: fixed point size"),
        (
            job.largest_point_px == 1,
            "splat loop",
            "points are one pixel: the kernel without the inner loop is used",
        ),
        (not config.output.png, "PNG encoding", "output.png is false"),
        (not config.output.mp4, "film encoding", "output.mp4 is false"),
    ]
    unused = [name for name in info.attributes if name not in job.attributes_read]
    items.append((bool(unused), f"attributes {', '.join(unused)}", "neither colour nor culling reads them"))
    return [{"what": what, "why": why} for holds, what, why in items if holds]
