"""The experiment file made into points: everything that can be wrong with it is said here, before the first run."""

from __future__ import annotations

import copy
import difflib
import hashlib
import itertools
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...shared.config import RunConfig, parse_config, read_config, read_toml, validated
from ...shared.errors import ConfigError
from ...shared.toml_text import toml_value
from .config import ExperimentConfig

Point = dict[str, Any]
"""Settings of one point: ``section.key`` → value, only those that the experiment varies."""

MAX_POINTS = 10_000


@dataclass(frozen=True)
class Experiment:
    """A checked experiment.

    config : the file's content.
    file, base, output : paths of the file, the run configuration and the results.
    points : the varied settings of each point, in order, all different.
    runs : the checked run configuration of each point; scenes by their final paths.
    """

    config: ExperimentConfig
    file: Path
    base: Path
    output: Path
    points: list[Point]
    runs: list[RunConfig]

    @property
    def keys(self) -> list[str]:
        """The keys that vary, in the order they first stand in the file."""
        return list(dict.fromkeys(key for point in self.points for key in point))

    @property
    def sha256(self) -> str:
        """Hash of all that decides what is measured: every point's whole configuration and the scenes' recipes."""
        runs = [run.model_dump(mode="json", exclude={"output": {"directory"}}) for run in self.runs]
        scenes = {name: recipe.model_dump(mode="json") for name, recipe in self.config.scenes.items()}
        return hashlib.sha256(json.dumps([runs, scenes], sort_keys=True).encode()).hexdigest()


def load_experiment(file: Path, output: Path | None = None) -> Experiment:
    """The checked experiment of a TOML file.

    output : where its results go, if not where the file says.

    Raises ConfigError naming file and key for anything unknown, of a wrong type, or a point that is listed twice.
    """
    config = validated(ExperimentConfig, read_toml(file), str(file))
    base = file.parent / config.experiment.base
    output = output or Path(os.path.normpath(file.parent / config.experiment.output))
    data = read_config(base)
    points = list(expand(config, str(file)))
    runs = []
    for point in points:
        settings = config.set | point
        runs.append(_run_config(data, settings, config, file, output))
    seen: dict[str, int] = {}
    for i, run in enumerate(runs):
        first = seen.setdefault(run.model_dump_json(), i)
        if first != i:
            raise ConfigError(f"{file}: points {first + 1} and {i + 1} are the same run: {describe(points[i])}")
    _check_names(config, {key for point in points for key in (config.set | point)}, str(file))
    return Experiment(config, file, base, output, points, runs)


def expand(config: ExperimentConfig, source: str) -> Iterator[Point]:
    """The points: every combination of ``grid`` and ``zip``, then each ``point``; one empty point if there are none.

    Raises ConfigError for zipped lists of different lengths, a key with two dimensions, or too many points.
    """
    dimensions: list[list[Point]] = [[{key: value} for value in values] for key, values in config.grid.items()]
    for group in config.zip:
        lengths = {key: len(values) for key, values in group.items()}
        if len(set(lengths.values())) > 1:
            raise ConfigError(f"{source}: zip: found lists of different lengths {lengths}, expected equal ones")
        dimensions.append([dict(zip(group, values, strict=True)) for values in zip(*group.values(), strict=True)])
    keys = [key for dimension in dimensions for key in dimension[0]]
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise ConfigError(f"{source}: {twice[0]}: found in two dimensions of the grid, expected one")
    n_points = len(config.point)
    if dimensions or not config.point:
        total = 1
        for dimension in dimensions:
            total *= len(dimension)
        if total + n_points > MAX_POINTS:
            raise ConfigError(f"{source}: grid: found {total + n_points} points, expected at most {MAX_POINTS}")
        for parts in itertools.product(*dimensions):
            yield {key: value for part in parts for key, value in part.items()}
    yield from config.point


def describe(point: Point) -> str:
    """A point as people read it."""
    return ", ".join(f"{key} = {value}" for key, value in point.items()) or "the base configuration"


def overrides(point: Point) -> list[str]:
    """A point as ``--set`` arguments."""
    return [f"{key}={toml_value(value)}" for key, value in point.items()]


def scene_folder(output: Path, name: str) -> Path:
    """Where an experiment keeps the scene that it builds under a name."""
    return output / "scenes" / f"{name}.scene"


def resolve_paths(point: Point, config: ExperimentConfig, file: Path, output: Path) -> Point:
    """The point with its scene as a path: one of ``[scenes]`` by name, another relative to the experiment file."""
    path = point.get("scene.path")
    if not isinstance(path, str):
        return point
    found = scene_folder(output, path) if path in config.scenes else file.parent / path
    return point | {"scene.path": os.path.normpath(found)}


def _run_config(data: dict[str, Any], settings: Point, config: ExperimentConfig, file: Path, output: Path) -> RunConfig:
    tables = copy.deepcopy(data)
    for key, value in resolve_paths(settings, config, file, output).items():
        section, dot, name = key.partition(".")
        if not dot:
            _refuse_key(key, str(file))
        table = tables.setdefault(section, {})
        if not isinstance(table, dict):
            raise ConfigError(f"{config.experiment.base}: {section} = {table!r}, expected a table")
        table[name] = value
    run = parse_config(tables, source=str(file))
    if not run.scene.path:
        raise ConfigError(f"{file}: scene.path: missing, expected a scene directory or a name of [scenes]")
    return run


def run_keys() -> list[str]:
    """Every ``section.key`` of a run's configuration."""
    return [
        f"{section}.{key}"
        for section, field in RunConfig.model_fields.items()
        for key in getattr(field.annotation, "model_fields", {})
    ]


def _refuse_key(key: str, source: str) -> None:
    near = difflib.get_close_matches(key, run_keys(), n=1, cutoff=0.0)[0]
    raise ConfigError(f"{source}: unknown key {key}, did you mean {near}?")


def _check_names(config: ExperimentConfig, varied: set[str], source: str) -> None:
    """Keys that ``scaling`` and ``paper`` speak of must be among those that are set, measures among the columns."""
    from .table import MEASURES

    named = [config.scaling.over, *config.scaling.along] if config.scaling else []
    named += [key for figure in config.paper for key in figure.where]
    for key in named:
        if key not in varied:
            near = difflib.get_close_matches(key, varied, n=1, cutoff=0.0)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise ConfigError(f"{source}: {key} is no key that this experiment sets{hint}")
    for measure in (config.experiment.measure, *(figure.measure for figure in config.paper)):
        if measure not in MEASURES:
            near = difflib.get_close_matches(measure, MEASURES, n=1, cutoff=0.0)
            raise ConfigError(f"{source}: measure = {measure!r}, did you mean {near[0]!r}?")
