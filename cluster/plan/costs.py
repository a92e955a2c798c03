"""What a unit of each kind of work costs, and what an average frame of them takes."""

from __future__ import annotations

from dataclasses import dataclass

from ..job import Job
from .workload import Workload


@dataclass(frozen=True)
class UnitCosts:
    """Seconds of one core for a unit of work, from runs on 2 cores of an Intel Xeon without a GPU.

    They stand only for what cannot be tried without loading the points: culling and sampling are timed where the run
    starts. Another machine's clock scales them together, which moves no decision.

    point_s, square_s : drawing a point of one pixel, of 3×3; sized_s : more for one pixel found by size.
    pixel_s : clearing and merging a framebuffer word.
    entry_s : of a render-points entry, before the threads start.
    gl_point_s : of a GPU, which takes no core; not measured.  picture_s, png_s, mp4_s : of a pixel.
    message_s, message_byte_s : a frame's messages and waits, each of their bytes.
    code_byte_s : coding and decoding a byte.  coded_framebuffer, coded_bits : what is left of it;
    coded_entry_bytes : of a render-points entry (``splatpipe bench messages``).
    start_s : three ranks instead of one, until the first frame.
    back_face_s, lod_s : of a cell.  flatness_s : of a point, when building.  checksum_s : of a byte.
    opengl_s, colour_maps_s : import, and for OpenGL a context.
    class_s, box_s : filtering a point, when loading.  compact_s : encoding a point, when loading.
    spacing_s : of a cell, when loading.  splat_s : of a splat of a few pixels, all passes.
    edl_s, average_s : lighting a pixel, averaging a drawn one.  depth_s, normals_s : a pixel, written.
    """

    point_s: float = 4e-9
    square_s: float = 13e-9
    sized_s: float = 5e-9
    pixel_s: float = 1.5e-9
    entry_s: float = 0.2e-6
    gl_point_s: float = 0.5e-9
    picture_s: float = 3e-9
    png_s: float = 34e-9
    mp4_s: float = 29e-9
    message_s: float = 0.5e-3
    message_byte_s: float = 1e-9
    code_byte_s: float = 3.5e-9
    coded_framebuffer: float = 0.48
    coded_bits: float = 0.15
    coded_entry_bytes: float = 3.7
    start_s: float = 2.0
    back_face_s: float = 5e-9
    lod_s: float = 6e-9
    flatness_s: float = 180e-9
    checksum_s: float = 0.4e-9
    opengl_s: float = 0.1
    colour_maps_s: float = 0.1
    class_s: float = 2e-9
    box_s: float = 4e-9
    compact_s: float = 12e-9
    spacing_s: float = 12e-6
    splat_s: float = 300e-9
    edl_s: float = 28e-9
    average_s: float = 15e-9
    depth_s: float = 11e-9
    normals_s: float = 190e-9


COSTS = UnitCosts()


def draw_core_s(job: Job, work: Workload, costs: UnitCosts = COSTS) -> float:
    """Seconds of one core that drawing an average frame takes; 0 where OpenGL draws."""
    if job.rasterizer != "cpu":
        return 0.0
    if job.splats:
        point_s = costs.splat_s
    else:
        point_s = costs.point_s if job.largest_point_px == 1 else costs.square_s
    return point_s * work.points + costs.pixel_s * work.pixels


def compose_core_s(job: Job, work: Workload, costs: UnitCosts = COSTS) -> float:
    """Seconds of one core that composing pictures adds to a frame, shared by the threads that draw."""
    render, output = job.config.render, job.config.output
    a_pixel_s = (
        costs.edl_s * bool(render.edl_strength) + costs.depth_s * output.depth + costs.normals_s * output.normals
    )
    averaged_s = costs.average_s * work.pixels * (render.supersampling > 1)
    return a_pixel_s * work.pixels * job.composed_share + averaged_s
