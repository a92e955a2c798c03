"""Every part of the program that a run can do without: needed or left out, why, and what leaving it out gains."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from ...shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from ...shared.pooled import PoolCounts
from ..job import Job
from ..topologies import FRAME_PARALLEL, layout_of, ranks_to_start
from ..wall import writes_screens
from .costs import COSTS
from .part import (
    ADAPTIVE,
    BACK_FACE,
    BOXES,
    CHECKSUMS,
    CLASSES,
    COLOUR,
    COLOUR_MAPS,
    COMPRESSION,
    LAYERS,
    LEVEL_OF_DETAIL,
    MPI,
    NO_NORMALS,
    OPENGL,
    PAGING,
    SPLAT_LOOP,
    Part,
)
from .picture_needs import picture_parts
from .topology import Decision
from .workload import Workload

_MEASURED_UNITS: dict[str, str] = dict.fromkeys((CHECKSUMS, CLASSES, BOXES), "ms of loading")
_FEATURE_BYTES = 8 + 8 + 1 + 24 + 24  # CellFeatures, a cell
_COLOUR_MAPPED = ("intensity", "elevation", "level")


def parts(job: Job, work: Workload, decision: Decision) -> list[Part]:
    """All parts, left out or kept, of a run with this topology and an average frame like this."""
    return [
        _mpi(decision),
        _delivery(job, decision),
        _compositing(job, work, decision),
        _compression(job, work, decision),
        _back_face_test(job, work),
        _level_of_detail(job, work),
        _render_point_stride(job, work),
        _class_filter(job),
        _clip_boxes(job),
        _splat_loop(job, work),
        _adaptive_size(job, work),
        _compact_positions(job),
        _pools(job, work),
        _paging(job),
        _splats(job, work),
        _quads(job, work),
        _colour(job),
        *_attributes(job),
        _codec(job),
        _flatness(job),
        _checksums(job),
        *_layers(job, work),
        _opengl(job),
        _colour_maps(job),
        *picture_parts(job, work),
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


def _delivery(job: Job, decision: Decision) -> Part:
    info = job.scene.info
    read = [*info.position_arrays, "block_first_point", "block_origin"]
    read += [f"attr_{name}" for name in sorted(job.attributes_read)] + ["pool_codes"] * job.wanted.pools
    sent_mb = 1e-6 * sum(info.arrays[name].bytes for name in read)
    what, unit = "delivery of the scene by messages", "MB sent once"
    if decision.topology == "single":
        return Part(what, True, "one rank: scene.delivery has no effect, it opens the scene", sent_mb, unit)
    if job.config.scene.delivery == "files":
        return Part(what, True, "scene.delivery is files: every rank opens the scene", sent_mb, unit)
    why = f"scene.delivery is messages: the render rank opens none of its files; positions cross as {info.positions}"
    return Part(what, False, why, sent_mb, unit)


def _compositing(job: Job, work: Workload, decision: Decision) -> Part:
    sent, unit = 1e-6 * work.pixels * FRAMEBUFFER_EMPTY.nbytes, "MB/frame"
    if decision.topology == FRAME_PARALLEL:
        return Part("compositing", True, "a picture is drawn by one rank", sent, unit, "counted")
    pipeline = job.config.pipeline
    layout = layout_of(pipeline, ranks_to_start(pipeline, decision.topology))
    others = len(layout.render) - 1
    if decision.topology == "single" or not others:
        return Part("compositing", True, "one render rank: no framebuffer is sent", sent, unit, "counted")
    if writes_screens(job, layout):
        return Part("compositing", True, "wall.output is tiles: a screen is written by one rank", sent, unit, "counted")
    if layout.split == "tiles":
        sent *= others / len(layout.render)
        why = f"{others} ranks send rank {layout.display} their tiles, at most this; background is not sent"
    else:
        sent *= others
        why = f"{others} ranks send rank {layout.display} what they have drawn, at most this; background is not sent"
    return Part("compositing", False, why, sent, unit, "counted")


def _compression(job: Job, work: Workload, decision: Decision) -> Part:
    """What coding takes of a frame's time, less what it saves on the links where those are configured."""
    pipeline = job.config.pipeline
    raw, coded, kinds = _coded_messages(job, work, decision)
    spent_ms = 1e3 * COSTS.code_byte_s * raw
    if decision.topology == "single" or not kinds:
        why = "one rank: nothing is sent" if decision.topology == "single" else "no message of it has a coded form"
        return Part(COMPRESSION, True, why, None, "ms/frame")
    why = f"pipeline.compression is {pipeline.compression}: {kinds}, about {raw:,.0f} → {coded:,.0f} bytes a frame"
    if pipeline.link_mb_per_s:
        saved_ms = 1e-3 * (raw - coded) / pipeline.link_mb_per_s
        why += f", would save {saved_ms:.3g} ms at pipeline.link_mb_per_s = {pipeline.link_mb_per_s:g}"
        off = pipeline.compression == "off" or (pipeline.compression == "auto" and saved_ms <= spent_ms)
        return Part(COMPRESSION, off, why, spent_ms - saved_ms, "ms/frame")
    if pipeline.compression == "auto":
        even = 1e-3 * (raw - coded) / spent_ms
        why += f"; coded between hosts whose link is measured below about {even:,.0f} MB/s"
    return Part(COMPRESSION, pipeline.compression == "off", why, spent_ms, "ms/frame")


def _coded_messages(job: Job, work: Workload, decision: Decision) -> tuple[float, float, str]:
    """Bytes of a frame's messages that have a coded form, at most; those coded, about; which they are."""
    if decision.topology in ("single", FRAME_PARALLEL):
        return 0.0, 0.0, ""
    pipeline = job.config.pipeline
    layout = layout_of(pipeline, ranks_to_start(pipeline, decision.topology))
    raw = coded = 0.0
    kinds = []
    if any(lane.culling != lane.sampling or lane.sampling != lane.render for lane in layout.lanes):
        raw = work.cells / 8 + RENDER_POINT.itemsize * work.entries
        coded = COSTS.coded_bits * work.cells / 8 + COSTS.coded_entry_bytes * work.entries
        kinds.append("visibility bits and render-points")
    others = len(layout.render) - 1
    if others:
        pictures = others / len(layout.render) if layout.split == "tiles" else others
        raw += pictures * work.pixels * FRAMEBUFFER_EMPTY.nbytes
        coded += pictures * work.pixels * FRAMEBUFFER_EMPTY.nbytes * COSTS.coded_framebuffer
        kinds.append("framebuffers")
    return raw, coded, " and ".join(kinds)


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


def _class_filter(job: Job) -> Part:
    classes = job.point_filter.classes
    why = (
        f"only classes {', '.join(map(str, classes))} are drawn"
        if classes
        else "filter.classes is empty: all are drawn"
    )
    return Part(CLASSES, not classes, why, COSTS.class_s * job.scene.info.n_stored, "s of loading")


def _clip_boxes(job: Job) -> Part:
    n = len(job.point_filter.boxes)
    cost_s = COSTS.box_s * max(n, 1) * job.scene.info.n_stored
    return Part(
        BOXES,
        not n,
        f"{n} boxes, applied once, and cells beyond them are spared" if n else "filter.boxes is empty",
        cost_s,
        "s of loading",
    )


def _splat_loop(job: Job, work: Workload) -> Part:
    cost_ms = COSTS.sized_s * work.points * 1e3
    if job.splats:
        return Part(SPLAT_LOOP, True, "splats have radii of their own", cost_ms, "core-ms/frame")
    if job.largest_point_px == 1:
        why = "points are one pixel: the kernel without sizes and inner loop is used"
        return Part(SPLAT_LOOP, True, why, cost_ms, "core-ms/frame")
    return Part(SPLAT_LOOP, False, f"points are up to {job.largest_point_px} px wide", cost_ms, "core-ms/frame")


def _adaptive_size(job: Job, work: Workload) -> Part:
    cost_s = COSTS.spacing_s * work.cells
    why = "render.point_size_adaptive is " + (
        "true: sides follow the spacing of each cell" if job.wanted.spacing else "false"
    )
    return Part(ADAPTIVE, not job.wanted.spacing, why, cost_s, "s of loading")


def _compact_positions(job: Job) -> Part:
    cost_s = COSTS.compact_s * job.scene.info.n_stored
    if job.compact and (job.splats or job.rasterizer != "cpu"):
        why = f"{'splats' if job.splats else f'rasterizer {job.rasterizer}'}: only points on cpu are drawn from them"
        return Part("compact positions", True, why, cost_s, "s of loading")
    if job.compact:
        why = "render.positions is compact: 4 or 8 bytes a point are read for its 12"
        return Part("compact positions", False, why, cost_s, "s of loading")
    why = "render.positions is " + ("coded" if job.coded else "float32")
    return Part("compact positions", True, why, cost_s, "s of loading")


def _pools(job: Job, work: Workload) -> Part:
    scene = job.scene
    size_mb = 1e-6 * scene.info.pool_bytes or None
    held = "the scene was built without --pools"
    if scene.info.pool_bits:
        held = ", ".join(PoolCounts.of(scene.octree(pools=True)).texts())
    if job.pools == "off":
        return Part("pools", True, f"{job.why_no_pools}; {held}", size_mb, "MB read", "counted")
    share = work.pooled_points / max(work.points, 1)
    why = f"sampling.pools is {job.pools}: {share:.0%} of the points are drawn from them; {held}"
    return Part("pools", False, why, size_mb, "MB read", "counted")


def _paging(job: Job) -> Part:
    memory = job.config.memory
    if not job.paged:
        why = "memory.residency is mapped: what was drawn stays resident as far as memory goes"
        return Part(PAGING, True, why, None, "bytes read/frame")
    whole_mb = 1e-6 * job.scene.info.n_stored * (job.position_bytes + job.attribute_bytes)
    why = f"memory.residency is paged: a pool of {memory.budget} for {whole_mb:,.0f} MB of points; frames "
    why += "wait for theirs" if memory.complete else "are drawn from those that are there"
    return Part(PAGING, False, why, None, "bytes read/frame")


def _splats(job: Job, work: Workload) -> Part:
    cost_ms = (COSTS.splat_s - COSTS.point_s) * work.points * 1e3
    why = f"render.style is {job.config.render.style}"
    return Part("splat passes, normals and radii", job.splats is None, why, cost_ms, "core-ms/frame")


def _quads(job: Job, work: Workload) -> Part:
    size_mb = 1e-6 * _FEATURE_BYTES * work.cells
    why = (
        f"splats.features is {str(job.config.splats.features).lower()}" if job.splats else "points are drawn, no splats"
    )
    return Part("quads of flat cells", not job.wanted.features, why, size_mb, "MB resident", "counted")


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
    why = "nothing of this run reads them"
    return [Part(f"attributes {', '.join(unused)}", True, why, size_mb, "MB read", "counted")]


def _codec(job: Job) -> Part:
    info = job.scene.info
    if info.positions == "float32":
        return Part("codecs", True, "the scene holds plain float32 positions", None, "s of loading")
    bits = 8 * info.position_bytes / info.n_stored
    why = f"the scene holds positions as {info.positions}, {bits:.1f} bits each, which are decoded when they are loaded"
    if job.coded:
        why = f"render.positions is coded: whole sets are drawn from linear groups, {bits:.1f} bits a position"
    return Part("codecs", False, why, None, "s of loading")


def _flatness(job: Job) -> Part:
    info = job.scene.info
    cost_s = COSTS.flatness_s * info.n_points
    if info.build.get("flatness"):
        return Part("flatness analysis", False, "the scene was built with it", cost_s, "s of building")
    return Part("flatness analysis", True, "the scene was built without --flatness", cost_s, "s of building")


def _checksums(job: Job) -> Part:
    info = job.scene.info
    read = (*info.position_arrays, *(f"attr_{name}" for name in job.attributes_read))
    cost_s = COSTS.checksum_s * sum(info.arrays[name].bytes for name in read)
    if job.paged:
        why = (
            "memory.residency is paged: points are not read at the start; headers, sizes, cells and blocks are checked"
        )
        return Part(CHECKSUMS, True, why, cost_s, "s of loading")
    if job.config.scene.verify:
        return Part(CHECKSUMS, False, "scene.verify is true: damage is named, not drawn", cost_s, "s of loading")
    return Part(CHECKSUMS, True, "scene.verify is false", cost_s, "s of loading")


def _layers(job: Job, work: Workload) -> list[Part]:
    """A part for each layer: what it has on the device, and what triangles would take there."""
    if not job.layers:
        return [Part(LAYERS, True, "no [[layers]]: no OpenGL and no shader for them", None, "MB resident", "counted")]
    from ...nodes.layers.sizes import layer_bytes
    from ...shared.layers.kinds import objects_of

    found = []
    for layer, settings, drawn in zip(job.layers, job.config.layers, work.objects, strict=True):
        held, as_triangles = (layer_bytes(layer, settings, how) for how in (settings.technique, "triangles"))
        why = f"{len(layer):,} {objects_of(layer.kind)}, {drawn:,.0f} a frame, as {settings.technique}: "
        why += f"{_size(held)} resident"
        if settings.technique != "triangles":
            why += f", as triangles {_size(as_triangles)}"
        found.append(Part(f"layer {layer.name}", False, why, 1e-6 * held, "MB resident", "counted"))
    return found


def _size(n_bytes: int) -> str:
    return f"{1e-6 * n_bytes:,.1f} MB" if n_bytes >= 1e6 else f"{1e-3 * n_bytes:,.1f} kB"


def _opengl(job: Job) -> Part:
    cpu = job.rasterizer == "cpu"
    why = "rasterizer cpu: no import, context or shader" if cpu else f"rasterizer {job.rasterizer}"
    if job.layers:
        why = f"layers are drawn with it; rasterizer {job.rasterizer}"
    return Part(OPENGL, cpu and not job.layers, why, COSTS.opengl_s, "s of starting")


def _colour_maps(job: Job) -> Part:
    mapped = job.colouring.mode in _COLOUR_MAPPED
    why = f"colour {job.colouring.mode} " + ("goes through one" if mapped else "needs none: matplotlib is not imported")
    if not mapped and (by_value := [layer.name for layer in job.layers if layer.kind != "blocks"]):
        mapped, why = True, f"values of layers go through them: {', '.join(by_value)}"
    return Part(COLOUR_MAPS, not mapped, why, COSTS.colour_maps_s, "s of starting")
