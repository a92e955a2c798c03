"""``splatpipe bench splats``: thesis Table 4-4 redone, and the holes that splats close.

Each scene is drawn from all around by the cpu rasterizer, every visible point, with normal and with feature-driven
visibility splatting in turn, so that a change of the machine's speed meets both. The pictures of one are held against
those of the other; plain points are drawn beside them for their holes.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import binary_closing

from ...nodes.raster import SplatSettings
from ...nodes.raster.cpu import CpuRasterizer
from ...nodes.raster.splat import CpuSplatRasterizer, SplatCounts
from ...shared.colour import frame_to_rgba
from ...shared.config import RunConfig
from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.metrics import check_installed, flip, psnr_db, rmse
from ...shared.octree import FLAT
from ..job import Job
from ..record import machine_record, spread_ms

THESIS = (
    {"scene": "Stanford Dragon (thesis)", "points": 437_645, "flat_cells": 54_418, "flat_points": 380_467,
     "visibility": 111_596, "reduction": 0.7450},
    {"scene": "Stanford Buddha (thesis)", "points": 543_652, "flat_cells": 127_199, "flat_points": 508_405,
     "visibility": 162_446, "reduction": 0.7012},
)  # fmt: skip
"""Table 4-4."""

CLOSED_PX = 3
"""Gaps up to twice this wide count as holes of the silhouette, wider ones as the shape's own."""


def bench_splats(
    scenes: Sequence[Path],
    *,
    size: int = 1024,
    views: int = 4,
    repeats: int = 7,
    pictures: Path | None = None,
) -> dict[str, Any]:
    """Draw ``views`` views of scenes that were built with --features, ``size``² pixels each.

    repeats : timed frames of each view and way.  pictures : a folder for the first view of each scene: points, splats,
    feature-driven splats and their difference side by side.

    Returns a JSON-able dict: ``rows``, one a scene, and the machine. Raises InputError, StoreError for a scene without,
    DeviceError without the packages of splatpipe[error].
    """
    check_installed()
    return {
        "benchmark": "splats",
        "size_px": size,
        "views": views,
        "rows": [_bench_scene(path, size, views, repeats, pictures) for path in scenes],
        "thesis": THESIS,
        "machine": machine_record(),
    }


def _bench_scene(path: Path, size: int, views: int, repeats: int, pictures: Path | None) -> dict[str, Any]:
    job = Job(
        RunConfig.model_validate(
            {
                "scene": {"path": str(path), "verify": False},
                "camera": {"width": size, "height": size},
                "sampling": {"pixel_threshold": 0},
                "render": {"style": "splats", "rasterizer": "cpu"},
                "splats": {"features": True},
                "output": {"frames": views},
            }
        )
    )
    octree = job.scene.octree(features=True)
    assert octree.feature is not None
    culling, sampling = job.culling_node(octree), job.sampling_node(octree)
    points = job.load_points(verify=False)
    flat = octree.is_leaf & (octree.feature == FLAT)

    times: dict[bool, list[float]] = {False: [], True: []}
    counts: list[SplatCounts] = []
    errors: list[tuple[float, float]] = []
    holes: list[tuple[int, int, int, int]] = []
    normal, driven = (CpuSplatRasterizer(points, size, size, SplatSettings(features=f)) for f in (False, True))
    with normal, driven, CpuRasterizer(points, size, size) as plain:
        for view in range(views):
            camera = job.camera(view)
            entries = sampling.process(camera, culling.process(camera)).entries
            for rasterizer in (normal, driven):
                rasterizer.draw(camera, entries)
            for _ in range(repeats):
                for features, rasterizer in ((False, normal), (True, driven)):
                    start = time.perf_counter()
                    rasterizer.draw(camera, entries)
                    times[features].append(time.perf_counter() - start)
            counts.append(driven.counts)
            words = [rasterizer.draw(camera, entries) for rasterizer in (plain, normal, driven)]
            shown = [frame_to_rgba(w, job.background)[:, :, :3] for w in words]
            errors.append((flip(shown[1], shown[2]), psnr_db(rmse(shown[1], shown[2])) or 0.0))
            holes.append(_holes(*words))
            if pictures and not view:
                pictures.mkdir(parents=True, exist_ok=True)
                difference = np.abs(shown[1].astype(np.int16) - shown[2]).astype(np.uint8)
                Image.fromarray(np.hstack([*shown, difference])).save(pictures / f"{path.stem}.png")
    colour = sum(c.colour_splats for c in counts)
    visibility = sum(c.visibility_splats + c.quads for c in counts)
    return {
        "scene": path.stem,
        "points": job.scene.info.n_points,
        "flat_cells": int(flat.sum()),
        "flat_points": int(octree.n_points[flat].sum()),
        "colour": colour / views,
        "visibility": visibility / views,
        "quads": sum(c.quads for c in counts) / views,
        "reduction": 1 - visibility / colour if colour else 0.0,
        "ms": {name: spread_ms(times[f]) for name, f in (("normal", False), ("feature-driven", True))},
        "flip": max(error[0] for error in errors),
        "psnr_db": min(error[1] for error in errors),
        "silhouette_px": sum(h[0] for h in holes),
        "holes_px": {
            "points": sum(h[1] for h in holes),
            "splats": sum(h[2] for h in holes),
            "feature-driven": sum(h[3] for h in holes),
        },
    }


def _holes(plain: np.ndarray, normal: np.ndarray, driven: np.ndarray) -> tuple[int, int, int, int]:
    """Pixels of the silhouette, and those that points, splats and feature-driven splats leave empty in it."""
    closed = binary_closing(np.pad(normal != FRAMEBUFFER_EMPTY, CLOSED_PX), iterations=CLOSED_PX)
    silhouette = closed[CLOSED_PX:-CLOSED_PX, CLOSED_PX:-CLOSED_PX]
    points, splats, quads = (
        int((silhouette & (words == FRAMEBUFFER_EMPTY)).sum()) for words in (plain, normal, driven)
    )
    return int(silhouette.sum()), points, splats, quads


def print_splats(results: dict[str, Any], console: Any) -> None:
    """The result as a table like Table 4-4, and one of pictures and times."""
    from rich.table import Table

    table = Table(title=f"Thesis Table 4-4, {results['size_px']}² pixels, mean of {results['views']} views")
    for heading in ("scene", "points", "flat cells", "points in them", "in visibility pass", "reduction"):
        table.add_column(heading, justify="left" if heading == "scene" else "right")
    for row in (*results["rows"], *results["thesis"]):
        numbers = (f"{row[key]:,.0f}" for key in ("points", "flat_cells", "flat_points", "visibility"))
        table.add_row(row["scene"], *numbers, f"{row['reduction']:.2%}")
    console.print(table)
    table = Table(title="Feature-driven against normal visibility splatting; holes in the silhouette")
    headings = ("scene", "normal ms", "feature-driven ms", "FLIP", "PSNR dB", "silhouette px")
    for heading in (*headings, "empty: points", "splats", "feature-driven"):
        table.add_column(heading, justify="left" if heading == "scene" else "right")
    for row in results["rows"]:
        ms = (f"{spread['median']:.1f} ({spread['min']:.1f}…{spread['p95']:.1f})" for spread in row["ms"].values())
        holes = (f"{n:,}" for n in row["holes_px"].values())
        table.add_row(
            row["scene"], *ms, f"{row['flip']:.4f}", f"{row['psnr_db']:.1f}", f"{row['silhouette_px']:,}", *holes
        )
    console.print(table)
    machine = results["machine"]
    console.print(f"{machine['cpu']}, {machine['cores']} cores, commit {machine['commit'] or 'unknown'}")
