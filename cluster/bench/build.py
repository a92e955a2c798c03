"""``splatpipe bench build``: a LAS file → a scene, in memory, with a quarter of the memory that takes, and on ranks.

Each build is a process of its own running ``splatpipe build``, timed from its start to its end, interpreter and imports
included, with the input in the page cache. The file is an airborne survey of rolling ground, point format 3 with every
attribute set, once in scan-line order as a scanner writes it and once shuffled, the worst order there is.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ...shared.errors import SplatpipeError
from ..record import machine_record

_SPACING_M = 0.25
_LINE_POINTS = 2000
_CHUNK = 1 << 20
_BYTES_IN_MEMORY = 68
"""A point of the file while it is built in memory: columns, key, indices."""
_PROCESS_BYTES = 256 << 20


def bench_build(
    n_points: int = 20_000_000,
    *,
    memory_bytes: int | None = None,
    repeats: int = 3,
    ranks: int = 0,
    workdir: Path | None = None,
) -> dict[str, Any]:
    """Time ``splatpipe build`` of an ``n_points`` LAS file in scan-line and in shuffled order, and out of core.

    memory_bytes : for the in-memory builds; None for twice what they need.
    ranks : also on so many MPI ranks of this host, with the memory and the cores of one process among them; 0: not.
    workdir : where files and scenes go; the files are kept there for the next time. None for a temporary folder.
    Returns a JSON-able dict: ``rows`` (one for each case) and the machine.
    Raises SplatpipeError if a build fails.
    """
    if workdir is None:
        with tempfile.TemporaryDirectory(prefix="splatpipe-bench-") as folder:
            return bench_build(n_points, memory_bytes=memory_bytes, repeats=repeats, ranks=ranks, workdir=Path(folder))
    workdir.mkdir(parents=True, exist_ok=True)
    enough = memory_bytes or 2 * n_points * _BYTES_IN_MEMORY + _PROCESS_BYTES
    quarter = n_points * _BYTES_IN_MEMORY // 4 + _PROCESS_BYTES
    rows = []
    cases = [
        ("in memory", "scan lines", enough, 0),
        ("in memory", "shuffled", enough, 0),
        ("external", "scan lines", quarter, 0),
    ]
    if ranks:
        cases.append((f"{ranks} ranks", "scan lines", enough, ranks))
    for case, order, memory, n_ranks in cases:
        file = workdir / f"survey-{n_points}-{order.replace(' ', '-')}.las"
        if not file.exists():
            write_survey(file, n_points, shuffled=order == "shuffled")
        _read_through(file)
        rows.append({"case": case, "order": order, **_measure(file, n_points, memory, repeats, n_ranks)})
    return {"benchmark": "build", "n_points": n_points, "repeats": repeats, "rows": rows, "machine": machine_record()}


def write_survey(path: Path, n_points: int, *, shuffled: bool) -> None:
    """A LAS 1.2 file of point format 3: colour, intensity, classification, returns, GPS time. Memory: 4 bytes a point.

    The scanner sweeps to and fro across lines of 2000 points; ``shuffled`` puts the points in random order.
    """
    import laspy

    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.001), np.array([5e5, 5.4e6, 0.0])
    order = np.random.default_rng(0).permutation(n_points).astype(np.uint32) if shuffled else None
    partial = path.with_name(path.name + ".partial")
    with laspy.open(partial, mode="w", header=header) as writer:
        for begin in range(0, n_points, _CHUNK):
            index = np.arange(begin, min(begin + _CHUNK, n_points), dtype=np.int64)
            writer.write_points(_survey_points(index if order is None else order[index].astype(np.int64), header))
    partial.rename(path)


def _survey_points(index: np.ndarray, header: Any) -> Any:
    """Points of the survey by number: the same point for the same number, whatever the order."""
    import laspy

    line, column = np.divmod(index, _LINE_POINTS)
    column = np.where(line % 2 == 0, column, _LINE_POINTS - 1 - column)
    noise = ((index * 0x9E3779B1) % 65536) / 65536 - 0.5
    x, y = (column + noise) * _SPACING_M, (line - noise) * _SPACING_M
    z = 20 * np.sin(x / 97) * np.cos(y / 131) + 3 * np.sin(x / 13 + y / 17) + 0.1 * noise
    points = laspy.ScaleAwarePointRecord.zeros(len(index), header=header)
    points.x, points.y, points.z = x + header.offsets[0], y + header.offsets[1], z
    shade = ((z + 24) / 48 * 65535).clip(0, 65535)
    points.red, points.green, points.blue = shade, 65535 - shade, np.full(len(index), 20000)
    points.intensity = (noise + 0.5) * 4000
    points.classification = np.where(z > 0, 2, 5)
    points.return_number = 1 + index % 2
    points.gps_time = index * 1e-6
    return points


def _read_through(file: Path) -> None:
    """Bring a file into the page cache, and what was written to the disk, so that neither is part of a timing."""
    os.sync()
    with file.open("rb", buffering=0) as stream:
        buffer = bytearray(1 << 22)
        while stream.readinto(buffer):
            pass


def _measure(file: Path, n_points: int, memory: int, repeats: int, n_ranks: int) -> dict[str, Any]:
    seconds, reports = [], []
    _build(file, memory, n_ranks)  # compiles the kernels, where they are not cached yet
    for _ in range(repeats):
        os.sync()
        wall_s, report = _build(file, memory, n_ranks)
        seconds.append(wall_s)
        reports.append(report)
    median = statistics.median(seconds)
    peak_bytes = max(report["peak_bytes"] for report in reports)
    report = reports[seconds.index(min(seconds, key=lambda s: abs(s - median)))]
    return {
        "seconds": {"median": median, "min": min(seconds), "max": max(seconds)},
        "points_per_s": n_points / median,
        "memory_bytes": memory,
        "peak_bytes": peak_bytes,
        "peak_of_memory": peak_bytes / memory,
        "input_bytes": file.stat().st_size,
        "scene_bytes": report["bytes"],
        "spilled_bytes": report["spilled_bytes"],
        "n_stored": report["n_stored"],
        "n_cells": report["n_cells"],
        "n_partitions": report["n_partitions"],
        "stage_s": report["stage_s"],
    }


def _build(file: Path, memory: int, n_ranks: int) -> tuple[float, dict[str, Any]]:
    """(seconds, report) of one ``splatpipe build``; the scene is removed again."""
    with tempfile.TemporaryDirectory(dir=file.parent, prefix="build-") as folder:
        told = Path(folder, "report.json")
        command = [sys.executable, "-m", "splatpipe.cluster", "build", str(file), "-o", str(Path(folder, "scene"))]
        command += ["--memory", str(memory), "--json", str(told), "--ranks", str(n_ranks)]
        start = time.perf_counter()
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False)
        wall_s = time.perf_counter() - start
        if done.returncode:
            raise SplatpipeError(f"bench build: exit status {done.returncode}: {done.stderr.strip()[-300:]}")
        report = json.loads(told.read_text())
        shutil.rmtree(Path(folder, "scene"))
    return wall_s, report


def print_build(results: dict[str, Any], console: Console) -> None:
    """One line a case."""
    table = Table(title=f"LAS file of {results['n_points']:,} points → scene, {results['repeats']} builds each")
    for name in ("case", "order"):
        table.add_column(name)
    for name in ("s median", "min", "max", "M points/s", "memory MB", "peak MB", "written MB"):
        table.add_column(name, justify="right")
    for row in results["rows"]:
        s, written = row["seconds"], row["scene_bytes"] + row["spilled_bytes"]
        table.add_row(
            row["case"],
            row["order"],
            *(f"{s[key]:.2f}" for key in ("median", "min", "max")),
            f"{row['points_per_s'] / 1e6:.2f}",
            *(f"{n / 1e6:.0f}" for n in (row["memory_bytes"], row["peak_bytes"], written)),
        )
    console.print(table)
    for row in results["rows"]:
        stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in row["stage_s"].items())
        console.print(f"{row['case']}, {row['order']}: {stages} s; the rest is starting the process")
    console.print(f"{results['machine']['cpu']}, {results['machine']['cores']} cores")
