"""Points that stay on disk (``memory.residency = 'paged'``): what a run may then not ask for, and frames told ahead."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

from ..shared.config import RunConfig
from ..shared.errors import ConfigError
from ..shared.scene_info import SceneInfo

_Frame = TypeVar("_Frame")


def check_paging(config: RunConfig, info: SceneInfo) -> None:
    """Raise ConfigError for what is not drawn from paged points, in one line."""
    render = config.render
    refused = {
        f"render.rasterizer = {render.rasterizer!r}": render.rasterizer not in ("auto", "cpu"),
        f"render.style = {render.style!r}": render.style != "points",
        f"render.positions = {render.positions!r}": render.positions != "float32",
        "render.point_size_adaptive = true": render.point_size_adaptive,
        f"sampling.pools = {config.sampling.pools!r}": config.sampling.pools != "off",
        "scene.delivery = 'messages'": config.scene.delivery != "files",
        "scene.path: none": not config.scene.path,
        f"scene.path: positions are {info.positions}": info.coded,
    }
    for found in (name for name, is_refused in refused.items() if is_refused):
        raise ConfigError(
            f"{found}: memory.residency = 'paged' draws float32 points of a scene's files on cpu, in sizes that do not "
            "depend on their cells"
        )


def told_ahead(frames: Iterable[_Frame], n: int, tell: Callable[[_Frame], None]) -> Iterator[_Frame]:
    """The frames, each of which is told of when at most ``n`` others are before it; n = 0: never.

    Frames are made that much earlier, too.
    """
    waiting: deque[_Frame] = deque()
    for frame in frames:
        if n:
            tell(frame)
        waiting.append(frame)
        if len(waiting) > n:
            yield waiting.popleft()
    yield from waiting
