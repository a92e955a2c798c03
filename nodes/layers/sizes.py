"""Device memory of a layer by technique, counted without drawing: records, or the vertices that they stand for.

Templates of instancing, which are there once however many objects there are, are not counted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .expand_arcs import CLOSED, DEFAULT_SEGMENTS, whole_root
from .expand_trajectories import CAP, HIDDEN, Look, Templates, segments
from .gl_blocks import BLOCK_VERTEX
from .gl_mesh import VERTEX
from .gl_polygons import RECORD as POLYGON_RECORD
from .gl_trajectories import RECORD as NODE_RECORD

if TYPE_CHECKING:
    from ...shared.layer_config import LayerSection, TrajectoryStyle
    from ...shared.layers.layer import Layer

SEGMENT_BYTES, SELECTION_BYTES = 16, 4
"""Of trajectories: four elements; a bit a trajectory, in words."""


def layer_bytes(layer: Layer, settings: LayerSection, technique: str) -> int:
    """Bytes on the device of a layer drawn with ``technique``. Cost: a pass over its elements."""
    if technique in ("avc", "instancing"):
        match layer.kind:
            case "polygons":  # one element more, for the last one's next
                return layer.objects.nbytes + POLYGON_RECORD.itemsize * (len(layer.elements) + 1)
            case "trajectories":
                words = len(layer.parameters["names"]) // 32 + 1
                n_segments = len(segments(layer).index)
                return NODE_RECORD.itemsize * len(layer.elements) + SEGMENT_BYTES * n_segments + SELECTION_BYTES * words
        return layer.objects.nbytes
    vertex = BLOCK_VERTEX if layer.kind == "blocks" else VERTEX
    return vertex.itemsize * _vertices(layer, settings, as_strips=technique == "strips")


def _vertices(layer: Layer, settings: LayerSection, *, as_strips: bool) -> int:
    match layer.kind:
        case "arcs":
            n = whole_root(settings.arcs.segments or DEFAULT_SEGMENTS) ** 2
            angle = layer.objects["angle"]
            n_open = int((angle[:, 1] - angle[:, 0] < np.float32(CLOSED)).sum())
            return (10 if as_strips else 24) * n * len(layer) + (4 if as_strips else 12) * n_open
        case "polygons":
            position, apex = layer.elements["position"], layer.elements["apex"]
            own = (position != apex).any(axis=1)
            ends = own & (np.roll(position, -1, axis=0) != apex).any(axis=1)
            side = layer.elements["side"] == 1
            if not as_strips:
                return 6 * int(ends.sum() + side.sum())
            drawn = np.array([0, 6, 12, 8])[side + 2 * ends]
            whole = np.concatenate([[0], np.cumsum(drawn)])[layer.first_element]
            return int(drawn.sum()) - int((np.diff(whole) > 0).sum())  # an object's first vertex is there once
        case "trajectories":
            sides = settings.trajectories.sides
            return (2 * sides + 2 if as_strips else 6 * sides) * _trajectory_strips(layer, settings.trajectories)
    return (14 if as_strips else 36) * len(layer)


def _trajectory_strips(layer: Layer, style: TrajectoryStyle) -> int:
    """Strips of ``expand_trajectories.strips``: one a tube, and one for each band of a ball."""
    parts, look, only_balls = segments(layer), Look.of(layer, style), style.style == "spheres"
    ends = parts.index[:, 1:3]
    tubes = np.full(len(ends), not only_balls) | look.is_highlighted(look.value[ends].mean(axis=1), ends[:, 0])
    nodes = np.flatnonzero(parts.flags & HIDDEN == 0)
    balls = np.full(len(nodes), only_balls) | (parts.flags[nodes] & CAP > 0)
    balls |= look.is_highlighted(look.value[nodes], nodes)
    return int(tubes.sum()) + Templates(style.sides).bands * int(balls.sum())
