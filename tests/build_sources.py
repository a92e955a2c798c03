"""Point clouds as sources for the builder, and scenes read back cell by cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from splatpipe.shared.points import ATTRIBUTES, PointBatch
from splatpipe.shared.readers.source import Source, SourceInfo
from splatpipe.shared.store import Scene


class ArraySource(Source):
    """Positions and attribute columns in memory, with whatever header the test wants."""

    def __init__(self, positions, attributes=None, *, name="cloud.npy", n_points="true", bounds="true", crs=None):
        self.positions = np.ascontiguousarray(positions, np.float64)
        self.columns = attributes or {}
        finite = self.positions[np.isfinite(self.positions).all(axis=1)]
        if isinstance(bounds, str):
            bounds = (finite.min(axis=0), finite.max(axis=0)) if len(finite) else None
        self.info = SourceInfo(
            path=Path(name),
            format="npy",
            n_points=len(self.positions) if n_points == "true" else n_points,
            attributes=tuple(self.columns),
            lower=bounds[0] if bounds else None,
            upper=bounds[1] if bounds else None,
            crs=crs,
        )

    def _read(self, max_points, attributes):
        for i in range(0, len(self.positions), max_points):
            part = slice(i, i + max_points)
            yield PointBatch(self.positions[part], {name: self.columns[name][part] for name in attributes})


def columns_for(n, names=("rgb",), seed=0):
    """Random attribute columns; the first one numbers the points, so that each can be told from the others."""
    rng = np.random.default_rng(seed)
    columns = {name: rng.integers(0, 200, n).astype(ATTRIBUTES[name]) for name in names}
    columns[names[0]] = np.arange(n).astype(ATTRIBUTES[names[0]])
    return columns


def cells_of(path):
    """(level, code) → (n_below, first child's presence, stored x, y, z in world and attributes of the cell's range)."""
    scene = Scene.open(path)
    octree = scene.octree()
    x, y, z = scene.positions()
    first, origin = scene.blocks()
    columns = {name: np.asarray(scene.attribute(name)) for name in scene.info.attributes}
    out = {}
    for cell in range(len(octree)):
        begin = int(octree.first_point[cell])
        own = slice(begin, begin + int(octree.n_points[cell]))
        block = np.searchsorted(first, np.arange(own.start, own.stop), side="right") - 1
        world = origin[block] + np.column_stack([x[own], y[own], z[own]]).astype(np.float64)
        key = (int(octree.level[cell]), int(octree.code[cell]))
        cone = None if octree.cone is None else octree.cone[cell].tobytes()
        attributes = {name: column[own].tobytes() for name, column in columns.items()}
        out[key] = (int(octree.n_below[cell]), int(octree.n_children[cell]), world.tobytes(), cone, attributes)
    return out
