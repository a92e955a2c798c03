"""Device memory of a layer by technique, counted without drawing: records, or the vertices that they stand for.

Templates of instancing, which are there once however many objects there are, are not counted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .expand_arcs import CLOSED, DEFAULT_SEGMENTS, whole_root

if TYPE_CHECKING:
    from ...shared.layer_config import LayerSection
    from ...shared.layers.layer import Layer

VERTEX_BYTES = 28
"""Of a mesh: position, normal, value, all float32."""
BLOCK_VERTEX_BYTES = 40
"""Of blocks: position, normal, place in the block, type."""
ELEMENT_BYTES = 20
"""Of a polygon's element: position, apex, number of its object."""


def layer_bytes(layer: Layer, settings: LayerSection, technique: str) -> int:
    """Bytes on the device of a layer drawn with ``technique``. Cost: a pass over its elements."""
    if technique in ("avc", "instancing"):
        n_elements = len(layer.elements) + 1 if len(layer.elements) else 0  # one more, for the last one's next
        return layer.objects.nbytes + ELEMENT_BYTES * n_elements
    vertex_bytes = BLOCK_VERTEX_BYTES if layer.kind == "blocks" else VERTEX_BYTES
    return vertex_bytes * _vertices(layer, settings, as_strips=technique == "strips")


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
    return (14 if as_strips else 36) * len(layer)
