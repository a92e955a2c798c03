"""Colouring: every mode against its definition, what auto takes, and one line for what cannot be done."""

import re

import numpy as np
import pytest
from build_sources import ArraySource
from matplotlib import colormaps
from splatpipe.shared import colour
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.colour import Colouring, colour_words, frame_to_rgba, map_scalars, parse_colour, shade
from splatpipe.shared.errors import ConfigError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY
from splatpipe.shared.points import NO_NORMAL, pack_normals, pack_rgb, unpack_normals, unpack_rgb
from splatpipe.shared.store import Scene

N = 3000
SHIFT = 6.4e6


@pytest.fixture(scope="module")
def columns():
    rng = np.random.default_rng(11)
    return {
        "rgb": pack_rgb(*rng.integers(0, 256, (3, N)).astype(np.uint8)),
        "normal": pack_normals(rng.normal(size=(N, 3))),
        "intensity": rng.exponential(100, N).astype(np.float32),
        "classification": rng.integers(0, 25, N).astype(np.uint8),
    }


@pytest.fixture(scope="module")
def make_scene(tmp_path_factory):
    def make(attributes, **settings):
        positions = np.random.default_rng(3).uniform(size=(N, 3)) * [100, 80, 20] + SHIFT
        path = tmp_path_factory.mktemp("scene") / "s.scene"
        settings = BuildSettings(**{"points_per_cell": 60, "threads": 1, "up": "z"} | settings)
        build_scene([ArraySource(positions, attributes)], path, settings=settings)
        return Scene.open(path)

    return make


@pytest.fixture(scope="module", params=["layered", "depth-first"])
def scene(request, make_scene, columns):
    return make_scene(columns, point_order=request.param)


def words_of(scene, mode, **options):
    words = colour_words(scene, Colouring.choose(scene, mode, **options))
    assert words.dtype == np.uint32
    assert len(words) == scene.info.n_stored
    return words


def mapped(values, low, high, name="viridis"):
    """matplotlib's own way from values to colour words."""
    entry = np.rint(np.clip((values - low) / (high - low), 0, 1) * 255).astype(int)
    rgba = (np.array(colormaps[name](entry)) * 255).astype(np.uint8)
    return rgba.view("<u4").ravel()


def test_rgb_is_the_stored_column(scene):
    np.testing.assert_array_equal(words_of(scene, "rgb"), scene.attribute("rgb"))


def test_intensity_maps_the_given_range(scene):
    words = words_of(scene, "intensity", value_range=(10.0, 200.0), colormap="magma")
    np.testing.assert_array_equal(words, mapped(scene.attribute("intensity"), 10.0, 200.0, "magma"))


def test_a_range_turned_round_turns_the_colours(scene):
    up, down = (words_of(scene, "intensity", value_range=r) for r in [(0.0, 200.0), (200.0, 0.0)])
    brightest, darkest = scene.attribute("intensity").argmax(), scene.attribute("intensity").argmin()
    assert up[brightest] == down[darkest]


def test_the_default_range_leaves_out_the_outermost_fiftieth(scene):
    values = scene.attribute("intensity")
    expected = mapped(values, *np.percentile(values, [2, 98]))
    np.testing.assert_array_equal(words_of(scene, "intensity"), expected)


@pytest.mark.parametrize(("up", "axis", "sign"), [("z", 2, 1), ("x", 0, 1), ("y", 1, 1)])
def test_elevation_is_the_world_coordinate_along_up(make_scene, columns, up, axis, sign):
    scene = make_scene({"rgb": columns["rgb"]}, up=up)
    first, origin = scene.blocks()
    block = np.searchsorted(first, np.arange(scene.info.n_stored), side="right") - 1
    world = sign * (origin[block, axis] + scene.positions()[axis])
    low, high = SHIFT + 1.0, SHIFT + 15.0
    words = words_of(scene, "elevation", value_range=(low, high))
    np.testing.assert_array_equal(words, mapped(world, low, high))


def test_level_is_that_of_the_cell_that_owns_the_point(scene):
    octree = scene.octree()
    level = np.full(scene.info.n_stored, -1)
    for cell in range(len(octree)):  # breadth-first: in depth-first order the leaf comes last
        level[octree.first_point[cell] :][: octree.n_points[cell]] = octree.level[cell]
    assert len(np.unique(level)) > 1
    words = words_of(scene, "level", value_range=(0.0, 4.0))
    np.testing.assert_array_equal(words, mapped(level, 0.0, 4.0))


def test_classes_have_the_colours_of_the_table(scene):
    rgba = unpack_rgb(words_of(scene, "classification"))
    codes = scene.attribute("classification")
    for code in np.unique(codes):
        expected = colour.CLASS_COLOURS.get(code, colour.OTHER_CLASS)
        found = {"#" + bytes(row[:3]).hex() for row in np.unique(rgba[codes == code], axis=0)}
        assert found == {expected}
    assert (rgba[:, 3] == 255).all()


def test_normals_are_shaded_within_three_steps_of_255(make_scene, columns):
    normals = columns["normal"].copy()
    normals[::10] = NO_NORMAL
    normals[1::10] = pack_normals(np.array([[0.0, 0.0, -1.0]]))  # its word is next to that of no normal
    scene = make_scene({"normal": normals})
    found = unpack_rgb(words_of(scene, "normal")).astype(int)
    expected = unpack_rgb(shade(unpack_normals(scene.attribute("normal")), np.array([0.0, 0.0, 1.0]))).astype(int)
    assert np.abs(found - expected).max() <= 3
    bare = scene.attribute("normal") == NO_NORMAL
    np.testing.assert_array_equal(found[bare], expected[bare])


def test_one_colour_for_all(scene):
    assert set(words_of(scene, "#102030").tolist()) == {0xFF302010}


def test_words_do_not_depend_on_how_many_are_made_at_a_time(scene, monkeypatch):
    modes = ["elevation", "level", "normal", "classification"]
    whole = [words_of(scene, mode) for mode in modes]
    monkeypatch.setattr(colour, "_CHUNK", 37)
    for mode, words in zip(modes, whole, strict=True):
        np.testing.assert_array_equal(words_of(scene, mode), words)


@pytest.mark.parametrize(
    ("keep", "constant", "expected"),
    [
        (["rgb", "normal", "intensity"], [], "rgb"),
        (["rgb", "normal", "intensity"], ["rgb"], "normal"),
        (["normal", "intensity", "classification"], ["normal"], "intensity"),
        (["intensity", "classification"], ["intensity"], "elevation"),
        (["classification"], [], "elevation"),
    ],
)
def test_auto_takes_the_first_that_tells_something(make_scene, columns, keep, constant, expected):
    chosen = {name: columns[name] for name in keep}
    for name in constant:
        chosen[name] = np.full_like(chosen[name], chosen[name][0])
    colouring = Colouring.choose(make_scene(chosen), "auto")
    assert colouring.mode == expected
    assert colouring.attribute == (expected if expected != "elevation" else None)


@pytest.mark.parametrize(
    ("mode", "options", "message"),
    [
        ("rgb", {}, r"render.colour = 'rgb': the scene has intensity"),
        ("colour", {}, r"render.colour = 'colour', expected one of auto, rgb,"),
        ("#12345", {}, r"render.colour = '#12345', expected #rrggbb"),
        ("elevation", {"colormap": "virids"}, r"render.colormap = 'virids', expected .* such as viridis"),
        ("elevation", {"value_range": (2.0, 2.0)}, r"render.colour_range = \[2.0, 2.0\], expected two different"),
        ("elevation", {"value_range": (0.0, np.inf)}, r"render.colour_range"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(make_scene, columns, mode, options, message):
    scene = make_scene({"intensity": columns["intensity"]})
    with pytest.raises(ConfigError) as caught:
        Colouring.choose(scene, mode, **options)
    assert re.match(message, str(caught.value))
    assert "\n" not in str(caught.value)


def test_classes_have_the_colours_that_a_run_gives_them(make_scene, columns):
    scene = make_scene({"classification": columns["classification"]})
    own = {"2": "#010203", "200": "white"}
    words = colour_words(scene, Colouring.choose(scene, "classification", class_colours=own))
    codes = np.asarray(scene.attribute("classification"))
    np.testing.assert_array_equal(unpack_rgb(words[codes == 2]) == [1, 2, 3, 255], True)
    np.testing.assert_array_equal(words[codes != 2], words_of(scene, "classification")[codes != 2])


@pytest.mark.parametrize(
    ("key", "colour", "message"),
    [
        ("256", "red", r"render\.class_colours\.256: found class '256', expected a code of 0…255"),
        ("02", "red", r"render\.class_colours\.02: found class '02'"),
        ("ground", "red", r"render\.class_colours\.ground: found class 'ground'"),
        ("6", "rde", r"render\.class_colours\.6 = 'rde', expected #rrggbb"),
        ("6", "transparent", r"render\.class_colours\.6 = 'transparent', expected #rrggbb .*; filter\.classes"),
    ],
)
def test_colours_of_no_class_and_no_colours_are_refused(make_scene, columns, key, colour, message):
    scene = make_scene({"intensity": columns["intensity"]})
    with pytest.raises(ConfigError, match=message):
        Colouring.choose(scene, "intensity", class_colours={"1": "blue", key: colour})


def test_values_that_are_no_numbers_and_constant_values_have_a_colour(make_scene, columns):
    table = np.arange(256, dtype=np.uint32)
    values = np.array([np.nan, -np.inf, np.inf, 0.0, 0.5, 1.0, 7.0], np.float32)
    assert map_scalars(values, 0.0, 1.0, table).tolist() == [0, 0, 255, 0, 128, 255, 255]
    assert map_scalars(np.full(3, 5.0), 5.0, 5.0, table).tolist() == [128] * 3
    huge = np.array([-1e308, 1e308])
    assert map_scalars(huge, -1e308, 1e308, table).tolist() == [0, 255]
    nothing = make_scene({"intensity": np.full(N, np.nan, np.float32)})
    assert len(set(words_of(nothing, "intensity").tolist())) == 1


def test_shading_is_bright_towards_the_light_and_dim_but_visible_away_from_it():
    up = np.array([0.0, 1.0, 0.0])
    normals = np.array([[0, 1, 0], [0, -1, 0], [1, 0, 0], [0, 0, 0]], np.float32)
    rgba = unpack_rgb(shade(normals, up)).astype(int)
    brightness = rgba[:, :3].sum(axis=1)
    assert brightness[0] > 1.2 * brightness[1] > 200
    assert (rgba[:, 3] == 255).all()
    assert np.ptp(rgba[3, :3]) < 32  # without a normal: grey


@pytest.mark.parametrize(
    ("text", "expected"),
    [("#1e2127", (30, 33, 39, 255)), ("white", (255, 255, 255, 255)), ("transparent", (0, 0, 0, 0))],
)
def test_background_colours(text, expected):
    assert tuple(parse_colour(text, "render.background")) == expected


def test_an_unknown_background_is_refused():
    with pytest.raises(ConfigError, match=r"render\.background = 'blurple', expected #rrggbb"):
        parse_colour("blurple", "render.background")


def test_a_frame_becomes_an_image():
    words = np.full((2, 3), FRAMEBUFFER_EMPTY)
    words[0, 1] = (0x3F800000 << 32) | 0xFF030201
    image = frame_to_rgba(words, parse_colour("#a0b0c0", "background"))
    assert image.shape == (2, 3, 4)
    assert image[0, 1].tolist() == [1, 2, 3, 255]
    image[0, 1] = (0xA0, 0xB0, 0xC0, 255)
    assert (image == [0xA0, 0xB0, 0xC0, 255]).all()
