"""Degenerate clouds: each built in both point orders, verified, culled, sampled and drawn."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...shared.errors import InputError
from ...shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from ...shared.stability.case import case, cases, expect
from ..culling import CullingNode
from ..raster import ResidentPoints
from ..raster.cpu import CpuRasterizer
from ..sampling import SamplingNode
from .chain import STEPS, Chain, built, camera_at, is_drawn


def _random(n: int, *scales: float) -> np.ndarray:
    return np.random.default_rng(17).uniform(0.0, 1.0, (n, 3)) * scales


def _hot_octant() -> np.ndarray:
    """All but eight of 200 000 points in a cube of a millionth of the scene's edge."""
    return np.concatenate([_random(200_000, 1e-6, 1e-6, 1e-6) + 0.3, np.eye(3), 1 - np.eye(3), [[0, 0, 0], [1, 1, 1]]])


def _cell_faces() -> np.ndarray:
    """33³ points at multiples of 1/32 of the root edge but for the last: on corners of cells down to level 5."""
    grid = np.stack(np.meshgrid(*[np.arange(33)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid * (2049 / 2048 / 32)


CLOUDS: dict[str, Callable[[], np.ndarray]] = {
    "one point": lambda: np.array([[3.0, -2.0, 7.0]]),
    "two points": lambda: np.array([[0.0, 0.0, 0.0], [1.0, 1e-3, 2.0]]),
    "two points a float64 step apart": lambda: np.array([[1e6, 0, 0], [np.nextafter(1e6, 2e6), 0, 0]]),
    "a million coincident": lambda: np.full((1_000_000, 3), 1 / 3),
    "coincident and one apart": lambda: np.concatenate([np.full((20_000, 3), 0.1), [[50.0, 60.0, 70.0]]]),
    "collinear along an axis": lambda: _random(20_000, 100, 0, 0),
    "collinear oblique": lambda: _random(20_000, 1, 0, 0)[:, :1] * [31.0, 47.0, -13.0],
    "coplanar": lambda: _random(20_000, 100, 100, 0),
    "coplanar oblique": lambda: _random(20_000, 100, 100, 0) @ [[1, 0, 0.3], [0, 1, -0.7], [0, 0, 0]],
    "on the faces of cells": _cell_faces,
    "one hot octant": _hot_octant,
    "anisotropy 1:1e8 along x": lambda: _random(20_000, 1e8, 1, 1),
    "anisotropy 1:1e8 flat": lambda: _random(20_000, 1, 1, 1e-8),
    "denormal and negative zero": lambda: np.concatenate([_random(2000, 1, 1, 1), [[5e-324, -0.0, 0.0]] * 3]),
}
_ORDERS = ("layered", "depth-first")
_EVERY = dict.fromkeys(CLOUDS, 0.0)


def cameras_of(positions: np.ndarray) -> list:
    """From outside, and from 1/10 of its extent beside a point of the cloud."""
    lower, upper = positions.min(axis=0), positions.max(axis=0)
    extent = max(float((upper - lower).max()), 1e-6)
    middle = (lower + upper) / 2
    views = [(middle + extent * np.array([1.1, -1.4, 0.9]), middle), (positions[0] - 0.1 * extent, positions[-1])]
    return [
        camera_at(eye, target + (0 if np.any(eye != target) else extent), width=480, height=270, near=1e-4 * extent)
        for eye, target in views
    ]


@cases("cloud/drawn", bounds=_EVERY, unit="pixels")
def drawn(name: str) -> float:
    """Pixels that are not the nearest of all points by brute force, in both point orders, from outside and from within;
    the scene passes ``verify``, and every point is stored once.
    """
    positions = CLOUDS[name]()
    wrong = 0
    for order in _ORDERS:
        with built(positions, order=order) as chain:
            chain.scene.verify()
            entries = chain.leaf_entries
            stored = np.concatenate([chain.source[o : o + r] for o, r, _ in entries.tolist()])
            expect(np.array_equal(np.sort(stored), np.arange(len(positions))), "every point is in one leaf, once")
            cameras = cameras_of(positions)
            expect(is_drawn(chain.frame(cameras[0])).any(), "the picture shows something")
            wrong += sum(map(chain.differing_pixels, cameras))
    return wrong


@cases("cloud/projected", bounds=dict.fromkeys(CLOUDS, STEPS), unit="float32 steps")
def projected(name: str) -> float:
    """Image position of every drawn point, from outside and from within, against float64 of the points as given."""
    positions = CLOUDS[name]()
    with built(positions) as chain:
        moved = np.concatenate([chain.moved_steps(camera) for camera in cameras_of(positions)])
        expect(len(moved), "points are in the image")
        return float(moved.max())


@cases("cloud/cut", bounds=_EVERY, unit="leaves")
def cut(name: str) -> float:
    """Visible leaves without exactly one drawn ancestor-or-self, over both point orders and thresholds 0, 1, 30 px."""
    positions = CLOUDS[name]()
    wrong = 0
    for order in _ORDERS:
        with built(positions, order=order) as chain:
            cameras = cameras_of(positions)
            expect(chain.chosen(cameras[0]).n_points, "a cell is visible")
            for camera in cameras:
                for threshold in (0.0, 1.0, 30.0):
                    wrong += _broken_leaves(chain, camera, threshold)
    return wrong


def _broken_leaves(chain: Chain, camera, threshold: float) -> int:
    """Holds the entries, not the sampler's own table, against the octree: a cell is drawn if an entry begins at or
    covers its first point.
    """
    tree = chain.octree
    bits = CullingNode(tree, backface=False).process(camera)
    visible = bits.unpack().astype(bool)
    node = SamplingNode(tree, pixel_threshold=threshold)
    entries = node.process(camera, bits).entries
    covered = np.zeros(chain.scene.info.n_stored + 1, np.int64)
    np.add.at(covered, entries["offset"].astype(np.int64), 1)
    np.add.at(covered, (entries["offset"] + entries["range"]).astype(np.int64), -1)
    times_drawn = np.cumsum(covered)[:-1]
    if tree.point_order == "depth-first":  # an inner cell is drawn where its first leaf is
        count = times_drawn[tree.first_point[tree.is_leaf & visible]]
        return int((count != 1).sum())
    own = (tree.n_points > 0) & (times_drawn[np.minimum(tree.first_point, len(times_drawn) - 1)] > 0)
    above = np.zeros(len(tree), np.int64)
    for cell in range(len(tree)):
        above[cell] = own[cell] + (above[tree.parent[cell]] if cell else 0)
    return int((above[tree.is_leaf & visible] != 1).sum())


@case("cloud/none", bound=0.0, unit="failures")
def none() -> float:
    """A file without points is refused with an InputError, and an empty render-points array draws an empty frame."""
    try:
        with built(np.empty((0, 3))):
            return 1.0
    except InputError:
        pass
    column = np.empty(0, np.float32)
    points = ResidentPoints(column, column, column, np.empty(0, np.uint32), np.zeros(1, np.int64), np.zeros((1, 3)))
    with CpuRasterizer(points, 8, 8) as rasterizer:
        frame = rasterizer.draw(camera_at(np.zeros(3), np.ones(3), width=8, height=8), np.empty(0, RENDER_POINT))
        return float((frame != FRAMEBUFFER_EMPTY).any())


@case("cloud/all in one pixel", bound=0.0, unit="words")
def one_pixel() -> float:
    """A million points seen in one pixel, two threads: that pixel's word against the least by brute force, and no
    other pixel drawn.
    """
    rng = np.random.default_rng(23)
    z = rng.uniform(1.0, 1000.0, 1_000_000)
    positions = np.column_stack([z * rng.uniform(1e-5, 9e-4, len(z)), z * rng.uniform(1e-5, 9e-4, len(z)), z])
    with built(positions) as chain:
        camera = camera_at(np.zeros(3), np.array([0.0, 0.0, 1.0]), fov_deg=90, width=480, height=270, near=0.5)
        wrong = chain.differing_pixels(camera)
        return wrong + abs(int(is_drawn(chain.frame(camera)).sum()) - 1)
