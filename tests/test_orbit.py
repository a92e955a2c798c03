"""Motions of a camera about a target: what stays where it is, and the poles."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.camera_path import axis_vector
from splatpipe.shared.errors import InputError
from splatpipe.shared.orbit import FARTHEST, NEAREST, Orbit, up_of_pose

UPS = ["x", "y", "z", "-x", "-y", "-z"]
ups = st.sampled_from(UPS).map(axis_vector)
angles = st.floats(-10, 10)
shares = st.floats(-2, 2)
places = st.tuples(*3 * [st.floats(-1e6, 1e6)]).map(np.array)
orbits = st.builds(
    Orbit,
    target=places,
    distance=st.floats(0.1, 100),
    up=ups,
    azimuth_rad=st.floats(-3, 3),
    elevation_rad=st.floats(-math.pi / 2, math.pi / 2),
    fov_y_rad=st.floats(0.2, 2),
    scale=st.just(10.0),
)


def in_picture(orbit, place):
    """(x, y) of a world place in shares of the height from the middle, y upwards."""
    camera = perspective_camera(
        frame=0, world_from_camera=orbit.pose(), fov_y_rad=orbit.fov_y_rad, width=1000, height=1000, near=1e-9
    )
    x, y, _, w = camera.clip_from_world[:, :3] @ (place - camera.eye)
    return np.array([x, y]) / w / 2


def is_rigid(pose):
    return np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12) and np.linalg.det(pose[:3, :3]) > 0


@given(orbits, angles, angles)
def test_turning_keeps_target_and_distance_and_stops_at_the_poles(orbit, azimuth_rad, elevation_rad):
    turned = orbit.turned(azimuth_rad, elevation_rad)
    assert is_rigid(turned.pose())
    assert abs(turned.elevation_rad) <= math.pi / 2
    assert math.dist(turned.eye, turned.target) == pytest.approx(orbit.distance, rel=1e-6)
    assert in_picture(turned, turned.target) == pytest.approx([0, 0], abs=1e-6)
    assert turned.pose()[:3, 1] @ orbit.up >= -1e-12, "never upside down"


@given(orbits, shares, shares)
def test_panning_moves_what_is_as_deep_as_the_target_by_shares_of_the_height(orbit, right, up):
    panned = orbit.panned(right, up)
    assert in_picture(panned, orbit.target) == pytest.approx([-right, -up], abs=1e-5)
    assert np.array_equal(panned.pose()[:3, :3], orbit.pose()[:3, :3])


@given(orbits, st.floats(0.01, 100), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_zooming_keeps_what_is_under_the_pointer(orbit, factor, x, y):
    pose, height = orbit.pose(), 2 * orbit.distance * math.tan(orbit.fov_y_rad / 2)
    under = orbit.target + height * (x * pose[:3, 0] + y * pose[:3, 1])
    zoomed = orbit.zoomed(factor, x, y)
    assert zoomed.distance == pytest.approx(orbit.distance / factor)
    assert in_picture(zoomed, under) == pytest.approx([x, y], abs=1e-4)


def test_zooming_has_ends():
    orbit = Orbit(np.zeros(3), 10.0, axis_vector("z"), 0.0, 0.3, 0.8, 10.0)
    assert orbit.zoomed(1e300).distance == 10 * NEAREST
    assert orbit.zoomed(1e-300).distance == 10 * FARTHEST


@given(orbits, shares, shares, shares)
def test_flying_moves_eye_and_target_alike(orbit, right, up, ahead):
    flown = orbit.flown(right, up, ahead)
    moved = np.linalg.solve(orbit.pose()[:3, :3], flown.target - orbit.target) / orbit.distance
    assert moved == pytest.approx([right, up, -ahead], abs=1e-6)
    assert flown.eye - orbit.eye == pytest.approx(flown.target - orbit.target, abs=1e-6)


@given(orbits)
def test_an_orbit_is_found_again_from_its_eye(orbit):
    again = Orbit.seen_from(orbit.eye, orbit.target, orbit.up, fov_y_rad=orbit.fov_y_rad)
    assert again.eye == pytest.approx(orbit.eye, abs=1e-6)
    assert again.elevation_rad == pytest.approx(orbit.elevation_rad, abs=1e-6)
    aimed = orbit.aimed(orbit.target + 0.3)
    assert aimed.eye == pytest.approx(orbit.eye, abs=1e-6)


@pytest.mark.parametrize("up", UPS)
def test_straight_above_it_looks_down_whatever_the_azimuth(up):
    axis = axis_vector(up)
    seen = Orbit.seen_from(5 * axis, np.zeros(3), axis, fov_y_rad=0.8)
    assert seen.elevation_rad == pytest.approx(math.pi / 2)
    for azimuth_rad in (0.0, 1.0, 3.0):
        pose = seen.turned(azimuth_rad, 0.0).pose()
        assert is_rigid(pose)
        assert -pose[:3, 2] == pytest.approx(-axis, abs=1e-12)
    low = Orbit.seen_from(-5 * axis, np.zeros(3), axis, fov_y_rad=0.8)
    assert low.elevation_rad == pytest.approx(-math.pi / 2)


def test_a_box_is_in_the_picture_and_its_middle_in_the_middle():
    lower, upper = np.array([6.4e6, 0, -3]), np.array([6.4e6 + 30, 10, 5])
    orbit = Orbit.around(lower, upper, axis_vector("z"), fov_y_rad=0.8, aspect=1.5, azimuth_rad=0.4)
    corners = [in_picture(orbit, np.where(np.array(which), upper, lower)) for which in np.ndindex(2, 2, 2)]
    assert (np.abs(corners).max(axis=0) <= [0.75 + 1e-6, 0.5 + 1e-6]).all()
    assert in_picture(orbit, (lower + upper) / 2) == pytest.approx([0, 0], abs=1e-6)


@given(orbits)
def test_up_of_a_pose_gives_the_pose_back(orbit):
    pose = orbit.pose()
    again = look_at(np.zeros(3), -pose[:3, 2], up_of_pose(pose, orbit.distance, orbit.up))
    assert again[:3, :3] == pytest.approx(pose[:3, :3], abs=1e-6)


@pytest.mark.parametrize("eye", [(1.0, 2, 3), (math.nan, 0, 0), (math.inf, 0, 0)])
def test_a_camera_needs_two_places(eye):
    with pytest.raises(InputError, match="expected two places"):
        Orbit.seen_from(np.array(eye), np.array([1.0, 2, 3]), axis_vector("z"), fov_y_rad=0.8)
