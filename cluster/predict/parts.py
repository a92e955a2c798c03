"""What falls to each of n ranks: tiles of the picture, shares of the points, subtrees of the octree.

Counted from the scene, so that cells on the borders of tiles count on each of them, and shares are as uneven as they
are: culling and sampling are run for each part, in a sample of the frames. Beyond ``MOST_COUNTED`` parts, what all of
them have together and what the fullest has go on as from half as many to so many (a power of the number of parts).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, Protocol

import numpy as np

from ...shared.framebuffer_runs import encode_runs
from ...shared.messages import FRAMEBUFFER_EMPTY, HEADER, RenderPoints, points_of
from ...shared.octree_parts import Subtrees, balanced_borders, cells_of_range, part_of
from ...shared.scene_share import clip_entries, share_borders
from ...shared.windows import tiles
from ..job import Job
from ..selection import SUBTREES_PER_RANK
from .workload import COLD_POINTS, Workload

Kind = Literal["tiles", "shares", "subtrees"]

MOST_COUNTED = 32
SAMPLED_FRAMES = 6
COUNTED = ("cells", "cells_visible", "entries", "points", "cold")
FILLED = ("filled", "filled_bytes")


@dataclass(frozen=True)
class Part:
    """What one rank has of every frame.

    load : counts as of a workload.
    pixels : of the part's window, which it sends; a rasterizer's framebuffer is that of the whole picture all the same.
    filled, filled_bytes : (n_frames,) pixels of its framebuffer on which points fall, and the bytes that these are as
        a message.
    """

    load: Workload
    pixels: float
    filled: np.ndarray
    filled_bytes: np.ndarray


class Parts(Protocol):
    """The parts of a run's work."""

    @property
    def whole(self) -> Workload:
        """All of it."""
        ...

    def of(self, kind: Kind, n: int) -> Sequence[Part]:
        """The n parts, in the order of ranks."""
        ...


class EvenParts:
    """Parts without a scene to count: equal ones, nothing on two of them."""

    def __init__(self, whole: Workload) -> None:
        self.whole = whole

    def of(self, kind: Kind, n: int) -> Sequence[Part]:
        """As of ``Parts``. Points fall on pixels independently: e^(−points a pixel) of these stay background."""
        whole = self.whole
        pixels = whole.pixels / n if kind == "tiles" else whole.pixels
        covered = whole.covered / n
        filled = pixels * -np.expm1(-covered / pixels)
        counts = {name: getattr(whole, name) / n for name in COUNTED[1:]} | {"covered": covered}
        cells = whole.cells if kind == "tiles" else whole.cells / n
        return [_part(whole, counts | {"cells": np.full(whole.n_frames, cells)}, pixels, filled, 8 * filled)] * n


class CountedParts:
    """Parts of a scene as it is, counted when they are asked for and kept.

    whole : counts of all frames of the job.
    """

    def __init__(self, job: Job, whole: Workload) -> None:
        self.whole = whole
        self._job = job
        self._octree = job.load_octree()
        self._frames = np.unique(np.linspace(0, job.n_frames - 1, SAMPLED_FRAMES).astype(np.int64))
        self._parts: dict[tuple[Kind, int], Sequence[Part]] = {}
        self._counts: dict[tuple[Kind, int], dict[str, np.ndarray]] = {}

    def of(self, kind: Kind, n: int) -> Sequence[Part]:
        """As of ``Parts``.  Cost: of the sampled frames, culling and sampling once a part, and drawing them once."""
        if (kind, n) not in self._parts:
            self._parts[kind, n] = EvenParts(self.whole).of(kind, 1) if n == 1 else self._several(kind, n)
        return self._parts[kind, n]

    def _several(self, kind: Kind, n: int) -> list[Part]:
        counts = self._table(kind, n) if n <= MOST_COUNTED else None
        pixels = [float(self.whole.pixels)] * n
        if kind == "tiles":
            windows = tiles(self._job.views.width, self._job.views.height, [1.0] * n)
            pixels = [float(window.n_pixels) for window in windows]
        if counts is None:
            fullest, others = self._continued(kind, n)
            return [self._full(fullest, pixels[0])] + [self._full(others, pixels[-1])] * (n - 1)
        return [self._full({name: of[i] for name, of in counts.items()}, pixels[i]) for i in range(n)]

    def _full(self, counts: dict[str, np.ndarray], pixels: float) -> Part:
        """A part's counts of the sampled frames as those of all: as shares of the whole, linear between samples."""
        whole, frames = self.whole, np.arange(self.whole.n_frames)
        full = {"cells": np.full(len(frames), counts["cells"].mean())}
        for name in COUNTED[1:]:
            of_all = getattr(whole, name)
            share = counts[name] / np.maximum(of_all[self._frames], 1)
            full[name] = of_all * np.interp(frames, self._frames, share)
        full["covered"] = whole.covered * full["points"] / np.maximum(whole.points, 1)
        filled, filled_bytes = (np.interp(frames, self._frames, counts[name]) for name in FILLED)
        return _part(whole, full, pixels, filled, filled_bytes)

    def _continued(self, kind: Kind, n: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Counts of the fullest of n parts, and of each of the others."""
        half, full = self._table(kind, MOST_COUNTED // 2), self._table(kind, MOST_COUNTED)
        doublings = np.log2(n / MOST_COUNTED)
        fullest, others = {}, {}
        for name in full:
            most = _power(half[name].max(axis=0), full[name].max(axis=0), doublings)
            total = _power(half[name].sum(axis=0), full[name].sum(axis=0), doublings)
            fullest[name] = np.maximum(most, total / n)
            others[name] = np.maximum(total - fullest[name], 0) / (n - 1)
        return fullest, others

    def _table(self, kind: Kind, n: int) -> dict[str, np.ndarray]:
        """Count → (n, sampled frames)."""
        if (kind, n) not in self._counts:
            found = {"tiles": self._tiles, "shares": self._shares, "subtrees": self._subtrees}[kind](n)
            self._counts[kind, n] = found
        return self._counts[kind, n]

    def _tiles(self, n: int) -> dict[str, np.ndarray]:
        job, out = self._job, self._empty(n)
        windows = tiles(job.views.width, job.views.height, [1.0] * n)
        culling, sampling = job.culling_node(self._octree), job.sampling_node(self._octree)
        for f, frame in enumerate(self._frames.tolist()):
            camera = job.camera(frame)
            for i, window in enumerate(windows):
                if window.n_pixels:
                    bits = culling.process(camera, window)
                    _count(out, i, f, bits.bits, sampling.process(camera, bits).entries)
        out["cells"][:] = len(self._octree)
        for f, _, words in self._drawn([None]):
            for i, window in enumerate(windows):
                _count_filled(out, i, f, window.of(words).reshape(-1))
        return out

    def _shares(self, n: int) -> dict[str, np.ndarray]:
        job, out = self._job, self._empty(n)
        borders = share_borders(self._octree, n).tolist()
        for i in range(n):
            octree = part_of(self._octree, cells_of_range(self._octree, *borders[i : i + 2]))
            culling, sampling = job.culling_node(octree), job.sampling_node(octree)
            out["cells"][i] = len(octree)
            for f, frame in enumerate(self._frames.tolist()):
                camera = job.camera(frame)
                bits = culling.process(camera)
                entries = sampling.process(camera, bits).entries
                _count(out, i, f, bits.bits, _clipped(entries, *borders[i : i + 2]))
        for f, i, words in self._drawn(list(pairwise(borders))):
            _count_filled(out, i, f, words.reshape(-1))
        return out

    def _subtrees(self, n: int) -> dict[str, np.ndarray]:
        job, out = self._job, self._empty(n)
        subtrees = Subtrees.of(self._octree, SUBTREES_PER_RANK * n)
        borders = balanced_borders(subtrees.cells, n).tolist()
        for i in range(n):
            _, octree, own = subtrees.part(*borders[i : i + 2])
            culling, sampling = job.culling_node(octree), job.sampling_node(octree, own)
            out["cells"][i] = len(octree)
            for f, frame in enumerate(self._frames.tolist()):
                camera = job.camera(frame)
                bits = culling.process(camera)
                _count(out, i, f, bits.bits, sampling.process(camera, bits).entries)
        return out

    def _empty(self, n: int) -> dict[str, np.ndarray]:
        return {name: np.zeros((n, len(self._frames))) for name in (*COUNTED, *FILLED)}

    def _drawn(self, shares: Sequence[tuple[int, int] | None]) -> Iterator[tuple[int, int, np.ndarray]]:
        """(number of the sampled frame, of the share, words) that each share of the points leaves; None: all points."""
        job = self._job
        culling, sampling = job.culling_node(self._octree), job.sampling_node(self._octree)
        with job.open_render(lambda *_: None, shown=False) as render:
            for f, frame in enumerate(self._frames.tolist()):
                camera = job.camera(frame)
                entries = sampling.process(camera, culling.process(camera)).entries
                for i, share in enumerate(shares):
                    mine = entries if share is None else _clipped(entries, *share)
                    yield f, i, render.rasterize(camera, RenderPoints(frame, mine))


def _clipped(entries: np.ndarray, first: int, stop: int) -> np.ndarray:
    """Entries of the points ``first`` … ``stop`` − 1 alone, offsets as they were."""
    out = clip_entries(entries, first, stop)
    out["offset"] += first
    return out


def _part(
    whole: Workload, counts: dict[str, np.ndarray], pixels: float, filled: np.ndarray, filled_bytes: np.ndarray
) -> Part:
    cells = float(counts.pop("cells").mean())
    entry_bytes = (whole.render_points_bytes - HEADER.size) / np.maximum(whole.entries, 1)
    load = replace(
        whole,
        cells=cells,
        visibility_bytes=HEADER.size + cells / 8,
        render_points_bytes=HEADER.size + entry_bytes * counts["entries"],
        **counts,
    )
    return Part(load, pixels, filled, filled_bytes)


def _count(out: dict[str, np.ndarray], i: int, f: int, bits: np.ndarray, entries: np.ndarray) -> None:
    points = points_of(entries)
    out["cells_visible"][i, f] = np.bitwise_count(bits).sum()
    out["entries"][i, f] = len(entries)
    out["points"][i, f] = points.sum()
    out["cold"][i, f] = np.minimum(points, COLD_POINTS).sum()


def _count_filled(out: dict[str, np.ndarray], i: int, f: int, words: np.ndarray) -> None:
    out["filled"][i, f] = np.count_nonzero(words != FRAMEBUFFER_EMPTY)
    out["filled_bytes"][i, f] = HEADER.size + len(encode_runs(words))


def _power(half: np.ndarray, full: np.ndarray, doublings: float) -> np.ndarray:
    """What goes from ``half`` to ``full`` in one doubling, after as many more."""
    return full * (full / np.maximum(half, 1e-12)) ** doublings
