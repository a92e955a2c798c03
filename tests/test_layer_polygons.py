"""Polygons: any outline comes apart into fans that fill its inside once; shaders and techniques make the same prisms."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from layer_example import TECHNIQUES, captured, look_at_box
from splatpipe.nodes.layers.expand_polygons import strips, triangles
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.shared.errors import InputError
from splatpipe.shared.layer_config import LayerSection
from splatpipe.shared.layers.layer import check_layer
from splatpipe.shared.layers.layer_store import open_layer, write_layer
from splatpipe.shared.layers.outlines import DONE, TOO_MANY_ABREAST, TOO_MANY_CROSSINGS, fans
from splatpipe.shared.layers.polygons import polygon_layer
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT

needs_gl = pytest.mark.skipif(not gl_available()[0], reason=gl_available()[1])

SQUARE = [(0, 0), (10, 0), (10, 10), (0, 10)]
HOLE = [(2, 2), (4, 2), (4, 4), (2, 4)]
COURT = [(0, 0), (10, 0), (10, 10), (6, 10), (6, 4), (4, 4), (4, 10), (0, 10)]
BOW_TIE = [(0, 0), (10, 10), (10, 0), (0, 10)]
STAR = [(0, 10), (6, -8), (-10, 3), (10, 3), (-6, -8)]


def fanned(rings):
    """(t, 3, 2) triangles and (s, 2, 2) sides."""
    point, apex, side, status = fans([np.array(ring, np.int64) for ring in rings])
    assert status == DONE
    if not len(point):
        return np.empty((0, 3, 2)), np.empty((0, 2, 2))
    start, end, apex = point[:-1], point[1:], apex[:-1]
    fills = (start != apex).any(axis=1) & (end != apex).any(axis=1)
    assert not side[-1]
    return np.stack([apex, start, end], axis=1)[fills], np.stack([start, end], axis=1)[side[:-1]]


def cross(a, b, c):
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


def areas(found):
    return cross(found[:, 0], found[:, 1], found[:, 2]) / 2


def is_inside(rings, points):
    """The even-odd rule itself."""
    crossed = np.zeros(len(points), int)
    for ring in rings:
        for a, b in zip(np.array(ring, float), np.roll(np.array(ring, float), -1, axis=0), strict=True):
            if a[1] == b[1]:
                continue
            between = (a[1] > points[:, 1]) != (b[1] > points[:, 1])
            crossed += between & (points[:, 0] < (b[0] - a[0]) * (points[:, 1] - a[1]) / (b[1] - a[1]) + a[0])
    return crossed % 2


def covered(found, points):
    count = np.zeros(len(points), int)
    for a, b, c in found.astype(float):
        count += (cross(a, b, points) > 0) & (cross(b, c, points) > 0) & (cross(c, a, points) > 0)
    return count


def check_sides(found, sides):
    """Sides are what is left of the triangles' edges when those that two of them share vanish, the inside on the left."""
    edges = {}
    for triangle in found:
        for i in range(3):
            a, b = tuple(triangle[i]), tuple(triangle[(i + 1) % 3])
            if edges.get((b, a), 0):
                edges[b, a] -= 1
            else:
                edges[a, b] = edges.get((a, b), 0) + 1
    left = sorted(edge for edge, n in edges.items() for _ in range(n))
    assert left == sorted((tuple(a), tuple(b)) for a, b in sides)


coordinate = st.integers(-(1 << 20), 1 << 20)
outline = st.lists(st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=9), min_size=1, max_size=3)


@settings(deadline=None, max_examples=150)
@given(outline, st.integers(0, 1000))
def test_random_outlines_are_filled_once_where_the_even_odd_rule_says(rings, seed):
    found, sides = fanned(rings)
    points = np.random.default_rng(seed).uniform(-(1 << 20), 1 << 20, (300, 2))
    count = covered(found, points)
    assert (count <= 1).all()
    wrong = count != is_inside(rings, points)
    assert wrong.sum() <= 1  # crossings are rounded, by less than a unit in two million
    assert (areas(found) > 0).all()
    check_sides(found, sides)


step = st.tuples(st.integers(0, 1), st.integers(-3, 3))


@settings(deadline=None, max_examples=150)
@given(st.lists(st.lists(step, min_size=2, max_size=12), min_size=1, max_size=3))
def test_outlines_along_the_axes_touch_and_overlap_themselves_without_harm(walks):
    rings = []
    for walk in walks:
        at, ring = [0, 0], []
        for axis, length in walk:
            at[axis] += length
            ring.append(tuple(at))
        rings.append([*ring, (ring[-1][0], ring[0][1])])
    found, sides = fanned(rings)
    points = np.stack(np.meshgrid(np.arange(-36, 37), np.arange(-36, 37)), axis=-1).reshape(-1, 2) + 0.5
    points += np.random.default_rng(0).uniform(-0.4, 0.4, points.shape)
    assert np.array_equal(covered(found, points), is_inside(rings, points))
    check_sides(found, sides)


@pytest.mark.parametrize(
    ("rings", "area", "n_triangles", "n_sides"),
    [
        ([SQUARE], 100, 2, 4),
        ([SQUARE[::-1]], 100, 2, 4),
        ([[*SQUARE, SQUARE[0]]], 100, 2, 4),
        ([[p for p in SQUARE for _ in range(3)]], 100, 2, 4),
        ([[(0, 0), (5, 0), (10, 0), (10, 10), (0, 10)]], 100, 3, 5),
        ([COURT], 88, 6, 8),
        ([SQUARE, HOLE], 96, 8, 8),
        ([SQUARE, HOLE[::-1]], 96, 8, 8),
        ([SQUARE, SQUARE], 0, 0, 0),
        ([SQUARE, [(0, 0), (10, 0), (10, 4), (0, 4)]], 60, 2, 4),
        ([BOW_TIE], 50, 2, 6),
        ([[*SQUARE, (0, 0), (2, 2), (2, 4), (4, 4), (4, 2), (2, 2)]], 96, 8, 8),  # a hole at the end of a cut
        ([[(0, 0), (10, 0), (20, 0), (10, 0), (10, 10), (0, 10)]], 100, 2, 4),  # a spike
        ([[(0, 0), (10, 0), (5, 0)]], 0, 0, 0),
        ([[(1, 1), (1, 1), (1, 1)]], 0, 0, 0),
        ([[(1, 1), (2, 2)], []], 0, 0, 0),
        ([], 0, 0, 0),
    ],
)
def test_outlines_of_each_sort(rings, area, n_triangles, n_sides):
    found, sides = fanned(rings)
    assert (areas(found).sum(), len(found), len(sides)) == (area, n_triangles, n_sides)
    check_sides(found, sides)


def test_a_star_drawn_in_one_line_is_hollow():
    found, _ = fanned([1000 * np.array(STAR)])
    assert covered(found, np.array([[0.0, 0.0], [0.0, 8e3]])).tolist() == [0, 1]


def test_convex_outlines_are_one_fan():
    angle = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    ring = np.rint(1e7 * np.column_stack([np.cos(angle), np.sin(angle)])).astype(np.int64)
    point, apex, side, _ = fans([ring])
    assert len(point) == 501
    assert (apex == apex[0]).all()
    assert side.sum() == 500


def test_outlines_with_more_crossings_than_room_are_refused_by_name():
    rng = np.random.default_rng(0)
    ring = rng.integers(-(1 << 24), 1 << 24, (400, 2))
    assert fans([ring])[3] == TOO_MANY_CROSSINGS
    with pytest.raises(InputError, match="layer x: outline of object 1, of 400 points: crosses itself too often"):
        polygon_layer("x", [[[np.array(SQUARE, float)]], [[ring.astype(float)]]], np.array([[0, 1.0]] * 2), np.zeros(2))


def test_outlines_with_more_edges_abreast_than_there_is_time_for_are_refused():
    x = np.tile([0, 1000], 50)
    comb = np.column_stack([x, np.arange(100)])
    ring = np.concatenate([comb, [[2000, 100], [2000, -1]]])
    assert fans([ring])[3] == DONE
    assert fans([ring], most_pairs=4000)[3] == TOO_MANY_ABREAST


def layer_of(shapes, origin=(0.0, 0.0), **kwargs):
    shapes = [[[np.array(ring, float) + origin for ring in rings]] for rings in shapes]
    height = kwargs.get("height", np.column_stack([np.arange(len(shapes)), 3.0 + 2 * np.arange(len(shapes))]))
    return polygon_layer("made", shapes, height, kwargs.get("value", np.arange(len(shapes)) * 1.0))


def random_polygons(n, seed, origin=(0.0, 0.0)):
    """Outlines of each sort, somewhere, some turned over or flat."""
    rng = np.random.default_rng(seed)
    shapes = []
    for i in range(n):
        rings = ([SQUARE, HOLE], [COURT], [BOW_TIE], [STAR], [rng.uniform(0, 10, (6, 2))])[i % 5]
        angle = rng.uniform(0, 7)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        shapes.append([np.array(ring) @ turn + rng.uniform(-60, 60, 2) for ring in rings])
    height = rng.uniform(-5, 25, (n, 2))
    height[::7, 1] = height[::7, 0]
    return layer_of(shapes, origin, height=height, value=rng.normal(size=n))[0]


@pytest.mark.parametrize("origin", [(0.0, 0.0), (6e6, 5e6)])
def test_prisms_are_closed_and_face_outward(origin):
    layer, kept = layer_of([[SQUARE], [COURT], [SQUARE, HOLE], [BOW_TIE]], origin)
    expected = np.array([100, 88, 96, 50.0]) @ [3, 4, 5, 6]
    assert kept.tolist() == [0, 1, 2, 3]
    for mesh in (triangles(layer), strips(layer)):
        corners = mesh.position[mesh.triangles()]
        outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        np.testing.assert_allclose((corners[:, 0] * outward).sum() / 6, expected, rtol=1e-6)  # its volume
        normal = mesh.normal[mesh.triangles()[:, 2]]
        length = np.linalg.norm(outward, axis=1)
        np.testing.assert_allclose((normal * outward).sum(axis=1), length, atol=1e-6)
        np.testing.assert_allclose(outward.sum(axis=0), 0, atol=1e-6)
    assert np.array_equal(mesh.first_vertex, mesh.first_strip_vertex)


def test_strips_have_the_triangles_of_triangles():
    layer = random_polygons(40, 3)
    some, others = triangles(layer), strips(layer)
    corners = others.triangles()
    position = others.position[corners]
    size = np.linalg.norm(np.cross(position[:, 1] - position[:, 0], position[:, 2] - position[:, 0]), axis=1)
    own = some.position.reshape(-1, 3, 3)
    own_size = np.linalg.norm(np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0]), axis=1)
    normal = np.repeat(others.normal[corners[:, 2:]], 3, axis=1)
    found = by_position(position[size > 0], normal[size > 0])
    expected = by_position(own[own_size > 0], some.normal.reshape(-1, 3, 3)[own_size > 0])
    assert np.array_equal(found[0], expected[0])
    assert np.array_equal(found[1], expected[1])
    for mesh in (some, others):
        objects = np.repeat(np.arange(len(layer)), np.diff(mesh.first_vertex))
        assert np.array_equal(mesh.value, layer.objects["value"][objects].astype(float))


def test_a_layer_keeps_its_place_and_comes_back_from_disk(tmp_path):
    layer, kept = layer_of([[[(0, 0), (5, 0)]], [SQUARE], [COURT]], (6_378_137.0, -5e6))
    assert kept.tolist() == [1, 2]
    lower, upper = (corner[np.argsort(layer.objects["value"])] for corner in layer.bounds)
    assert np.array_equal(lower, [[6_378_137.0, -5e6, 1], [6_378_137.0, -5e6, 2]])
    assert np.array_equal(upper, [[6_378_147.0, -4_999_990.0, 5], [6_378_147.0, -4_999_990.0, 7]])
    write_layer(layer, tmp_path / "x.layer")
    back = open_layer(tmp_path / "x.layer")
    for name in ("objects", "elements", "first_element", "origin"):
        assert np.array_equal(getattr(layer, name), getattr(back, name))


def test_positions_are_float32_without_rounding():
    layer = random_polygons(20, 1, (6e6, 5e6))
    positions = layer.elements["position"].astype(float)
    unit = 2.0 ** (np.ceil(np.log2(np.abs(positions).max())) - 24)
    assert np.array_equal(positions, np.rint(positions / unit) * unit)


@pytest.mark.parametrize(
    ("shapes", "height", "value", "text"),
    [
        ([[[(0, 0), (1, 0), (np.nan, 1)]]], [[0, 1]], [0], "outline of object 0: found nan, expected finite"),
        ([[SQUARE]], [[0, np.inf]], [0], "height of object 0: found"),
        ([[SQUARE]], [[0, 1e39]], [0], "objects, height of record 0: found"),
        ([[SQUARE]], [[0, 1]], [np.nan], "objects, value of record 0: found nan, expected finite"),
        ([[[(0, 0), (1e300, 0), (0, 1)]]], [[0, 1]], [0], "extent of 1e\\+300"),
        ([[[(0, 0), (1, 1), (2, 2)]]], [[0, 1]], [0], "found no outline with an area"),
        ([[]], [[0, 1]], [0], "found no outline, expected at least one"),
    ],
)
def test_what_nothing_can_be_drawn_from_is_refused_by_name(shapes, height, value, text):
    with pytest.raises(InputError, match=text):
        layer_of(shapes, height=np.array(height, float), value=np.array(value, float))


def test_damaged_elements_are_refused():
    def damage(change):
        layer, _ = layer_of([[SQUARE], [COURT]])
        change(layer)
        with pytest.raises(InputError) as error:
            check_layer(layer)
        return str(error.value)

    assert "is not the apex" in damage(lambda layer: layer.elements["position"].__setitem__(-1, 77))
    assert "is not the apex" in damage(lambda layer: layer.elements["side"].__setitem__(-1, 1))
    assert "side of element 2: found 9" in damage(lambda layer: layer.elements["side"].__setitem__(2, 9))
    assert "apex of record 3" in damage(lambda layer: layer.elements["apex"].__setitem__(3, np.inf))
    assert "object 0: found no elements" in damage(lambda layer: layer.first_element.__setitem__(1, 0))


def by_position(position, normal):
    """Triangles, each begun at its least corner, in the order of their corners, and their normals."""
    start = np.array([min(range(3), key=lambda i: tuple(t[i])) for t in position])
    turned = position[np.arange(len(position))[:, None], (start[:, None] + np.arange(3)) % 3]
    order = np.lexsort(turned.reshape(-1, 9).T)
    return turned[order], normal[order]


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize("seed", range(2))
def test_the_geometry_shader_makes_the_triangles_of_the_reference(seed):
    layer = random_polygons(60, seed, (6e6, 0.0))
    mesh = triangles(layer)
    expected_position, expected_normal = (a.reshape(-1, 3, 3) for a in (mesh.position, mesh.normal))
    position, normal = captured(layer, LayerSection(path=""), len(expected_position) + 10)
    flat = np.repeat(normal[:, 2:], 3, axis=1)  # of its last vertex
    found, expected = by_position(position, flat), by_position(expected_position, expected_normal)
    np.testing.assert_array_equal(found[0], expected[0])  # float32 to the bit
    np.testing.assert_allclose(found[1], expected[1], atol=1e-6)


def everything(layer):
    return np.array([(0, len(layer), 1)], RENDER_POINT)


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize("seed", range(3))
def test_all_techniques_draw_the_same_picture(seed):
    from splatpipe.nodes.layers.gl_canvas import GlLayers

    layer = random_polygons(60, seed, (6e6, 5e6))
    lower, upper = layer.bounds
    camera = look_at_box(lower.min(axis=0), upper.max(axis=0), seed + 10)
    pictures = []
    for technique in TECHNIQUES:
        section = LayerSection(path="", technique=technique, value_filter=(-1.0, 5.0))
        with GlLayers([layer], [section], camera.width, camera.height) as canvas:
            pictures.append(canvas.draw(camera, [everything(layer)]).copy())
    first, *others = pictures
    drawn = first != FRAMEBUFFER_EMPTY
    assert drawn.any()
    for other in others:
        colours = first.astype("<u4") != other.astype("<u4")
        assert colours.sum() <= 0.003 * drawn.sum() + 2  # edges that fall on a pixel's centre
        both = ~colours & drawn
        depth, other_depth = ((words[both] >> np.uint64(32)).astype("<u4").view("<f4") for words in (first, other))
        np.testing.assert_allclose(depth, other_depth, rtol=1e-4)


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize("technique", TECHNIQUES)
def test_a_courtyard_is_open_from_above_and_ranges_draw_their_objects_only(technique):
    from splatpipe.nodes.layers.gl_canvas import GlLayers
    from splatpipe.shared.camera import perspective_camera

    shapes = [[SQUARE, HOLE], [np.add(COURT, (20, 0))], [np.add(SQUARE, (40, 0))]]
    layer, _ = layer_of(shapes, height=np.array([[0.0, 1.0]] * 3))
    down = np.array([[1, 0, 0, 25.0], [0, 1, 0, 5.0], [0, 0, 1, 100.0], [0, 0, 0, 1]])
    camera = perspective_camera(frame=0, world_from_camera=down, fov_y_rad=0.6, width=128, height=128, near=0.1)

    def is_drawn(words, x, y):
        clip = camera.pixel_from_world[:, :3] @ ([x, y, 1.0] - camera.eye)
        column, row = (clip[:2] / clip[2]).astype(int)
        return bool(words[row, column] != FRAMEBUFFER_EMPTY)

    with GlLayers([layer], [LayerSection(path="", technique=technique)], 128, 128) as canvas:
        words = canvas.draw(camera, [everything(layer)]).copy()
        at = [(3, 3), (1, 5), (8, 3), (25, 7), (25, 2), (22, 8), (28, 8), (45, 5), (15, 5)]
        assert [is_drawn(words, *p) for p in at] == [False, True, True, False, True, True, True, True, False]
        for i in range(3):
            (square,) = np.flatnonzero(layer.objects["value"] == i)
            words = canvas.draw(camera, [np.array([(square, 1, 1)], RENDER_POINT)])
            assert [is_drawn(words, *p) for p in ((8, 3), (25, 2), (45, 5))] == [i == k for k in range(3)]


@pytest.mark.parametrize("name", ["delft.city.json", "tudcampus.geojson", "vancouver-blocks.json"])
def test_real_outlines_have_the_area_that_their_rings_have(data_dir, name):
    from splatpipe.shared.layers.readers.footprints import HeightRules, polygons_from_file, read_footprints

    path = data_dir / "objects" / name
    read = polygons_from_file(path, HeightRules())
    layer = read.layer
    n = len(read_footprints(path).objects)
    assert len(layer) == n == {"d": 160, "t": 1529, "v": 4627}[name[0]]
    mesh = triangles(layer)
    up = mesh.normal[::3, 2] == 1
    top = mesh.position.reshape(-1, 3, 3)[up]
    area = cross(top[:, 0], top[:, 1], top[:, 2]) / 2
    assert (area > 0).all()
    if name[0] == "d":
        assert area.sum() == pytest.approx(8654.03, abs=0.1)  # of all the triangles of the roofs
    if name[0] == "t":
        features = json.loads(path.read_text())["features"]
        rings = [[np.array(r) for r in p] for f in features for p in f["geometry"]["coordinates"]]
        shoelace = [[abs(cross(r[0], r[:-1], r[1:]).sum()) / 2 for r in polygon] for polygon in rings]
        assert area.sum() == pytest.approx(sum(own[0] - sum(own[1:]) for own in shoelace), rel=1e-4)
    if name[0] == "v":
        lower, upper = layer.bounds
        size = upper.max(axis=0) - lower.min(axis=0)
        assert size[:2] == pytest.approx([17_506, 10_687], rel=1e-3)
        assert "degrees" in read.notes[1]
