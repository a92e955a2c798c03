"""The two passes over every point of every sweep: first time alone, then error alone.

In the first, the nodes of one rank draw the frames again and again, warm, and nothing else is done. In the second each
frame is drawn once more, encoded, and held against its reference. Pictures are the same bits each time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...shared import metrics
from ...shared.camera import Camera
from ...shared.colour import frame_to_rgba
from ...shared.errors import DeviceError
from ...shared.messages import FrameStart, encode
from ..progress import FrameProgress
from .config import ErrorConfig, SweepPoint
from .picture import decode_picture, encode_picture
from .scene import STAGES, Pipeline, SweptScene


@dataclass(frozen=True)
class Omission:
    """What the sweep left out, and why."""

    what: str
    why: str


ROUNDS = 3
"""Times that the first pass goes over all points of a scene."""

NOT_MEASURED = (
    Omission(
        "splats against closed surfaces",
        "the reference is of points: gaps between them that splats close are errors",
    ),
    Omission("rounding of stored positions", "the reference has them as the scene has, whatever it was built with"),
)


@dataclass(frozen=True)
class Sweep:
    """What was found: one row a point that could be measured, in the order of the configuration; the rest named."""

    rows: list[dict[str, Any]]
    omissions: list[Omission]


def run_sweep(config: ErrorConfig, source: str, progress: FrameProgress) -> Sweep:
    """Measure every point on every scene; a point that this machine cannot draw becomes an omission.

    source : the file, for messages.
    Raises, before anything is measured: InputError for a scene that is missing or damaged, DeviceError where SSIM or
    FLIP are not installed.
    """
    metrics.check_installed()
    rows: list[dict[str, Any]] = []
    omissions: dict[Omission, None] = {}  # an ordered set
    for scene in [SweptScene(config, entry, source) for entry in config.scene]:
        scene.prepare(progress)
        timed, not_drawn = _time_points(scene, config.repeats, progress)
        omissions |= dict.fromkeys(not_drawn)
        references = scene.references(progress)
        for i, (point, times) in enumerate(timed.items()):
            progress.show(f"{scene.name}: errors of {point.method}", i, len(timed))
            rows.append(_time_row(scene, point, times) | _errors(scene, point, references))
            omissions |= dict.fromkeys(_without_value(rows[-1]))
    return Sweep(rows, [*omissions, *NOT_MEASURED])


@dataclass
class _Times:
    """Seconds of one point: (camera, stage) of each pass, and encoding of each picture.  device : what drew."""

    passes: list[list[list[float]]] = field(default_factory=list)
    encode: list[float] = field(default_factory=list)
    device: str = ""


def _time_points(
    scene: SweptScene, repeats: int, progress: FrameProgress
) -> tuple[dict[SweepPoint, _Times], list[Omission]]:
    """First pass. The repeats of a point are spread over ``ROUNDS``, so that a slow moment of the machine meets all."""
    timed = {point: _Times() for point in scene.points}
    not_drawn = []
    for n in range(ROUNDS):
        for i, point in enumerate(scene.points):
            progress.show(f"{scene.name}: timing {point.method}", n * len(scene.points) + i, ROUNDS * len(scene.points))
            share = repeats * (n + 1) // ROUNDS - repeats * n // ROUNDS
            if share and point in timed:
                try:
                    _time_point(scene, point, share, timed[point])
                except DeviceError as error:
                    not_drawn.append(Omission(f"{point.method}: {point.key} = {point.value}", str(error)))
                    del timed[point]
    return timed, not_drawn


def _time_point(scene: SweptScene, point: SweepPoint, repeats: int, times: _Times) -> None:
    with scene.open(point) as pipeline:
        pictures = [_rgb(pipeline.draw(camera)[2], scene) for camera in scene.cameras]  # warms up, too
        times.passes += [[pipeline.timed_draw(camera) for camera in scene.cameras] for _ in range(repeats)]
        times.device = pipeline.render.description
    encode_picture(pictures[0], point.config.image)  # warms up
    for picture in pictures:
        started = time.perf_counter()
        encode_picture(picture, point.config.image)
        times.encode.append(time.perf_counter() - started)


def _time_row(scene: SweptScene, point: SweepPoint, times: _Times) -> dict[str, Any]:
    """What a point is, and its times: mean of a frame over the cameras, median and quartiles over the repeats.

    The time to encode a picture stands beside it, not in it. Milliseconds.
    """
    of_pass = np.array(times.passes).mean(axis=1)  # (repeats, stages)
    first_quartile, median, third_quartile = 1e3 * np.percentile(of_pass.sum(axis=1), [25, 50, 75])
    return {
        "scene": scene.name,
        "method": point.method,
        "key": point.key,
        "value": point.value,
        "order": scene.order_of(point),
        "rasterizer": times.device,
        "width": point.config.camera.width,
        "height": point.config.camera.height,
        "frames": len(scene.cameras),
        "repeats": len(of_pass),
        "frame_ms": float(median),
        "frame_q1_ms": float(first_quartile),
        "frame_q3_ms": float(third_quartile),
        **{f"{name}_ms": 1e3 * float(np.median(of_pass[:, i])) for i, name in enumerate(STAGES)},
        "encode_ms": 1e3 * float(np.median(times.encode)),
    }


def _errors(scene: SweptScene, point: SweepPoint, references: list[np.ndarray]) -> dict[str, Any]:
    """Second pass: counts, bytes and errors, each the mean over the cameras; None where no camera has a value."""
    with scene.open(point) as pipeline:
        frames = [
            _frame_errors(scene, point, pipeline, camera, reference)
            for camera, reference in zip(scene.cameras, references, strict=True)
        ]
        means = {}
        for name in frames[0]:
            values = [value for frame in frames if (value := frame[name]) is not None]
            means[name] = sum(values) / len(values) if values else None
        return {"position_bytes": pipeline.position_bytes, **means}


def _frame_errors(
    scene: SweptScene, point: SweepPoint, pipeline: Pipeline, camera: Camera, reference: np.ndarray
) -> dict[str, float | None]:
    bits, chosen, words = pipeline.draw(camera)
    messages = (FrameStart(camera), FrameStart(camera), bits, chosen)  # it goes to the sampling and to the render rank
    message_bytes = sum(len(header) + len(payload) for header, payload in map(encode, messages))
    image = point.config.image
    encoded = encode_picture(_rgb(words, scene), image)
    wanted, found = _rgb(reference, scene), decode_picture(encoded, image, camera.width, camera.height)
    in_front = metrics.foreground(reference)
    colour_rmse = metrics.rmse(wanted[in_front], found[in_front])
    rmse, similarity = metrics.rmse(wanted, found), metrics.ssim(wanted, found)
    return {
        "points": chosen.n_points,
        "pooled_points": chosen.n_pooled,
        "read_bytes": pipeline.read_bytes(chosen),
        "entries": len(chosen.entries),
        "message_bytes": message_bytes,
        "picture_bytes": len(encoded),
        "frame_bytes": message_bytes + len(encoded),
        "flip": metrics.flip(wanted, found),
        "ssim": similarity,
        "dissimilarity": None if similarity is None else 1 - similarity,
        "rmse": rmse,
        "psnr_db": metrics.psnr_db(rmse),
        "colour_rmse": colour_rmse,
        "colour_psnr_db": metrics.psnr_db(colour_rmse),
        **(_frame_geometry(scene, reference, words) if image.codec == "png" else dict.fromkeys(GEOMETRY)),
    }


GEOMETRY = ("holes", "false_pixels", "coverage_error", "depth_rmse")
"""Measures of a frame's words, which a lossy picture does not have."""


def _frame_geometry(scene: SweptScene, reference: np.ndarray, words: np.ndarray) -> dict[str, float | None]:
    covered = metrics.coverage(reference, words)
    depth = metrics.depth_rmse(reference, words)
    relative = None if depth is None or not scene.radius else depth / scene.radius
    return dict(zip(GEOMETRY, (covered.holes, covered.false_pixels, covered.error, relative), strict=True))


def _rgb(words: np.ndarray, scene: SweptScene) -> np.ndarray:
    return np.ascontiguousarray(frame_to_rgba(words, scene.background)[..., :3])


def _without_value(row: dict[str, Any]) -> Iterator[Omission]:
    """The measures that a row lacks, and why."""
    if row["ssim"] is None:
        yield Omission(f"{row['scene']}: SSIM", f"the picture is smaller than its window, {metrics.SSIM_WINDOW_PX} px")
    if row["key"].startswith("image.") and row["coverage_error"] is None:
        yield Omission(f"{row['method']}: coverage and depth", "a lossy picture has neither")
    elif row["coverage_error"] is None:
        yield Omission(f"{row['scene']}: coverage, depth, colour", "no point is in view: the reference covers no pixel")
    elif row["depth_rmse"] is None:
        yield Omission(f"{row['scene']}, {row['method']} = {row['value']}: depth", "no pixel is covered by both frames")
