"""Points of pools in the image, in NumPy: the twin of ``pools``, with each float32 operation rounded as there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...shared.camera import Camera
from ...shared.codecs.streams import PooledPoints
from . import ResidentPoints
from .pools import PoolCell
from .reference import Projection


def decoded(cells: Sequence[PoolCell]) -> ResidentPoints:
    """The points of cells one by one, in coded order, each cell a block whose origin is its lower corner."""
    relative = [(np.add(*_parts(cell.points)) + 0.5) * cell.step for cell in cells]
    x, y, z = (np.ascontiguousarray(column) for column in np.concatenate(relative).astype(np.float32).T)
    colour = np.concatenate([cell.palette[cell.colour] for cell in cells])
    first = np.cumsum([0, *(len(cell.points) for cell in cells[:-1])])
    return ResidentPoints(x, y, z, colour, first, np.array([cell.origin for cell in cells]))


def project_pools(cells: Sequence[PoolCell]) -> Projection:
    """u, v, w of the cells' points in coded order, in float32."""
    of_cell = np.repeat(np.arange(len(cells)), [len(cell.points) for cell in cells])
    vertex, translation = (np.concatenate(p) for p in zip(*(_parts(cell.points) for cell in cells), strict=True))
    origin, step = np.array([cell.origin for cell in cells]), np.array([cell.step for cell in cells])

    def project(_: ResidentPoints, camera: Camera, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        m = camera.pixel_from_world[:, :3]
        rows = np.empty((len(cells), 3, 4))
        rows[:, :, :3] = m * step[:, None, None]
        x, y, z = (origin - camera.eye + 0.5 * step[:, None]).T[:, :, None]
        rows[:, :, 3] = x * m[:, 0] + y * m[:, 1] + z * m[:, 2]
        r = rows.astype(np.float32)[of_cell[index]]
        v, t = vertex[index].astype(np.float32), translation[index].astype(np.float32)
        linear = [(r[:, :, 0].T * p[:, 0] + r[:, :, 1].T * p[:, 1]) + r[:, :, 2].T * p[:, 2] for p in (v, t)]
        x, y, w = (linear[0] + r[:, :, 3].T) + linear[1]
        with np.errstate(all="ignore"):
            return x / w, y / w, w

    return project


def _parts(points: PooledPoints) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) int64 vertex and (n, 3) int64 translation of each point in coded order; none for those left over."""
    vertex, translation = [points.loose[:0]], [np.empty((0, 3), np.int8)]
    for pool in points.pools:
        bits = np.unpackbits(pool.tags.astype("<u4").view(np.uint8), axis=1, bitorder="little")
        v, t = np.nonzero(bits)
        vertex.append(pool.vertices[v])
        translation.append(pool.translations[t])
    vertex.append(points.loose)
    translation.append(np.zeros((len(points.loose), 3), np.int8))
    return np.concatenate(vertex).astype(np.int64), np.concatenate(translation).astype(np.int64)
