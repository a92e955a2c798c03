"""splatpipe in Python: open a scene, render cameras to images.

::

    with open_scene("survey.scene", width=1280, height=720, colour="elevation") as view:
        image = view.render(view.orbit(azimuth_deg=30))

Nothing is imported before a scene is opened, and no MPI, socket or web library then. What draws is what ``splatpipe
run`` draws with, in this process: the same camera and settings give the same bits.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..shared.compile_cache import ensure_compile_cache

if TYPE_CHECKING:
    from .scene_view import SceneView


def open_scene(
    path: Path | str,
    *,
    width: int = 1280,
    height: int = 720,
    colour: str = "auto",
    settings: Mapping[str, Any] | None = None,
) -> SceneView:
    """A view of a scene directory made by ``splatpipe build``; close it, or use it as a context manager.

    width, height : of pictures whose camera does not say otherwise, pixels.  colour : as ``render.colour``.
    settings : keys of a run's configuration (``configs/defaults.toml``) and their values, such as
    ``{"render.edl_strength": 0.4, "filter.classes": [2, 6]}``.
    Raises ConfigError for a key or value that is wrong or does not suit the scene, StoreError for a scene that cannot
    be read; each says in one line what was found and what was expected.
    Cost: checksums are compared, one read of what is drawn (``{"scene.verify": False}``: not), and positions stay
    mapped.
    """
    named = {"scene.path": str(path), "camera.width": width, "camera.height": height, "render.colour": colour}
    return _opened({}, named | dict(settings or {}), "open_scene")


def open_config(path: Path | str, settings: Mapping[str, Any] | None = None) -> SceneView:
    """A view as a configuration file of ``splatpipe run`` has it, with other settings in place of some of its own.

    Its topology and outputs are not used. Raises ConfigError and StoreError as ``open_scene`` does.
    """
    from ..shared.config import read_config

    return _opened(read_config(path), settings or {}, str(path))


def _opened(tables: dict[str, Any], settings: Mapping[str, Any], source: str) -> SceneView:
    ensure_compile_cache()
    from .scene_view import SceneView, with_settings

    return SceneView(with_settings(tables, settings, source))


__all__: Iterable[str] = ["open_config", "open_scene"]
