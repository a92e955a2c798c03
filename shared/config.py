"""The configuration of a run: TOML in, validated settings out.

``configs/defaults.toml`` states every key with its unit and reason; a test holds that file equal to the defaults
here. Paths in a file are relative to the file; paths given on the command line are relative to the working directory.
"""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, BeforeValidator, Field, ValidationError

from .byte_size import parse_bytes
from .errors import ConfigError, InputError
from .layer_config import LayerSection
from .section import Section

Vector = tuple[float, float, float]
Matrix = list[list[float]]
PositiveInt = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Ranks = Annotated[int, Field(ge=0, le=65536)]


def _byte_size(value: Any) -> str:
    text = str(value)
    try:
        parse_bytes(text, "")
    except InputError:
        raise ValueError("expected a size such as 500MB or 4GiB") from None
    return text


ByteSize = Annotated[str, BeforeValidator(_byte_size)]
"""Text that ``parse_bytes`` takes; a number of bytes will do."""

Topology = Literal[
    "auto",
    "single",
    "pipelined",
    "master-slave",
    "hybrid",
    "sort-first",
    "sort-last",
    "sort-first-only",
    "sort-last-only",
    "frame-parallel",
]

AnySection = TypeVar("AnySection", bound=Section)


class Keyframe(Section):
    """One key of a keyframe path: where the camera is, at what time in [0, 1], what it looks at."""

    time: Annotated[float, Field(ge=0, le=1)]
    eye: Vector
    target: Vector
    fov_deg: Annotated[float, Field(gt=0, lt=180)] | None = None


class SceneSection(Section):
    """``[scene]``."""

    path: str = ""
    verify: bool = True
    delivery: Literal["files", "messages"] = "files"


class Box(Section):
    """One clip box: an axis-aligned box in world coordinates, and which side of it is kept."""

    lower: Vector
    upper: Vector
    keep: Literal["inside", "outside"] = "inside"


class CameraSection(Section):
    """``[camera]``."""

    view: Literal["mono", "stereo", "panorama"] = "mono"
    stereo_base: Annotated[float, Field(ge=0)] = 0.0
    stereo_layout: Literal["side-by-side", "over-under"] = "side-by-side"
    path: Literal["orbit", "keyframes", "poses"] = "orbit"
    width: Annotated[int, Field(ge=1, le=16384)] = 1280
    height: Annotated[int, Field(ge=1, le=16384)] = 720
    fov_deg: Annotated[float, Field(gt=0, lt=180)] = 45.0
    near: Annotated[float, Field(ge=0)] = 0.0
    up: Literal["scene", "x", "y", "z", "-x", "-y", "-z"] = "scene"
    center: Vector | None = None
    radius: Annotated[float, Field(ge=0)] = 0.0
    elevation_deg: Annotated[float, Field(ge=-90, le=90)] = 25.0
    start_deg: float = 0.0
    sweep_deg: float = 360.0
    keyframes: list[Keyframe] = Field(default=[])
    poses: list[Matrix] = Field(default=[])


class WallSection(Section):
    """``[wall]``."""

    columns: Annotated[int, Field(ge=1, le=256)] = 1
    rows: Annotated[int, Field(ge=1, le=256)] = 1
    mullion_x_px: Annotated[int, Field(ge=0, le=4096)] = 0
    mullion_y_px: Annotated[int, Field(ge=0, le=4096)] = 0
    output: Literal["assembled", "tiles"] = "assembled"
    mullion_colour: str = "#000000"


class FilterSection(Section):
    """``[filter]``."""

    classes: list[Annotated[int, Field(ge=0, le=255)]] = Field(default=[])
    boxes: list[Box] = Field(default=[])


class CullingSection(Section):
    """``[culling]``."""

    backface: bool = False


class SamplingSection(Section):
    """``[sampling]``."""

    pixel_threshold: Annotated[float, Field(ge=0, le=4096)] = 32.0
    points_per_pixel: Annotated[float, Field(gt=0, le=64)] = 2.0
    pools: Literal["off", "bytes", "time"] = "off"
    point_budget: Annotated[int, Field(ge=0, lt=2**60)] = 0


class RenderSection(Section):
    """``[render]``."""

    rasterizer: Literal["auto", "cpu", "gl", "gl-points"] = "auto"
    style: Literal["points", "splats"] = "points"
    positions: Literal["float32", "compact", "coded"] = "float32"
    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    point_size_px: Annotated[int, Field(ge=1, le=255)] = 1
    point_size_world: Annotated[float, Field(ge=0)] = 0.0
    point_size_max_px: Annotated[int, Field(ge=1, le=255)] = 64
    point_size_adaptive: bool = False
    colour: str = "auto"
    colormap: str = "viridis"
    colour_range: tuple[float, float] | None = None
    class_colours: dict[str, str] = Field(default={})
    background: str = "#1e2127"
    supersampling: Annotated[int, Field(ge=1, le=8)] = 1
    edl_strength: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    edl_radius_px: Annotated[float, Field(ge=0.5, le=64)] = 1.5


class MemorySection(Section):
    """``[memory]``."""

    residency: Literal["mapped", "paged"] = "mapped"
    budget: ByteSize = "1GB"
    prefetch: bool = True
    complete: bool = False

    @property
    def budget_bytes(self) -> int:
        """``budget`` as a number."""
        return parse_bytes(self.budget, "memory.budget =")


class SplatSection(Section):
    """``[splats]``: used where ``render.style`` is ``splats``."""

    radius_scale: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    depth_offset: Annotated[float, Field(ge=0)] = 1.0
    features: bool = False
    lighting: bool = True


class PipelineSection(Section):
    """``[pipeline]``."""

    topology: Topology = "auto"
    ranks: Ranks = 0
    culling_ranks: Ranks = 0
    sampling_ranks: Ranks = 0
    render_ranks: Ranks = 0
    render_split: Literal["tiles", "shares"] = "tiles"
    balance: Literal["off", "measured"] = "measured"
    frames_in_flight: Annotated[int, Field(ge=1, le=64)] = 4
    compositing: Literal["auto", "direct", "direct-reduce", "binary-swap", "radix-k", "mpi-min"] = "auto"
    radix: Annotated[int, Field(ge=2, le=1024)] = 8
    timeout_s: Positive = 300.0
    loading_timeout_s: Positive = 3600.0
    survive: bool = True
    compression: Literal["auto", "off", "on"] = "auto"
    link_mb_per_s: Annotated[float, Field(ge=0, le=1e9)] = 0.0


class OutputSection(Section):
    """``[output]``."""

    directory: str = "frames"
    frames: PositiveInt = 120
    fps: Annotated[float, Field(gt=0, le=1000)] = 30.0
    png: bool = True
    png_bits: Literal[8, 16] = 8
    mp4: bool = False
    depth: bool = False
    normals: bool = False
    resume: bool = False


class LiveSection(Section):
    """``[live]``: of ``splatpipe view``."""

    fps: Annotated[float, Field(ge=1, le=240)] = 30.0
    least_scale: Annotated[float, Field(ge=0.1, le=1)] = 0.25
    jpeg_quality: Annotated[int, Field(ge=1, le=95)] = 75
    still_after_s: Annotated[float, Field(ge=0.05, le=60)] = 0.25


class RunConfig(Section):
    """Every setting of ``splatpipe run``."""

    scene: SceneSection = SceneSection()
    camera: CameraSection = CameraSection()
    wall: WallSection = WallSection()
    filter: FilterSection = FilterSection()
    culling: CullingSection = CullingSection()
    sampling: SamplingSection = SamplingSection()
    render: RenderSection = RenderSection()
    memory: MemorySection = MemorySection()
    splats: SplatSection = SplatSection()
    layers: list[LayerSection] = Field(default=[])
    pipeline: PipelineSection = PipelineSection()
    output: OutputSection = OutputSection()
    live: LiveSection = LiveSection()


_PATH_KEYS = (("scene", "path"), ("output", "directory"))


def load_config(path: Path | str, overrides: list[str] | None = None) -> RunConfig:
    """The validated configuration of a TOML file with ``section.key=value`` overrides.

    Raises ConfigError naming the file and key, what was found and what was expected; an unknown key is refused and
    the nearest known one suggested.
    """
    return parse_config(read_config(path), str(path), overrides)


def read_config(path: Path | str) -> dict[str, Any]:
    """The tables of a run's TOML file as they stand there, paths made relative to the working directory.

    Raises ConfigError if it cannot be read or is not TOML.
    """
    data = read_toml(path)
    for section, key in _PATH_KEYS:
        value = data.get(section, {}).get(key) if isinstance(data.get(section), dict) else None
        if isinstance(value, str) and value:
            data[section][key] = str(Path(path).parent / value)
    for layer in data.get("layers", []) if isinstance(data.get("layers"), list) else []:
        if isinstance(layer, dict) and isinstance(layer.get("path"), str) and layer["path"]:
            layer["path"] = str(Path(path).parent / layer["path"])
    return data


def read_toml(path: Path | str) -> dict[str, Any]:
    """The tables of a TOML file. Raises ConfigError if it cannot be read or is not TOML."""
    try:
        text = Path(path).read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        return tomllib.loads(text.decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None


def parse_config(data: dict[str, Any], source: str = "configuration", overrides: list[str] | None = None) -> RunConfig:
    """The validated configuration of nested tables with overrides. Raises ConfigError as ``load_config`` does."""
    for override in overrides or []:
        _apply(data, override)
    return validated(RunConfig, data, source)


def refuse_layers(config: RunConfig, why: str) -> None:
    """Raise ConfigError, saying why, where a run has layers; for what knows points alone."""
    if config.layers:
        raise ConfigError(f"layers: found {len(config.layers)}, expected none: {why}")


def validated(model: type[AnySection], data: dict[str, Any], source: str) -> AnySection:
    """Nested tables as ``model``; ConfigError names the key, what was found and what was expected."""
    _refuse_unknown(data, model, source, "")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{source}: {key} = {first['input']!r}, {_expected(first)}") from None


def _expected(error: Any) -> str:
    message = error["msg"].removeprefix("Input ").removeprefix("Value error, ")
    message = message.replace("should be", "expected").replace("should have", "expected")
    return message[:1].lower() + message[1:]


def _apply(data: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise ConfigError(f"--set {override}: expected section.key=value")
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        value = text  # a bare word is a string: --set render.colour=rgb
    table = data
    for part in parts[:-1]:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise ConfigError(f"--set {override}: {part} is not a section")
    table[parts[-1]] = value


def _refuse_unknown(data: dict[str, Any], model: type[BaseModel], source: str, prefix: str) -> None:
    for key, value in data.items():
        field = model.model_fields.get(key)
        if field is None:
            near = difflib.get_close_matches(key, model.model_fields, n=1, cutoff=0.0)
            raise ConfigError(f"{source}: unknown key {prefix}{key}, did you mean {prefix}{near[0]}?")
        inner = field.annotation
        items = [value]
        if get_args(inner) and isinstance(value, list):
            inner, items = get_args(inner)[0], value
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            for item in items:
                if not isinstance(item, dict):
                    raise ConfigError(f"{source}: {prefix}{key} = {item!r}, expected a table")
                _refuse_unknown(item, inner, source, f"{prefix}{key}.")
