"""``splatpipe bench codecs --sizes``: frames drawn from encoded cells, from scenes that fit a cache to such as do not.

A scene of a size is copies of a few cells, side by side in a square, each in memory of its own, so that a frame reads
as many bytes as a scene of that size would have. The camera sees all of them from above at a slant: every point is
drawn, and points are spread over the image. The forms take turns, so that a change of the machine's speed meets all,
and each is compared with the float32 frame of the same turn.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...nodes.raster import ResidentPoints
from ...nodes.raster.groups import GroupCell
from ...nodes.raster.pools import PoolCell
from ...shared.build.settings import available_memory_bytes
from ...shared.camera import Camera, look_at, perspective_camera
from ...shared.codecs import streams
from ...shared.codecs.linear_groups import LinearGroupCodec
from ...shared.errors import InputError
from ..progress import FrameProgress
from ..record import machine_record, spread_ms
from .codec_cells import Cell, load_cells, scene_paths
from .codec_frames import Draw, cell_groups_frame, cell_of_groups, cell_of_pools, cell_pools_frame, resident_frame

MOST_CELLS = 8
"""Cells that are encoded and copied."""

_POINTS_PER_CELL, _GENERATED_POINTS = 1 << 18, 1 << 21
"""Of the generated surface: at 7 bits each of its eight cells has a point in nearly every bin that it meets."""

_BYTES_PER_POINT = 64
"""Memory that all forms of a point take, and what they are made from."""

_CACHES = Path("/sys/devices/system/cpu")


@dataclass(frozen=True)
class _Forms:
    """A cell in every form.  columns : (3, n) float32 relative to its lower corner, in the stored order.

    pools : None where the grid has more bits than pools can.
    """

    cell: Cell
    columns: np.ndarray
    pools: PoolCell | None
    groups: GroupCell


def bench_sizes(
    inputs: Sequence[str],
    sizes: Sequence[float],
    *,
    bits: int = streams.DEFAULT_BITS,
    epsilon: float = 0.005,
    size: int = 1024,
    repeats: int = 5,
) -> dict[str, Any]:
    """Measure frames of ``sizes`` million points from copies of cells of a scene, or of a generated surface.

    inputs : one scene or point file, or none.  sizes : > 0.  epsilon : of linear groups, as a share of a cell's edge.
    The rest as of ``bench_codecs``.
    Returns a JSON-able dict: ``rows``, one for each size and form; ``crossovers``, one for each form;
    ``cache_bytes``, None where the system does not tell; ``omitted``; the machine.
    Raises InputError for sizes that do not fit the memory that is free, and for more inputs.
    """
    most, room = max(sizes) * 1e6 * _BYTES_PER_POINT, available_memory_bytes()
    if most > room:
        raise InputError(
            f"--sizes: {max(sizes):g} million points need {most / 1e9:.1f} GB, found {room / 1e9:.1f} GB free"
        )
    if len(inputs) > 1:
        raise InputError(f"--sizes: found {len(inputs)} inputs, expected one or none")
    rows = []
    with FrameProgress(None) as progress:
        progress.show("cells", 0)
        with scene_paths(inputs, _GENERATED_POINTS, _POINTS_PER_CELL) as paths:
            scene = load_cells(*paths[0], bits=bits, most_cells=MOST_CELLS, leaves=True, size=size)
        forms = []
        for done, cell in enumerate(scene.cells):
            progress.show("encoding", done, len(scene.cells))
            forms.append(_forms(cell, bits, epsilon))
        for million in sorted(set(sizes)):
            progress.show(f"{million:g} M points", 0)
            rows += _measure(forms, million * 1e6, size, repeats, progress)
    cache = cache_bytes()
    for row in rows:
        row["in_cache"] = None if cache is None else row["bytes_read"] <= cache
    return {
        "benchmark": "codec sizes",
        "scene": scene.name,
        "cells": len(forms),
        "points_per_cell": sum(len(form.cell.points) for form in forms) / len(forms),
        "bits": bits,
        "epsilon": epsilon,
        "size_px": size,
        "repeats": repeats,
        "cache_bytes": cache,
        "rows": rows,
        "crossovers": crossovers(rows, cache),
        "omitted": [] if forms[0].pools else [{"form": "pools", "reason": f"found {bits} bits, expected 1 … 8"}],
        "machine": machine_record(),
    }


def _forms(cell: Cell, bits: int, epsilon: float) -> _Forms:
    pools = None
    if bits <= streams.MAX_STREAM_BITS:
        coded = streams.encode(cell.points, bits)
        pools = cell_of_pools(bits, cell, coded.data, coded.order)
    coded = LinearGroupCodec(epsilon * 2**bits).encode(cell.points, bits)
    return _Forms(
        cell,
        np.ascontiguousarray(cell.positions.T, np.float32),
        pools,
        cell_of_groups(bits, cell, coded.data, coded.order),
    )


def _measure(
    forms: Sequence[_Forms], n_points: float, size: int, repeats: int, progress: FrameProgress
) -> list[dict[str, Any]]:
    """Rows of one size: about ``n_points``, one cell at least."""
    mean = sum(len(form.cell.points) for form in forms) / len(forms)
    n_cells = max(1, round(n_points / mean))
    chosen = [forms[i % len(forms)] for i in range(n_cells)]
    side = int(np.ceil(np.sqrt(n_cells)))
    edge = max(form.cell.edge for form in forms)
    places = edge * np.column_stack([np.arange(n_cells) % side, np.arange(n_cells) // side, np.zeros(n_cells)])
    camera = _camera(edge * (side + 0.5), edge * side, size)
    counts = [len(form.cell.points) for form in chosen]
    x, y, z = (np.concatenate([form.columns[axis] for form in chosen]) for axis in range(3))
    points = ResidentPoints(
        x,
        y,
        z,
        np.concatenate([form.cell.colour for form in chosen]),
        np.cumsum([0, *counts[:-1]], dtype=np.int64),
        places,
    )
    pools = [replace(f.pools, origin=place) for f, place in zip(chosen, places, strict=True) if f.pools]
    groups = [replace(f.groups, origin=place) for f, place in zip(chosen, places, strict=True)]
    with ExitStack() as stack:
        draws: dict[str, tuple[Draw, int]] = {
            "float32": (stack.enter_context(resident_frame(points, camera, False)), 16 * len(points)),
            "10-bit fixed point": (stack.enter_context(resident_frame(points, camera, True)), 8 * len(points)),
        }
        if pools:
            draws["pools"] = stack.enter_context(cell_pools_frame(pools, camera)), sum(map(_pool_bytes, pools))
        draws["groups"] = stack.enter_context(cell_groups_frame(groups, camera)), sum(map(_group_bytes, groups))
        times: dict[str, list[float]] = {name: [] for name in draws}
        for repeat in range(-1, repeats):  # the first one compiles, and brings in what fits the cache
            for i, (name, (draw, _)) in enumerate(draws.items()):
                progress.show(f"{n_points / 1e6:g} M points", (repeat + 1) * len(draws) + i, (repeats + 1) * len(draws))
                start = time.perf_counter()
                draw()
                if repeat >= 0:
                    times[name].append(time.perf_counter() - start)
    return [_row(name, times, len(points), n_bytes) for name, (_, n_bytes) in draws.items()]


def _row(form: str, times: dict[str, list[float]], n_points: int, n_bytes: int) -> dict[str, Any]:
    ms, ratios = spread_ms(times[form]), np.divide(times[form], times["float32"])
    return {
        "form": form,
        "points": n_points,
        "bytes_read": n_bytes,
        "ms": ms,
        "ns_per_point": ms["median"] * 1e6 / n_points,
        "gb_per_s": n_bytes / ms["median"] / 1e6,
        "times_float32": {"median": float(np.median(ratios)), "min": float(ratios.min()), "max": float(ratios.max())},
    }


def _camera(span: float, side: float, size: int) -> Camera:
    """Looks at the square from above, at a slant; its cells are in the image altogether."""
    centre = np.array([side / 2, side / 2, span / 16])
    pose = look_at(centre + span * np.array([0.0, -0.9, 1.2]), centre, np.array([0.0, 0.0, 1.0]))
    return perspective_camera(
        frame=0, world_from_camera=pose, fov_y_rad=0.95, width=size, height=size, near=0.01 * span
    )


def _pool_bytes(cell: PoolCell) -> int:
    """Bytes that a frame reads: positions, colours, palette."""
    return cell.points.n_bytes + cell.colour.nbytes + 4 * 256


def _group_bytes(cell: GroupCell) -> int:
    arrays = (cell.kept, cell.kept_colour, cell.ends, cell.n_inner, cell.parameter, cell.inner_colour)
    return sum(array.nbytes for array in arrays)


def cache_bytes(folder: Path = _CACHES) -> int | None:
    """Bytes of the last-level caches of all processors together, as the system tells them; None where it does not."""
    found: dict[tuple[int, str], int] = {}
    for index in folder.glob("cpu[0-9]*/cache/index*"):
        try:
            kind, level, shared, text = (
                (index / name).read_text().strip() for name in ("type", "level", "shared_cpu_list", "size")
            )
            if kind != "Instruction":
                found[int(level), shared] = int(text.removesuffix("K")) * 1024
        except (OSError, ValueError):
            continue
    last = max((level for level, _ in found), default=0)
    return sum(n for (level, _), n in found.items() if level == last) or None


def crossovers(rows: Sequence[dict[str, Any]], cache: int | None) -> list[dict[str, Any]]:
    """For each form the size from which on it is faster than float32 at every size; None if it is not at the largest.

    ``leaves_cache_at``: points at which what its frames read is as large as the cache; None where that is unknown.
    """
    found = []
    for form in dict.fromkeys(row["form"] for row in rows):
        own = [row for row in rows if row["form"] == form]
        slower = [i for i, row in enumerate(own) if row["times_float32"]["median"] >= 1]
        first = slower[-1] + 1 if slower else 0
        per_point = own[-1]["bytes_read"] / own[-1]["points"]
        found.append(
            {
                "form": form,
                "bytes_per_point": per_point,
                "leaves_cache_at": None if cache is None else cache / per_point,
                "faster_from": own[first]["points"] if form != "float32" and first < len(own) else None,
            }
        )
    return found


def print_sizes(results: dict[str, Any], console: Any) -> None:
    """A table, then where each form leaves the cache and where it becomes faster than float32."""
    from rich.table import Table

    table = Table(
        title=f"Frames of {results['size_px']}² pixels from copies of {results['cells']} cells of {results['scene']}, "
        f"{results['points_per_cell']:,.0f} points each at {results['bits']} bits an axis"
    )
    table.add_column("M points", justify="right", no_wrap=True)
    table.add_column("drawn from", no_wrap=True)
    for heading in ("MB read", "ms", "ns/point", "GB/s", "× float32"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("fits cache")
    for row in results["rows"]:
        ms, ratio = row["ms"], row["times_float32"]
        table.add_row(
            f"{row['points'] / 1e6:.3g}",
            row["form"],
            f"{row['bytes_read'] / 1e6:.1f}",
            f"{ms['median']:.2f} ({ms['min']:.2f}…{ms['max']:.2f})",
            f"{row['ns_per_point']:.2f}",
            f"{row['gb_per_s']:.1f}",
            f"{ratio['median']:.2f} ({ratio['min']:.2f}…{ratio['max']:.2f})" if row["form"] != "float32" else "–",
            {True: "yes", False: "no", None: "unknown"}[row["in_cache"]],
        )
    console.print(table)
    largest = max(row["points"] for row in results["rows"]) / 1e6
    for item in results["crossovers"]:
        at = "unknown" if item["leaves_cache_at"] is None else f"{item['leaves_cache_at'] / 1e6:.1f} M points"
        text = f"{item['form']}: {item['bytes_per_point']:.2f} bytes read a point, leaves the cache at {at}"
        if item["form"] != "float32":
            first = item["faster_from"]
            text += (
                f"; faster than float32: {f'from {first / 1e6:.3g} M on' if first else f'none up to {largest:.3g} M'}"
            )
        console.print(text)
    for item in results["omitted"]:
        console.print(f"{item['form']}: left out, {item['reason']}")
    machine, cache = results["machine"], results["cache_bytes"]
    console.print(
        f"Medians of {results['repeats']} (fastest … slowest); × float32: of the frames of the same turn. "
        f"Last-level cache: {f'{cache / 2**20:.0f} MiB' if cache else 'unknown'}, as the system tells it. "
        f"ε = {100 * results['epsilon']:g} % of a cell."
    )
    console.print(f"{machine['cpu']}, {machine['cores']} cores, commit {machine['commit'] or 'unknown'}")
