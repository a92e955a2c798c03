"""``splatpipe bench lod``: level of detail over a large mapped scene, its time beside its error.

Culling, sampling and the cpu rasterizer draw two generated scenes along two paths each, one after the other on one
rank, with every core, the point columns mapped from the disk. The pictures of some frames are held against all points,
drawn by the same rasterizer: what level of detail changes is the only difference. Errors are taken in frames of their
own, so that no timing holds them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ...nodes.culling import CullingNode
from ...nodes.raster.cpu import CpuRasterizer
from ...nodes.render import RenderNode, load_points
from ...nodes.sampling import SamplingNode
from ...shared.build import BuildSettings, build_scene
from ...shared.camera import Camera
from ...shared.camera_path import camera_path
from ...shared.colour import Colouring, frame_to_rgba, parse_colour
from ...shared.config import CameraSection, Keyframe
from ...shared.messages import RenderPoints
from ...shared.metrics import coverage, depth_rmse, foreground, psnr_db, rmse
from ...shared.process_memory import resident_bytes
from ...shared.readers.source import Source
from ...shared.store import Scene
from ...shared.synth import CityScan
from ...shared.synth.sphere import SphereScan
from ..progress import FrameProgress
from ..record import machine_record

STAGES = ("culling", "sampling", "render")
_BYTES_PER_POINT = 16
_BACKGROUND = "#1e2127"


@dataclass(frozen=True)
class _Surface:
    """A generated scene: where its points come from, what is kept of them, and how a camera flies over it."""

    source: Callable[[int], Source]
    attributes: tuple[str, ...]
    fly: list[Keyframe]


def _key(time: float, eye: tuple[float, float, float], target: tuple[float, float, float]) -> Keyframe:
    return Keyframe(time=time, eye=eye, target=target)


_CITY_M = 872.0
_SURFACES = {
    "sphere": _Surface(
        SphereScan,
        ("rgb", "normal"),
        [
            _key(0, (4.0, -1.0, 1.5), (0, 0, 0)),
            _key(0.6, (1.6, -1.6, 0.9), (0, 0, 0)),
            _key(1, (0, -1.7, 0.4), (0, 0, 0)),
        ],
    ),
    "city": _Surface(
        lambda n: CityScan(n, extent_m=_CITY_M),
        ("rgb",),
        [
            _key(0, (-150, -150, 160), (300, 300, 0)),
            _key(0.5, (200, 150, 60), (500, 480, 10)),
            _key(1, (480, 420, 35), (760, 800, 10)),
        ],
    ),
}


class _Stages:
    """The nodes of one setting, called one after the other."""

    def __init__(self, culling: CullingNode, sampling: SamplingNode, render: RenderNode) -> None:
        self._culling, self._sampling, self._render = culling, sampling, render

    def draw(self, camera: Camera) -> tuple[np.ndarray, RenderPoints, list[float]]:
        """(framebuffer words, render-points, seconds of each of ``STAGES``)."""
        at = [time.perf_counter()]
        bits = self._culling.process(camera)
        at.append(time.perf_counter())
        chosen = self._sampling.process(camera, bits)
        at.append(time.perf_counter())
        words = self._render.process(camera, chosen)
        at.append(time.perf_counter())
        return words, chosen, np.diff(at).tolist()


def bench_lod(
    n_points: int = 100_000_000,
    *,
    width: int = 1920,
    height: int = 1080,
    thresholds: Sequence[float] = (32.0,),
    densities: Sequence[float] = (1.0, 1.25, 1.5, 2.0, 3.0),
    frames: int = 30,
    error_frames: int = 5,
    workdir: Path,
    surfaces: Sequence[str] = ("sphere", "city"),
) -> dict[str, Any]:
    """Time and error of settings of the sampling node on generated scenes of ``n_points`` each.

    thresholds, densities : of ``sampling.pixel_threshold`` and ``sampling.points_per_pixel``; every pair is measured.
    frames : timed, of each path, after one round that is not.  error_frames : compared with all points.
    workdir : where the scenes are built, and kept for the next time.  surfaces : which scenes.
    Returns a JSON-able dict: ``rows`` (one for each scene, path and pair of settings) and the machine.
    """
    workdir.mkdir(parents=True, exist_ok=True)
    settings = list(product(thresholds, densities))
    rows: list[dict[str, Any]] = []
    with FrameProgress(None) as progress:
        for name in surfaces:
            scene = generated_scene(name, n_points, workdir, progress)
            rows += _bench_scene(name, scene, (width, height), settings, (frames, error_frames), progress)
    return {
        "benchmark": "lod",
        "n_points": n_points,
        "width": width,
        "height": height,
        "frames": frames,
        "error_frames": error_frames,
        "rows": rows,
        "machine": machine_record(),
    }


def generated_scene(name: str, n_points: int, workdir: Path, progress: FrameProgress) -> Scene:
    """The scene of a surface of ``_SURFACES``, built unless one of the same settings is there."""
    surface = _SURFACES[name]
    path = workdir / f"{name}-{n_points}.scene"
    settings = BuildSettings(up="z", attributes=surface.attributes)
    if not path.exists():
        build_scene([surface.source(n_points)], path, settings=settings, progress=progress.show)
    return Scene.open(path)


def _bench_scene(
    name: str,
    scene: Scene,
    size: tuple[int, int],
    settings: Sequence[tuple[float, float]],
    n_frames: tuple[int, int],
    progress: FrameProgress,
) -> list[dict[str, Any]]:
    octree = scene.octree()
    points = load_points(scene, Colouring.choose(scene, "rgb"), verify=False)
    culling = CullingNode(octree, backface="normal" in scene.info.attributes)
    rows = []
    with CpuRasterizer(points, *size) as rasterizer:
        render = RenderNode(rasterizer)
        everything = _Stages(culling, SamplingNode(octree, pixel_threshold=0), render)
        for path in ("orbit", "fly"):
            cameras = _cameras(name, path, scene, size, n_frames[0])
            shown = [cameras[i] for i in np.linspace(0, len(cameras) - 1, n_frames[1]).round().astype(int)]
            references = []
            for i, camera in enumerate(shown):
                progress.show(f"{name}, {path}: all points", i, len(shown))
                references.append(everything.draw(camera)[0].copy())
            for threshold, density in settings:
                progress.show(f"{name}, {path}: {density:g} points a pixel", 0, len(cameras))
                sampling = SamplingNode(octree, pixel_threshold=threshold, points_per_pixel=density)
                stages = _Stages(culling, sampling, render)
                row = {"scene": name, "path": path, "pixel_threshold": threshold, "points_per_pixel": density}
                row |= _timed(stages, cameras)
                pairs = zip(references, shown, strict=True)
                row["errors"] = [_errors(all_words, stages.draw(camera)[0]) for all_words, camera in pairs]
                rows.append({**row, "resident_bytes": resident_bytes()})
    return rows


def _cameras(name: str, path: str, scene: Scene, size: tuple[int, int], n_frames: int) -> list[Camera]:
    section = CameraSection(width=size[0], height=size[1])
    if path == "fly":
        section = CameraSection(width=size[0], height=size[1], path="keyframes", keyframes=_SURFACES[name].fly)
    cameras = camera_path(section, scene.info, n_frames)
    return [cameras.camera(i) for i in range(n_frames)]


def _timed(stages: _Stages, cameras: list[Camera]) -> dict[str, Any]:
    """Times of every frame, in the second round: the first reads from the disk what is not in the page cache."""
    for camera in cameras:
        stages.draw(camera)
    drawn = [stages.draw(camera)[1:] for camera in cameras]
    seconds = np.array([times for _, times in drawn])
    n_points = [chosen.n_points for chosen, _ in drawn]
    total_s = seconds.sum(axis=1)
    return {
        "points_drawn": int(np.median(n_points)),
        "bytes_drawn": int(np.median(n_points)) * _BYTES_PER_POINT,
        "entries": int(np.median([len(chosen.entries) for chosen, _ in drawn])),
        "ms": {stage: _quartiles(seconds[:, i]) for i, stage in enumerate(STAGES)} | {"frame": _quartiles(total_s)},
        "frames_per_s": len(cameras) / float(total_s.sum()),
    }


def _quartiles(seconds: np.ndarray) -> dict[str, float]:
    values = np.percentile(seconds * 1e3, [50, 25, 75])
    return dict(zip(("median", "q1", "q3"), map(float, values), strict=True))


def _errors(reference: np.ndarray, test: np.ndarray) -> dict[str, float | None]:
    """How far framebuffer words are from those of all points."""
    background = parse_colour(_BACKGROUND, "background")
    expected, found = (frame_to_rgba(words, background)[..., :3] for words in (reference, test))
    covered, front = coverage(reference, test), foreground(reference)
    return {
        "psnr_db": psnr_db(rmse(expected, found)),
        "foreground_psnr_db": psnr_db(rmse(expected[front], found[front])),
        "holes": covered.holes,
        "false_pixels": covered.false_pixels,
        "depth_rmse": depth_rmse(reference, test),
    }


def print_lod(results: dict[str, Any], console: Console) -> None:
    """Two tables, one line a scene, path and setting: what a frame takes, and how far it is from all points."""
    about = f"{results['n_points']:,} points a scene, {results['width']}×{results['height']}"
    speed = _table(
        f"Time: {about}, {results['frames']} frames a path, medians (quartiles)",
        ("M points", "MB", "entries", "culling ms", "sampling ms", "render ms", "frames/s", "GB held"),
    )
    error = _table(
        f"Error against all points: {about}, mean (worst) of {results['error_frames']} frames",
        ("PSNR dB", "PSNR of foreground", "holes %", "false pixels %", "depth RMSE"),
    )
    for row in results["rows"]:
        setting = (row["scene"], row["path"], f"{row['pixel_threshold']:g}", f"{row['points_per_pixel']:g}")
        render = row["ms"]["render"]
        speed.add_row(
            *setting,
            f"{row['points_drawn'] / 1e6:.2f}",
            f"{row['bytes_drawn'] / 1e6:.0f}",
            f"{row['entries']}",
            *(f"{row['ms'][stage]['median']:.1f}" for stage in STAGES[:2]),
            f"{render['median']:.1f} ({render['q1']:.1f}–{render['q3']:.1f})",
            f"{row['frames_per_s']:.1f}",
            f"{row['resident_bytes'] / 1e9:.1f}",
        )
        error.add_row(
            *setting,
            _mean_and_worst(row["errors"], "psnr_db", min),
            _mean_and_worst(row["errors"], "foreground_psnr_db", min),
            _mean_and_worst(row["errors"], "holes", max, 100),
            _mean_and_worst(row["errors"], "false_pixels", max, 100),
            _mean_and_worst(row["errors"], "depth_rmse", max),
        )
    console.print(speed)
    console.print(error)
    console.print(f"{results['machine']['cpu']}, {results['machine']['cores']} cores")


def _table(title: str, columns: Sequence[str]) -> Table:
    table = Table("scene", "path", title=title)
    for name in ("below px", "points a pixel", *columns):
        table.add_column(name, justify="right")
    return table


def _mean_and_worst(
    errors: list[dict[str, float | None]], name: str, worst: Callable[..., float], scale: float = 1
) -> str:
    values = [scale * value for error in errors if (value := error[name]) is not None]
    return f"{np.mean(values):.3g} ({worst(values):.3g})" if values else "–"
