"""The codecs that a scene may store the positions of its cells with, by name."""

from __future__ import annotations

from ..errors import CodecError
from . import MAX_BITS, Codec

_MOST_GROUP_BITS = 16
"""Kept points of linear groups are drawn from words of 16 bits an axis (``nodes.raster.groups``)."""


def most_position_bits(name: str) -> int:
    """Most bits an axis of the grid that a codec of positions is used with."""
    return _MOST_GROUP_BITS if name == "groups" else MAX_BITS


def position_codec(name: str, epsilon: float = 0.0, detail: float | None = None) -> Codec:
    """The codec of one of ``scene_info.POSITIONS`` but float32; imports that one only.

    epsilon, detail : of ``groups``, see ``LinearGroupCodec``; decoding needs none.  Raises CodecError for another name.
    """
    match name:
        case "ci":
            from . import ci as codec
        case "eci":
            from . import eci as codec
        case "occupancy":
            from . import occupancy as codec
        case "groups":
            from .linear_groups import LinearGroupCodec

            return LinearGroupCodec(epsilon, detail=detail)
        case _:
            raise CodecError(f"codec of positions: found {name!r}, expected ci, eci, occupancy or groups")
    return codec
