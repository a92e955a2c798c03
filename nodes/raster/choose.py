"""Which rasterizer a run draws with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...shared.errors import ConfigError
from . import PointSize, Rasterizer, ResidentPoints, SplatSettings

if TYPE_CHECKING:
    from .group_raster import ResidentGroups
    from .paged_points import PagedPoints

RASTERIZERS = ("auto", "cpu", "gl", "gl-points")


def make_rasterizer(
    name: str,
    points: ResidentPoints | ResidentGroups | PagedPoints,
    width: int,
    height: int,
    size: PointSize,
    threads: int | None,
    *,
    splats: SplatSettings | None = None,
    compact: bool = False,
) -> Rasterizer:
    """A rasterizer over ``points``; the caller closes it (it is a context manager). ``cpu`` draws linear
    groups and paged points.

    name : one of ``RASTERIZERS``. ``auto`` takes ``gl`` where a GPU draws it and ``cpu`` elsewhere: OpenGL in software
        is slower than the compiled kernels.
    threads : of ``cpu``; None for one a core.
    splats : draw splats instead of points; ``size`` is not used then. Points need normals and radii.
    compact : of ``cpu`` points: hold positions in fixed point inside their block. Blocks should be single cells.
    Raises ConfigError for another name or a style that it does not draw, DeviceError if OpenGL is asked for and not
    there.
    """
    if not isinstance(points, ResidentPoints):
        from .paged_points import PagedPoints

        if isinstance(points, PagedPoints):
            from .paged import PagedCpuRasterizer

            return PagedCpuRasterizer(points, width, height, size, threads)
        from .group_raster import CpuGroupRasterizer

        check_style(name, splats, groups=True)
        return CpuGroupRasterizer(points, width, height, size, threads)
    check_style(name, splats)
    match resolve_rasterizer(name), splats:
        case "cpu", None:
            from .cpu import CpuRasterizer

            return CpuRasterizer(points, width, height, size, threads, compact=compact)
        case "cpu", SplatSettings():
            from .splat import CpuSplatRasterizer

            return CpuSplatRasterizer(points, width, height, splats, threads)
        case "gl", None:
            from .gl import GlComputeRasterizer

            return GlComputeRasterizer(points, width, height, size)
        case "gl", SplatSettings():
            from .gl_splat import GlSplatRasterizer

            return GlSplatRasterizer(points, width, height, splats)
        case "gl-points", None:
            from .gl import GlPointsRasterizer

            return GlPointsRasterizer(points, width, height, size)
    raise ConfigError(f"render.rasterizer = {name!r}, expected one of {', '.join(RASTERIZERS)}")


def check_style(name: str, splats: SplatSettings | None, *, groups: bool = False) -> None:
    """Raise ConfigError if the rasterizer of this name does not draw splats, or linear groups, and is to."""
    if groups and splats:
        raise ConfigError("render.positions = 'coded': found render.style = 'splats', expected points")
    if groups and name not in ("auto", "cpu"):
        raise ConfigError(f"render.positions = 'coded': found render.rasterizer = {name!r}, expected auto or cpu")
    if name == "gl-points" and splats:
        raise ConfigError("render.rasterizer = 'gl-points' draws no splats, expected auto, cpu or gl")


def resolve_rasterizer(name: str) -> str:
    """``gl`` or ``cpu`` for ``auto``; any other name is itself. Cost: that of looking for a GPU, the first time."""
    if name != "auto":
        return name
    return "gl" if _has_gpu() else "cpu"


def _has_gpu() -> bool:
    from .gl_context import gl_available, is_software

    available, renderer = gl_available()
    return available and not is_software(renderer)
