"""Which rasterizer a run draws with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...shared.errors import ConfigError
from . import PointSize, ResidentPoints

if TYPE_CHECKING:
    from .cpu import CpuRasterizer
    from .gl import GlComputeRasterizer, GlPointsRasterizer

RASTERIZERS = ("auto", "cpu", "gl", "gl-points")


def make_rasterizer(
    name: str, points: ResidentPoints, width: int, height: int, size: PointSize, threads: int | None
) -> CpuRasterizer | GlComputeRasterizer | GlPointsRasterizer:
    """A rasterizer over ``points``; the caller closes it (it is a context manager).

    name : one of ``RASTERIZERS``. ``auto`` takes ``gl`` where a GPU draws it and ``cpu`` elsewhere: OpenGL in software
        is slower than the compiled kernels.
    threads : of ``cpu``; None for one a core.
    Raises ConfigError for another name, DeviceError if OpenGL is asked for and missing.
    """
    name = resolve_rasterizer(name)
    match name:
        case "cpu":
            from .cpu import CpuRasterizer

            return CpuRasterizer(points, width, height, size, threads)
        case "gl":
            from .gl import GlComputeRasterizer

            return GlComputeRasterizer(points, width, height, size)
        case "gl-points":
            from .gl import GlPointsRasterizer

            return GlPointsRasterizer(points, width, height, size)
    raise ConfigError(f"render.rasterizer = {name!r}, expected one of {', '.join(RASTERIZERS)}")


def resolve_rasterizer(name: str) -> str:
    """``gl`` or ``cpu`` for ``auto``; any other name is itself. Cost: that of looking for a GPU, the first time."""
    if name != "auto":
        return name
    return "gl" if _has_gpu() else "cpu"


def _has_gpu() -> bool:
    from .gl_context import gl_available, is_software

    available, renderer = gl_available()
    return available and not is_software(renderer)
