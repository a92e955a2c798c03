"""A tiny octree builder for tests: recursive, plain, and written apart from the product's builder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from splatpipe.shared.camera import Camera, look_at, perspective_camera
from splatpipe.shared.octree import MAX_LEVEL, Octree


@dataclass
class Cloud:
    """An octree with the points it was built over, in stored order (world, float64), and the cell each
    belongs to."""

    octree: Octree
    positions: np.ndarray
    normals: np.ndarray


def build_cloud(positions, normals, *, point_order, leaf_points=8, set_points=8, max_level=6, seed=0) -> Cloud:
    """Octree over (n, 3) positions with (n, 3) unit normals. Layered: inner sets are copies of up to
    ``set_points``."""
    rng = np.random.default_rng(seed)
    lower = positions.min(axis=0)
    edge = float(max((positions.max(axis=0) - lower).max(), 1e-3)) * (1 + 2.0**-20)
    grid = np.clip(((positions - lower) / edge * 2**MAX_LEVEL).astype(np.int64), 0, 2**MAX_LEVEL - 1)

    cells = [(0, 0, -1, np.arange(len(positions)))]  # level, code, parent, members
    children = []
    for index, (level, code, _, members) in enumerate(cells):  # grows while it is walked: breadth-first
        first = len(cells)
        if len(members) > leaf_points and level < max_level:
            bits = grid[members] >> (MAX_LEVEL - level - 1) & 1
            octant = bits[:, 0] | bits[:, 1] << 1 | bits[:, 2] << 2
            cells += [(level + 1, code << 3 | o, index, members[octant == o]) for o in range(8) if (octant == o).any()]
        children.append((first if len(cells) > first else -1, len(cells) - first))

    n = len(cells)
    leaf = np.array([first < 0 for first, _ in children])
    first_point = np.zeros(n, np.int64)
    n_points = np.zeros(n, np.int64)
    stored = []

    def store(members):
        stored.append(rng.permutation(members))
        return sum(map(len, stored[:-1]))

    def depth_first(cell):
        first_point[cell] = sum(map(len, stored))
        n_points[cell] = len(cells[cell][3])
        if leaf[cell]:
            store(cells[cell][3])
        for child in range(children[cell][0], children[cell][0] + children[cell][1]):
            depth_first(child)

    if point_order == "depth-first":
        depth_first(0)
    else:
        for cell in range(n):
            members = cells[cell][3]
            kept = members if leaf[cell] else rng.permutation(members)[:set_points]
            first_point[cell], n_points[cell] = store(kept), len(kept)

    cone = np.empty((n, 4), np.float32)
    for cell in range(n):
        below = normals[cells[cell][3]]
        axis = below.sum(axis=0)
        length = np.linalg.norm(axis)
        if length > 1e-9:
            axis /= length
            cone[cell] = (*axis, (below @ axis).min())
        else:
            cone[cell] = (1.0, 0.0, 0.0, -1.0)

    octree = Octree(
        origin=lower,
        edge=edge,
        level=np.array([c[0] for c in cells], np.uint8),
        code=np.array([c[1] for c in cells], np.uint64),
        parent=np.array([c[2] for c in cells], np.int32),
        first_child=np.array([first for first, _ in children], np.int32),
        n_children=np.array([count for _, count in children], np.uint8),
        first_point=first_point,
        n_points=n_points,
        n_below=np.array([len(c[3]) for c in cells], np.int64),
        cone=cone,
        point_order=point_order,
    )
    order = np.concatenate(stored)
    return Cloud(octree, positions[order], normals[order])


@st.composite
def clouds(draw) -> Cloud:
    """Clouds of every shape that makes trouble: clustered, coplanar, colinear, coincident, far from the
    origin."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.integers(1, 300))
    shape = draw(st.sampled_from(["uniform", "clustered", "coplanar", "colinear", "sphere", "coincident"]))
    positions = rng.normal(size=(n, 3))
    if shape == "clustered":
        positions = rng.normal(size=(3, 3))[rng.integers(3, size=n)] + 1e-3 * positions
    elif shape == "coplanar":
        positions[:, draw(st.integers(0, 2))] = 0.25
    elif shape == "colinear":
        positions = positions[:, :1] * [1.0, 0.5, 0.0]
    elif shape == "coincident":
        positions[:] = positions[0]
    normals = positions + 1e-3 * rng.normal(size=(n, 3)) if shape == "sphere" else rng.normal(size=(n, 3))
    if shape == "coplanar":
        normals = np.ones((n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if shape == "sphere":
        positions /= np.linalg.norm(positions, axis=1, keepdims=True)
    shift = draw(st.sampled_from([0.0, 6.4e6]))
    order = draw(st.sampled_from(["layered", "depth-first"]))
    return build_cloud(
        positions + shift,
        normals,
        point_order=order,
        leaf_points=draw(st.sampled_from([1, 8, 40])),
        set_points=draw(st.sampled_from([1, 8, 40])),
    )


@st.composite
def scenes(draw) -> tuple[Cloud, Camera]:
    """A cloud and a camera somewhere in or around it, looking anywhere, from telephoto to fisheye-wide."""
    cloud = draw(clouds())
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    middle = cloud.positions.mean(axis=0)
    eye = middle + rng.normal(size=3) * draw(st.sampled_from([0.0, 0.3, 3.0, 100.0]))
    toward = middle - eye + rng.normal(size=3) * draw(st.sampled_from([1e-3, 1.0, 30.0]))
    camera = perspective_camera(
        frame=3,
        world_from_camera=look_at(eye, eye + toward, rng.normal(size=3)),
        fov_y_rad=draw(st.sampled_from([0.01, 0.8, 3.0])),
        width=draw(st.sampled_from([1, 640])),
        height=draw(st.sampled_from([3, 480])),
        near=draw(st.sampled_from([1e-4, 0.5])),
    )
    return cloud, camera


def leaf_of_points(cloud: Cloud) -> np.ndarray:
    """(n_stored,) the leaf that holds each stored point, −1 for the level-of-detail copies of inner cells."""
    octree = cloud.octree
    leaf = np.full(len(cloud.positions), -1)
    for cell in np.flatnonzero(octree.is_leaf):
        leaf[octree.first_point[cell] :][: octree.n_points[cell]] = cell
    return leaf
