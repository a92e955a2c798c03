"""``splatpipe bench codecs``: what each codec makes of the cells of a scene, beside float32 and 10-bit fixed point.

All codecs are given the same grid points, those that share one left out but for one, cell by cell, cells in parallel on
all threads. Each repeat goes through all of them in turn, so that a change of the machine's speed meets all. A frame is
all chosen cells from one camera, without culling; from the encoded form where something draws that, else from the
decoded points as float32 in coded order. What is decoded is held against what was encoded before anything is timed.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...nodes.raster.compact import compact_positions
from ...nodes.raster.reference import unpack_bins
from ...shared.codecs import Encoded, ci, eci, linear_groups, occupancy, streams
from ...shared.codecs.grid import from_grid
from ...shared.errors import CodecError
from ...shared.messages import FRAMEBUFFER_EMPTY
from ..progress import FrameProgress
from ..record import machine_record, spread_ms
from .codec_cells import Cell, CellScene, load_cells, scene_paths
from .codec_frames import Draw, groups_frame, points_frame, pools_frame, resident

_HALF_DIAGONAL = np.sqrt(3) / 2

MakeFrame = Callable[[Sequence[Cell], Sequence[np.ndarray], Sequence[np.ndarray], Any, int], AbstractContextManager]


@dataclass(frozen=True)
class Contestant:
    """A codec of grid points.

    decode : data, bits, most points → grid points.  bound : most that a cell's point is moved, grid steps; 0: exact.
    text : what is printed beside the ``paper``'s figure, a format of what ``figures`` finds in the encoded cells.
    frame : draws from the encoded form; None: nothing does.
    """

    name: str
    encode: Callable[[Cell], Encoded]
    decode: Callable[[np.ndarray, int, int], np.ndarray]
    bound: Callable[[Cell], float] = lambda _: 0.0
    figures: Callable[[Sequence[np.ndarray]], dict[str, float]] = lambda _: {}
    text: str = "{bits_per_point:.1f} bits/point"
    paper: str = "none"
    frame: MakeFrame | None = None


@dataclass
class _Entry:
    """A contestant on one scene: its row, what is timed, and the times in seconds."""

    row: dict[str, Any]
    work: dict[str, Callable[[], Any]]
    times: dict[str, list[float]] = field(default_factory=dict)

    def time_once(self) -> None:
        for what, work in self.work.items():
            start = time.perf_counter()
            work()
            self.times.setdefault(what, []).append(time.perf_counter() - start)


def bench_codecs(
    inputs: Sequence[str],
    *,
    bits: int = streams.DEFAULT_BITS,
    most_cells: int = 64,
    leaves: bool = False,
    epsilon: float = 0.005,
    points_per_cell: int = 4096,
    n_default: int = 400_000,
    size: int = 1024,
    repeats: int = 5,
) -> dict[str, Any]:
    """Measure scenes and point files; a generated surface of ``n_default`` points where ``inputs`` is empty.

    bits : of the grid, an axis, 1 … 16.  most_cells, leaves : as of ``load_cells``.
    points_per_cell : of scenes that are built here.
    epsilon : of linear groups, as a share of the scene's longest side.  size : side of the image, pixels.

    Returns a JSON-able dict: ``rows``, one for each scene and codec, of which ``failed`` says why it is wrong;
    ``scenes``; ``omitted`` (codec and reason); the machine. ``bound``, ``error`` (the largest) and ``rms`` are
    distances from the stored positions, as shares of the scene's longest side.
    Raises InputError, StoreError for what cannot be read.
    """
    threads = len(os.sched_getaffinity(0))
    rows, scenes, omitted = [], [], {}
    with (
        FrameProgress(None) as progress,
        ThreadPoolExecutor(threads) as executor,
        scene_paths(inputs, n_default, points_per_cell) as paths,
    ):
        for name, path in paths:
            progress.show(f"{name}: reading", 0)
            scene = load_cells(name, path, bits=bits, most_cells=most_cells, leaves=leaves, size=size)
            n_points = sum(len(cell.points) for cell in scene.cells)
            scenes.append(
                {
                    "scene": name,
                    "cells": len(scene.cells),
                    "cells_in_scene": scene.n_owners,
                    "stored_points": scene.n_stored,
                    "grid_points": n_points,
                }
            )
            with ExitStack() as stack:
                entries = [_float32(scene, stack), _fixed_point(scene, stack, threads)]
                contestants, missing = _contestants(scene, bits, epsilon)
                omitted |= missing
                for contestant in contestants:
                    progress.show(f"{name}: {contestant.name}", 0)
                    try:
                        entries.append(_enter(contestant, scene, bits, executor, stack))
                    except CodecError as error:
                        omitted[contestant.name] = str(error)
                for repeat in range(repeats):
                    for i, entry in enumerate(entries):
                        progress.show(f"{name}: timing", repeat * len(entries) + i, repeats * len(entries))
                        entry.time_once()
            for entry in entries:
                spreads = {what: spread_ms(times) for what, times in entry.times.items()}
                rate = {what: n_points / spread["median"] * 1e3 for what, spread in spreads.items() if what != "frame"}
                rows.append(entry.row | {"ms": spreads, "points_per_s": rate})
    return {
        "benchmark": "codecs",
        "bits": bits,
        "epsilon": epsilon,
        "size_px": size,
        "repeats": repeats,
        "threads": threads,
        "scenes": scenes,
        "rows": rows,
        "omitted": [{"codec": name, "reason": reason} for name, reason in omitted.items()],
        "machine": machine_record(),
    }


def _contestants(scene: CellScene, bits: int, epsilon: float) -> tuple[list[Contestant], dict[str, str]]:
    """The codecs, and why others are left out."""

    def groups_of(cell: Cell) -> linear_groups.LinearGroupCodec:
        return linear_groups.LinearGroupCodec(epsilon * scene.extent / cell.edge * 2**bits)

    def removed(data: Sequence[np.ndarray]) -> dict[str, float]:
        held = [
            linear_groups.read(coded, bits, len(cell.points)) for cell, coded in zip(scene.cells, data, strict=True)
        ]
        inner, groups = sum(len(h.parameter) for h in held), sum(len(h.ends) for h in held)
        return {"removed": inner / sum(map(len, held)), "points_per_group": inner / groups if groups else 0.0}

    def pooled(data: Sequence[np.ndarray]) -> dict[str, float]:
        held = [
            streams.read_pools(coded, bits, len(cell.points)) for cell, coded in zip(scene.cells, data, strict=True)
        ]
        n_points = sum(map(len, held))
        return {
            "times_fewer_bytes": streams.POINT_BYTES * n_points / sum(h.n_bytes for h in held),
            "coverage": 1 - sum(len(h.loose) for h in held) / n_points,
            "cells_kept": sum(map(streams.keeps_pools, held)) / len(held),
        }

    found = [
        Contestant(
            "streams",
            lambda cell: streams.encode(cell.points, bits),
            streams.decode,
            figures=pooled,
            text="{times_fewer_bytes:.2f}× fewer bytes, {coverage:.0%} covered, {cells_kept:.0%} of cells",
            paper="2–5× fewer bytes, 80 % covered",
            frame=pools_frame,
        ),
        Contestant("ci", lambda cell: ci.encode(cell.points, bits), ci.decode, paper="5.0 bits/point"),
        Contestant("eci", lambda cell: eci.encode(cell.points, bits), eci.decode, paper="7.7 bits/point"),
        Contestant("occupancy", lambda cell: occupancy.encode(cell.points, bits), occupancy.decode),
        Contestant(
            "groups",
            lambda cell: groups_of(cell).encode(cell.points, bits),
            linear_groups.LinearGroupCodec(0).decode,
            bound=lambda cell: groups_of(cell).error_bound,
            figures=removed,
            text="{removed:.0%} of points removed, {points_per_group:.2f} a group",
            paper="≥ 55 % removed, 1.5 a group (ε 0.5 %)",
            frame=groups_frame,
        ),
    ]
    try:
        found.append(_draco(bits))
    except ImportError as error:
        return found, {"draco": f"{error}; pip install 'splatpipe[bench]'"}
    return found, {}


def _draco(bits: int) -> Contestant:
    """Draco's k-d tree on the same grid points. Raises ImportError where it is not installed."""
    import DracoPy  # pyright: ignore[reportMissingImports]

    def encode(cell: Cell) -> Encoded:
        data = DracoPy.encode(
            cell.points.astype(np.float32),
            quantization_bits=bits,
            quantization_range=2**bits - 1,
            quantization_origin=np.zeros(3),
            compression_level=7,
        )
        return Encoded(np.frombuffer(data, np.uint8), np.empty(0, np.int64))  # Draco does not tell the order

    def decode(data: np.ndarray, _bits: int, _most_points: int) -> np.ndarray:
        return np.rint(DracoPy.decode(data.tobytes()).points).astype(np.uint32)

    return Contestant("draco", encode, decode)


def _enter(contestant: Contestant, scene: CellScene, bits: int, executor: Executor, stack: ExitStack) -> _Entry:
    """A codec on a scene, its result checked. Raises CodecError where it does not take these points."""
    cells = scene.cells

    def encode() -> list[Encoded]:
        return list(executor.map(contestant.encode, cells))

    def decode() -> list[np.ndarray]:
        return list(executor.map(lambda cell, coded: contestant.decode(coded, bits, len(cell.points)), cells, data))

    encoded = encode()
    data = [cell.data for cell in encoded]
    n_bytes, n_points = sum(map(len, data)), sum(len(cell.points) for cell in cells)
    steps = np.array([cell.edge / 2**bits for cell in cells])
    bounds = np.array([contestant.bound(cell) for cell in cells])
    row = {
        "bytes_per_point": n_bytes / n_points,
        "bound": float(((_HALF_DIAGONAL + bounds) * steps).max() / scene.extent),
        "drawn_from": contestant.name if contestant.frame else "decoded points",
        "paper": contestant.paper,
    }
    try:
        decoded = decode()
        orders = [_checked_order(*each) for each in zip(cells, encoded, decoded, bounds, strict=True)]
        figures = contestant.figures(data)
    except CodecError as error:
        return _Entry(_row(scene, contestant.name, row, failed=str(error)), {})
    positions = [from_grid(points, np.zeros(3), cell.edge, bits) for points, cell in zip(decoded, cells, strict=True)]
    frame = (
        contestant.frame(cells, data, orders, scene.camera, bits)
        if contestant.frame
        else points_frame(cells, positions, orders, scene.camera, compact=False)
    )
    draw = stack.enter_context(frame)
    row |= {
        **_errors(scene, positions, orders),
        "figures": figures,
        "ours": contestant.text.format(bits_per_point=8 * n_bytes / n_points, **figures),
        "foreground_px": _foreground(draw),
    }
    return _Entry(_row(scene, contestant.name, row), {"encode": encode, "decode": decode, "frame": draw})


def _checked_order(cell: Cell, encoded: Encoded, decoded: np.ndarray, bound: float) -> np.ndarray:
    """Which point each decoded one is. Raises CodecError if one is not there, or further away than ``bound``."""
    points, n = cell.points.astype(np.int64), len(cell.points)
    if len(decoded) != n:
        raise CodecError(f"decoded: found {len(decoded)} points, expected {n}")
    order = encoded.order
    if not len(order):
        order = np.empty(n, np.int64)
        order[np.lexsort(decoded.T)] = np.lexsort(points.T)
    if not np.array_equal(np.sort(order), np.arange(n)):
        raise CodecError("decoded: found an order that does not name every point once")
    off = np.linalg.norm(decoded.astype(np.int64) - points[order], axis=1).max()
    if off > bound:
        raise CodecError(f"decoded: found a point {off:.3g} grid steps beside its place, expected at most {bound:.3g}")
    return order


def _float32(scene: CellScene, stack: ExitStack) -> _Entry:
    """Positions as they are stored."""
    positions, orders = _as_stored(scene)
    draw = stack.enter_context(points_frame(scene.cells, positions, orders, scene.camera, compact=False))
    rounded = [p.astype(np.float32).astype(np.float64) for p in positions]
    bound = _HALF_DIAGONAL * float(np.spacing(np.float32(max(cell.edge for cell in scene.cells)))) / scene.extent
    row = {"bytes_per_point": 12.0, "bound": bound, "drawn_from": "float32"} | _errors(scene, rounded, orders)
    return _Entry(_row(scene, "float32", row | {"foreground_px": _foreground(draw)}), {"frame": draw})


def _fixed_point(scene: CellScene, stack: ExitStack, threads: int) -> _Entry:
    """The high bits of fixed point in the cell's bounding box: a word a point. Another where a cell is near."""
    stored, orders = _as_stored(scene)
    points = resident(scene.cells, stored, orders)
    compact = compact_positions(points, threads)
    draw = stack.enter_context(points_frame(scene.cells, stored, orders, scene.camera, compact=True))
    ends = np.append(points.block_first_point, len(points))
    middle = unpack_bins(compact.high, np.full(len(points), 512 * (1 + 2**10 + 2**20), np.uint32))
    positions = [
        middle[a:b] * step + lower
        for a, b, step, lower in zip(ends[:-1], ends[1:], compact.step, compact.lower, strict=True)
    ]
    bound = np.linalg.norm(512 * compact.step, axis=1).max() / scene.extent
    errors = _errors(scene, positions, orders)
    row = {"bytes_per_point": 4.0, "bound": float(bound), "drawn_from": "fixed point"} | errors
    error = errors["error"]
    failed = None if error <= bound * (1 + 1e-6) else f"found an error of {error:.3g}, expected at most {bound:.3g}"
    work = {"encode": lambda: compact_positions(points, threads), "frame": draw}
    return _Entry(_row(scene, "10-bit fixed point", row | {"foreground_px": _foreground(draw)}, failed=failed), work)


def _as_stored(scene: CellScene) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return [cell.positions for cell in scene.cells], [np.arange(len(cell.points)) for cell in scene.cells]


def _row(scene: CellScene, codec: str, found: dict[str, Any], failed: str | None = None) -> dict[str, Any]:
    none = {"error": None, "rms": None, "figures": {}, "ours": None, "paper": None, "foreground_px": None}
    return {"scene": scene.name, "codec": codec} | none | found | {"failed": failed}


def _errors(scene: CellScene, positions: Sequence[np.ndarray], orders: Sequence[np.ndarray]) -> dict[str, float]:
    """Distances of positions, cell by cell, from those stored, as shares of the scene's longest side."""
    cells = zip(scene.cells, positions, orders, strict=True)
    off = np.concatenate([np.linalg.norm(p - cell.positions[order], axis=1) for cell, p, order in cells]) / scene.extent
    return {"error": float(off.max()), "rms": float(np.sqrt(np.mean(off**2)))}


def _foreground(draw: Draw) -> int:
    return int((draw() != FRAMEBUFFER_EMPTY).sum())


def print_codecs(results: dict[str, Any], console: Any) -> None:
    """A table for each scene, the figures beside those of the papers, and how they were measured."""
    from rich.table import Table

    for scene in results["scenes"]:
        rows = [row for row in results["rows"] if row["scene"] == scene["scene"]]
        table = Table(
            title=f"{scene['scene']}: {scene['cells']:,} of {scene['cells_in_scene']:,} cells, "
            f"{scene['stored_points']:,} points, {scene['grid_points']:,} at {results['bits']} bits an axis"
        )
        table.add_column("codec", no_wrap=True)
        for heading in ("bytes/point", "encode M/s", "decode M/s", "bound %", "error %", "RMS %", "frame ms"):
            table.add_column(heading, justify="right", no_wrap=True)
        table.add_column("drawn from")
        for row in rows:
            table.add_row(*_measured(row))
        console.print(table)
        for row in rows:
            if row["ours"] is not None:
                console.print(f"{row['codec']}: {row['ours']}; paper: {row['paper']}")
    for item in results["omitted"]:
        console.print(f"{item['codec']}: left out, {item['reason']}")
    machine = results["machine"]
    console.print(
        f"M/s: million points a second on {results['threads']} threads. "
        f"Medians of {results['repeats']}, of frames fastest … slowest. "
        f"bound, error (largest), RMS: from the stored position, of the scene's longest side. "
        f"ε = {100 * results['epsilon']:g} %. "
        f"Frames of {results['size_px']}² pixels hold all of these cells."
    )
    console.print(f"{machine['cpu']}, {machine['cores']} cores, commit {machine['commit'] or 'unknown'}")


def _measured(row: dict[str, Any]) -> list[str]:
    rate, ms = row["points_per_s"], row["ms"].get("frame")
    return [
        row["codec"],
        f"{row['bytes_per_point']:.2f}",
        *(f"{rate[what] / 1e6:.2f}" if what in rate else "–" for what in ("encode", "decode")),
        *("–" if row[what] is None else f"{100 * row[what]:.2g}" for what in ("bound", "error", "rms")),
        f"{ms['median']:.2f} ({ms['min']:.2f}…{ms['max']:.2f})" if ms else "–",
        f"failed: {row['failed']}" if row["failed"] else row["drawn_from"],
    ]
