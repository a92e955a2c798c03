"""``splatpipe bench budget``: frame rates with as much device memory as the pools of a scene take, drawn by OpenGL.

The constant GPU memory model of the paper: A_pools bytes, those of the vertices, translations, tags and colours of the
points that pools cover, lie on the device. The conventional way has as many of its points there as these bytes hold,
and sends the others with each frame; with pools, the points that none covers are sent. All ways draw the same points of
the same cells, seen by the same camera, without culling:

- *float32*: as this renderer holds points, 16 bytes each, three float32 and a colour word;
- *grid*: the same grid points one by one, 5 bytes each, a word of place and a byte into the palette of their cell,
  which is how those that no pool covers are held, too. (The paper's have 8 bytes, and no colour.)
- *pools*.

Each repeat goes through all ways in turn; gains are medians of the repeats' ratios.

Source: Kim, Lee, Varshney, "Vertex Transformation Streams", section 7.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...nodes.raster import ResidentPoints
from ...nodes.raster.gl import GlComputeRasterizer, GlPointsRasterizer
from ...nodes.raster.gl_budget import SentEachFrame
from ...nodes.raster.gl_context import require_gl
from ...nodes.raster.pools import PoolCell, PoolCells, pool_cells
from ...shared.codecs import streams
from ...shared.codecs.palette import to_palette
from ...shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from ..progress import FrameProgress
from ..record import machine_record, spread_ms
from .codec_cells import Cell, CellScene, load_cells, scene_paths
from .codec_frames import resident

GlRasterizer = GlComputeRasterizer | GlPointsRasterizer

PAPER_GAIN = (0.17, 0.32)
POINT_BYTES = 16
GRID_POINT_BYTES = 5


@dataclass
class _Way:
    """How points are drawn.  times : seconds of sending, and of drawing, of each repeat."""

    name: str
    rasterizer: GlRasterizer
    sent: SentEachFrame
    entries: np.ndarray
    n_bytes: int
    times: list[tuple[float, float]] = field(default_factory=list)

    def time_once(self, scene: CellScene) -> None:
        self.rasterizer.draw(scene.camera, self.entries)  # makes its context current, which takes time
        start = time.perf_counter()
        self.sent.send()
        middle = time.perf_counter()
        self.rasterizer.draw(scene.camera, self.entries)
        self.times.append((middle - start, time.perf_counter() - middle))

    def row(self, scene: CellScene) -> dict[str, Any]:
        send, draw = zip(*self.times, strict=True)
        frame = self.rasterizer.draw(scene.camera, self.entries)
        return {
            "bytes": self.n_bytes,
            "sent_bytes": self.sent.n_bytes,
            "send_ms": spread_ms(list(send)),
            "draw_ms": spread_ms(list(draw)),
            "frame_ms": spread_ms(self.frame_s.tolist()),
            "foreground_px": int((frame != FRAMEBUFFER_EMPTY).sum()),
        }

    @property
    def frame_s(self) -> np.ndarray:
        """(repeats,) seconds of a frame."""
        return np.array(self.times).sum(axis=1)


def bench_budget(
    inputs: Sequence[str],
    *,
    bits: int = 6,
    n_pools: int = 2,
    most_cells: int = 1000,
    points_per_cell: int = 32768,
    n_default: int = 400_000,
    size: int = 1024,
    repeats: int = 9,
) -> dict[str, Any]:
    """Measure leaves of scenes and point files; a generated surface of ``n_default`` points where ``inputs`` is empty.

    bits : of the grid, an axis, 1 … 8.  n_pools : most pools of a cell.  most_cells : of a scene, evenly spread.
    points_per_cell : of scenes that are built here.  size : side of the image, pixels.

    Returns a JSON-able dict: ``rows``, one for each scene and rasterizer: ``ways`` with bytes held and sent and times,
    ``gain`` of the pools' frame rate over the other ways'; the machine.
    Raises DeviceError without OpenGL, InputError, StoreError for what cannot be read, CodecError for bits out of range.
    """
    require_gl("bench budget")
    rows = []
    with (
        FrameProgress(None) as progress,
        ThreadPoolExecutor(len(os.sched_getaffinity(0))) as executor,
        scene_paths(inputs, n_default, points_per_cell) as paths,
    ):
        for name, path in paths:
            progress.show(f"{name}: reading", 0)
            scene = load_cells(name, path, bits=bits, most_cells=most_cells, leaves=True, size=size)
            progress.show(f"{name}: looking for pools", 0)
            forms = [
                pool_cells(list(executor.map(lambda cell, n=n: _pool_cell(cell, bits, n), scene.cells)))
                for n in (n_pools, 0)
            ]
            for rasterizer in (GlComputeRasterizer, GlPointsRasterizer):
                with ExitStack() as stack:
                    ways = _ways(rasterizer, scene, forms, stack)
                    for repeat in range(repeats):
                        progress.show(f"{name}: {rasterizer.name}", repeat, repeats)
                        for way in ways:
                            way.time_once(scene)
                    rows.append(_row(scene, forms[0], ways))
    return {
        "benchmark": "budget",
        "bits": bits,
        "n_pools": n_pools,
        "size_px": size,
        "repeats": repeats,
        "paper_gain": PAPER_GAIN,
        "rows": rows,
        "machine": machine_record(),
    }


def _pool_cell(cell: Cell, bits: int, n_pools: int) -> PoolCell:
    encoded = streams.encode(cell.points, bits, n_pools)
    palette, index = to_palette(cell.colour)
    held = streams.read_pools(encoded.data, bits, len(cell.points))
    return PoolCell(held, cell.lower, cell.edge / 2**bits, palette, index[encoded.order])


def _ways(rasterizer: type[GlRasterizer], scene: CellScene, forms: Sequence[PoolCells], stack: ExitStack) -> list[_Way]:
    """Points, grid points, pools, each with A_pools bytes on the device."""
    none = np.empty(0, np.float32)
    nothing = ResidentPoints(none, none, none, np.empty(0, np.uint32), np.zeros(1, np.int64), np.zeros((1, 3)))
    cells = scene.cells
    points = resident(cells, [cell.positions for cell in cells], [np.arange(len(cell.points)) for cell in cells])
    float32, pools, grid = (
        stack.enter_context(rasterizer(held, scene.camera.width, scene.camera.height))
        for held in (points, *(replace(nothing, pools=form) for form in forms))
    )
    rest = pools.loose_sent(0)
    budget = pools.resident_bytes - rest.n_bytes
    of_cells = grid.resident_bytes - grid.loose_sent(0).n_bytes  # palettes
    kept = max(budget - of_cells, 0) // GRID_POINT_BYTES
    n, pooled = len(points), [np.array([(0, len(points), stride)], RENDER_POINT) for stride in (1, 0)]
    return [
        _Way("float32", float32, float32.points_sent(budget // POINT_BYTES), pooled[0], POINT_BYTES * n),
        _Way("grid", grid, grid.loose_sent(kept), pooled[1], grid.resident_bytes),
        _Way("pools", pools, rest, pooled[1], pools.resident_bytes),
    ]


def _row(scene: CellScene, pools: PoolCells, ways: Sequence[_Way]) -> dict[str, Any]:
    *others, ours = ways
    n_points, rows = len(pools.colour), {way.name: way.row(scene) for way in ways}
    return {
        "scene": scene.name,
        "rasterizer": ours.rasterizer.name,
        "device": ours.rasterizer.device,
        "cells": len(scene.cells),
        "points": n_points,
        "coverage": 1 - pools.loose.shape[1] / n_points,
        "pool_bytes": ours.n_bytes - ours.sent.n_bytes,
        "ways": rows,
        "gain": {way.name: float(np.median(way.frame_s / ours.frame_s)) - 1 for way in others},
        "rate_for_gain": {way.name: _rate_for_gain(rows[way.name], rows[ours.name], PAPER_GAIN[0]) for way in others},
    }


def _rate_for_gain(other: dict[str, Any], ours: dict[str, Any], gain: float) -> float | None:
    """Bytes a second below which sending makes our frame rate that much higher, with the times of drawing as measured.

    None: drawing alone decides, one way or the other.
    """
    fewer = other["sent_bytes"] - (1 + gain) * ours["sent_bytes"]
    slower_s = ((1 + gain) * ours["draw_ms"]["median"] - other["draw_ms"]["median"]) * 1e-3
    return fewer / slower_s if fewer > 0 and slower_s > 0 else None


def print_budget(results: dict[str, Any], console: Any) -> None:
    """A table for each scene and rasterizer, and the gain beside the paper's."""
    from rich.table import Table

    low, high = results["paper_gain"]
    for row in results["rows"]:
        table = Table(
            title=f"{row['scene']}, {row['rasterizer']}: {row['points']:,} points of {row['cells']:,} cells at "
            f"{results['bits']} bits an axis, {row['coverage']:.0%} covered by pools; "
            f"{row['pool_bytes'] / 1e6:.2f} MB on the device"
        )
        for heading in ("drawn from", "bytes/point", "sent a frame, MB", "sending, ms", "drawing, ms", "frames/s"):
            table.add_column(heading, justify="left" if heading == "drawn from" else "right", no_wrap=True)
        for name, way in row["ways"].items():
            table.add_row(
                name,
                f"{way['bytes'] / row['points']:.2f}",
                f"{way['sent_bytes'] / 1e6:.2f}",
                f"{way['send_ms']['median']:.2f}",
                "{median:.1f} ({min:.1f}…{max:.1f})".format(**way["draw_ms"]),
                f"{1e3 / way['frame_ms']['median']:.1f}",
            )
        console.print(table)
        ours = row["ways"]["pools"]
        for name, gain in row["gain"].items():
            other, rate = row["ways"][name], row["rate_for_gain"][name]
            link = (
                "" if rate is None else f"; by these times of drawing {low:.0%} below {rate / 1e9:.2g} GB/s of sending"
            )
            console.print(
                f"pools over {name}: {gain:+.0%} frames/s (paper: {low:.0%}–{high:.0%}){link}; "
                f"{other['bytes'] / ours['bytes']:.1f}× fewer bytes (paper: 2–5×)"
            )
    for device in sorted({row["device"] for row in results["rows"]}):
        console.print(f"Drawn by {device}. Medians of {results['repeats']}, of drawing fastest … slowest.")
    machine = results["machine"]
    console.print(f"{machine['cpu']}, {machine['cores']} cores, commit {machine['commit'] or 'unknown'}")
