"""The program's whole way from positions to a frame, in one process, and what it is compared with."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ...shared.build import BuildSettings, build_scene
from ...shared.camera import Camera, look_at, perspective_camera
from ...shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT, RenderPoints
from ...shared.octree import Octree
from ...shared.readers.inputs import open_source
from ...shared.store import Scene
from ..culling import CullingNode
from ..raster import ResidentPoints
from ..raster.cpu import CpuRasterizer
from ..raster.reference import point_indices, project_float32, reference_frame
from ..sampling import SamplingNode

_POINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
ALPHA = np.uint32(255 << 24)

STEPS = 4.0
"""Bound of an image position in float32 steps of what it is added up from (``Chain.moved_steps``): a row is four
products and three sums, divided by another such row; most of its roundings are of small parts."""


@dataclass(frozen=True)
class Chain:
    """A scene made of ``given`` ((n, 3) float64, n < 2**24), whose colours number the points."""

    given: np.ndarray
    scene: Scene

    @cached_property
    def octree(self) -> Octree:
        """The selection ranks' half."""
        return self.scene.octree()

    @cached_property
    def points(self) -> ResidentPoints:
        """The render rank's half."""
        x, y, z = (np.asarray(column) for column in self.scene.positions())
        return ResidentPoints(x, y, z, np.asarray(self.scene.attribute("rgb")), *self.scene.blocks())

    @cached_property
    def source(self) -> np.ndarray:
        """(n_stored,) the given point that each stored one came from."""
        return (self.points.colour ^ ALPHA).astype(np.int64) - 1

    @cached_property
    def leaf_entries(self) -> np.ndarray:
        """Entries of all leaves: every given point once, without culling or sampling."""
        leaf = np.flatnonzero(self.octree.is_leaf)
        entries = np.ones(len(leaf), RENDER_POINT)
        entries["offset"], entries["range"] = self.octree.first_point[leaf], self.octree.n_points[leaf]
        return entries

    def chosen(self, camera: Camera, pixel_threshold: float = 0.0) -> RenderPoints:
        """What the culling and the sampling node choose."""
        bits = CullingNode(self.octree, backface=False).process(camera)
        return SamplingNode(self.octree, pixel_threshold=pixel_threshold).process(camera, bits)

    def frame(self, camera: Camera, pixel_threshold: float = 0.0) -> np.ndarray:
        """(height, width) words, through all three nodes."""
        with CpuRasterizer(self.points, camera.width, camera.height, threads=2) as rasterizer:
            return rasterizer.draw(camera, self.chosen(camera, pixel_threshold).entries).copy()

    def differing_pixels(self, camera: Camera) -> int:
        """Pixels of a frame that are not the nearest of all points by brute force (NumPy, no octree)."""
        brute = reference_frame(self.points, camera, self.leaf_entries, projection=project_float32)
        return int((self.frame(camera) != brute).sum())

    def moved_px(self, camera: Camera) -> np.ndarray:
        """(m,) distance, in pixels, between float32 and float64 image positions of the drawn points in the image.

        The reference projects the *given* point: its difference to the eye, then the camera's matrix, in float64. So
        the error holds what storing and projecting lose. Points that float64 puts behind the near plane and into the
        image are counted, wherever float32 puts them.
        """
        return self._moved(camera)[0]

    def moved_steps(self, camera: Camera) -> np.ndarray:
        """(m,) the same distances in float32 steps of what an image row adds up.

        A row adds offsets of up to ``reach`` (eye to block, block to point) times ``focal_px`` and the image position;
        a step of that, seen at the point's depth, is the unit. It grows as the point comes near: a point 5 cm before
        the eye in a block of 50 m has 10 bits fewer than one at 50 m.
        """
        moved, reach, depth, across = self._moved(camera)
        return moved / (2.0**-24 * (camera.focal_px + across) * reach / depth)

    def _moved(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of the drawn points in the image: distance px, reach, depth (world units), u + v (px)."""
        index = point_indices(self.chosen(camera).entries)
        u, v, _ = project_float32(self.points, camera, index)
        given = self.given[self.source[index]]
        exact_u, exact_v, seen = project_given(camera, given)
        depth = (given - camera.eye) @ camera.pixel_from_world[2, :3]
        with np.errstate(invalid="ignore"):
            moved = np.hypot(u[seen] - exact_u[seen], v[seen] - exact_v[seen])
        return moved, self._reach(camera, index)[seen], depth[seen], (exact_u + exact_v)[seen]

    def _reach(self, camera: Camera, index: np.ndarray) -> np.ndarray:
        """(n,) distance from the eye to the points' block origins and on to the points, world units."""
        points = self.points
        block = np.searchsorted(points.block_first_point, index, side="right") - 1
        offset = np.column_stack([c[index] for c in (points.x, points.y, points.z)]).astype(np.float64)
        return np.linalg.norm(points.block_origin[block] - camera.eye, axis=1) + np.linalg.norm(offset, axis=1)

    def depths(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the drawn points in the image: float32 depth, float64 depth of the given point, a float32 step of both
        the depth and what it is the sum of (world units).
        """
        index = point_indices(self.chosen(camera).entries)
        depth = project_float32(self.points, camera, index)[2].astype(np.float64)
        given = self.given[self.source[index]]
        seen = project_given(camera, given)[2]
        exact = (given - camera.eye) @ camera.pixel_from_world[2, :3]
        step = 2.0**-24 * (exact + self._reach(camera, index))
        return depth[seen], exact[seen], step[seen]


def project_given(camera: Camera, world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image positions u, v of (n, 3) float64 world points in float64, and which of them lie in the image."""
    with np.errstate(all="ignore"):
        x, y, w = camera.pixel_from_world[:, :3] @ (world - camera.eye).T
        u, v = x / w, y / w
        return u, v, (w >= camera.near) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)


@contextmanager
def built(positions: np.ndarray, *, order: str = "layered", points_per_cell: int = 500) -> Iterator[Chain]:
    """A scene of (n, 3) float64 positions, read from a file and built on disk; removed afterwards."""
    records = np.empty(len(positions), _POINT)
    number = np.arange(1, len(positions) + 1)  # black alone would be taken for no colour
    records["x"], records["y"], records["z"] = np.asarray(positions, np.float64).T
    records["red"], records["green"], records["blue"] = number & 255, number >> 8 & 255, number >> 16
    with tempfile.TemporaryDirectory(prefix="splatpipe-stability-") as folder:
        file, out = Path(folder) / "points.npy", Path(folder) / "scene"
        np.save(file, records)
        settings = BuildSettings(point_order=order, points_per_cell=points_per_cell)
        build_scene([open_source(file)], out, settings=settings)
        yield Chain(np.asarray(positions, np.float64), Scene.open(out))


def in_one_block(positions: np.ndarray, colour: np.ndarray | None = None) -> ResidentPoints:
    """(n, 3) positions, rounded to float32, in one block at the origin; colours number them where none are given."""
    x, y, z = np.ascontiguousarray(np.asarray(positions).T, np.float32)
    colour = np.arange(len(x)) if colour is None else colour
    return ResidentPoints(x, y, z, colour.astype(np.uint32), np.zeros(1, np.int64), np.zeros((1, 3)))


def draw_all(points: ResidentPoints, camera: Camera) -> np.ndarray:
    """(height, width) words of a frame of all points, drawn by ``cpu``."""
    with CpuRasterizer(points, camera.width, camera.height, threads=2) as rasterizer:
        return rasterizer.draw(camera, every_point(points))


def every_point(points: ResidentPoints) -> np.ndarray:
    """The entry that draws all points."""
    return np.array([(0, len(points), 1)], RENDER_POINT)


def camera_at(
    eye: np.ndarray,
    target: np.ndarray,
    *,
    fov_deg: float = 50.0,
    width: int = 1920,
    height: int = 1080,
    near: float = 0.05,
) -> Camera:
    """A camera that looks from eye to target, z upwards."""
    pose = look_at(eye, target, np.array([0.0, 0.0, 1.0]))
    return perspective_camera(
        frame=0, world_from_camera=pose, fov_y_rad=np.radians(fov_deg), width=width, height=height, near=near
    )


def city(n: int = 30_000, seed: int = 11) -> np.ndarray:
    """(n, 3) float64, metres: ground, walls and roofs over 200 m × 200 m × 60 m, on no grid."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 1, (n, 3)) * [200.0, 200.0, 0.2]
    kind = rng.integers(0, 3, n)
    height = 10 + 50 * rng.integers(0, 2, n) * rng.uniform(0, 1, n)
    points[kind == 1, 0] = np.rint(points[kind == 1, 0] / 40) * 40
    points[kind == 1, 2] = (rng.uniform(0, 1, n) * height)[kind == 1]
    points[kind == 2, 2] = np.rint(height[kind == 2])
    return points


def is_drawn(frame: np.ndarray) -> np.ndarray:
    """(height, width) bool."""
    return frame != FRAMEBUFFER_EMPTY
