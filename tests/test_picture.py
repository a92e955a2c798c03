"""Words in, pictures out: eye-dome lighting, averaging, panoramas, depths and normals, each against its twin."""

import math

import numpy as np
import pytest
from splatpipe.nodes.picture.colour import colours, to_linear, to_stored
from splatpipe.nodes.picture.compose import Composer, PictureSettings
from splatpipe.nodes.picture.edl import EyeDomeLighting
from splatpipe.nodes.picture.panorama import CubeMap, directions, distance_per_depth, face_pixels
from splatpipe.nodes.picture.reference import reference_colours, reference_normals, reference_shades
from splatpipe.nodes.picture.rows import Rows
from splatpipe.nodes.picture.surface import Rays, depths, normals
from splatpipe.nodes.raster import PointSize, ResidentPoints
from splatpipe.nodes.raster.reference import reference_frame
from splatpipe.shared.camera import perspective_camera
from splatpipe.shared.camera_path import CameraPath, PosesPath
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from splatpipe.shared.views import CUBE_FACES, PanoramaViews, cube_face_px

GREY = np.array([30, 60, 90, 255], np.uint8)
CLEAR = np.zeros(4, np.uint8)


@pytest.fixture
def rows():
    pool = Rows(2)
    yield pool
    pool.close()


def words_of(depth, colour=0xFF80_4020) -> np.ndarray:
    """Framebuffer words of depths, empty where a depth is 0."""
    depth = np.asarray(depth, np.float32)
    words = depth.view(np.uint32).astype(np.uint64) << np.uint64(32) | np.broadcast_to(np.uint64(colour), depth.shape)
    return np.where(depth > 0, words, FRAMEBUFFER_EMPTY)


def random_words(shape, seed=1, holes=0.3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random(shape) < holes, 0, 10 * np.exp(rng.normal(0, 0.01, shape)))
    return words_of(depth, rng.integers(0, 1 << 24, shape, np.uint64) | np.uint64(0xFF00_0000))


def with_threads(n, work):
    pool = Rows(n)
    try:
        return work(pool)
    finally:
        pool.close()


# --- eye-dome lighting ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrap", [False, True])
@pytest.mark.parametrize(("strength", "radius"), [(0.05, 0.5), (0.4, 1.5), (1.0, 4.0), (0.4, 40.0)])
def test_eye_dome_lighting_is_its_twin_with_any_number_of_threads(wrap, strength, radius):
    words = random_words((37, 53))
    light = EyeDomeLighting(strength, radius, wrap=wrap)
    found = with_threads(1, lambda pool: light.shades(words, pool))
    assert np.abs(found - reference_shades(words, strength, radius, wrap=wrap)).max() < 1e-4
    assert (found[words == FRAMEBUFFER_EMPTY] == 1).all()
    assert found.min() < 0.9 < found.max()
    for threads in (2, 5):
        assert np.array_equal(found, with_threads(threads, lambda pool: light.shades(words, pool)))


def test_only_what_lies_behind_a_step_darkens_and_the_same_at_every_scale(rows):
    depth = np.full((20, 20), 8.0)
    depth[:, 10:] = 8.2
    depth[5, 3] = 0  # a hole darkens nobody
    light = EyeDomeLighting(0.4, 1.0, wrap=False)
    found = light.shades(words_of(depth), rows)
    assert (found[:, :10] == 1).all()
    assert (found[:, 11:] == 1).all()
    expected = math.exp(-300 * 0.4 * 3 / 8 * math.log2(8.2 / 8))
    np.testing.assert_allclose(found[1:-1, 10], expected, rtol=1e-4)
    far = light.shades(words_of(depth * 1024), rows)
    assert np.array_equal(far, found)


# --- averaging -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("background", [GREY, CLEAR])
@pytest.mark.parametrize("s", [1, 2, 3])
def test_averages_are_their_twin_with_any_number_of_threads(bits, background, s):
    words = random_words((12 * s, 15 * s))
    shades = np.random.default_rng(2).random(words.shape, np.float32)
    for given in (shades, None):
        found = with_threads(1, lambda pool, given=given: colours(words, given, background, s, bits, pool))
        exact = reference_colours(words, np.ones(words.shape) if given is None else given, background, s, bits)
        assert found.dtype == (np.uint8 if bits == 8 else np.uint16)
        assert np.abs(found - exact).max() <= 0.5 + 0.02
        assert np.array_equal(
            found, with_threads(3, lambda pool, given=given: colours(words, given, background, s, bits, pool))
        )


def test_an_even_picture_stays_as_it_is_and_halves_average_as_light(rows):
    even = words_of(np.full((4, 6), 3.0), 0xFF80_4020)
    assert (colours(even, None, GREY, 2, 8, rows) == (0x20, 0x40, 0x80, 255)).all()
    black_and_white = np.where(
        np.indices((4, 4)).sum(axis=0) % 2, words_of(3.0, 0xFFFF_FFFF), words_of(3.0, 0xFF00_0000)
    )
    half = colours(black_and_white, None, GREY, 2, 16, rows)
    assert (half[..., :3] == round(65535 * float(to_stored(np.array(0.5))))).all()
    assert (half[..., 3] == 65535).all()


def test_edges_on_a_transparent_background_keep_the_colour_of_their_points(rows):
    depth = np.zeros((2, 4))
    depth[0, 0] = depth[:, 2] = 5.0
    found = colours(words_of(depth, 0xFF10_20C8), None, CLEAR, 2, 8, rows)
    np.testing.assert_array_equal(found[0], [(0xC8, 0x20, 0x10, 64), (0xC8, 0x20, 0x10, 128)])


def test_srgb_there_and_back():
    stored = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(to_stored(to_linear(stored)), stored, atol=1e-12)
    assert float(to_linear(np.array(188 / 255))) == pytest.approx(0.503, abs=1e-3)


# --- depths and normals --------------------------------------------------------------------------------------------


def test_depth_is_that_of_the_nearest_drawn_pixel():
    drawn = np.array([[4, 3, 0, 0], [9, 0, 0, 0]])
    np.testing.assert_array_equal(depths(words_of(drawn), 2), [[3, 0]])
    np.testing.assert_array_equal(depths(words_of(drawn), 1), drawn)


def camera_of(width=48, height=32, shift=0.0, fov=0.9):
    camera = perspective_camera(
        frame=0, world_from_camera=np.eye(4), fov_y_rad=fov, width=width, height=height, near=0.1
    )
    return camera.shifted(shift)


def plane_depth(rays, normal, distance):
    """Depths at which the rays meet normal · p = −distance."""
    slope = (
        np.outer(rays.level, rays.x) * normal[0]
        + rays.y[:, None] * normal[1]
        + np.outer(rays.level, rays.z) * normal[2]
    )
    return np.where(slope < -1e-3, -distance / slope, 0).astype(np.float32)


@pytest.mark.parametrize("shift", [0.0, 0.4])
@pytest.mark.parametrize("normal", [(0, 0, 1), (0.3, 0.2, 0.933), (0, 0.8, 0.6), (-0.6, 0.0, 0.8)])
def test_the_normals_of_a_plane_are_its_own_also_with_an_off_axis_frustum(rows, normal, shift):
    rays = Rays.of_camera(camera_of(shift=shift), 1)
    found = normals(plane_depth(rays, normal, 7.0), rays, rows)
    seen = found[..., 3] == 255
    assert seen.mean() > 0.9
    off = found[seen][:, :3] / 127.5 - 1 - np.array(normal)
    assert np.abs(off).max() < 0.03


def test_the_normals_of_the_ground_and_a_wall_in_a_panorama(rows):
    rays = Rays.of_panorama(96, 48)
    ground, wall = plane_depth(rays, (0, 1, 0), 2.0), plane_depth(rays, (0, 0, 1), 3.0)
    depth = np.where((wall > 0) & ((ground == 0) | (wall < ground)), wall, ground)
    found = normals(depth, rays, rows)
    for at, normal in (((40, 48), (0, 1, 0)), ((40, 5), (0, 1, 0)), ((20, 48), (0, 0, 1)), ((25, 40), (0, 0, 1))):
        np.testing.assert_allclose(found[at][:3] / 127.5 - 1, normal, atol=0.03)
    assert (found[:10, :20] == 0).all(), "behind there is nothing above the horizon"


@pytest.mark.parametrize("rays", [Rays.of_camera(camera_of(30, 20, 0.1), 1), Rays.of_panorama(30, 20)])
def test_normals_are_their_twin_with_any_number_of_threads(rays):
    rng = np.random.default_rng(4)
    depth = (5 + rng.random((10, 15))).repeat(2, axis=0).repeat(2, axis=1).astype(np.float32)  # squares of 2 px
    depth[rng.random(depth.shape) < 0.2] = 0
    found = with_threads(1, lambda pool: normals(depth, rays, pool))
    exact = reference_normals(depth, rays)
    known = ~np.isnan(exact).any(axis=-1)
    assert np.array_equal(found[..., 3] == 255, known)
    assert known.mean() > 0.5
    assert np.abs(found[known][:, :3] - (exact[known] + 1) * 127.5).max() < 0.51
    assert np.array_equal(found, with_threads(3, lambda pool: normals(depth, rays, pool)))


# --- panoramas -----------------------------------------------------------------------------------------------------


def panorama_views(width, height, pose=None):
    pose = np.eye(4)[[0, 2, 1, 3]] * [1, 1, -1, 1] if pose is None else pose  # looks along y, z is up
    side = cube_face_px(width, height)
    path = PosesPath(pose[None], 1.0, np.zeros(3), 1.0)
    return PanoramaViews(CameraPath(path, 1, side, side, 1e-3, np.array([0.0, 0.0, 1.0])))


def panorama(points, colour, width, height, views, **settings):
    """The composed picture of points in the world."""
    x, y, z = np.ascontiguousarray(points.T, np.float32)
    resident = ResidentPoints(x, y, z, colour, np.zeros(1, np.int64), np.zeros((1, 3)))
    entries = np.array([(0, len(points), 1)], RENDER_POINT)
    with Composer(picture_settings("panorama", width, height, **settings)) as composer:
        for face in range(6):
            camera = views.camera(face)
            picture = composer.add(face, camera, reference_frame(resident, camera, entries, PointSize(1)))
            assert (picture is None) == (face < 5)
    return picture


def picture_settings(view, width, height, **changed):
    settings = {
        "view": view, "layout": "side-by-side", "width": width, "height": height, "supersampling": 1, "bits": 8,
        "background": GREY, "edl_strength": 0.0, "edl_radius_px": 1.5, "colours": True, "depth": True, "normals": False,
        "threads": 2,
    }  # fmt: skip
    return PictureSettings(**(settings | changed))


def test_faces_are_right_handed_and_cover_every_direction_once():
    for axes in CUBE_FACES:
        np.testing.assert_array_equal(np.cross(axes[0], axes[1]), axes[2])
    np.testing.assert_array_equal(np.abs(CUBE_FACES[:, 2]).sum(axis=1), np.ones(6))
    assert len(np.unique(CUBE_FACES[:, 2], axis=0)) == 6


def test_what_lies_at_a_known_bearing_is_at_its_pixel():
    width, height = 360, 180  # a pixel a degree
    azimuth = np.radians([0.5, 45.5, 90.5, 179.5, -179.5, -90.5, -44.5, 10.5, 10.5])
    elevation = np.radians([0.5, 0.5, -30.5, 10.5, 10.5, 40.5, 50.5, 88.5, -88.5])
    towards = np.column_stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)]
    )
    distance = np.arange(3.0, 12.0)
    found = panorama(
        towards * distance[:, None], np.full(9, 0xFFFF_FFFF, np.uint32), width, height, panorama_views(width, height)
    )
    for a, e, d in zip(np.degrees(azimuth), np.degrees(elevation), distance, strict=True):
        row, column = int(90 - e), int(a + 180)
        around = found.depth[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        assert around.max() == pytest.approx(d, rel=0.01), (a, e)


def test_a_sphere_around_the_eye_has_no_seam_in_colour_depth_or_light():
    width, height = 128, 64
    n = 600_000
    rng = np.random.default_rng(7)
    towards = rng.normal(size=(n, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    shade = np.rint((towards + 1) * 127.5).astype(np.uint32)
    colour = shade[:, 0] | shade[:, 1] << 8 | shade[:, 2] << 16 | np.uint32(0xFF00_0000)
    views = panorama_views(width, height)
    found = panorama(5 * towards, colour, width, height, views)
    assert (found.depth > 0).all()
    np.testing.assert_allclose(found.depth, 5.0, rtol=1 / views.width)  # half a pixel of a face is that much
    expected = np.array(list(directions(width, height)))[..., [0, 2, 1]] * [1, -1, 1]
    assert np.abs(found.rgba[..., :3] - (expected + 1) * 127.5).max() < 127.5 * 3 / views.width * 1.5
    lit = panorama(5 * towards, colour, width, height, views, edl_strength=0.02)
    dark = found.rgba[..., :3].astype(int) - lit.rgba[..., :3]
    assert dark.max() <= 0.06 * 255, "depths differ by less than a step that shows"


def test_depth_of_a_floor_is_continuous_over_the_edges_of_the_cube():
    width, height, face = 256, 128, cube_face_px(256, 128)
    cube = CubeMap(width, height, face)
    slope = (np.arange(face) + 0.5) / face * 2 - 1
    pool = Rows(2)
    for number, axes in enumerate(CUBE_FACES):
        ray = slope[None, :, None] * axes[0] - slope[:, None, None] * axes[1] - axes[2]
        down = ray[..., 1]
        cube.add(number, words_of(np.where(down < -0.05, 2 / -down.clip(max=-0.05), 0)), pool)
    pool.close()
    depth = depths(cube.words, 1)
    up = np.array([direction[:, 1] for direction in directions(width, height)])
    below = up < -0.1
    assert np.abs(depth[below] * -up[below] / 2 - 1).max() < 1.5 / face / 0.1


def test_the_cube_map_is_a_gather(rows):
    cube = CubeMap(50, 31, 17)
    faces = np.stack([random_words((17, 17), seed) for seed in range(6)])
    for number, words in enumerate(faces):
        cube.add(number, words, rows)
    stretch = distance_per_depth(17)
    for row, direction in enumerate(directions(50, 31)):
        face, source = face_pixels(direction, 17)
        words = faces.reshape(6, -1)[face, source]
        np.testing.assert_array_equal(
            depths(cube.words[row : row + 1], 1)[0], depths(words[None], 1)[0] * stretch[source]
        )
        np.testing.assert_array_equal(cube.words[row] & np.uint64(0xFFFF_FFFF), words & np.uint64(0xFFFF_FFFF))


def test_the_horizon_is_level_and_ahead_is_in_the_middle_whatever_the_tilt():
    def looking(axis, up):
        right = np.cross(axis, up)
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([right, np.cross(right, axis), -np.array(axis)])
        return pose

    tilted = (0.6, 0.0, -0.8)
    for pose, ahead in (
        (looking(tilted, (0.8, 0.0, 0.6)), (1, 0, 0)),
        (looking((0.0, 0.0, -1.0), (0.0, 1.0, 0.0)), (0, 1, 0)),
        (looking((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)), (1, 0, 0)),
    ):
        views = panorama_views(64, 32, pose)
        np.testing.assert_allclose(views.camera(0).clip_from_world[3, :3], ahead, atol=1e-12)
        np.testing.assert_allclose(views.camera(4).clip_from_world[3, :3], (0, 0, 1), atol=1e-12)


# --- composition ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("layout", "axis"), [("side-by-side", 1), ("over-under", 0)])
def test_a_pair_is_two_pictures_that_do_not_darken_each_other(layout, axis):
    eyes = words_of(np.full((6, 8), 4.0), 0xFF00_00FF), words_of(np.full((6, 8), 40.0), 0xFF00_FF00)
    with Composer(picture_settings("stereo", 8, 6, layout=layout, edl_strength=1.0, normals=True)) as composer:
        assert composer.add(0, camera_of(8, 6), eyes[0]) is None
        found = composer.add(1, camera_of(8, 6), eyes[1])
    left, right = np.split(found.rgba, 2, axis=axis)
    assert (left == (255, 0, 0, 255)).all()
    assert (right == (0, 255, 0, 255)).all()
    assert [d.mean() for d in np.split(found.depth, 2, axis=axis)] == [4, 40]
    assert (found.normals == (128, 128, 255, 255)).all()


def test_sixteen_bits_of_a_plain_picture_are_its_eight():
    words = random_words((5, 7))
    with (
        Composer(picture_settings("mono", 7, 5)) as eight,
        Composer(picture_settings("mono", 7, 5, bits=16)) as sixteen,
    ):
        plain = eight.add(0, camera_of(7, 5), words).rgba
        assert np.array_equal(sixteen.add(0, camera_of(7, 5), words).rgba, plain.astype(np.uint16) * 257)
