"""``build_scene``: inputs → scene directory."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..camera_path import axis_vector
from ..errors import InputError
from ..points import PointBatch
from ..readers.source import Source
from ..scene_info import SceneInfo, SourceCount
from .assembly import Assembly
from .coded_positions import code_positions
from .features import cell_features
from .ingest import Bounds, Columns, Tally, declared_bounds, finite_batches, planned_attributes, root_bounds
from .morton import keys_of, root_cube
from .neighbours import SurfaceRule, add_surface
from .parallel import Workers
from .partition import Subdivision
from .point_array import PointArrayWriter, block_level, block_levels_of
from .pooled import pool_positions, suited_bits
from .runs import Partition, Runs
from .settings import (
    BuildReport,
    BuildSettings,
    MemoryPlan,
    available_memory_bytes,
    peak_resident_bytes,
    plan_memory,
)
from .streamed import append_streamed_leaf
from .subtree import build_subtree
from .writer import ColumnFolder, SceneWriter, settings_json

Progress = Callable[[str, int, int | None], None]


def build_scene(
    sources: Iterable[Source],
    out: str | Path,
    *,
    settings: BuildSettings | None = None,
    progress: Progress | None = None,
) -> BuildReport:
    """Build the scene directory ``out`` from all points of the sources.

    progress : called with (``read``, ``bounds``, ``write``, ``positions`` or ``pools``, points done, points in all or
        None), from any thread.
    Points that do not fit into ``settings.memory_bytes`` are sorted into runs inside ``.OUT.partial`` and built
    partition by partition; cells, sets and their order are the same for any memory and any number of threads, the
    place of a cell's range in the point-array is not. Neighbours, for normals and radii, are searched inside a
    partition: next to its faces radii are a little larger and normals less exact than in memory. The runs take as much
    disk as the points, which is given back, as far as the file system can, while the scene is written.
    A build that was killed is started again from clean.
    Raises InputError for inputs that cannot be used, a target that must not be replaced, or a full disk; nothing is
    left behind then.
    Cost: O(n); each input is read once, twice if it does not fit into memory and states no bounds or wrong ones.
    """
    return Build(list(sources), Path(out), settings or BuildSettings(), progress or silent).run()


def silent(stage: str, done: int, total: int | None) -> None:
    """Progress that nobody looks at."""


Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Finished:
    """The cells of a scene whose points are all stored: name → array, the root cube, and the blocks."""

    cells: Arrays
    origin: np.ndarray
    edge: float
    block_first_point: np.ndarray
    block_origin: np.ndarray


class Build:
    """One build: reading, partitions, the cells above them, ``scene.json``.

    ranks_here : processes that build together on this host and share ``settings.memory_bytes``.
    """

    writer: ColumnFolder
    workers: Workers

    def __init__(
        self, sources: list[Source], out: Path, settings: BuildSettings, progress: Progress, ranks_here: int = 1
    ) -> None:
        if not sources:
            raise InputError("build: found no inputs, expected at least one")
        self.sources, self.out, self.settings, self.progress = sources, out, settings, progress
        self.share = sources  # what this process reads of them
        self.read_attributes, self.attributes, self.dropped_attributes = planned_attributes(sources, settings)
        self.makes = set(self.attributes) - set(self.read_attributes)
        self.budget = settings  # with the memory of this process
        if ranks_here > 1:
            memory_bytes = settings.memory_bytes or available_memory_bytes() // 2
            self.budget = replace(settings, memory_bytes=max(1, memory_bytes // ranks_here))
        self.memory: MemoryPlan = plan_memory(self.budget, self.attributes, bool(self.makes))
        self.rule = Subdivision(settings.points_per_cell, settings.max_depth, settings.flatness)
        self.declared = declared_bounds(sources)
        self.stage_s: dict[str, float] = {}

    def run(self) -> BuildReport:
        """The whole build."""
        with (
            SceneWriter(self.out, overwrite=self.settings.overwrite) as writer,
            Workers(self.settings.threads) as self.workers,
        ):
            self.writer = writer
            with self.timed("read"):
                held, runs, tally = self.read_all()
            origin, edge = self.prepare(root_bounds(self.declared, tally))
            if runs is None:
                assert held is not None
                self.add_partition(held, keys_of(held.positions, origin, edge, self.workers), 0, 0, tally.n_points)
            else:
                for partition in runs.partitions(self.memory.capacity):
                    runs.release_before(partition)
                    self.add_from_runs(runs, partition, tally.n_points)
                runs.discard()
            with self.timed("write"):
                self.assembly.append_top(self.array, self.workers)
            with self.timed("finish"):
                finished = self.finish_cells(writer, origin, edge, tally)
                if self.settings.pools:
                    finished.cells.update(self.pool(finished, [writer.written(axis) for axis in "xyz"]))
                info = self.commit(writer, finished, tally)
        return self.report(info, runs.bytes if runs else 0, peak_resident_bytes())

    def prepare(self, bounds: Bounds) -> tuple[np.ndarray, float]:
        """Open the point-array; (origin, edge) of the root cube."""
        origin, edge = root_cube(*bounds)
        self.surface = self.surface_rule(origin, edge, bounds)
        self.array = PointArrayWriter(self.writer, self.attributes, origin, edge)
        self.assembly = Assembly(self.settings.point_order, self.settings.points_per_cell)
        return origin, edge

    def report(self, info: SceneInfo, spilled_bytes: int, peak_bytes: int, n_ranks: int = 1) -> BuildReport:
        """What has been done."""
        return BuildReport(
            path=self.out,
            n_points=info.n_points,
            n_stored=info.n_stored,
            n_cells=info.n_cells,
            n_dropped=info.n_dropped,
            dropped_attributes=self.dropped_attributes,
            n_partitions=self.assembly.n_partitions,
            spilled_bytes=spilled_bytes,
            bytes=sum(array.bytes for array in info.arrays.values()),
            position_bytes=sum(info.arrays[name].bytes for name in info.position_arrays),
            peak_bytes=peak_bytes,
            n_ranks=n_ranks,
            stage_s=self.stage_s,
        )

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time that the block takes to a stage's."""
        start = time.perf_counter()
        yield
        self.stage_s[stage] = self.stage_s.get(stage, 0.0) + time.perf_counter() - start

    def read_all(self) -> tuple[PointBatch | None, Runs | None, Tally]:
        """The points in memory, or the runs that hold them."""
        held, runs, tally = self.read_with(self.declared)
        self.check_found(tally)
        bounds = root_bounds(self.declared, tally)
        if runs is not None and bounds is not self.declared and not runs.built_for(*root_cube(*bounds)):
            runs.discard()  # the headers were wrong: once more, now that the bounds are known
            held, runs, tally = self.read_with(bounds)
        return held, runs, tally

    def check_found(self, tally: Tally) -> None:
        """Raise InputError where there are no points."""
        if not tally.n_points:
            raise InputError(f"{self.sources[0].info.path}: found no finite point, expected at least one")

    def read_with(
        self, bounds: Bounds | None, runs: Runs | None = None
    ) -> tuple[PointBatch | None, Runs | None, Tally]:
        """Read this process's share; into runs if they are given, or else if it does not fit into memory."""
        promised = [source.info.n_points for source in self.share]
        expected = None if None in promised else sum(n for n in promised if n is not None)
        capacity = self.memory.capacity
        columns = Columns(capacity if expected is None else max(1, min(capacity, expected)), self.read_attributes)
        tally = Tally()
        for batch in finite_batches(self.share, self.read_attributes, self.memory.batch, self.settings.strict, tally):
            while len(batch) > columns.room:
                room = columns.room
                columns.add(batch.select(slice(0, room)))
                batch = batch.select(slice(room, None))
                if runs is None:
                    runs = self.new_runs(bounds or self.measured_bounds())
                runs.add(columns.points())
                columns.clear()
            columns.add(batch)
            self.progress("read", tally.n_points, expected)
        if runs is None:
            return columns.points(), None, tally
        if columns.n_points:
            runs.add(columns.points())
        return None, runs, tally

    def new_runs(self, bounds: Bounds) -> Runs:
        """No runs yet, to be sorted in the root cube of these bounds."""
        directory = self.writer.partial / "runs"
        return Runs(directory, self.read_attributes, *root_cube(*bounds), self.rule, self.workers)

    def measured_bounds(self) -> Bounds:
        """Tight bounds of this process's share, by a pass over the positions alone."""
        tally = Tally()
        for _ in finite_batches(self.share, (), self.memory.batch, self.settings.strict, tally):
            self.progress("bounds", tally.n_points, None)
        return tally.lower, tally.upper

    def add_from_runs(self, runs: Runs, partition: Partition, n_total: int) -> None:
        """Build a partition and append it. n_total : points that are going to be built, for the progress."""
        if partition.fits:
            with self.timed("load"):
                points, keys = runs.load(partition)
            self.add_partition(points, keys, partition.level, partition.code, n_total)
            return
        if self.settings.positions != "float32":
            raise InputError(
                f"build: positions = {self.settings.positions!r}: a cell of {partition.n_points} points does not fit "
                "into memory, expected float32, or more memory"
            )
        with self.timed("write"):
            cells, root_set = append_streamed_leaf(
                partition, runs, self.memory.capacity, self.settings, self.surface, self.array, self.workers
            )
            self.assembly.add(cells, root_set)

    def add_partition(self, points: PointBatch, keys: np.ndarray, level: int, code: int, n_total: int) -> None:
        """Build the cell (level, code) of these points, and append them."""
        order = self.settings.point_order
        if self.surface:
            with self.timed("neighbours"):
                points = add_surface(points, keys, self.surface, self.workers)
        with self.timed("sort"):
            subtree = build_subtree(keys, points.attributes.get("normal"), level, code, self.rule, order, self.workers)
        with self.timed("write"):
            done, share = self.assembly.n_points, len(points) / len(subtree.stored)
            cells, owners = subtree.cells, subtree.owners
            cells.first_point += self.array.n_stored
            first_set = subtree.stored[: min(int(cells.n_points[0]), self.settings.points_per_cell)]
            self.assembly.add(cells, points.select(first_set))
            self.array.append(
                points,
                subtree.stored,
                cells.level[owners],
                cells.code[owners],
                cells.n_points[owners],
                cells.count[owners],
                block_level(cells, order, self.settings.points_per_cell)[owners],
                self.workers,
                lambda n_stored: self.progress("write", done + int(n_stored * share), n_total),
            )

    def surface_rule(self, origin: np.ndarray, edge: float, bounds: Bounds) -> SurfaceRule | None:
        """What is made of neighbours. Normals of surveys (LAS) point up, others away from the middle of the bounds."""
        if not self.makes:
            return None
        is_survey = all(source.info.format in ("las", "laz", "copc") for source in self.sources)
        up = axis_vector("z" if self.settings.up == "auto" else self.settings.up) if is_survey else None
        return SurfaceRule(
            normals="normal" in self.makes,
            radii="radius" in self.makes,
            origin=origin,
            edge=edge,
            up=up,
            center=bounds[0] + (bounds[1] - bounds[0]) / 2,
        )

    def finish_cells(self, writer: SceneWriter, origin: np.ndarray, edge: float, tally: Tally) -> Finished:
        """The cells, and what is made of them but for pools."""
        cells = self.assembly.cell_arrays("normal" in self.attributes)
        first, block_origin = self.array.blocks()
        if self.settings.positions != "float32":
            with self.timed("positions"):
                cells |= code_positions(
                    cells,
                    origin,
                    edge,
                    first,
                    block_origin,
                    float(np.max(tally.upper - tally.lower)),
                    self.settings,
                    self.memory.capacity,
                    writer,
                    self.workers,
                    lambda done, total: self.progress("positions", done, total),
                )
        if self.settings.features:
            with self.timed("features"):
                cells |= cell_features(cells, origin, edge, first, block_origin, writer.written, self.workers)
        return Finished(cells, origin, edge, first, block_origin)

    def pool(self, finished: Finished, columns: list[np.ndarray], share: tuple[int, int] = (0, 1)) -> Arrays:
        """Write the pooled form of a share of the cells; what it adds to them. columns : x, y and z of all points."""
        x, y, z = columns
        with self.timed("pools"):
            return pool_positions(
                finished.cells,
                finished.origin,
                finished.edge,
                finished.block_first_point,
                finished.block_origin,
                lambda begin, end: (x[begin:end], y[begin:end], z[begin:end]),
                self.pool_bits,
                self.budget,
                self.writer,
                self.workers,
                lambda done, total: self.progress("pools", done, total),
                share=share,
            )

    @property
    def pool_bits(self) -> int:
        """Bits an axis of the pooled form's grid; 0 without one."""
        if not self.settings.pools:
            return 0
        return self.settings.pool_bits or suited_bits(self.settings.points_per_cell)

    def commit(self, writer: SceneWriter, finished: Finished, tally: Tally) -> SceneInfo:
        """Write the cells, the blocks and ``scene.json``, and put the scene in its place."""
        cells, first = finished.cells, finished.block_first_point
        coded = self.settings.positions != "float32"
        for axis in "xyz" if coded else "":
            writer.drop(axis)
        for name, values in {**cells, "block_first_point": first, "block_origin": finished.block_origin}.items():
            writer.write_array(name, values)

        def bytes_of(name: str) -> int:
            return int(cells[name].sum(dtype=np.int64)) if name in cells else 0

        info = SceneInfo(
            point_order=self.settings.point_order,
            origin=_triple(finished.origin),
            edge=finished.edge,
            lower=_triple(tally.lower),
            upper=_triple(tally.upper),
            n_points=tally.n_points,
            n_stored=self.array.n_stored,
            n_cells=len(cells["cell_level"]),
            n_blocks=len(first),
            n_dropped=tally.n_dropped,
            attributes=self.attributes,
            features=self.settings.features,
            positions=self.settings.positions,
            position_bits=self.settings.position_bits if coded else 0,
            position_bytes=bytes_of("cell_position_bytes"),
            pool_bits=self.pool_bits,
            pool_bytes=bytes_of("cell_pool_bytes"),
            block_levels=block_levels_of(self.settings.point_order, self.settings.points_per_cell),
            up=self.settings.up,
            crs=next((s.info.crs for s in self.sources if s.info.crs), None),
            sources=tuple(
                SourceCount(source.info.path.name, n)
                for source, n in zip(self.sources, tally.source_points, strict=True)
            ),
            build=settings_json(self.settings),
            arrays=writer.close_columns(),
        )
        writer.commit(info)
        return info


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
