"""Which runs the costs are fitted on, and how they are made: as points of an experiment, so resumable and interleaved.

No calibration run has the settings of the run that is predicted: other pixel thresholds, another resolution.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...shared.config import RunConfig, load_config, parse_config, refuse_layers
from ...shared.framebuffer_runs import encode_runs, merge_runs
from ...shared.messages import FRAMEBUFFER_EMPTY
from ..experiment.config import ExperimentConfig, ExperimentSection
from ..experiment.grid import Experiment, Point
from ..experiment.journal import Journal
from ..job import Job
from ..launch import mpi_available
from .costs import Costs, Measured, fit_costs
from .forecast import fit_messages
from .machine import Machine
from .parts import CountedParts
from .workload import NO_LAYERS, count_workload

THRESHOLDS_PX = (4.0, 16.0)
"""Of the calibration of a run that draws every point (threshold 0); of others half and double theirs."""


OWN_RANKS = {"pipeline.ranks": 0} | dict.fromkeys(
    (f"pipeline.{stage}_ranks" for stage in ("culling", "sampling", "render")), 0
)
"""Settings with which a topology has the ranks that it has by itself."""


def calibration_points(run: RunConfig) -> list[Point]:
    """The settings to measure for the costs of a run.

    On one rank two thresholds and half the resolution; both thresholds with all cores; three ranks where there is MPI.
    Raises ConfigError for a run with layers.
    """
    refuse_layers(run, NO_LAYERS)
    threshold = run.sampling.pixel_threshold
    fine, coarse = (threshold / 2, threshold * 2) if threshold else THRESHOLDS_PX
    size = (run.camera.width, run.camera.height)
    half = (max(size[0] // 2, 16), max(size[1] // 2, 16))
    cores = len(os.sched_getaffinity(0))
    wanted = [("single", 1, fine, size), ("single", 1, coarse, size), ("single", 1, fine, half)]
    if cores > 1:
        wanted += [("single", cores, fine, size), ("single", cores, coarse, size)]
    if mpi_available():
        wanted += [("pipelined", threads, coarse, size) for threads in dict.fromkeys((1, cores))]
    return [
        {
            "pipeline.topology": topology,
            **OWN_RANKS,
            "render.threads": threads,
            "sampling.pixel_threshold": min(pixels, 4096.0),
            "camera.width": width,
            "camera.height": height,
        }
        for topology, threads, pixels, (width, height) in wanted
    ]


def with_point(run: RunConfig, point: Point) -> RunConfig:
    """The run with a point's settings."""
    tables: dict[str, Any] = run.model_dump(mode="json", exclude_none=True)
    for key, value in point.items():
        section, _, name = key.partition(".")
        tables[section][name] = value
    return parse_config(tables)


def calibration_experiment(base: Path, overrides: list[str], output: Path, repeats: int) -> Experiment:
    """The calibration of one run configuration as an experiment of its own."""
    run = load_config(base, overrides)
    points = calibration_points(run)
    whole: dict[str, Any] = run.model_dump(mode="json", exclude={"layers"}, exclude_none=True)
    common = {f"{section}.{key}": value for section, table in whole.items() for key, value in table.items()}
    for key in ("output.directory", "output.png", "output.mp4", "output.depth", "output.normals"):
        del common[key]
    common["scene.path"] = os.path.abspath(run.scene.path)
    settings = ExperimentSection(base=str(base), output=str(output), repeats=repeats, title="Calibration")
    config = ExperimentConfig(experiment=settings, set=common)
    return Experiment(config, base, base, output, points, [with_point(run, point) for point in points])


def extended(experiment: Experiment) -> Experiment:
    """The experiment followed by the calibration points of each of its scenes that it does not hold itself."""
    points, runs = list(experiment.points), list(experiment.runs)
    for path in dict.fromkeys(run.scene.path for run in experiment.runs):
        i = next(i for i, run in enumerate(experiment.runs) if run.scene.path == path)
        for point in calibration_points(experiment.runs[i]):
            run = with_point(experiment.runs[i], point)
            if run not in runs:
                points.append(experiment.points[i] | point)
                runs.append(run)
    return replace(experiment, points=points, runs=runs)


def measured_points(experiment: Experiment, journal: Journal, *, best: bool = False) -> dict[int, Measured]:
    """Point → what was measured there; points that never succeeded are missing.

    best : only the fastest repeat, for a machine that others work on: what they take only ever slows a run down.
    """
    records: dict[int, list[dict[str, Any]]] = {}
    for run in journal.runs:
        if run.record is not None:
            records.setdefault(run.point, []).append(run.record)
    if best:
        records = {i: [max(done, key=lambda record: record["frames_per_s"])] for i, done in records.items()}
    parts: dict[str, CountedParts] = {}
    out = {}
    for i, done in sorted(records.items()):
        run = experiment.runs[i]
        key = run.model_dump_json(exclude={"pipeline": True, "render": {"threads"}, "output": {"directory"}})
        if key not in parts:
            job = Job(run)
            parts[key] = CountedParts(job, count_workload(job))
        out[i] = Measured(run, parts[key].whole, done, parts[key])
    return out


def all_costs(runs: Sequence[Measured], machine: Machine) -> Costs:
    """Stages, contention and messages from calibration runs."""
    return fit_messages(replace(fit_costs(runs), **framebuffer_costs()), runs, machine)


def framebuffer_costs(n_pixels: int = 640 * 1600) -> dict[str, float]:
    """What putting framebuffers into messages and taking them out costs here: fields of ``Costs``, by name.

    From a framebuffer of background and one with a fifth of its pixels, in runs, drawn on.  Cost: 0.1 s.
    """
    empty = np.full(n_pixels, FRAMEBUFFER_EMPTY, np.uint64)
    drawn = empty.copy()
    drawn.reshape(-1, 640)[:, :128] = np.arange(n_pixels // 5, dtype=np.uint64).reshape(-1, 128)
    payload = encode_runs(drawn).tobytes()
    pixel_s = _fastest_s(lambda: encode_runs(empty)) / n_pixels
    words = n_pixels // 5
    return {
        "encode_pixel_s": pixel_s,
        "encode_word_s": max(_fastest_s(lambda: encode_runs(drawn)) - pixel_s * n_pixels, 0.0) / words,
        "merge_word_s": _fastest_s(lambda: merge_runs(payload, drawn.copy())) / words,
    }


def _fastest_s(work: Callable[[], object]) -> float:
    times = []
    for _ in range(5):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return min(times)
