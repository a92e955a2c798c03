"""The order of an experiment's runs: repeats interleaved, so that a change of the machine's speed meets every point."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ...shared.errors import SplatpipeError
from ..measured import measured_run
from .grid import Experiment, overrides, resolve_paths
from .journal import Journal, Run

Runner = Callable[[Path, list[str]], dict[str, Any]]
"""Runs a configuration with overrides in a fresh process; its record."""

Progress = Callable[[str, int], None]


def schedule(experiment: Experiment) -> Iterator[tuple[int, int]]:
    """(point, repeat) of every run: once through all points, then the next repeat."""
    settings = experiment.config.experiment
    numbers = list(range(len(experiment.points)))
    rng = random.Random(settings.seed)
    for repeat in range(settings.repeats):
        if settings.order == "shuffled":
            rng.shuffle(numbers)
        yield from ((point, repeat) for point in numbers)


def run_missing(experiment: Experiment, journal: Journal, progress: Progress, runner: Runner = measured_run) -> None:
    """Run what the journal lacks. A run that fails is kept with its reason and does not stop the others."""
    config = experiment.config
    wanted = list(schedule(experiment))
    finished = journal.finished
    for done, (point, repeat) in enumerate(wanted):
        if (point, repeat) in finished:
            continue
        progress(f"point {point + 1} of {len(experiment.points)}, repeat {repeat + 1}", done)
        settings = resolve_paths(config.set | experiment.points[point], config, experiment.file, experiment.output)
        try:
            run = Run(point, repeat, record=runner(experiment.base, overrides(settings)))
        except SplatpipeError as error:
            run = Run(point, repeat, failed=str(error))
        journal.add(run)
    progress("done", len(wanted))
