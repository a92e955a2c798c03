"""Stereo pairs and cube faces: parallax, what lies where, and that culling and sampling hold for them."""

from types import SimpleNamespace

import numpy as np
import pytest
from splatpipe.nodes.frustum import frustum_planes
from splatpipe.shared.config import CameraSection
from splatpipe.shared.views import STEREO_SHARE, camera_views, cube_face_px

SCENE = SimpleNamespace(lower=(0.0, 0.0, 0.0), upper=(10.0, 6.0, 2.0), up="z", attributes=("rgb",), sources=())
POSE = [[1.0, 0, 0, 5], [0, 0, -1.0, -20], [0, 1.0, 0, 1], [0, 0, 0, 1]]
PATHS = {
    "orbit": {"path": "orbit", "radius": 20.0},
    "keyframes": {"path": "keyframes", "keyframes": [{"time": 0, "eye": (1, -19, 3), "target": (5, 3, 1)}]},
    "poses": {"path": "poses", "poses": [POSE]},
}


def views_of(n=1, supersampling=1, **settings):
    return camera_views(CameraSection(width=64, height=48, **settings), SCENE, n, supersampling)


def image_positions(camera, points):
    """(n, 2) pixels and (n,) depth."""
    x, y, w = camera.pixel_from_world[:, :3] @ (points - camera.eye).T
    return np.column_stack([x / w, y / w]), w


@pytest.mark.parametrize("path", PATHS)
def test_the_target_has_no_parallax_what_is_nearer_stands_out_and_nothing_is_askew(path):
    views = views_of(view="stereo", stereo_base=0.5, **PATHS[path])
    left, right = views.camera(0), views.camera(1)
    assert (left.frame, right.frame) == (0, 1)
    one = views_of(view="mono", **PATHS[path]).camera(0)
    np.testing.assert_allclose((left.eye + right.eye) / 2, one.eye)
    assert np.linalg.norm(right.eye - left.eye) == pytest.approx(0.5)
    axis = one.clip_from_world[3, :3]
    distance = {"orbit": 20.0, "keyframes": np.linalg.norm([4, 22, -2]), "poses": 23.0}[path]
    rng = np.random.default_rng(1)
    aside = rng.normal(size=(50, 3))
    aside -= (aside @ axis)[:, None] * axis
    for depth, sign in ((distance, 0), (distance / 2, -1), (distance * 3, 1)):
        at = one.eye + depth * axis + aside
        (seen_left, w), (seen_right, _) = image_positions(left, at), image_positions(right, at)
        np.testing.assert_allclose(w, depth)
        np.testing.assert_allclose(seen_left[:, 1], seen_right[:, 1], atol=1e-9)
        parallax = seen_right[:, 0] - seen_left[:, 0]  # > 0: behind the picture
        expected = one.focal_px * 0.5 * (1 / distance - 1 / depth)
        np.testing.assert_allclose(parallax, expected, atol=1e-9)
        assert np.sign(np.round(parallax, 6)).tolist() == [sign] * 50
        if sign == 0:
            seen, _ = image_positions(one, at)
            np.testing.assert_allclose(seen_left, seen, atol=1e-9)


def test_the_default_base_is_a_share_of_the_radius():
    assert views_of(view="stereo", **PATHS["orbit"]).base == pytest.approx(20 * STEREO_SHARE)
    for path in ("keyframes", "poses"):
        assert views_of(view="stereo", **PATHS[path]).base == pytest.approx(np.sqrt(140) / 2 * STEREO_SHARE)


@pytest.mark.parametrize("view", ["stereo", "panorama"])
def test_culling_and_sampling_hold_for_every_view(view):
    views = views_of(view=view, stereo_base=4.0, **PATHS["keyframes"])
    points = np.random.default_rng(3).uniform(-30, 30, (4000, 3))
    for frame in range(views.per_picture):
        camera = views.camera(frame)
        at, w = image_positions(camera, points)
        inside = (w >= camera.near) & (at >= 0).all(axis=1) & (at < [views.width, views.height]).all(axis=1)
        planes = frustum_planes(camera, 0.0)
        kept = ((points - camera.eye) @ planes[:, :3].T >= planes[:, 3]).all(axis=1)
        np.testing.assert_array_equal(kept, inside)
        assert inside.any()
        assert camera.pinhole_px[:2] == pytest.approx((camera.focal_px, camera.focal_px))


def test_the_pinhole_of_an_off_axis_camera_is_where_points_fall():
    camera = views_of(view="stereo", stereo_base=4.0, **PATHS["poses"]).camera(1)
    fx, fy, cx, cy = camera.pinhole_px
    at, w = image_positions(camera, camera.eye + np.array([[1.5, 10.0, -0.7]]))  # right, ahead, down
    np.testing.assert_allclose(at, [[cx + fx * 0.15, cy + fy * 0.07]])
    assert w == pytest.approx(10.0)


def test_each_direction_falls_on_exactly_one_face_of_a_panorama():
    views = views_of(view="panorama", **PATHS["poses"])
    points = np.random.default_rng(3).normal(size=(4000, 3)) + np.array([5.0, -20.0, 1.0])
    n_faces = np.zeros(len(points), int)
    for face in range(6):
        camera = views.camera(face)
        at, w = image_positions(camera, points)
        n_faces += (w > 0) & (at >= 0).all(axis=1) & (at < views.width).all(axis=1)
    assert (n_faces == 1).all()


def test_a_face_is_nowhere_coarser_than_its_panorama():
    for width, height in ((2048, 1024), (1000, 1000), (7, 1), (1, 1)):
        side = cube_face_px(width, height)
        assert side / 2 >= max(width / (2 * np.pi), height / np.pi)
        assert side <= max(width, 2 * height) / np.pi + 1


@pytest.mark.parametrize(
    ("view", "per_picture", "size"), [("mono", 1, (192, 144)), ("stereo", 2, (192, 144)), ("panorama", 6, (92, 92))]
)
def test_frames_count_views_and_are_drawn_larger_where_pixels_are_averaged(view, per_picture, size):
    views = views_of(n=3, supersampling=3, view=view)
    assert (views.per_picture, views.width, views.height) == (per_picture, *size)
    for picture in range(3):
        cameras = [views.camera(picture * per_picture + i) for i in range(per_picture)]
        assert [camera.frame for camera in cameras] == list(range(picture * per_picture, (picture + 1) * per_picture))
        assert {(camera.width, camera.height) for camera in cameras} == {size}
        eye = views_of(n=3, view="mono").camera(picture).eye
        np.testing.assert_allclose(np.mean([camera.eye for camera in cameras], axis=0), eye, atol=1e-9)
