"""The configuration of ``splatpipe error``: a base run, scenes, and sweeps over settings that trade error for time.

Each point of a sweep is the base run with one key changed. Two sections exist here alone: ``positions``, coordinates
rounded before drawing, and ``image``, what the picture is encoded as.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from ...shared.config import PositiveInt, RunConfig, read_toml, refuse_layers, validated
from ...shared.errors import ConfigError
from ...shared.section import Section

SWEPT_SECTIONS = ("sampling", "render", "culling", "splats", "positions", "image")
REFERENCE_KEYS = ("render.colour", "render.colormap", "render.colour_range", "render.background")
"""A sweep may change any key of those sections but these: camera, scene and colour stay what the reference shows."""

_AS_DRAWN = (
    ("camera", "view", "mono"),
    ("wall", "columns", 1),
    ("wall", "rows", 1),
    ("render", "supersampling", 1),
    ("render", "edl_strength", 0.0),
)
"""What composes a picture of frames, and is not measured."""

Value = bool | int | float | str


class PositionsSection(Section):
    """``[run.positions]``. bits_per_axis : fixed point inside the block's cube, see ``nodes.raster.fixed_point``."""

    bits_per_axis: Annotated[int, Field(ge=0, le=24)] = 0


class ImageSection(Section):
    """``[run.image]``: what a frame is encoded as, see ``picture``."""

    codec: Literal["png", "jpeg", "h264"] = "png"
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 90
    h264_crf: Annotated[int, Field(ge=0, le=51)] = 20


class PointConfig(RunConfig):
    """Every setting of one point: those of ``splatpipe run``, and the two sections above."""

    positions: PositionsSection = PositionsSection()
    image: ImageSection = ImageSection()


class SceneEntry(Section):
    """``[[scene]]``: one scene; ``set`` changes keys of the base run for it."""

    name: Annotated[str, Field(min_length=1, pattern=r"^[\w .+-]+$")]
    path: Annotated[str, Field(min_length=1)]
    set: dict[str, Any] = Field(default_factory=dict)


class SweepEntry(Section):
    """``[[sweep]]``: one method, a line of the diagrams; ``key`` takes the ``values``, ``set`` holds for all of them.

    order : the point order the scene is drawn in; a scene of the other order is rebuilt.
    """

    method: Annotated[str, Field(min_length=1)]
    key: str
    values: Annotated[list[Value], Field(min_length=1)]
    order: Literal["as built", "layered", "depth-first"] = "as built"
    set: dict[str, Any] = Field(default_factory=dict)


class ErrorConfig(Section):
    """The whole file. frames : of the camera path, drawn at every point.  repeats : timed passes over them."""

    run: PointConfig = PointConfig()
    frames: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)] = Field(default=[0])
    repeats: PositiveInt = 7
    scene: Annotated[list[SceneEntry], Field(min_length=1)]
    sweep: Annotated[list[SweepEntry], Field(min_length=1)]


@dataclass(frozen=True, eq=False)
class SweepPoint:
    """One point of one method on one scene."""

    scene: str
    method: str
    key: str
    value: Value
    order: str
    config: PointConfig


def load_error_config(path: Path) -> ErrorConfig:
    """The validated configuration of a TOML file; its paths are relative to it.

    Raises ConfigError naming the file and key, what was found and what was expected.
    """
    config = validated(ErrorConfig, _rebased(read_toml(path), path.parent), str(path))
    last = config.run.output.frames - 1
    if max(config.frames) > last:
        raise ConfigError(f"{path}: frames = {config.frames}, expected numbers up to run.output.frames − 1 = {last}")
    for what, names in (("scene", [s.name for s in config.scene]), ("sweep", [s.method for s in config.sweep])):
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f"{path}: {what} {name!r} occurs twice, expected names that differ")
    for scene in config.scene:
        base_config(config, scene, str(path))
        list(sweep_points(config, scene, str(path)))
    return config


def base_config(config: ErrorConfig, scene: SceneEntry, source: str) -> PointConfig:
    """The run that the reference of a scene is drawn for."""
    run = _changed(config.run, {"scene.path": scene.path, **_flat(scene.set)}, f"{source}: scene {scene.name!r}")
    refuse_layers(run, f"{source} measures errors of points")
    return run


def sweep_points(config: ErrorConfig, scene: SceneEntry, source: str) -> Iterator[SweepPoint]:
    """Every point of every sweep on one scene. Raises ConfigError for a key or value that does not exist."""
    base = base_config(config, scene, source)
    for sweep in config.sweep:
        where = f"{source}: sweep {sweep.method!r}"
        settled = _flat(sweep.set)
        for key in (sweep.key, *settled):
            section = key.partition(".")[0]
            if key in REFERENCE_KEYS or (section in RunConfig.model_fields and section not in SWEPT_SECTIONS):
                raise ConfigError(
                    f"{where}: {key} cannot be swept, expected a key that leaves camera, scene and colour"
                )
        for value in sweep.values:
            changed = _changed(base, {**settled, sweep.key: value}, where)
            yield SweepPoint(scene.name, sweep.method, sweep.key, value, sweep.order, changed)


def _flat(tables: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """``section.key`` → value: TOML makes tables of dotted keys that are not quoted."""
    flat: dict[str, Any] = {}
    for key, value in tables.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


def _changed(config: PointConfig, values: dict[str, Any], source: str) -> PointConfig:
    data = config.model_dump(mode="json")
    for key, value in values.items():
        table = data
        *sections, name = key.split(".")
        for section in sections:
            table = table.setdefault(section, {})
            if not isinstance(table, dict):
                raise ConfigError(f"{source}: {key}: {section} is not a section")
        table[name] = value
    changed = validated(PointConfig, data, source)
    for section, key, expected in _AS_DRAWN:
        if (found := getattr(getattr(changed, section), key)) != expected:
            why = "errors are measured on frames as they are drawn"
            raise ConfigError(f"{source}: {section}.{key} = {found!r}: {why}, expected {expected!r}")
    if changed.render.positions == "coded" and (bits := changed.positions.bits_per_axis):
        raise ConfigError(f"{source}: positions.bits_per_axis = {bits}: found render.positions = 'coded', expected 0")
    return changed


def _rebased(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The tables with the paths in them made relative to where one stands; what is malformed is left for validation."""
    run, scenes = data.get("run"), data.get("scene")
    output = run.get("output") if isinstance(run, dict) else None
    tables = [(output, "directory"), *((scene, "path") for scene in (scenes if isinstance(scenes, list) else []))]
    for table, key in tables:
        if isinstance(table, dict) and isinstance(table.get(key), str) and table[key]:
            table[key] = os.path.normpath(folder / table[key])
    return data
