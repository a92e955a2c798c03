"""Culling: equal to a plain twin, and conservative against every point and every normal."""

import numpy as np
import pytest
from helpers_octree import build_cloud, leaf_of_points, scenes
from hypothesis import given, settings
from splatpipe.nodes.culling import CullingNode
from splatpipe.nodes.frustum import padded_half_edges
from splatpipe.shared.camera import look_at, perspective_camera

EXAMPLES = settings(max_examples=150, derandomize=True, deadline=None)


def in_image(camera, positions, margin_px=0.0):
    """(n,) bool: which points project into the widened image, each by itself, in float64."""
    x, y, w = camera.pixel_from_world[:, :3] @ (positions - camera.eye).T
    inside = (x >= -margin_px * w) & (x <= (camera.width + margin_px) * w)
    return inside & (y >= -margin_px * w) & (y <= (camera.height + margin_px) * w) & (w >= camera.near)


def cull_twin(octree, camera, *, backface, margin_px):
    """Which cells may be seen, by the definition: the eight corners against each half-space, angles in
    degrees."""
    x, y, w = camera.pixel_from_world[:, :3]
    sides = [x + margin_px * w, (camera.width + margin_px) * w - x, y + margin_px * w]
    sides.append((camera.height + margin_px) * w - y)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    visible = np.zeros(len(octree), bool)
    for cell in range(len(octree)):
        if cell and not visible[octree.parent[cell]]:
            continue
        center = octree.centers[cell] - camera.eye
        half = padded_half_edges(octree)[octree.level[cell]]
        corners = center + half * signs
        outside = (corners @ w < camera.near).all() or any((corners @ side < 0).all() for side in sides)
        distance, radius = np.linalg.norm(center), half * 3**0.5
        if backface and distance > radius:
            axis = octree.cone[cell, :3].astype(np.float64)
            spread = np.degrees(np.arccos(max(octree.cone[cell, 3] - 1e-6, -1.0)) + np.arcsin(radius / distance))
            outside |= np.degrees(np.arccos(np.clip(axis @ center / distance, -1, 1))) + spread <= 90
        visible[cell] = not outside
    return visible


@EXAMPLES
@given(scenes())
def test_equals_its_twin(scene):
    cloud, camera = scene
    for backface in (False, True):
        node = CullingNode(cloud.octree, backface=backface, margin_px=1.0)
        visible = node.process(camera).unpack().astype(bool)
        twin = cull_twin(cloud.octree, camera, backface=backface, margin_px=1.0)
        np.testing.assert_array_equal(visible, twin)


@EXAMPLES
@given(scenes())
def test_every_point_in_the_image_lies_in_a_visible_leaf(scene):
    cloud, camera = scene
    bits = CullingNode(cloud.octree, backface=False, margin_px=2.5).process(camera)
    visible = bits.unpack().astype(bool)
    assert bits.frame == camera.frame
    leaf = leaf_of_points(cloud)
    drawn = in_image(camera, cloud.positions, 2.5) & (leaf >= 0)
    assert visible[leaf[drawn]].all()
    parent = cloud.octree.parent
    assert visible[parent[visible & (parent >= 0)]].all()


@EXAMPLES
@given(scenes())
def test_every_point_facing_the_eye_lies_in_a_visible_leaf(scene):
    cloud, camera = scene
    visible = CullingNode(cloud.octree, backface=True, margin_px=0.0).process(camera).unpack().astype(bool)
    leaf = leaf_of_points(cloud)
    facing = ((camera.eye - cloud.positions) * cloud.normals).sum(axis=1) > 0
    drawn = in_image(camera, cloud.positions) & facing & (leaf >= 0)
    assert visible[leaf[drawn]].all()


@pytest.fixture(scope="module")
def sphere():
    positions = np.random.default_rng(5).normal(size=(20_000, 3))
    positions /= np.linalg.norm(positions, axis=1, keepdims=True)
    return build_cloud(positions, positions, point_order="layered", leaf_points=20)


def camera_at(eye, fov_y_rad=0.5):
    pose = look_at(eye, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=fov_y_rad, width=640, height=480, near=1e-3)


def leaf_share(cloud, camera, **options):
    visible = CullingNode(cloud.octree, **options).process(camera).unpack()
    return visible[cloud.octree.is_leaf].mean()


def test_back_faces_of_a_closed_surface_are_left_out(sphere):
    far = camera_at([50.0, 0.0, 0.0])
    assert leaf_share(sphere, far, backface=False) == 1.0
    assert 0.5 < leaf_share(sphere, far, backface=True) < 0.65


def test_a_narrow_view_leaves_out_most_cells(sphere):
    assert leaf_share(sphere, camera_at([50.0, 0.0, 0.0], fov_y_rad=0.01), backface=False) < 0.2


def test_a_scene_behind_the_camera_is_invisible_from_the_root_on(sphere):
    pose = look_at([50.0, 0.0, 0.0], [60.0, 0.0, 0.0], np.array([0.0, 0.0, 1.0]))
    camera = perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.5, width=64, height=64, near=1e-3)
    assert leaf_share(sphere, camera, backface=False) == 0.0


def test_without_cones_back_faces_stay(sphere):
    octree = sphere.octree
    bare = type(octree)(**{**{f: getattr(octree, f) for f in octree.__dataclass_fields__}, "cone": None})
    visible = CullingNode(bare, backface=True).process(camera_at([50.0, 0.0, 0.0])).unpack()
    assert visible.all()
