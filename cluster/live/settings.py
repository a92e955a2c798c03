"""What those who look at a live run may change: some keys of its configuration, and no other.

None of them names a file, a rank or an amount of memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...shared.colour import MODES
from ...shared.config import RunConfig, parse_config
from ...shared.errors import ConfigError
from ...shared.store import Scene

MAX_PIXELS = 1 << 23
"""Of a picture that is drawn again and again; screenshots may have more."""
MAX_DRAWN_PIXELS = 1 << 25
"""Of the framebuffer of any picture, supersampled as it is: 8K once, or full HD sixteen times; some 0.8 GB with two
threads.
"""
MAX_DRAWN_SIDE_PX = 1 << 14
"""What any device with OpenGL 4.5 has room for in a texture; a rank that had not would end the run."""
MAX_TEXT = 64

COLORMAPS = ("viridis", "plasma", "inferno", "magma", "cividis", "turbo", "terrain", "gray", "coolwarm", "Spectral")

_PX = {"unit": "px"}
SETTABLE: dict[str, dict[str, Any]] = {
    "camera.width": {"type": "integer", "least": 16, "most": 4096, "label": "Width", **_PX},
    "camera.height": {"type": "integer", "least": 16, "most": 4096, "label": "Height", **_PX},
    "camera.fov_deg": {"type": "number", "least": 5, "most": 120, "label": "Field of view", "unit": "°"},
    "sampling.pixel_threshold": {"type": "number", "least": 0, "most": 256, "label": "Pixel threshold", **_PX},
    "sampling.points_per_pixel": {"type": "number", "least": 0.1, "most": 16, "label": "Points per pixel", "unit": ""},
    "sampling.point_budget": {
        "type": "integer",
        "least": 0,
        "most": 1_000_000_000,
        "label": "Point budget",
        "unit": "",
    },
    "render.point_size_px": {"type": "integer", "least": 1, "most": 32, "label": "Point size", **_PX},
    "render.point_size_world": {"type": "number", "least": 0, "most": 1000, "label": "Size in the scene", "unit": "m"},
    "render.point_size_max_px": {"type": "integer", "least": 1, "most": 255, "label": "Largest size", **_PX},
    "render.colour": {"type": "choice", "label": "Colour", "unit": ""},
    "render.colormap": {"type": "choice", "options": list(COLORMAPS), "label": "Colour map", "unit": ""},
    "render.colour_range": {"type": "range", "label": "Range of the map", "unit": ""},
    "render.background": {"type": "colour", "label": "Background", "unit": ""},
    "render.supersampling": {"type": "integer", "least": 1, "most": 4, "label": "Supersampling", "unit": "×"},
    "render.edl_strength": {"type": "number", "least": 0, "most": 4, "label": "Eye-dome lighting", "unit": ""},
    "render.edl_radius_px": {"type": "number", "least": 0.5, "most": 8, "label": "Lighting radius", **_PX},
    "filter.classes": {"type": "classes", "label": "Classes", "unit": ""},
    "filter.boxes": {"type": "boxes", "label": "Clip boxes", "most": 8, "unit": ""},
    "live.fps": {"type": "number", "least": 1, "most": 60, "label": "Rate to hold", "unit": "1/s"},
}
"""Keys, and what a page needs to offer them: a name for people, unit, bounds."""


def choices(config: RunConfig, scene: Scene) -> dict[str, dict[str, Any]]:
    """``SETTABLE`` with the options that a scene leaves and the configuration's values; JSON-able."""
    offered = {key: dict(about) | {"default": value_of(config, key)} for key, about in SETTABLE.items()}
    attributes = scene.info.attributes
    needs = {"rgb", "intensity", "classification", "normal"}
    offered["render.colour"]["options"] = [mode for mode in MODES if mode not in needs or mode in attributes]
    if "classification" not in attributes:
        del offered["filter.classes"]
    return offered


def value_of(config: RunConfig, key: str) -> Any:
    """The value of a dotted key, JSON-able."""
    section, name = key.split(".")
    return config.model_dump(mode="json")[section][name]


def settings_of(config: RunConfig) -> dict[str, Any]:
    """The values of all keys that may be changed; JSON-able."""
    return {key: value_of(config, key) for key in SETTABLE}


def changed(settings: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """Settings that hold in place of the configuration's, after a change. None: the configuration's again.

    Raises ConfigError for a key or a value that is not allowed; what the configuration allows is for ``configured``.
    """
    merged = dict(settings)
    for key, value in wanted.items():
        about = SETTABLE.get(key)
        if about is None:
            raise ConfigError(f"{key[:MAX_TEXT]!r} cannot be changed in a live run, only {', '.join(SETTABLE)}")
        if value is None:
            merged.pop(key, None)
            continue
        _check(key, value, about)
        merged[key] = value
    return merged


def configured(config: RunConfig, settings: Mapping[str, Any]) -> RunConfig:
    """A configuration with settings in place, whatever its size (``check_size``). Raises ConfigError naming the key."""
    if not settings:
        return config
    tables = config.model_dump()
    for key, value in settings.items():
        section, name = key.split(".")
        tables[section][name] = value
    return parse_config(tables, "settings")


def check_size(config: RunConfig, given: RunConfig, *, screenshot: bool = False) -> None:
    """Raise ConfigError where a picture is larger than viewers may have it.

    given : the configuration as the run was started with: what it draws viewers may have in any case.
    """
    (pixels, drawn), (given_pixels, given_drawn) = _pixels(config), _pixels(given)
    size = f"{config.camera.width} × {config.camera.height}"
    if not screenshot and pixels > max(MAX_PIXELS, given_pixels):
        raise ConfigError(f"settings: found {size} pixels, expected at most {MAX_PIXELS:,}: take a screenshot")
    found = f"{'screenshot' if screenshot else 'settings'}: found {size} pixels, render.supersampling = "
    found += str(config.render.supersampling)
    if drawn > max(MAX_DRAWN_PIXELS, given_drawn):
        raise ConfigError(f"{found}, expected at most {MAX_DRAWN_PIXELS:,} to be drawn")
    if _longest_side(config) > max(MAX_DRAWN_SIDE_PX, _longest_side(given)):
        raise ConfigError(f"{found}, expected at most {MAX_DRAWN_SIDE_PX} px a side to be drawn")


def _pixels(config: RunConfig) -> tuple[int, int]:
    """Of a picture, and of its framebuffer."""
    shown = config.camera.width * config.camera.height
    return shown, shown * config.render.supersampling**2


def _longest_side(config: RunConfig) -> int:
    """Of a framebuffer, pixels."""
    return max(config.camera.width, config.camera.height) * config.render.supersampling


def _check(key: str, value: Any, about: Mapping[str, Any]) -> None:
    kind = about["type"]
    if kind in ("number", "integer"):
        number = isinstance(value, int if kind == "integer" else int | float) and not isinstance(value, bool)
        if not number or not about["least"] <= value <= about["most"]:
            raise ConfigError(f"{key}: found {str(value)[:MAX_TEXT]}, expected {about['least']} … {about['most']}")
    elif kind in ("choice", "colour"):
        if not isinstance(value, str) or len(value) > MAX_TEXT:
            raise ConfigError(f"{key}: found {str(value)[:MAX_TEXT]!r}, expected a name")
        if value not in about.get("options", [value]):
            raise ConfigError(f"{key}: found {value!r}, expected one of {', '.join(about['options'])}")
    elif not isinstance(value, list) or len(value) > 256:
        raise ConfigError(f"{key}: expected a list of at most 256")
    elif kind == "boxes" and len(value) > about["most"]:
        raise ConfigError(f"{key}: found {len(value)} boxes, expected at most {about['most']}")
