"""The kinds of layers by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from . import arcs, blocks, cuboids, polygons, trajectories
from .layer import Layer


class Kind(Protocol):
    """What the module of a kind offers.  OBJECT, ELEMENT : its records; ELEMENT is None for single ones."""

    OBJECT: np.dtype
    ELEMENT: np.dtype | None

    def bounds(self, layer: Layer) -> tuple[np.ndarray, np.ndarray]:
        """((n, 3), (n, 3)) float64: lower and upper corner of each object's box, relative to the layer's origin."""
        ...

    def check(self, layer: Layer) -> None:
        """Raise InputError, naming the attribute, for finite values that nothing can be drawn from."""
        ...


KINDS: Mapping[str, Kind] = {
    "arcs": arcs,  # type: ignore[dict-item]
    "blocks": blocks,  # type: ignore[dict-item]
    "cuboids": cuboids,  # type: ignore[dict-item]
    "polygons": polygons,  # type: ignore[dict-item]
    "trajectories": trajectories,  # type: ignore[dict-item]
}


def objects_of(kind: str) -> str:
    """What objects of a kind are called, for people."""
    return "runs of trajectories" if kind == "trajectories" else kind
