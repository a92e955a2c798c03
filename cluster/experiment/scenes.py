"""Scenes that an experiment builds for itself: kept in its output folder, made again if the recipe changes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...shared.build import BuildSettings, build_scene
from ...shared.errors import InputError, SplatpipeError
from ...shared.files import write_json
from ...shared.readers import expand_inputs, open_source
from ...shared.synth import CityScan
from ..job import Job
from .config import SceneRecipe
from .grid import Experiment, scene_folder


def prepare_scenes(experiment: Experiment, progress: Any) -> None:
    """Build the scenes of ``[scenes]`` that a point uses and that are not there, then open every scene that is used.

    Raises InputError naming scene and file for an input that is missing, ConfigError or StoreError for a scene that
    cannot be drawn as asked.
    """
    used = {run.scene.path for run in experiment.runs}
    for name, recipe in experiment.config.scenes.items():
        path = scene_folder(experiment.output, name)
        if str(path) in used and not _is_made(path, recipe):
            progress(f"building scene {name}", 0)
            _make(name, recipe, path, experiment.file)
    for path in used:
        Job(next(run for run in experiment.runs if run.scene.path == path))


def _recipe_file(path: Path) -> Path:
    return path.with_suffix(".recipe.json")


def _is_made(path: Path, recipe: SceneRecipe) -> bool:
    try:
        return path.is_dir() and SceneRecipe.model_validate_json(_recipe_file(path).read_text()) == recipe
    except (OSError, ValueError):
        return False


def _make(name: str, recipe: SceneRecipe, path: Path, file: Path) -> None:
    source = f"{file}: scenes.{name}"
    if bool(recipe.inputs) == bool(recipe.synth):
        raise InputError(f"{source}: expected either inputs or synth")
    settings = BuildSettings(
        point_order=recipe.point_order,
        points_per_cell=recipe.points_per_cell,
        max_depth=recipe.max_depth,
        flatness=recipe.flatness,
        features=recipe.features,
        up="z" if recipe.synth else recipe.up,
        overwrite=True,
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if recipe.synth:
            sources: list[Any] = [CityScan(n_points=recipe.synth, seed=recipe.seed)]
        else:
            sources = [
                open_source(found) for found in expand_inputs([str(file.parent / item) for item in recipe.inputs])
            ]
        build_scene(sources, path, settings=settings)
    except OSError as error:
        raise InputError(f"{source}: {error}") from None
    except SplatpipeError as error:
        raise type(error)(f"{source}: {error}") from None
    write_json(_recipe_file(path), recipe.model_dump(mode="json"))
