"""A layer in memory: its objects, what they consist of, and where they lie."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import InputError
from ..octree import Octree
from .box_octree import box_octree


@dataclass(frozen=True)
class Layer:
    """Objects of one kind.

    name : for people.  kind : one of ``kinds.KINDS``.  origin : (3,) float64, world; what positions are relative to.
    objects : (n,) records of the kind's ``OBJECT``.
    elements : (m,) records of the kind's ``ELEMENT`` that objects consist of, object after object; (0,) for kinds
        whose objects are single records.
    first_element : (n + 1,) int64, where the elements of each object begin.
    parameters : what holds for all objects, as documented by the kind.
    """

    name: str
    kind: str
    origin: np.ndarray
    objects: np.ndarray
    elements: np.ndarray
    first_element: np.ndarray
    parameters: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.objects)

    @property
    def told(self) -> dict[str, Any]:
        """What it is and how much there is of it, JSON-able."""
        return {"name": self.name, "kind": self.kind, "objects": len(self), "elements": len(self.elements)}

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """((n, 3), (n, 3)) float64: lower and upper corner of each object's box, world frame."""
        from .kinds import KINDS

        lower, upper = KINDS[self.kind].bounds(self)
        return lower + self.origin, upper + self.origin

    @cached_property
    def octree(self) -> Octree:
        """The octree of the boxes. Raises InputError unless objects stand in its order (``in_octree_order``)."""
        octree, order = box_octree(*self.bounds)
        if not np.array_equal(order, np.arange(len(order))):
            raise InputError(f"layer {self.name}: objects do not stand in the order of their octree")
        return octree

    def in_octree_order(self) -> Layer:
        """The same objects in the order of their octree, in which a layer is stored and drawn."""
        _, order = box_octree(*self.bounds)
        counts = np.diff(self.first_element)[order]
        first = np.cumsum([0, *counts])
        of_object = np.repeat(np.arange(len(order)), counts)
        taken = self.first_element[order][of_object] + np.arange(first[-1]) - first[of_object]
        return replace(self, objects=self.objects[order], elements=self.elements[taken], first_element=first)


def simple_layer(name: str, kind: str, origin: np.ndarray, objects: np.ndarray, **parameters: Any) -> Layer:
    """A layer whose objects are single records, checked and in octree order. Raises InputError as ``check_layer``."""
    none = np.zeros(len(objects) + 1, np.int64)
    layer = Layer(name, kind, np.asarray(origin, np.float64), objects, np.empty(0, np.uint8), none, parameters)
    check_layer(layer)
    return layer.in_octree_order()


def check_layer(layer: Layer) -> None:
    """Raise InputError, naming the attribute, for records that nothing can be drawn from."""
    from .kinds import KINDS

    if not len(layer):
        raise InputError(f"layer {layer.name}: found no object, expected at least one")
    for what, records in (("objects", layer.objects), ("elements", layer.elements)):
        for attribute in records.dtype.names or ():
            values = records[attribute]
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                bad = int(np.argmin(np.isfinite(values).reshape(len(values), -1).all(axis=1)))
                where = f"layer {layer.name}: {what}, {attribute} of record {bad}"
                raise InputError(f"{where}: found {values[bad]}, expected finite numbers")
    KINDS[layer.kind].check(layer)
