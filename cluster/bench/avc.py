"""``splatpipe bench avc``: block worlds by four techniques, after tables 1.1, 1.2 and figures 1.7, 1.8 of the paper.

A grid of n³ blocks of random types is drawn from one viewpoint, all of it, with and without rasterization. Techniques
take turns in each repeat, so that a change of the machine's speed meets all. A frame ends when the device has finished
it; nothing is read back.

Source: Scheibel, Buschmann, Trapp, Döllner, "Attributed Vertex Clouds", 1.4.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ...nodes.layers.gl_canvas import GlLayers
from ...nodes.layers.stages import input_components
from ...shared.camera import look_at, perspective_camera
from ...shared.errors import DeviceError
from ...shared.files import write_whole
from ...shared.layer_config import LayerSection
from ...shared.layers.blocks import OBJECT
from ...shared.layers.layer import Layer, simple_layer
from ...shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from ..progress import FrameProgress
from ..record import machine_record, spread_ms

PAPER = {
    "triangles": {"static": 0, "vertices": 36, "block": 1440, "stages": (10, None, 11)},
    "strips": {"static": 0, "vertices": 14, "block": 560, "stages": (10, None, 11)},
    "instancing": {"static": 336, "vertices": 1, "block": 16, "stages": (10, None, 11)},
    "avc": {"static": 0, "vertices": 1, "block": 16, "stages": (4, 5, 11)},
}
"""Tables 1.1 and 1.2: bytes of static data, vertices and bytes of a block, input components of the stages: vertex
shader, geometry shader, rasterizer."""

GRIDS = (16, 32, 64, 100)
"""Blocks a side: 4096 to 10⁶, as in figures 1.7 and 1.8."""

_TYPES = 16
_MOST_S = 90.0


def bench_avc(
    *, grids: Sequence[int] = GRIDS, width: int = 1920, height: int = 1200, repeats: int = 5
) -> dict[str, Any]:
    """Measure on the device at hand.

    grids : blocks a side.  width, height : of the frame, pixels; the paper's.  repeats : timed frames of each technique
    with and without rasterization; fewer where those of a grid take longer than 90 s.

    Returns a JSON-able dict: ``rows``, one for each grid and technique (``failed`` says why there are no figures), and
    the machine. Raises DeviceError where no OpenGL is.
    """
    rows: list[dict[str, Any]] = []
    device = ""
    with FrameProgress(None) as progress:
        for n in grids:
            layer = block_grid(n)
            device, found = _measured(layer, width, height, repeats, progress)
            first = next((f["covered_px"] for f in found.values() if "covered_px" in f), None)
            for technique, figures in found.items():
                if figures.get("covered_px", first) != first:
                    figures["failed"] = f"covers {figures['covered_px']} pixels, expected {first}"
                rows.append(
                    {"blocks": n**3, "technique": technique, "components": input_components(technique), **figures}
                )
    return {
        "benchmark": "avc",
        "device": device,
        "width": width,
        "height": height,
        "repeats": repeats,
        "rows": rows,
        "machine": machine_record(),
    }


def block_grid(n: int) -> Layer:
    """A cube of n³ blocks of size 1, their types random."""
    index = np.arange(n**3)
    objects = np.empty(n**3, OBJECT)
    objects["cell"] = np.column_stack([index // n**2, index // n % n, index % n]) - n // 2
    objects["type"] = np.random.default_rng(1).integers(0, _TYPES, n**3)
    colours = [f"#{40 + 13 * t:02x}{(90 + 47 * t) % 256:02x}{230 - 12 * t:02x}" for t in range(_TYPES)]
    return simple_layer("grid", "blocks", np.zeros(3), objects, block_size=1.0, colours=colours)


def _measured(
    layer: Layer, width: int, height: int, repeats: int, progress: FrameProgress
) -> tuple[str, dict[str, dict[str, Any]]]:
    """Device, and figures of each technique; all are on the device at once, so that they can take turns."""
    lower, upper = layer.bounds
    extent = float(np.max(upper.max(axis=0) - lower.min(axis=0)))
    pose = look_at(np.array([1.1, -1.6, 1.0]) * extent, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    camera = perspective_camera(
        frame=0, world_from_camera=pose, fov_y_rad=math.radians(45), width=width, height=height, near=extent / 100
    )
    everything = [np.array([(0, len(layer), 1)], RENDER_POINT)]
    found: dict[str, dict[str, Any]] = {}
    canvases: dict[str, GlLayers] = {}
    times: dict[str, dict[str, list[float]]] = {}
    device = ""
    with ExitStack() as stack:
        for technique in PAPER:
            progress.show(f"{len(layer):,} blocks: {technique}", 0)
            section = LayerSection(path="", technique=technique)  # type: ignore[arg-type]
            try:
                canvas = stack.enter_context(GlLayers([layer], [section], width, height))
            except DeviceError as error:
                found[technique] = {"failed": str(error)}
                continue
            resident, static = canvas.resident_bytes
            covered = int(np.count_nonzero(canvas.draw(camera, everything) != FRAMEBUFFER_EMPTY))
            per_block = (resident - static) / len(layer)
            found[technique] = {"static_bytes": static, "bytes_per_block": per_block, "covered_px": covered}
            device, canvases[technique], times[technique] = canvas.device, canvas, {"frame": [], "geometry": []}
        started = time.perf_counter()
        for repeat in range(repeats):
            for technique, canvas in canvases.items():
                progress.show(f"{len(layer):,} blocks: timing {technique}", repeat)
                for what, rasterized in (("frame", True), ("geometry", False)):
                    times[technique][what].append(canvas.timed_draw(camera, everything, rasterized=rasterized))
            if time.perf_counter() - started > _MOST_S:
                break
    for technique, measured in times.items():
        found[technique]["ms"] = {what: spread_ms(t) for what, t in measured.items()}
    return device, found


def print_avc(found: dict[str, Any], console: Console) -> None:
    """The paper's two tables and two figures, its values beside ours."""
    memory = Table(title="Memory (table 1.1; paper in brackets)", title_justify="left")
    for name in (
        "technique",
        "static B",
        "B a block",
        "10⁶ blocks MiB",
        "components: vertex",
        "geometry",
        "rasterizer",
    ):
        memory.add_column(name, justify="left" if name == "technique" else "right")
    for technique, paper in PAPER.items():
        rows = [r for r in found["rows"] if r["technique"] == technique and "bytes_per_block" in r]
        if rows:
            static, per_block = rows[-1]["static_bytes"], rows[-1]["bytes_per_block"]
            stages = [
                f"{'–' if ours is None else ours} ({'–' if theirs is None else theirs})"
                for ours, theirs in zip(rows[-1]["components"], paper["stages"], strict=True)
            ]
            mib = (static + per_block * 1e6) / 2**20
            memory.add_row(
                technique, f"{static} ({paper['static']})", f"{per_block:.0f} ({paper['block']})", f"{mib:.0f}", *stages
            )
    console.print(memory)
    times = Table(
        title=f"Frames (figures 1.7, 1.8), {found['width']}×{found['height']}, {found['device']}", title_justify="left"
    )
    for name in (
        "blocks",
        "technique",
        "frames/s",
        "ms/frame (min – max)",
        "geometry alone, ms",
        "avc is faster: frame",
        "geometry",
    ):
        times.add_column(name, justify="left" if name == "technique" else "right")
    for row in found["rows"]:
        if "ms" not in row:
            times.add_row(f"{row['blocks']:,}", row["technique"], row["failed"])
            continue
        frame, geometry = row["ms"]["frame"], row["ms"]["geometry"]
        times.add_row(
            f"{row['blocks']:,}",
            row["technique"],
            f"{1e3 / frame['median']:.1f}",
            f"{frame['median']:.1f} ({frame['min']:.1f} – {frame['max']:.1f})",
            f"{geometry['median']:.1f} ({geometry['min']:.1f} – {geometry['max']:.1f})",
            *(_ratio(found, row, what) for what in ("frame", "geometry")),
        )
    console.print(times)
    console.print("paper: avc draws up to twice the frames of the others; its geometry takes the least time")


def _ratio(found: dict[str, Any], row: dict[str, Any], what: str) -> str:
    """How many times the technique's time is that of avc with as many blocks."""
    same = (r for r in found["rows"] if r["technique"] == "avc" and r["blocks"] == row["blocks"] and "ms" in r)
    avc = next(same, None)
    if avc is None or row is avc:
        return ""
    return f"{row['ms'][what]['median'] / avc['ms'][what]['median']:.2f} ×"


def plot_avc(found: dict[str, Any], path: Path) -> None:
    """Figures 1.7 and 1.8 as a picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for technique in PAPER:
        rows = [r for r in found["rows"] if r["technique"] == technique and "ms" in r]
        blocks = [r["blocks"] for r in rows]
        left.plot(blocks, [1e3 / r["ms"]["frame"]["median"] for r in rows], "o-", label=technique)
        right.plot(blocks, [r["ms"]["geometry"]["median"] for r in rows], "o-", label=technique)
    left.set(title="frames a second (figure 1.7)", xlabel="blocks", xscale="log", yscale="log")
    right.set(title="geometry alone, ms (figure 1.8)", xlabel="blocks", xscale="log", yscale="log")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    left.legend()
    figure.suptitle(f"{found['device']}, {found['width']}×{found['height']}", fontsize=9)
    write_whole(path, lambda part: figure.savefig(part, format="png", dpi=120))
