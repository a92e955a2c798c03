"""Arcs, and the layouts that are made of arcs and cuboids."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from layer_example import TECHNIQUES, look_at_box
from splatpipe.nodes.layers.expand_arcs import strips, template, whole_root
from splatpipe.nodes.layers.mesh import separate
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.errors import InputError
from splatpipe.shared.layer_config import ArcStyle, LayerSection
from splatpipe.shared.layers.arcs import OBJECT, bounds
from splatpipe.shared.layers.hierarchy import from_paths, squarified, sunburst, treemap
from splatpipe.shared.layers.layer import simple_layer
from splatpipe.shared.layers.readers.hierarchies import read_hierarchy
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT

needs_gl = pytest.mark.skipif(not gl_available()[0], reason=gl_available()[1])


def random_arcs(n, seed=0, origin=(0.0, 0.0, 0.0), extreme=False):
    rng = np.random.default_rng(seed)
    objects = np.zeros(n, OBJECT)
    objects["center"] = rng.uniform(-50, 50, (n, 2))
    start = rng.uniform(-7, 7, n)
    span = rng.choice([0.0, 1e-6, 0.3, math.pi, 2 * math.pi], n) if extreme else rng.uniform(0.05, 6, n)
    objects["angle"] = np.column_stack(
        [start, np.minimum(start.astype("f4") + span, start.astype("f4") + np.float32(2 * math.pi))]
    )
    inner = rng.uniform(0, 10, n) * (rng.choice([0, 1], n) if extreme else 1)
    objects["radius"] = np.column_stack(
        [inner, inner + rng.uniform(0, 10, n) * (rng.choice([0, 1], n) if extreme else 1)]
    )
    objects["height"] = rng.uniform(-5, 5, (n, 2)) * (rng.choice([0, 1], (n, 1)) if extreme else 1)
    objects["value"] = rng.normal(size=n)
    return simple_layer("random", "arcs", np.array(origin), objects)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32), extreme=st.booleans())
def test_boxes_hold_the_geometry_and_are_tight(seed, extreme):
    layer = random_arcs(30, seed, extreme=extreme)
    mesh = strips(layer, 4096)
    lower, upper = bounds(layer)
    of_arc = np.repeat(np.arange(len(layer)), np.diff(mesh.first_vertex))
    slack = 1e-6 + 2e-5 * layer.objects["radius"][of_arc, 1:]
    assert (mesh.position >= lower[of_arc] - slack).all()
    assert (mesh.position <= upper[of_arc] + slack).all()
    for i in range(len(layer)):
        own = mesh.position[of_arc == i]
        loose = 1e-2 * layer.objects["radius"][i, 1] + 1e-5
        assert (own.min(axis=0) <= lower[i] + loose).all()
        assert (own.max(axis=0) >= upper[i] - loose).all()


@pytest.mark.parametrize(
    ("attribute", "value"),
    [("radius", (-1, 1)), ("radius", (2, 1)), ("angle", (1, 0)), ("angle", (0, 7)), ("height", (0, np.nan))],
)
def test_what_is_no_arc_is_refused_by_name(attribute, value):
    objects = np.zeros(2, OBJECT)
    objects[attribute][1] = value
    with pytest.raises(InputError, match=attribute):
        simple_layer("x", "arcs", np.zeros(3), objects)


def test_the_surface_is_closed():
    """Each edge of the triangles of an open arc, seen as positions, occurs twice."""
    layer = random_arcs(1, 3)
    mesh = separate(strips(layer, 16))
    corners = np.round(mesh.position, 6).reshape(-1, 3, 3)
    edges = {}
    for triangle in corners:
        for a, b in ((0, 1), (1, 2), (2, 0)):
            key = tuple(sorted((tuple(triangle[a]), tuple(triangle[b]))))
            edges[key] = edges.get(key, 0) + 1
    assert set(edges.values()) == {2}
    out = np.einsum(
        "ti,ti->t", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), mesh.normal[::3]
    )
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert (np.abs(out) > 0.99 * area).all()  # normals are across their triangles
    centre = np.array([*layer.objects["center"][0], layer.objects["height"][0].mean()])
    assert np.abs(np.sum(mesh.normal[::3] * area[:, None], axis=0)).max() < 1e-3 * area.sum()
    assert np.isfinite(centre).all()


def test_the_template_of_instancing_is_the_triangles_of_an_open_arc():
    part, code = template(9)
    mesh = separate(strips(random_arcs(1, 5), 9))
    assert len(part) == len(code) == len(mesh.position)
    assert whole_root(9) == 3
    assert [whole_root(s) for s in (1, 4, 5, 4096, 10**9)] == [2, 2, 3, 64, 64]


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize("extreme", [False, True])
def test_all_techniques_draw_the_same_picture(extreme):
    from splatpipe.nodes.layers.gl_canvas import GlLayers

    layer = random_arcs(60, 7, origin=(6e6, 0.0, 0.0), extreme=extreme)
    lower, upper = layer.bounds
    camera = look_at_box(lower.min(axis=0), upper.max(axis=0), 1)
    pictures = []
    for technique in TECHNIQUES:
        section = LayerSection(path="", technique=technique, arcs=ArcStyle(segments=36))
        with GlLayers([layer], [section], camera.width, camera.height) as canvas:
            pictures.append(canvas.draw(camera, [np.array([(0, 60, 1)], RENDER_POINT)]).copy())
    first = pictures[0]
    drawn = first != FRAMEBUFFER_EMPTY
    assert drawn.sum() > 300
    for other in pictures[1:]:
        differs = first.astype("<u4") != other.astype("<u4")
        assert differs.sum() <= 0.02 * drawn.sum() + 2  # edges, and faces that coincide


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize("distance", [1.0, 2.0, 5.0])
def test_tessellated_arcs_are_round_from_near_and_far(distance):
    from splatpipe.nodes.layers.gl_canvas import GlLayers

    layer = random_arcs(12, 3)
    lower, upper = (np.min(layer.bounds[0], axis=0), np.max(layer.bounds[1], axis=0))
    middle, extent = (lower + upper) / 2, np.linalg.norm(upper - lower)
    pose = look_at(middle + distance * extent * np.array([0.3, 0.2, 0.6]), middle, np.array([0.0, 0.0, 1.0]))
    camera = perspective_camera(
        frame=0, world_from_camera=pose, fov_y_rad=0.8, width=320, height=240, near=1e-3 * extent
    )

    def covered(**style):
        with GlLayers([layer], [LayerSection(path="", arcs=ArcStyle(**style))], 320, 240) as canvas:
            return canvas.draw(camera, [np.array([(0, len(layer), 1)], RENDER_POINT)]) != FRAMEBUFFER_EMPTY

    exact, fine, coarse = covered(segments=4096), covered(tolerance_px=0.02), covered(segments=4)
    assert exact.any()
    assert (fine != exact).sum() <= 0.02 * exact.sum() + 3
    if distance == 1.0:
        assert (coarse != exact).sum() > 3 * (fine != exact).sum() + 10


PATHS = {"a/b/x": 4.0, "a/b/y": 2.0, "a/z": 6.0, "w": 12.0, "empty/none": 0.0}


def test_sizes_sum_up_and_values_are_inherited():
    tree = from_paths("t", PATHS, {path: float(i) for i, path in enumerate(PATHS)})
    assert tree.size[0] == 24
    assert sorted(tree.size.tolist(), reverse=True)[:4] == [24, 12, 12, 6]
    a_b = int(np.flatnonzero((tree.size == 6) & ~tree.is_leaf)[0])
    assert tree.value[a_b] == pytest.approx((4 * 0 + 2 * 1) / 6)


@settings(max_examples=60, deadline=None)
@given(sizes=st.lists(st.floats(1e-3, 1e6), min_size=1, max_size=60), wide=st.floats(0.1, 10))
def test_squarified_rectangles_share_out_the_area_without_overlap(sizes, wide):
    sizes = np.sort(np.array(sizes))[::-1]
    rectangles = squarified(sizes, 1.0, 2.0, 3.0 * wide, 4.0)
    x, y, width, height = rectangles.T
    np.testing.assert_allclose(width * height, sizes / sizes.sum() * 12 * wide, rtol=1e-6)
    slack = 1e-6 * (1 + wide)
    assert (x >= 1 - slack).all()
    assert (y >= 2 - slack).all()
    assert (x + width <= 1 + 3 * wide + slack).all()
    assert (y + height <= 6 + slack).all()
    across = np.minimum((x + width)[:, None], x + width) - np.maximum(x[:, None], x)
    along = np.minimum((y + height)[:, None], y + height) - np.maximum(y[:, None], y)
    np.fill_diagonal(across, 0)
    assert (np.minimum(across, along) <= slack).all()


def test_layouts_hold_every_node_that_has_a_size():
    tree = from_paths("t", PATHS)
    boxes, rings = treemap(tree), sunburst(tree)
    shown = int((tree.size > 0).sum())
    assert len(boxes) == len(rings) == shown
    leaves = boxes.objects[boxes.objects["height"][:, 0] > 0]
    assert len(leaves) == shown - 1
    whole = rings.objects["angle"][:, 1] - rings.objects["angle"][:, 0]
    assert whole.max() == pytest.approx(2 * math.pi, rel=1e-6)
    w = rings.objects[(rings.objects["radius"][:, 0] > 0) & (whole > 3)]
    assert len(w) == 2  # a and w have half of the size each


@pytest.mark.parametrize(
    ("sizes", "said"),
    [({}, "size of 0"), ({"a": 0.0}, "size of 0"), ({"a": -1.0}, "size of a"), ({"a": math.inf}, "size of a")],
)
def test_trees_without_a_size_are_refused(sizes, said):
    with pytest.raises(InputError, match=said):
        from_paths("t", sizes)


def test_folders_and_tables_are_read(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "x").write_bytes(b"1234")
    (tmp_path / "w").write_bytes(b"12")
    (tmp_path / "link").symlink_to(tmp_path)
    tree = read_hierarchy(tmp_path)
    assert tree.size[0] == 6
    table = tmp_path / "t.csv"
    table.write_text("path,size,value\na/b,3,1\nc,2,5\n")
    assert read_hierarchy(table).size[0] == 5
    for text, said in (
        ("path,size\na,1\na,2\n", "twice"),
        ("size\n1\n", "column path"),
        ("path,size\na,x\n", "expected numbers"),
    ):
        table.write_text(text)
        with pytest.raises(InputError, match=said):
            read_hierarchy(table)
