"""``build_scene_on_ranks``: the same scene, built by several processes that share a folder.

1. Each rank reads its share of the inputs, consecutive in their order, into runs of its own.
2. The runs of all ranks, in order, are what one process would have written. Partitions are dealt to the ranks,
   consecutive in Morton order; each builds the subtrees of its own from the runs of all, into files of its own.
3. Each copies its rows into the scene's files, behind those of the ranks before it, and rank 0 makes the cells above
   the partitions and whatever a pass over the finished cells makes (coded positions, features, pools).

Inside a leaf points stand in the order of (bucket, input), whoever read them, so cells, sets and their order are those
of ``build_scene``. Ranks exchange counts and bounds in messages, points and cells through the folder.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import socket
import time
from collections.abc import Iterable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..readers.source import Source
from .builder import Build, Finished, Progress, silent
from .ingest import Bounds, Tally, root_bounds
from .morton import root_cube
from .parallel import Workers
from .point_array import POINT_ARRAY_PART, least_partition
from .ranks import FailedElsewhere, Ranks, step
from .runs import Partition, Runs
from .settings import BuildReport, BuildSettings, MemoryPlan, peak_resident_bytes
from .shares import consecutive, input_share, wanted_points
from .writer import ColumnFolder, SceneWriter, partial_folder, writing

_TOKEN = "token"
_CELLS = "cells.npz"
_FINISHED = "finished.npz"
_POOL_CODES = "pool_codes"
_PATIENCE_S = 10.0
"""How long a file that another host wrote may take to be seen."""


def build_scene_on_ranks(
    sources: Iterable[Source],
    out: str | Path,
    ranks: Ranks,
    *,
    settings: BuildSettings | None = None,
    progress: Progress | None = None,
) -> BuildReport | None:
    """Build a scene together; the report on rank 0, None elsewhere. Collective: sources and settings alike on all.

    settings : memory and threads are those of a host, which its ranks share.
    progress : as for ``build_scene``, of this rank's own share.
    Cells, sets and their order are those of ``build_scene``; all bits are the same for 2 to 16 ranks with as much
    memory for each. Neighbours are searched inside partitions, which are smaller than in a build by one process.
    The runs take as much disk as the points, the copying as much as the scene, beside the scene.
    Raises InputError as ``build_scene`` does, or where the ranks do not share the folder, on the first rank that finds
    something, FailedElsewhere on the others; nothing is left behind then.
    """
    ranks_here = ranks.ranks_here()
    build = None
    with step(ranks):
        build = _SharedBuild(
            list(sources), Path(out), settings or BuildSettings(), progress or silent, ranks, ranks_here
        )
    assert build is not None
    with ExitStack() as stack:
        return build.run_on_ranks(stack)


class _SharedBuild(Build):
    """One rank's part. Each method that has a step is collective."""

    def __init__(
        self,
        sources: list[Source],
        out: Path,
        settings: BuildSettings,
        progress: Progress,
        ranks: Ranks,
        ranks_here: int,
    ) -> None:
        super().__init__(sources, out, settings, self.watched(progress), ranks_here)
        self.ranks, self.ranks_here = ranks, ranks_here
        self.is_first = ranks.rank == 0
        share = input_share(sources, ranks.rank, ranks.size)
        self.share_of = [index for index, _ in share]
        self.share = [source for _, source in share]

    def watched(self, progress: Progress) -> Progress:
        """Progress that ends this rank's step where another rank has failed."""

        def show(stage: str, done: int, total: int | None) -> None:
            progress(stage, done, total)
            if self.ranks.warned():
                raise FailedElsewhere

        return show

    def run_on_ranks(self, stack: ExitStack) -> BuildReport | None:
        """The whole build; ``stack`` closes what it opens."""
        self.open_folder(stack)
        self.workers = stack.enter_context(Workers(self.threads_of_rank()))
        with self.timed("read"):
            runs, tally = self.read_shares()
        with self.step():
            origin, edge = self.prepare(root_bounds(self.declared, tally))
        with self.timed("deal"):
            own = self.deal_partitions(runs, tally.n_points)
        with self.step():
            for partition in own:
                self.add_from_runs(runs, partition, sum(p.n_points for p in own))
            if self.is_first:
                self.array.abandon()
        with self.timed("join"):
            self.join_parts(runs)
        measured = np.array([runs.bytes, peak_resident_bytes()], np.float64)
        spilled, peaks = self.ranks.join(measured).reshape(-1, 2).T
        finished = report = None
        with self.step():
            if self.scene is not None:
                with Workers(self.settings.threads) as all_workers:  # the other ranks only wait
                    own_workers, self.workers = self.workers, all_workers
                    with self.timed("write"):
                        self.assembly.append_top(self.array, self.workers)
                    with self.timed("finish"):
                        finished = self.finish_cells(self.scene, origin, edge, tally)
                    self.workers = own_workers
                if self.settings.pools:
                    self.save_finished(finished)
        if self.settings.pools:
            finished = self.pool_together(finished, origin, edge)
        with self.step():
            if self.scene is not None:
                assert finished is not None
                self.remove_what_is_no_scene()
                with self.timed("finish"):
                    info = self.commit(self.scene, finished, tally)
                report = self.report(info, int(spilled.sum()), int(peaks.max()), self.ranks.size)
        return report

    def threads_of_rank(self) -> int:
        """A rank's part of the threads of its host: of all cores that its ranks may run on, bound to some or not."""
        own = {"host": socket.gethostname(), "cores": sorted(os.sched_getaffinity(0))}
        told = [json.loads(rank) for rank in self.ranks.gather(json.dumps(own).encode())]
        cores = {core for rank in told if rank["host"] == own["host"] for core in rank["cores"]}
        return max(1, (self.settings.threads or len(cores)) // self.ranks_here)

    def step(self) -> AbstractContextManager[None]:
        return step(self.ranks)

    def rank_folder(self, rank: int) -> Path:
        """Where a rank puts what is its own."""
        return self.partial if rank == 0 else self.partial / f"rank-{rank:05d}"

    def open_folder(self, stack: ExitStack) -> None:
        """Make the scene's folder, which every rank must see, and in it one for each rank."""
        self.partial = partial_folder(self.out)
        self.scene: SceneWriter | None = None
        token = ""
        with self.step():
            if self.is_first:
                self.scene = stack.enter_context(SceneWriter(self.out, overwrite=self.settings.overwrite))
                token = secrets.token_hex(16)
                with writing(self.partial):
                    (self.partial / _TOKEN).write_text(token)
        token = self.ranks.gather(token.encode())[0].decode()
        with self.step():
            if self.scene is not None:
                self.writer = self.scene
                return
            self.await_token(token)
            own = self.rank_folder(self.ranks.rank)
            with writing(own):
                own.mkdir()
            self.writer = stack.enter_context(ColumnFolder(own))

    def await_token(self, token: str) -> None:
        """Raise InputError where this rank does not see what rank 0 wrote."""
        until = time.monotonic() + _PATIENCE_S
        while True:
            try:
                if (self.partial / _TOKEN).read_text() == token:
                    return
            except OSError:
                pass
            if time.monotonic() > until:
                raise InputError(
                    f"{self.out}: found no folder that rank 0 shares with {socket.gethostname()}, expected one that "
                    "all ranks see under the same path"
                )
            time.sleep(_PATIENCE_S / 100)

    def read_shares(self) -> tuple[Runs, Tally]:
        """(runs of this rank's share, in the root cube of all points; what all ranks have read)."""
        bounds = self.declared
        if bounds is None:
            with self.step():
                bounds = self.measured_bounds()
            bounds = self.bounds_of_all(*bounds)
        runs, tally = self.read_into_runs(bounds)
        agreed = root_bounds(self.declared, tally)
        if agreed is not self.declared and not runs.built_for(*root_cube(*agreed)):
            runs.discard()  # the headers were wrong: once more, now that the bounds are known
            runs, tally = self.read_into_runs(agreed)
        return runs, tally

    def read_into_runs(self, bounds: Bounds) -> tuple[Runs, Tally]:
        with self.step():
            runs = self.new_runs(bounds)
            _, _, own = self.read_with(bounds, runs)
        counts = np.zeros(len(self.sources) + 1, np.int64)
        np.add.at(counts, self.share_of, own.source_points)
        counts[-1] = own.n_dropped
        *source_points, n_dropped = self.ranks.total(counts).tolist()
        tally = Tally(*self.bounds_of_all(own.lower, own.upper), n_dropped, source_points)
        with self.step():
            self.check_found(tally)
            root_cube(*root_bounds(self.declared, tally))  # refuses extents without bounds
        return runs, tally

    def bounds_of_all(self, lower: np.ndarray, upper: np.ndarray) -> Bounds:
        bounds = self.ranks.join(np.concatenate([lower, upper])).reshape(-1, 2, 3)
        return bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)

    def deal_partitions(self, runs: Runs, n_points: int) -> list[Partition]:
        """Let ``runs`` be those of all ranks; the partitions that this rank builds."""
        n_runs = self.ranks.agree(runs.n_runs)
        counts = self.ranks.total(runs.counts)
        moments = None if runs.moments is None else self.ranks.total(runs.moments)
        runs.read_on([(self.rank_folder(rank) / "runs", n) for rank, n in enumerate(n_runs)], counts, moments)
        capacity = int(self.ranks.join(np.array([self.memory.capacity], np.float64)).min())
        self.memory = MemoryPlan(capacity, self.memory.batch)
        least = least_partition(self.settings.point_order, self.settings.points_per_cell)
        wanted = wanted_points(n_points, self.ranks.size, least, capacity)
        found = np.zeros((0, 4), np.int64)
        with self.step():
            if self.is_first:  # may read runs, where points crowd
                cells = [(p.level, p.code, p.n_points, p.fits) for p in runs.partitions(capacity, wanted)]
                found = np.array(cells, np.int64)
        found = np.frombuffer(self.ranks.gather(found.tobytes())[0], np.int64).reshape(-1, 4)
        own = consecutive(found[:, 2], self.ranks.rank, self.ranks.size)
        return [Partition(level, code, n, bool(fits)) for level, code, n, fits in found[own].tolist()]

    def join_parts(self, runs: Runs) -> None:
        """Put the points of all ranks into the scene's files, and the cells of all into the assembly of rank 0."""
        n_stored = self.ranks.join(np.array([self.array.n_stored], np.float64)).astype(np.int64)
        first_point = np.cumsum(n_stored) - n_stored
        own = self.rank_folder(self.ranks.rank)
        with self.step():
            runs.discard()
            if not self.is_first:
                self.array.copy_into(self.partial, int(first_point[self.ranks.rank]))
                with writing(own):
                    arrays: dict[str, Any] = self.array.part() | self.assembly.part()
                    np.savez(own / _CELLS, **arrays)
        with self.step():
            if self.is_first:
                parts = []
                for rank in range(1, self.ranks.size):
                    with np.load(self.rank_folder(rank) / _CELLS) as file:
                        part = dict(file)
                    self.assembly.take(part, int(first_point[rank]))
                    parts.append({name: part[name] for name in POINT_ARRAY_PART})
                self.array.go_on(parts)

    def save_finished(self, finished: Finished) -> None:
        """Let the other ranks see the cells."""
        blocks = {"block_first_point": finished.block_first_point, "block_origin": finished.block_origin}
        arrays: dict[str, Any] = finished.cells | blocks | {"n_stored": np.array(self.array.n_stored)}
        with writing(self.partial):
            np.savez(self.partial / _FINISHED, **arrays)

    def pool_together(self, finished: Finished | None, origin: np.ndarray, edge: float) -> Finished:
        """Pool a share of the cells each; the finished cells with what all have added."""
        cells: dict[str, np.ndarray] = {}
        with self.step():
            with np.load(self.partial / _FINISHED) as file:
                arrays = dict(file)
            n_stored = int(arrays.pop("n_stored"))
            blocks = arrays.pop("block_first_point"), arrays.pop("block_origin")
            finished = finished or Finished(arrays, origin, edge, *blocks)
            columns = [self.writer.columns[axis].map_of(self.partial / f"{axis}.npy", n_stored) for axis in "xyz"]
            cells = self.pool(finished, columns, (self.ranks.rank, self.ranks.size))
            codes = self.writer.columns[_POOL_CODES]
            if self.is_first:
                codes.abandon()
        assert finished is not None
        for name, own in cells.items():
            finished.cells[name] = self.ranks.total(own.astype(np.int64)).astype(own.dtype)
        parts = self.ranks.join(np.array(codes.part, np.float64)).astype(np.int64).reshape(-1, 2)
        with self.step():
            if not self.is_first:
                with writing(self.partial):
                    codes.copy_into(self.partial / codes.path.name, int(parts[: self.ranks.rank, 0].sum()))
        with self.step():
            if self.is_first:
                with writing(self.partial):
                    codes.go_on([(rows, crc) for rows, crc in parts[1:].tolist()])
        return finished

    def remove_what_is_no_scene(self) -> None:
        """Leave the scene's own files in the folder."""
        with writing(self.partial):
            (self.partial / _TOKEN).unlink()
            (self.partial / _FINISHED).unlink(missing_ok=True)
            for rank in range(1, self.ranks.size):
                shutil.rmtree(self.rank_folder(rank))
