"""``build_scene``: inputs → scene directory."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..points import PointBatch
from ..readers.source import Source
from ..scene_info import SceneInfo, SourceCount
from .assembly import Assembly
from .ingest import Columns, Tally, common_attributes, finite_batches
from .morton import morton_keys, root_cube
from .parallel import Workers
from .partition import Subdivision
from .point_array import PointArrayWriter, block_levels_of
from .settings import BuildReport, BuildSettings
from .subtree import build_subtree
from .writer import SceneWriter, settings_json

Progress = Callable[[str, int, int | None], None]


def keys_of(positions: np.ndarray, origin: np.ndarray, edge: float, workers: Workers) -> np.ndarray:
    """(n,) int64 Morton keys of (n, 3) finite positions."""
    keys = np.empty(len(positions), np.int64)
    workers.map(morton_keys, [(positions, origin, 2.0**21 / edge, a, b, keys) for a, b in workers.ranges(len(keys))])
    return keys


def build_scene(
    sources: Iterable[Source],
    out: str | Path,
    *,
    settings: BuildSettings | None = None,
    progress: Progress | None = None,
) -> BuildReport:
    settings = settings or BuildSettings()
    report_progress = progress or (lambda stage, done, total: None)
    inputs = list(sources)
    if not inputs:
        raise InputError("build: found no inputs, expected at least one")
    kept, dropped = common_attributes(inputs, settings.attributes)
    rule = Subdivision(settings.points_per_cell, settings.max_depth, settings.flatness)
    stage_s = {}
    clock = time.perf_counter()
    promised = [s.info.n_points for s in inputs]
    expected = None if None in promised else sum(p for p in promised if p is not None)
    with SceneWriter(Path(out), overwrite=settings.overwrite) as writer, Workers(settings.threads) as workers:
        tally = Tally()
        columns = Columns(expected or 1 << 26, kept)
        for batch in finite_batches(inputs, kept, 1 << 20, settings.strict, tally):
            columns.add(batch)
            report_progress("read", tally.n_points, expected)
        if not tally.n_points:
            raise InputError(f"{inputs[0].info.path}: found no finite point, expected at least one")
        stage_s["read"] = time.perf_counter() - clock
        points = columns.points()
        origin, edge = root_cube(tally.lower, tally.upper)
        levels = block_levels_of(settings.points_per_cell)
        array = PointArrayWriter(writer, kept, origin, edge, levels)
        assembly = Assembly(settings.point_order, settings.points_per_cell)

        clock = time.perf_counter()
        keys = keys_of(points.positions, origin, edge, workers)
        subtree = build_subtree(keys, points.attributes.get("normal"), 0, 0, rule, settings.point_order, workers)
        stage_s["sort"] = time.perf_counter() - clock
        clock = time.perf_counter()
        add_partition(subtree, points, array, assembly, settings, workers)
        assembly.append_top(array, workers)
        stage_s["write"] = time.perf_counter() - clock
        clock = time.perf_counter()
        cells = assembly.cell_arrays("normal" in kept)
        for name, values in cells.items():
            writer.write_array(name, values)
        first, block_origin = array.blocks()
        writer.write_array("block_first_point", first)
        writer.write_array("block_origin", block_origin)
        arrays = writer.close_columns()
        info = SceneInfo(
            point_order=settings.point_order,
            origin=tuple(origin.tolist()),
            edge=edge,
            lower=tuple(tally.lower.tolist()),
            upper=tuple(tally.upper.tolist()),
            n_points=tally.n_points,
            n_stored=array.n_stored,
            n_cells=len(cells["cell_level"]),
            n_blocks=len(first),
            n_dropped=tally.n_dropped,
            attributes=kept,
            block_levels=levels,
            up=settings.up,
            crs=next((s.info.crs for s in inputs if s.info.crs), None),
            sources=tuple(SourceCount(s.info.path.name, n) for s, n in zip(inputs, tally.source_points, strict=True)),
            build=settings_json(settings),
            arrays=arrays,
        )
        writer.commit(info)
        stage_s["finish"] = time.perf_counter() - clock
    return BuildReport(
        Path(out),
        info.n_points,
        info.n_stored,
        info.n_cells,
        info.n_dropped,
        dropped,
        assembly.n_partitions,
        0,
        sum(a.bytes for a in arrays.values()),
        stage_s,
    )


def add_partition(subtree, points: PointBatch, array, assembly, settings, workers) -> None:
    cells = subtree.cells
    owners = np.arange(len(cells))
    if settings.point_order == "depth-first":
        owners = np.flatnonzero(cells.first_child < 0)
        owners = owners[np.argsort(cells.first_point[owners])]
    root_set = points.select(subtree.stored[: min(int(cells.n_points[0]), settings.points_per_cell)])
    first = array.n_stored
    array.append(points, subtree.stored, cells.level[owners], cells.code[owners], cells.n_points[owners], workers)
    cells.first_point += first
    assembly.add(cells, root_set)
