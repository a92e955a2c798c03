"""``splatpipe bench paged``: a moving camera over points that stay on disk, for several pools and budgets of points.

Error against run time: each row is a run of the configuration, drawn at once from what is there, in a process of its
own that finds nothing of the scene in the page cache. Some of its frames are held against complete ones without a
budget of points; their error is that of missing pages and of the budget together. In the time of a frame are culling,
sampling and drawing; no picture is made.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ...shared.camera import Camera
from ...shared.colour import frame_to_rgba
from ...shared.config import load_config, parse_config
from ...shared.messages import RenderPoints
from ...shared.metrics import coverage, psnr_db, rmse
from ...shared.scene_info import SCENE_FILE
from ..job import Job
from ..paging import told_ahead
from ..progress import FrameProgress
from ..record import FrameCounts, machine_record, rank_record, spread_ms, with_missing


def bench_paged(
    config: Path,
    overrides: Sequence[str],
    *,
    budgets: Sequence[str],
    million_points: Sequence[float],
    error_frames: int = 5,
) -> dict[str, Any]:
    """Run a configuration with pools of these sizes and budgets of so many million points, and without one.

    overrides : ``section.key=value``.  error_frames : how many frames of the path are held against complete ones.
    Returns a JSON-able dict: ``rows``, one for each pool and budget; the machine.
    Raises InputError as a run does.
    """
    job = Job(load_config(config, [*overrides, "memory.residency=paged"]))
    compared = np.unique(np.linspace(0, job.n_frames - 1, error_frames).astype(int)).tolist()
    settings = job.config.model_dump(mode="json")
    rows = []
    with TemporaryDirectory(prefix="splatpipe-bench-") as folder, FrameProgress(None) as progress:
        progress.show("complete frames", 0)
        whole = {"memory": {"complete": True, "budget": budgets[-1]}, "sampling": {"point_budget": 0}}
        _in_a_process(_changed(settings, whole), compared, compared, f"{folder}/complete")
        for budget in budgets:
            for million in (*million_points, 0):
                progress.show(f"{budget}, {million:g} M points", len(rows))
                asked = {
                    "memory": {"complete": False, "budget": budget},
                    "sampling": {"point_budget": int(million * 1e6)},
                }
                frames = list(range(job.n_frames))
                row = _in_a_process(_changed(settings, asked), frames, compared, f"{folder}/row")
                errors = [_error(job, f"{folder}/complete-{i}.npy", f"{folder}/row-{i}.npy") for i in compared]
                rows.append({"budget": budget, "point_budget": int(million * 1e6), **row, "errors": errors})
    return {
        "benchmark": "paged",
        "config": config.name,
        "overrides": list(overrides),
        "scene_points": job.scene.info.n_points,
        "scene_bytes": sum(array.bytes for array in job.scene.info.arrays.values()),
        "size_px": [job.views.width, job.views.height],
        "frames": job.n_frames,
        "error_frames": compared,
        "rows": rows,
        "machine": machine_record(),
    }


def _changed(settings: dict[str, Any], changes: dict[str, dict[str, Any]]) -> dict[str, Any]:
    return settings | {section: settings[section] | keys for section, keys in changes.items()}


def _in_a_process(settings: dict[str, Any], frames: list[int], kept: list[int], stem: str) -> dict[str, Any]:
    with ProcessPoolExecutor(1, get_context("spawn")) as executor:
        return executor.submit(draw_paged, settings, frames, kept, stem).result()


def draw_paged(settings: dict[str, Any], frames: list[int], kept: list[int], stem: str) -> dict[str, Any]:
    """Draw frames of a configuration on one rank; the words of those that are kept go to ``STEM-FRAME.npy``."""
    job = Job(parse_config(settings))
    octree = job.load_octree()
    culling, sampling = job.culling_node(octree), job.sampling_node(octree)
    sampling.process(job.camera(0), culling.process(job.camera(0)))  # compiles, or loads what was compiled
    _forget_cached(job.scene.path)
    counts = FrameCounts()

    def select(frame: int) -> tuple[Camera, RenderPoints]:
        camera = job.camera(frame)
        chosen = sampling.process(camera, culling.process(camera))
        counts.add(chosen)
        return camera, chosen

    frame_s = []
    with job.open_render(lambda *_: None, shown=False) as render:
        started = time.perf_counter()
        for camera, chosen in told_ahead(
            map(select, frames), render.frames_ahead, lambda frame: render.expect(frame[1])
        ):
            words = render.rasterize(camera, chosen)
            frame_s.append(time.perf_counter() - started)
            counts.add_residency(render.residency)
            if camera.frame in kept:
                np.save(f"{stem}-{camera.frame}.npy", words)
            started = time.perf_counter()
        held = rank_record("single", 0)
    lists = with_missing(counts.lists())
    return {
        "frames_per_s": len(frames) / sum(frame_s),
        "frame_ms": spread_ms(frame_s),
        "points": float(np.mean(lists["points"])),
        "missing": {"mean": float(np.mean(lists["missing"])), "max": max(lists["missing"])},
        "loaded_bytes": sum(lists["loaded_bytes"]),
        "rss_bytes": held["rss_bytes"],
        "peak_rss_bytes": held["peak_rss_bytes"],
    }


def _forget_cached(scene: Path) -> None:
    """Ask the system to drop a scene's files from its page cache, where it can."""
    if not hasattr(os, "posix_fadvise"):
        return
    for file in [*scene.glob("*.npy"), scene / SCENE_FILE]:
        descriptor = os.open(file, os.O_RDONLY)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)


def _error(job: Job, reference: str, test: str) -> dict[str, float | None]:
    wanted, drawn = np.load(reference, allow_pickle=False), np.load(test, allow_pickle=False)
    covered = coverage(wanted, drawn)
    pictures = [frame_to_rgba(words, job.background)[..., :3] for words in (wanted, drawn)]
    return {"holes": covered.holes, "false_pixels": covered.false_pixels, "psnr_db": psnr_db(rmse(*pictures))}


def print_paged(results: dict[str, Any], console: Any) -> None:
    """A line for each pool and budget of points."""
    from rich.table import Table

    width, height = results["size_px"]
    table = Table(
        title=f"{results['scene_points']:,} points ({results['scene_bytes'] / 1e9:.1f} GB), {width}×{height}, "
        f"{results['frames']} frames of a moving camera"
    )
    headings = ("pool", "budget, M points", "drawn, M", "frames/s", "ms p95", "missing", "at most", "MB read/frame")
    for heading in (*headings, "peak MB", "holes", "false", "PSNR dB"):
        table.add_column(heading, justify="right")
    for row in results["rows"]:
        errors = [[error[name] for error in row["errors"]] for name in ("holes", "false_pixels", "psnr_db")]
        holes, false, psnr = (
            float(np.mean([value for value in values if value is not None] or [0])) for values in errors
        )
        table.add_row(
            row["budget"],
            f"{row['point_budget'] / 1e6:g}" if row["point_budget"] else "none",
            f"{row['points'] / 1e6:.1f}",
            f"{row['frames_per_s']:.1f}",
            f"{row['frame_ms']['p95']:.0f}",
            f"{row['missing']['mean']:.1%}",
            f"{row['missing']['max']:.1%}",
            f"{row['loaded_bytes'] / results['frames'] / 1e6:.1f}",
            f"{row['peak_rss_bytes'] / 1e6:.0f}",
            f"{holes:.1%}",
            f"{false:.1%}",
            f"{psnr:.1f}",
        )
    console.print(table)
    machine, compared = results["machine"], ", ".join(map(str, results["error_frames"]))
    console.print(
        f"Holes, false pixels and PSNR: means of frames {compared} against complete ones without a budget of points. "
        f"{machine['cpu']}, {machine['cores']} cores"
    )
