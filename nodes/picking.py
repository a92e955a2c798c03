"""Which stored point a picture shows at a pixel.

From the scene's files and in float64, without a framebuffer, so that it disturbs no rank that draws. Looked at are the
points that the frame's render-points name, so what is picked is what is drawn: in the cells whose cubes reach to the
pixel, front to back, until nothing that is left can be nearer. A cell drawn from its pooled form is looked at in its
stored points, all of them: each pooled point stands for at least one, less than a pixel beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..shared.camera import Camera
from ..shared.messages import RENDER_POINT
from ..shared.octree import Octree
from ..shared.points import NO_NORMAL, radius_table, unpack_normals, unpack_rgb
from ..shared.store import Scene
from .cell_blocks import HEAD_POINTS, spacing_of_heads
from .frustum import padded_half_edges
from .point_filter import PointFilter
from .pooled_entries import PooledForms
from .raster import PointSize, SplatSettings
from .raster.pieces import split_entries
from .raster.threads import read_only

TOLERANCE_PX = 4.0
"""How far beside the pixel a point may be, where none covers it."""

MOST_POINTS = 20_000_000
"""Points looked at for a pixel, at most: about 2 s. Beyond half of them, only some pieces of what is left."""

_PIECE_POINTS = 1 << 14
_LEAST_COST = 256
"""Points that could be looked at in the time that a piece takes, however short."""
_BATCH = 1 << 16
_ROUNDING_PX = 1.0
"""Of the image position: cells that reach as close are looked at."""


@dataclass(frozen=True)
class Picked:
    """A stored point that a picture shows.

    index : in the point-array.  position : world frame, float64.  depth : along the view axis, world units; of a splat
    where its disc covers the pixel.  beside_px : from the pixel's centre to what the point covers; 0 where that is it.
    attributes : all that the scene holds of the point, JSON-able: ``rgb`` as three numbers 0…255, ``normal`` as three,
    ``radius`` in world units, others as they are; None for what is absent or not finite.
    """

    index: int
    position: tuple[float, float, float]
    depth: float
    beside_px: float
    attributes: dict[str, Any]


@dataclass
class _Best:
    """What is best so far: the nearest to the eye of those that cover the pixel, else the nearest to the pixel."""

    index: int = -1
    depth: float = math.inf
    beside_px: float = math.inf
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def take(self, index: np.ndarray, depth: np.ndarray, beside_px: np.ndarray, position: np.ndarray) -> None:
        if len(index):
            i = int(np.lexsort((depth, beside_px))[0])
            if (beside_px[i], depth[i]) < (self.beside_px, self.depth):
                self.index, self.depth, self.beside_px = int(index[i]), float(depth[i]), float(beside_px[i])
                x, y, z = position[i].tolist()
                self.position = x, y, z


class Picker:
    """Finds the points of a scene in its pictures.

    octree : of the scene, loaded with pools where they are drawn.
    size : of points, as the rasterizer has it; not used where ``splats`` are drawn.
    point_filter : which points are drawn at all.
    most_points : to look at for a pixel, at most.
    Raises StoreError for splats of a scene without them, or a damaged array.
    """

    def __init__(
        self,
        scene: Scene,
        octree: Octree,
        size: PointSize = PointSize(),  # noqa: B008 (frozen)
        point_filter: PointFilter = PointFilter(),  # noqa: B008 (frozen)
        splats: SplatSettings | None = None,
        *,
        most_points: int = MOST_POINTS,
    ) -> None:
        self._scene, self._octree, self._filter, self._size = scene, octree, point_filter, size
        self._most_points = most_points
        self._owners = octree.owners
        self._half = padded_half_edges(octree)
        self._forms = PooledForms.of(octree)
        first, origin = scene.blocks()
        first_point = octree.first_point[self._owners]
        self._origin = origin[np.searchsorted(first, first_point, side="right") - 1]
        self._columns = None if scene.info.coded else scene.positions()
        self._read = scene.position_reader()
        self._splats = splats
        self._smallest, self._largest = size.pixels, size.pixels
        if splats:
            self._radius, self._normal = scene.attribute("radius"), scene.attribute("normal")
            self._radii = radius_table(scene.info.edge) * splats.radius_scale
            self._smallest, self._largest = 1, np.inf
        elif size.world or size.adaptive:
            self._largest = max(size.pixels, size.maximum)
        self._classes = scene.attribute("classification") if point_filter.classes else None

    def pick(
        self, camera: Camera, entries: np.ndarray, x: float, y: float, tolerance_px: float = TOLERANCE_PX
    ) -> Picked | None:
        """The point nearest to the eye of those that cover the pixel at (x, y); where none does, the one that comes
        nearest to the pixel's centre within the tolerance; else None.

        entries : (m,) RENDER_POINT of the camera's frame.  x, y : pixels from the upper left corner.
        Points are where float64 has them: one within the rounding of float32 (about 1e-3 px) of a pixel's edge may
        have been drawn on the next. Splats are discs, their blending is not looked at.
        Raises MessageError for an entry beyond the point-array.
        Cost: a look at each cell of the cut, then at the points of those that reach to the pixel.
        """
        column, row = math.floor(x), math.floor(y)
        pieces, nearest, world_side = self._pieces(camera, entries, column + 0.5, row + 0.5, tolerance_px)
        best = _Best()
        ends = np.cumsum(pieces["count"], dtype=np.int64)
        i = 0
        while i < len(pieces) and not (best.beside_px == 0 and nearest[i] > best.depth):
            begun = int(ends[i - 1]) if i else 0
            j = max(i + 1, int(np.searchsorted(ends, begun + _BATCH, side="right")))
            widest = np.clip(world_side[i:j] * (camera.focal_px / nearest[i:j]), self._smallest, self._largest).max()
            self._look_at(camera, pieces[i:j], widest, world_side[i:j], column, row, tolerance_px, best)
            i = j
        if best.index < 0:
            return None
        attributes = attributes_of(self._scene, best.index)
        return Picked(best.index, best.position, best.depth, best.beside_px, attributes)

    # --- cells -------------------------------------------------------------------------------------------------------

    def _pieces(
        self, camera: Camera, entries: np.ndarray, x: float, y: float, tolerance_px: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What to look at, front to back: (p,) PIECE whose segments are owners, (p,) float64 least depth of each one's
        cube, (p,) float64 side of its points, world units.
        """
        octree = self._octree
        if (entries["stride"] == 0).any():
            entries = self._stored(entries)
        first_point = octree.first_point[self._owners]
        pieces = split_entries(entries, first_point, self._scene.info.n_stored, _PIECE_POINTS)
        owner, of_piece = np.unique(pieces["segment"], return_inverse=True)
        cell = self._owners[owner]
        reaches, nearest = self._reaching(camera, cell, x, y, tolerance_px, np.full(len(cell), np.inf))
        world_side = np.zeros(len(cell))
        world_side[reaches] = self._world_sides(cell[reaches])
        reaches[reaches] = self._reaching(camera, cell[reaches], x, y, tolerance_px, world_side[reaches])[0]
        kept = np.flatnonzero(reaches[of_piece])
        kept = kept[np.argsort(nearest[of_piece[kept]], kind="stable")]
        kept = kept[self._affordable(pieces[kept])]
        return pieces[kept], nearest[of_piece[kept]], world_side[of_piece[kept]]

    def _stored(self, entries: np.ndarray) -> np.ndarray:
        """Entries with the whole ranges of pooled cells in place of their pooled points."""
        cells = self._forms.cell[self._forms.drawn(entries)]
        ranges = np.empty(len(cells), RENDER_POINT)
        ranges["offset"], ranges["range"] = self._octree.first_point[cells], self._octree.n_points[cells]
        ranges["stride"] = 1
        return np.concatenate([entries[entries["stride"] != 0], ranges])

    def _reaching(
        self, camera: Camera, cell: np.ndarray, x: float, y: float, tolerance_px: float, world_side: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(c,) bool: a point of that side, anywhere in the cell's cube, may come within the tolerance of the pixel;
        (c,) float64: least depth of the cube.
        """
        half = self._half[self._octree.level[cell]]
        to_center = self._octree.centers[cell] - camera.eye
        across, down, ahead = camera.pixel_from_world[:, :3]
        reach = half * np.abs(ahead).sum()
        depth = to_center @ ahead
        nearest = np.maximum(depth - reach, camera.near)
        side = np.clip(world_side * (camera.focal_px / nearest), self._smallest, self._largest)
        margin = np.minimum(0.5 * side + tolerance_px + _ROUNDING_PX, 4.0 * (camera.width + camera.height))
        reaches = depth + reach >= camera.near
        for axis, at in ((across, x), (down, y)):
            for sign in (1.0, -1.0):
                plane = sign * (axis - np.multiply.outer(at - sign * margin, ahead))
                reaches &= (plane * to_center).sum(axis=1) + half * np.abs(plane).sum(axis=1) >= 0
        return reaches, nearest

    def _world_sides(self, cell: np.ndarray) -> np.ndarray:
        """(c,) float64: side of the points of each cell, world units; of splats, what they hardly exceed."""
        if self._splats:
            return 4 * self._octree.half_edges[cell] * self._splats.radius_scale
        side = np.full(len(cell), self._size.world)
        if self._size.adaptive and len(cell):
            n = np.minimum(self._octree.n_points[cell], HEAD_POINTS)
            first_point = self._octree.first_point[cell]
            heads = np.concatenate([self._read(a, a + k) for a, k in zip(first_point, n, strict=True)], axis=1)
            x, y, z = map(read_only, heads)
            spacing = spacing_of_heads(self._octree, cell, x, y, z, np.cumsum(n) - n)
            side = np.maximum(spacing.astype(np.float64), side)
        return side

    def _affordable(self, pieces: np.ndarray) -> np.ndarray:
        """(k,) indices of the pieces to look at: all, or where these are too many the front ones and some of the rest.

        Coded positions are decoded by whole cells.
        """
        if self._columns is None:
            cost = self._octree.n_points[self._owners[pieces["segment"]]]
        else:
            cost = pieces["count"].astype(np.int64)
        spent = np.cumsum(np.maximum(cost, _LEAST_COST))
        if not len(spent) or spent[-1] <= self._most_points:
            return np.arange(len(pieces))
        n_front = int(np.searchsorted(spent, self._most_points // 2, side="right"))
        left = int(spent[-1]) - (int(spent[n_front - 1]) if n_front else 0)
        step = -(-left // max(self._most_points // 2, 1))
        return np.concatenate([np.arange(n_front), np.arange(n_front, len(pieces), step)])

    # --- points ------------------------------------------------------------------------------------------------------

    def _look_at(
        self,
        camera: Camera,
        pieces: np.ndarray,
        widest_px: float,
        world_side: np.ndarray,
        column: int,
        row: int,
        tolerance_px: float,
        best: _Best,
    ) -> None:
        """Hold the points of some pieces, none of them wider than ``widest_px``, against the best."""
        count, owner = pieces["count"].astype(np.int64), pieces["segment"]
        offset = self._offsets(pieces)
        to_block = (self._origin[owner] - camera.eye).T
        relative = offset + np.repeat(to_block, count, axis=1)
        farthest = best.depth if best.beside_px == 0 and not self._splats else np.finfo(np.float32).max
        reach = 0.5 * widest_px + tolerance_px + _ROUNDING_PX
        with np.errstate(all="ignore"):
            u, v, w = camera.pixel_from_world[:, :3] @ relative
            u, v = u / w - (column + 0.5), v / w - (row + 0.5)
            near = np.flatnonzero((w >= camera.near) & (w <= farthest) & (np.abs(u) <= reach) & (np.abs(v) <= reach))
        if not len(near):
            return
        u, v, w, relative = u[near], v[near], w[near], relative[:, near].T
        ends = np.cumsum(count)
        piece = np.searchsorted(ends, near, side="right")
        index = pieces["first"][piece] + (near - (ends - count)[piece]) * pieces["stride"][piece].astype(np.int64)
        position = self._origin[owner[piece]] + offset[:, near].T
        if self._splats:
            covers, w, beside = self._covered_by_discs(camera, index, relative, u, v, w, column, row)
        else:
            side = np.floor(np.clip(world_side[piece] * (camera.focal_px / w), self._smallest, self._largest) + 0.5)
            left, top = (np.floor(p + at + 0.5 - (side - 1) / 2) for p, at in ((u, column), (v, row)))
            covers = (left <= column) & (column < left + side) & (top <= row) & (row < top + side)
            beside = np.hypot(*(np.maximum(np.abs(p) - side / 2, 0) for p in (u, v)))
        beside = np.where(covers, 0.0, np.maximum(beside, np.finfo(np.float64).tiny))
        kept = beside <= tolerance_px
        kept &= self._filter.keeps(position, None if self._classes is None else self._classes[index])
        best.take(index[kept], w[kept], beside[kept], position[kept])

    def _offsets(self, pieces: np.ndarray) -> np.ndarray:
        """(3, n) float64: points of pieces relative to the origin of their block."""
        parts = []
        for first, count, stride, _ in pieces.tolist():
            stop = first + (count - 1) * stride + 1
            if self._columns is None:
                parts.append(self._read(first, stop)[:, ::stride])
            else:
                parts.append(np.stack([column[first:stop:stride] for column in self._columns]))
        return np.concatenate(parts, axis=1, dtype=np.float64)

    def _covered_by_discs(
        self,
        camera: Camera,
        index: np.ndarray,
        relative: np.ndarray,
        u: np.ndarray,
        v: np.ndarray,
        w: np.ndarray,
        column: int,
        row: int,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of splats: (k,) bool that the disc covers the pixel's centre, or the pixel holds the disc's; (k,) its depth
        there; (k,) how far beside it the disc ends, pixels, as if it faced the eye.

        u, v : (k,) of the splats' centres from the middle of the pixel.
        """
        rows = camera.pixel_from_world[:, :3]
        ray = np.linalg.solve(rows, [column + 0.5, row + 0.5, 1.0])
        radius = self._radii[self._radius[index]]
        words = np.asarray(self._normal[index])
        normal = np.where((words == NO_NORMAL)[:, None], rows[2], unpack_normals(words).astype(np.float64))
        with np.errstate(all="ignore"):
            depth = (normal * relative).sum(axis=1) / (normal @ ray)
            covers = np.linalg.norm(depth[:, None] * ray - relative, axis=1) <= radius
        covers &= depth >= camera.near
        holds = (np.abs(u) <= 0.5) & (np.abs(v) <= 0.5)
        beside = np.maximum(np.hypot(u, v) - radius * (camera.focal_px / w), 0)
        return covers | holds, np.where(covers, depth, w), beside


def attributes_of(scene: Scene, index: int) -> dict[str, Any]:
    """All that a scene holds of a stored point but its position, JSON-able, as of ``Picked``."""
    found: dict[str, Any] = {}
    for name in scene.info.attributes:
        word = scene.attribute(name)[index : index + 1]
        if name == "rgb":
            found[name] = unpack_rgb(word)[0, :3].tolist()
        elif name == "normal":
            found[name] = None if word[0] == NO_NORMAL else unpack_normals(word)[0].astype(np.float64).tolist()
        elif name == "radius":
            found[name] = float(radius_table(scene.info.edge)[word[0]])
        else:
            value = word[0].item()
            found[name] = value if math.isfinite(value) else None
    return found
