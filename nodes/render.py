"""The render node: render-points array in, framebuffer out (thesis 5.2.1, node 3).

Frames need no cell of the octree; what goes by cell is made when points are loaded (``cell_blocks``).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from ..shared.camera import Camera
from ..shared.colour import Colouring, colour_words
from ..shared.errors import MessageError, StoreError
from ..shared.messages import RENDER_POINT, RenderPoints
from ..shared.store import Scene
from .cell_blocks import cell_blocks, cell_features, cell_spacing
from .point_filter import PointFilter, features_left
from .pooled_entries import PooledForms
from .raster import Rasterizer, ResidentPoints

if TYPE_CHECKING:
    from .raster.group_raster import ResidentGroups
    from .raster.paged_points import Residency


class RenderNode:
    """Draws frames with a rasterizer, which its maker closes."""

    def __init__(self, rasterizer: Rasterizer):
        self._rasterizer = rasterizer

    @property
    def description(self) -> str:
        """Rasterizer and device, for people."""
        return f"{self._rasterizer.name} ({self._rasterizer.device})"

    def warm_up(self, camera: Camera) -> None:
        """Compile what drawing needs, by drawing nothing."""
        self._rasterizer.draw(camera, np.empty(0, RENDER_POINT))

    def process(self, camera: Camera, chosen: RenderPoints) -> np.ndarray:
        """(height, width) uint64 framebuffer words of one frame; valid until the next call.

        Raises MessageError if camera and render-points are of different frames, or an entry is not in the point-array.
        """
        if camera.frame != chosen.frame:
            raise MessageError(f"render-points: found frame {chosen.frame}, expected frame {camera.frame}")
        return self._rasterizer.draw(camera, chosen.entries)

    def expect(self, chosen: RenderPoints) -> None:
        """Say what a frame that follows will draw; for paged points, which are then loaded meanwhile."""
        expect = getattr(self._rasterizer, "expect", None)
        if expect is not None:
            expect(chosen.frame, chosen.entries)

    @property
    def residency(self) -> Residency | None:
        """What the last frame found of paged points; None where points are resident."""
        return getattr(self._rasterizer, "residency", None)


@dataclass(frozen=True)
class Wanted:
    """What a run needs of the points besides position and colour; nothing else is loaded.

    splats : normals and radii.  features : classes and quads of the cells.
    cells : blocks as single cells.  spacing : the spacing of their points.  pools : the pooled forms of cells.
    groups : positions as linear groups (``grouped_cells``), not decoded.
    point_filter : which points are drawn at all; the others get NaN as their x.
    """

    splats: bool = False
    features: bool = False
    cells: bool = False
    spacing: bool = False
    pools: bool = False
    groups: bool = False
    point_filter: PointFilter = field(default_factory=PointFilter)

    def check(self, scene: Scene) -> None:
        """Raise StoreError if the scene was built without what is wanted. Cost: none, it looks at no array."""
        if self.splats and not scene.info.splats:
            raise StoreError(f"{scene.path}: no radii and normals of splats: build it with --splats")
        if self.features and not scene.info.features:
            raise StoreError(f"{scene.path}: no features of cells: build it with --features")
        if self.groups and scene.info.positions != "groups":
            raise StoreError(f"{scene.path}: positions are {scene.info.positions}: build it with --positions groups")
        if self.pools and not scene.info.pool_bits:
            raise StoreError(f"{scene.path}: no pooled cells: build it with --pools")


def load_drawn(scene: Scene, colouring: Colouring, wanted: Wanted, *, verify: bool) -> ResidentPoints | ResidentGroups:
    """The render rank's half of a scene in the form that it is drawn from: ``load_points``, or linear groups."""
    if not wanted.groups:
        return load_points(scene, colouring, wanted, verify=verify)
    from .grouped_cells import load_groups

    return load_groups(scene, colouring, wanted, verify=verify)


def load_points(scene: Scene, colouring: Colouring, wanted: Wanted = Wanted(), *, verify: bool) -> ResidentPoints:
    """The render rank's half of a scene, coloured. Positions (and rgb) are mapped from the files, not copied, but for
    x where points are filtered; coded positions are decoded (``Scene.positions``).

    verify : hold the checksums of the arrays it reads against the scene first: one read of each.
    Raises StoreError naming the array that is damaged or that the scene was built without.
    """
    wanted.check(scene)
    if verify:
        attributes = [colouring.attribute, "classification" if wanted.point_filter.classes else None]
        attributes += ["normal", "radius"] if wanted.splats else []
        scene.check([*scene.info.position_arrays, *(f"attr_{name}" for name in dict.fromkeys(attributes) if name)])
        scene.check(["pool_codes"] if wanted.pools else [])
    x, y, z = scene.positions()
    if wanted.point_filter:
        x = wanted.point_filter.filtered_x(scene, x, y, z)
    block_spacing = features = None
    if wanted.cells or wanted.features:
        octree = scene.octree(features=wanted.features, pools=wanted.pools)
        features = cell_features(octree) if wanted.features else None
        if features and wanted.point_filter:
            features = features_left(features, x)
    if wanted.cells:
        block_first_point, block_origin, cells = cell_blocks(scene, octree)
        if wanted.spacing:
            block_spacing = cell_spacing(scene, octree, cells)
    else:
        block_first_point, block_origin = scene.blocks()
    points = ResidentPoints(
        x,
        y,
        z,
        colour_words(scene, colouring),
        block_first_point,
        block_origin,
        normal=scene.attribute("normal") if wanted.splats else None,
        radius=scene.attribute("radius") if wanted.splats else None,
        root_edge=scene.info.edge,
        block_spacing=block_spacing,
        features=features,
    )
    if wanted.pools:
        from .pooled_cells import load_pools

        pools = load_pools(scene, points)
        if block_spacing is not None:
            spacing = np.zeros(len(octree))
            spacing[cells] = block_spacing
            pools = pools._replace(world_side=spacing[PooledForms.of(octree).cell])
        points = replace(points, pools=pools)
    return points


def recoloured(points: ResidentPoints, scene: Scene, colouring: Colouring) -> ResidentPoints:
    """The points of a scene, without pools, in other colours. Raises StoreError."""
    return replace(points, colour=colour_words(scene, colouring))


def refiltered(points: ResidentPoints, scene: Scene, point_filter: PointFilter) -> ResidentPoints:
    """The points of a scene, without pools and features, of which another filter takes some out. Raises StoreError."""
    x, y, z = scene.positions()
    return replace(points, x=point_filter.filtered_x(scene, x, y, z) if point_filter else x)
