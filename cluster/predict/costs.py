"""Seconds a cell, an entry, a point, a pixel: fitted from measured runs by non-negative least squares.

Model of one frame's work, alone on the machine with one thread:

    culling  = a + b · cells + c · visible cells
    sampling = a + b · cells + c · visible cells + d · entries
    render   = a + b · entries + c · points + d · cold points + e · covered pixels + f · merged pixels

With t threads the render node uses u ≤ t framebuffers (``framebuffers_used``): points and covered pixels are divided
by u, merged pixels are pixels · u / t. What the threads lose to each other (memory bandwidth, shared cores of a core
pair) is one figure, ``contention``: the slow-down of each by every other that is busy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...nodes.raster.framebuffers import MERGED_PIXELS_PER_POINT
from ...shared.config import RunConfig
from ...shared.errors import InputError
from ...shared.views import VIEWS_PER_PICTURE
from .parts import EvenParts, Parts
from .setting import Setting
from .workload import Workload, threads_of

CONTENTIONS = np.linspace(0, 1.5, 151)
"""Slow-downs that are tried. At 1 a second thread gains nothing, above it costs."""

OUTLIER = 0.1
"""Share of a run's mean by which a frame may be off before it counts less."""

REWEIGHTINGS = 8

STAGES = ("culling", "sampling", "render")
Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class StageCost:
    """Fitted cost of one stage.

    seconds : feature → seconds for one of it, ≥ 0.
    residual : root mean square of (fitted − measured) / the run's mean, over the frames it was fitted on.
    """

    seconds: dict[str, float]
    residual: float

    def of(self, columns: Columns) -> np.ndarray:
        """(n_frames,) seconds of work."""
        return np.asarray(sum(self.seconds[name] * column for name, column in columns.items()), np.float64)


@dataclass(frozen=True)
class Costs:
    """What everything costs on the measured machine.

    stages : cost of culling, sampling and render on one thread with nothing beside it.
    loop_s : seconds a frame outside the stages: camera, statistics, progress.
    message_s : software latency: seconds a rank is busy, or late, for each message it sends or receives.
    contention : slow-down of a busy core by each other busy core, ≥ 0.
    late_s : seconds a frame that a rank with a thread on every core loses where other ranks share the cores: a thread
        that is woken on a core where one is working waits there for the next tick of the operating system.
    encode_pixel_s, encode_word_s, merge_word_s : of a framebuffer that crosses between ranks: a pixel looked at, a word
        that is not background put into the message, and taken out of it into the picture.
    """

    stages: dict[str, StageCost]
    loop_s: float
    message_s: float
    contention: float
    late_s: float = 0.0
    encode_pixel_s: float = 1e-9
    encode_word_s: float = 1e-9
    merge_word_s: float = 10e-9


@dataclass(frozen=True)
class Measured:
    """One setting that was measured: its configuration, what its frames had, and the records of its repeats."""

    config: RunConfig
    load: Workload
    records: Sequence[dict[str, Any]]
    counted: Parts | None = None

    @property
    def parts(self) -> Parts:
        """What falls to each of several ranks; even where nobody has counted it."""
        return self.counted or EvenParts(self.load)

    @property
    def topology(self) -> str:
        """As it ran, which for ``auto`` the record knows."""
        return self.records[0]["topology"]

    @property
    def threads(self) -> int:
        """Threads of the render rank."""
        return threads_of(self.config.render.threads)

    @property
    def setting(self) -> Setting:
        """How it was laid out."""
        return replace(Setting.of(self.config, len(self.records[0].get("ranks", ()))), topology=self.topology)

    @property
    def frames_per_s(self) -> list[float]:
        """Rate of the whole run, of each repeat. Records count pictures; frames are their views."""
        views = VIEWS_PER_PICTURE[self.config.camera.view]
        return [record["frames_per_s"] * views for record in self.records]

    @property
    def frame_s(self) -> float:
        """Seconds a frame of the whole run: median over the repeats."""
        return float(np.median([1 / rate for rate in self.frames_per_s]))

    def stage_s(self, stage: str) -> np.ndarray:
        """(n_frames,) seconds of work of each frame: median over the repeats, so that what disturbed one is not in."""
        return np.median([record["per_frame"][f"{stage}_s"] for record in self.records], axis=0)


def stage_columns(load: Workload, threads: int) -> dict[str, Columns]:
    """Stage → feature → (n_frames,) how much of it each frame has for the thread that has most to do."""
    one = np.ones(load.n_frames)
    used = framebuffers_used(load, threads)
    return {
        "culling": {"frame": one, "cell": one * load.cells, "visible cell": load.cells_visible},
        "sampling": {
            "frame": one,
            "cell": one * load.cells,
            "visible cell": load.cells_visible,
            "entry": load.entries,
        },
        "render": {
            "frame": one,
            "entry": load.entries,
            "point": load.points / used,
            "cold point": load.cold / used,
            "covered pixel": (load.covered - load.points) / used,
            "merged pixel": load.pixels * used / threads,
        },
    }


def framebuffers_used(load: Workload, threads: int) -> np.ndarray:
    """(n_frames,) framebuffers that the cpu rasterizer draws into: as many as make the frame shortest."""
    best = np.rint(np.sqrt(MERGED_PIXELS_PER_POINT * load.points * threads / load.pixels))
    return np.clip(best, 1, threads)


def fit_costs(runs: Sequence[Measured]) -> Costs:
    """Costs from runs on one rank, those with several threads included. ``message_s`` and ``late_s`` are 0.

    Raises InputError if no run is ``single`` with one thread.
    """
    single = [run for run in runs if run.topology == "single"]
    alone = [run for run in single if run.threads == 1]
    if not alone:
        raise InputError("costs: found no run of topology single with one thread, expected at least one")
    stages = {
        stage: fit_stage(
            [stage_columns(run.load, run.threads)[stage] for run in single], [run.stage_s(stage) for run in single]
        )
        for stage in ("culling", "sampling")
    }
    stages["render"], contention = _fit_render(single)
    loop = [run.frame_s - sum(float(run.stage_s(stage).mean()) for stage in STAGES) for run in alone]
    return Costs(stages, max(float(np.median(loop)), 0.0), 0.0, contention)


def _fit_render(runs: Sequence[Measured]) -> tuple[StageCost, float]:
    """Cost of the render stage, and the contention with which it fits all numbers of threads best."""
    columns = [stage_columns(run.load, run.threads)["render"] for run in runs]
    seconds = [run.stage_s("render") for run in runs]
    tried = CONTENTIONS if any(run.threads > 1 for run in runs) else CONTENTIONS[:1]
    fits = []
    for contention in tried:
        slower = [1 + contention * (run.threads - 1) for run in runs]
        scaled = [{name: c * s for name, c in of.items()} for of, s in zip(columns, slower, strict=True)]
        fits.append((fit_stage(scaled, seconds), float(contention)))
    return min(fits, key=lambda fit: fit[0].residual)


def fit_stage(columns: Sequence[Columns], seconds: Sequence[np.ndarray]) -> StageCost:
    """Non-negative least squares over the frames of all runs, each run weighted by the inverse of its mean.

    Weights by run and not by frame keep the fitted mean at the measured mean. Columns are scaled to a norm of 1. Frames
    further off than ``OUTLIER`` count less, in inverse proportion (Huber), since a machine that others disturb is slow
    at times and never fast.
    Source: Lawson, Hanson, "Solving Least Squares Problems", 1974, chapter 23; Holland, Welsch 1977 (reweighting).
    """
    from scipy.optimize import nnls

    names = list(columns[0])
    weights = [1 / max(float(s.mean()), 1e-12) for s in seconds]
    a = np.concatenate(
        [np.column_stack([of_run[n] for n in names]) * w for of_run, w in zip(columns, weights, strict=True)]
    )
    b = np.concatenate([s * w for s, w in zip(seconds, weights, strict=True)])
    norm = np.linalg.norm(a, axis=0)
    norm[norm == 0] = 1.0
    trust = np.ones(len(b))
    for _ in range(REWEIGHTINGS):
        solution, _ = nnls(a / norm * trust[:, None], b * trust)
        off = np.abs(a / norm @ solution - b)
        trust = np.sqrt(np.minimum(1.0, OUTLIER / np.maximum(off, OUTLIER)))
    residual = math.sqrt(float(np.mean((a / norm @ solution - b) ** 2)))
    return StageCost(dict(zip(names, (solution / norm).tolist(), strict=True)), residual)
