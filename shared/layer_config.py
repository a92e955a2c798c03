"""``[[layers]]`` of a configuration: which layers are drawn besides the points, and how.

Nothing here is in the records on the device: changing it sends no record again.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from .section import Section


class ArcStyle(Section):
    """``[layers.arcs]``."""

    segments: Annotated[int, Field(ge=0, le=4096)] = 0
    tolerance_px: Annotated[float, Field(gt=0, le=64)] = 0.25


class BlockStyle(Section):
    """``[layers.blocks]``."""

    texture: Literal["grain", "plain"] = "grain"


def _none_or_two(numbers: tuple[float, ...]) -> tuple[float, ...]:
    if len(numbers) not in (0, 2):
        raise ValueError("expected no number or two")
    return numbers


_Range = Annotated[tuple[float, ...], AfterValidator(_none_or_two)]


class TrajectoryStyle(Section):
    """``[layers.trajectories]``. Ranges of no numbers: none, or automatic."""

    style: Literal["auto", "lines", "splats", "spheres", "tubes"] = "auto"
    tube_px: Annotated[float, Field(ge=0, le=4096)] = 3.0
    colour: Literal["speed", "acceleration", "time", "height"] = "speed"
    radius: tuple[Annotated[float, Field(ge=0, le=2)], Annotated[float, Field(ge=0, le=2)]] = (0.5, 1.0)
    acceleration_range: _Range = ()
    selected: tuple[str | int, ...] = ()
    highlight: _Range = ()
    sides: Annotated[int, Field(ge=3, le=24)] = 8


class LayerSection(Section):
    """One of ``[[layers]]``."""

    path: str
    technique: Literal["avc", "triangles", "strips", "instancing"] = "avc"
    detail_px: Annotated[float, Field(ge=0, le=4096)] = 0.0
    colormap: str = "viridis"
    value_range: tuple[float, float] | None = None
    value_filter: tuple[float, float] | None = None
    arcs: ArcStyle = ArcStyle()
    blocks: BlockStyle = BlockStyle()
    trajectories: TrajectoryStyle = TrajectoryStyle()
