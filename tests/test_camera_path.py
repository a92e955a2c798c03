"""Camera paths: framing, smoothness, and the keys that make naive paths flip or break."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from splatpipe.shared.camera_path import (
    OrbitPath,
    axis_vector,
    camera_path,
    orbit_radius,
    up_vector,
)
from splatpipe.shared.config import CameraSection
from splatpipe.shared.errors import ConfigError, InputError
from splatpipe.shared.keyframes import Key, KeyframePath

EXAMPLES = settings(max_examples=60, derandomize=True, deadline=None)
Z = np.array([0.0, 0.0, 1.0])
AXES = ["x", "y", "z", "-x", "-y", "-z"]


def scene(lower=(0.0, 0.0, 0.0), upper=(10.0, 6.0, 2.0), up="z", attributes=("rgb",), file="scan.laz"):
    sources = (SimpleNamespace(name=file, n_points=1),)
    return SimpleNamespace(lower=lower, upper=upper, up=up, attributes=attributes, sources=sources)


def image_positions(camera, points):
    """(n, 2) pixels and (n,) depth."""
    x, y, w = camera.pixel_from_world[:, :3] @ (points - camera.eye).T
    return np.column_stack([x / w, y / w]), w


def corners(lower, upper):
    pick = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, 8).T
    return np.where(pick, upper, lower)


def keyframes(*keys, fov=1.0, up=Z):
    """A path through (eye, target) pairs at even times."""
    times = np.linspace(0, 1, len(keys)) if len(keys) > 1 else [0.0]
    made = [Key(t, np.array(e, float), np.array(g, float), fov) for t, (e, g) in zip(times, keys, strict=True)]
    return KeyframePath(tuple(made), up)


def angle(a, b):
    """Between two rotations, radians."""
    return 2 * math.asin(min(1.0, np.linalg.norm(a[:3, :3] - b[:3, :3]) / math.sqrt(8)))


def extents(least, shift):
    """Of boxes, flat ones too, and how far from the origin they are; shorter edges would be rounded away there."""
    return st.tuples(st.tuples(*[st.one_of(st.just(0.0), st.floats(least, 1000))] * 3), st.just(shift))


# --- orbit


@EXAMPLES
@given(
    st.sampled_from(AXES),
    st.floats(-90, 90),
    st.sampled_from([(640, 480), (1920, 400), (300, 900)]),
    st.one_of(extents(1e-300, 0.0), extents(1e-2, 6.4e6)),
)
@example("x", 90.0, (640, 480), ((1.0, 0.0, 0.0), 0.0))
@example("x", -29.0, (640, 480), ((1e-306, 1e-306, 0.0), 0.0))
def test_the_whole_scene_is_in_every_frame(up, elevation, size, placed):
    extent, shift = placed
    lower = np.full(3, shift)
    upper = lower + extent
    section = CameraSection(up=up, elevation_deg=elevation, width=size[0], height=size[1])
    path = camera_path(section, scene(lower, upper), 90)
    for frame in range(0, 90, 7):
        camera = path.camera(frame)
        at, depth = image_positions(camera, corners(lower, upper))
        assert (depth > camera.near).all()
        assert (at >= -1e-3).all()
        assert (at <= np.array(size) + 1e-3).all()


def test_the_orbit_radius_is_the_least():
    lower, upper = np.zeros(3), np.array([4.0, 4.0, 1.0])
    center = (lower + upper) / 2
    radius = orbit_radius(lower, upper, center, Z, 0.4, 0.8, 1.5)
    reach = []
    for azimuth in np.linspace(0, 2 * np.pi, 720):
        camera = camera_path(
            CameraSection(width=1500, height=1000, fov_deg=math.degrees(0.8), elevation_deg=math.degrees(0.4),
                          start_deg=math.degrees(azimuth), radius=radius), scene(lower, upper), 1,
        ).camera(0)  # fmt: skip
        at, _ = image_positions(camera, corners(lower, upper))
        reach.append(np.abs(at / [1500, 1000] - 0.5).max())
    assert max(reach) == pytest.approx(0.5, abs=1e-3)
    assert np.allclose(camera.eye - center, radius * np.array([0, -math.cos(0.4), math.sin(0.4)]), atol=1e-2)


@pytest.mark.parametrize("up", AXES)
def test_up_is_up_in_the_image_and_the_orbit_turns_counter_clockwise(up):
    section = CameraSection(up=up, elevation_deg=20.0, radius=10.0, center=(1.0, 2.0, 3.0))
    path = camera_path(section, scene(), 36)
    center, axis = np.array([1.0, 2.0, 3.0]), axis_vector(up)
    for frame in (0, 5, 30):
        camera = path.camera(frame)
        at, _ = image_positions(camera, np.array([center, center + axis]))
        np.testing.assert_allclose(at[0], [camera.width / 2, camera.height / 2], atol=1e-6)
        assert at[1, 1] < at[0, 1] - 10
        turned = np.cross(camera.eye - center, path.camera(frame + 1).eye - center)
        assert turned @ axis > 0


@pytest.mark.parametrize(("up", "offset"), [("z", [0, -7, 0]), ("y", [0, 0, 7]), ("x", [0, 0, -7])])
def test_a_film_starts_with_a_map_seen_from_the_south_and_a_model_from_its_front(up, offset):
    section = CameraSection(up=up, elevation_deg=0, radius=7.0, center=(0, 0, 0))
    np.testing.assert_allclose(camera_path(section, scene(), 4).camera(0).eye, offset, atol=1e-12)


@pytest.mark.parametrize("elevation", [-90.0, 90.0])
def test_an_orbit_over_the_pole_turns_the_picture(elevation):
    path = camera_path(CameraSection(elevation_deg=elevation), scene(), 4)
    poses = [path.path.pose(t) for t in (0, 0.25, 0.5)]
    assert angle(poses[0], poses[1]) == pytest.approx(math.pi / 2)
    assert angle(poses[0], poses[2]) == pytest.approx(math.pi)


def test_a_full_orbit_loops_and_a_partial_one_reaches_its_end():
    full = camera_path(CameraSection(sweep_deg=360), scene(), 8)
    assert np.allclose(full.path.pose(0.0), full.path.pose(1.0))
    assert angle(full.path.pose(0), full.path.pose(1 / 8)) > 0.1
    half = camera_path(CameraSection(sweep_deg=180, elevation_deg=0), scene(), 5)
    middle = np.array([5.0, 3.0, 1.0])
    assert np.allclose(half.camera(0).eye - middle, middle - half.camera(4).eye)
    assert not OrbitPath(middle, 1.0, Z, 1.0, sweep_rad=0.0).is_closed


def test_a_scene_of_one_point_can_be_seen():
    camera = camera_path(CameraSection(), scene((6.4e6,) * 3, (6.4e6,) * 3), 3).camera(1)
    at, depth = image_positions(camera, np.full((1, 3), 6.4e6))
    assert depth[0] == pytest.approx(1.0)
    assert camera.near < 1e-3
    assert np.allclose(at, [[640, 360]], atol=1e-3)


def test_near_is_a_small_share_of_the_scene_unless_given():
    assert camera_path(CameraSection(), scene(), 1).near == pytest.approx(1e-4 * math.sqrt(140) / 2)
    assert camera_path(CameraSection(near=0.5), scene(), 1).near == 0.5


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (scene(up="-y"), "-y"),
        (scene(up="auto", file="bunny.PLY", attributes=("normal", "intensity")), "y"),
        (scene(up="auto", file="statue.ply", attributes=("rgb", "normal")), "z"),
        (scene(up="auto", file="room.e57", attributes=("normal",)), "z"),
        (scene(up="auto", file="points.ply", attributes=()), "z"),
    ],
)
def test_which_way_is_up(found, expected):
    assert (up_vector(found) == axis_vector(expected)).all()


# --- keyframes


@EXAMPLES
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.sampled_from([0.0, 6.4e6]))
def test_a_path_goes_through_its_keys_and_is_smooth(seed, n_keys, shift):
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.02, 1.0, n_keys)) + np.arange(n_keys) * 1e-3
    times /= max(1.0, times[-1])
    keys = [Key(t, rng.normal(size=3) + shift, rng.normal(size=3) + shift, rng.uniform(0.1, 2.5)) for t in times]
    path = KeyframePath(tuple(keys), Z)
    for key in keys:
        pose = path.pose(key.time)
        toward = (key.target - key.eye) / np.linalg.norm(key.target - key.eye)
        np.testing.assert_allclose(pose[:3, 3], key.eye, atol=1e-8)
        np.testing.assert_allclose(-pose[:3, 2], toward, atol=1e-7)
        assert pose[2, 1] >= 0  # up is up
        assert path.fov_y_rad(key.time) == pytest.approx(key.fov_y_rad)
    sampled = np.array([path.pose(t) for t in np.linspace(0, 1, 400)])
    rotations = sampled[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (400, 3, 3)), atol=1e-9
    )
    assert all(0 < path.fov_y_rad(t) < math.pi for t in np.linspace(0, 1, 50))
    for key in keys[1:-1] if shift == 0 else []:  # the same velocity on both sides of a key
        step = 1e-8
        before, at, after = (path.pose(key.time + d)[:3] for d in (-step, 0, step))
        speed = max(np.abs(after - at).max(), np.abs(at - before).max())
        assert np.abs((after - at) - (at - before)).max() < 0.01 * speed + 1e-14


def test_opposite_views_turn_smoothly_and_never_flip():
    eye = [0.0, 0.0, 0.0]
    path = keyframes((eye, [1, 0, 0]), (eye, [-1, 0, 0]), (eye, [1, 0, 0]))
    poses = [path.pose(t) for t in np.linspace(0, 1, 2001)]
    assert max(angle(a, b) for a, b in itertools.pairwise(poses)) < 6 * 2 * math.pi / 2000
    assert min(pose[2, 1] for pose in poses) > 0.999  # the horizon stays level


def test_the_target_of_all_keys_stays_in_the_middle_and_the_horizon_level():
    target = [1.0, 2.0, 0.0]
    path = keyframes(([9, 2, 3], target), ([1, 9, 8], target), ([-9, 3, 1], target), ([1, -5, 5], target))
    for t in np.linspace(0, 1, 100):
        pose = path.pose(t)
        toward = target - pose[:3, 3]
        np.testing.assert_allclose(-pose[:3, 2], toward / np.linalg.norm(toward), atol=1e-9)
        assert abs(pose[2, 0]) < 1e-9  # right is horizontal


def test_equal_keys_are_a_rest():
    here, there = ([0, 0, 0], [1, 0, 0]), ([5, 0, 0], [9, 4, 0])
    path = keyframes(here, there, there, here)
    rest = path.pose(1 / 3)
    for t in np.linspace(1 / 3, 2 / 3, 20):
        np.testing.assert_allclose(path.pose(t), rest, atol=1e-9)
    still = keyframes(here, here)
    np.testing.assert_allclose(still.pose(0.4), still.pose(0.9), atol=1e-12)


def test_looking_straight_down_keeps_the_heading():
    path = keyframes(([0, 0, 5], [0, 5, 5]), ([0, 0, 5], [0, 0, 0]), ([0, 0, 5], [0, 5, 5]))
    poses = [path.pose(t) for t in np.linspace(0, 0.5, 50)]
    assert all(abs(pose[0, 0] - 1) < 1e-6 for pose in poses)  # right stays +x: it tilts and does not spin
    zenith = keyframes(([0, 0, 5], [0, 5, 5]), ([0, 0, 5], [0, 0, 9])).pose(1.0)
    assert zenith[0, 0] == pytest.approx(1)


def test_a_loop_is_smooth_where_it_closes():
    around = [([math.cos(a), math.sin(a), 0], [0, 0, 0]) for a in np.linspace(0, 2 * np.pi, 7)[:-1]]
    path = keyframes(*around, around[0])
    assert path.is_closed
    assert not keyframes(*around).is_closed

    def motion_around(time):
        poses = [path.pose((time + d) % 1.0) for d in np.linspace(-0.1, 0.1, 40)]
        return [(angle(a, b), np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in itertools.pairwise(poses)]

    np.testing.assert_allclose(motion_around(1.0), motion_around(1 / 3), rtol=1e-6)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ([], "found none"),
        ([Key(0, np.zeros(3), np.zeros(3), 1.0)], r"keyframes\[0\]: eye and target coincide"),
        ([Key(0.5, np.zeros(3), Z, 1.0), Key(0.5, Z, np.zeros(3), 1.0)], r"keyframes\[1\].time = 0.5, expected more"),
    ],
)
def test_keys_that_make_no_path_are_refused(keys, message):
    with pytest.raises(ConfigError, match=message):
        KeyframePath(tuple(keys), Z)


def test_keyframes_of_a_configuration_take_its_field_of_view_unless_they_have_their_own():
    section = CameraSection(
        path="keyframes",
        fov_deg=30,
        keyframes=[
            {"time": 0, "eye": (0, 0, 0), "target": (1, 0, 0)},
            {"time": 1, "eye": (2, 0, 0), "target": (3, 0, 0), "fov_deg": 60},
        ],
    )
    path = camera_path(section, scene(), 3)
    assert path.camera(1).eye[0] == pytest.approx(1)
    assert [math.degrees(path.path.fov_y_rad(t)) for t in (0, 1)] == pytest.approx([30, 60])


# --- explicit poses


def test_one_pose_a_frame():
    poses = [np.eye(4).tolist(), np.array([[0, -1, 0, 7], [1, 0, 0, 8], [0, 0, 1, 9.0]]).tolist()] * 5
    path = camera_path(CameraSection(path="poses", poses=poses), scene(), 10)
    for frame in range(10):
        assert path.camera(frame).eye.tolist() == ([7, 8, 9] if frame % 2 else [0, 0, 0])


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ([np.eye(4).tolist()], "found 1, expected 2"),
        ([np.eye(4).tolist(), np.eye(3).tolist()], r"poses\[1\]: found \[3, 3, 3\]"),
        ([np.eye(4).tolist(), (2 * np.eye(4)).tolist()], "not a rotation"),
    ],
)
def test_poses_that_fit_nothing_are_refused(poses, message):
    with pytest.raises(InputError, match=message):
        camera_path(CameraSection(path="poses", poses=poses), scene(), 2).camera(1)
