"""Trajectories: runs, motion, tubes without gaps, techniques, files."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from layer_example import TECHNIQUES, look_at_box, sorted_triangles
from splatpipe.nodes.layers.expand_trajectories import (
    ALONE,
    CAP,
    HIDDEN,
    Templates,
    segments,
    strips,
    values,
)
from splatpipe.nodes.layers.mesh import separate
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.errors import ConfigError, InputError
from splatpipe.shared.layer_config import LayerSection, TrajectoryStyle
from splatpipe.shared.layers.layer import Layer, check_layer
from splatpipe.shared.layers.layer_store import open_layer, write_layer
from splatpipe.shared.layers.motion import derivative, path_length
from splatpipe.shared.layers.trajectories import ELEMENT, NODE, OBJECT, REACH, RUN, SHARED, _runs, typical_gap
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from trajectory_example import random_tracks, track

needs_gl = pytest.mark.skipif(not gl_available()[0], reason=gl_available()[1])
ZIGZAG = [(0, 0, 0), (10, 0, 0), (20, 5, 0), (20, 5, 0), (30, 0, 3), (10, 0, 0)]


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32), n=st.integers(1, 300))
def test_runs_hold_every_node_once_and_every_step_with_its_neighbours(seed, n):
    rng = np.random.default_rng(seed)
    part = np.cumsum(rng.random(n) < rng.choice([0.01, 0.3]))
    part -= part[0]
    position = np.cumsum(rng.integers(0, 2, (n, 1)), axis=0) * np.ones(3, np.float32)
    source, role, first = _runs(position.astype("f4"), part)
    assert np.array_equal(np.sort(source[role == NODE]), np.arange(n))
    elements = np.zeros(len(source), ELEMENT)
    elements["position"], elements["role"], elements["time"] = position[source], role, source
    objects = np.zeros(len(first) - 1, OBJECT)
    layer = Layer("runs", "trajectories", np.zeros(3), objects, elements, first, {"names": ["a"], "radius": 1.0})
    index = segments(layer).index
    found = sorted(zip(*position[source[index]][:, 1:3, 0].T, part[source[index[:, 1]]], strict=True))
    steps = np.flatnonzero((part[1:] == part[:-1]) & (position[1:, 0] != position[:-1, 0]))
    expected = sorted(zip(position[steps, 0], position[steps + 1, 0], part[steps], strict=True))
    assert found == expected
    assert (part[source[index]] == part[source[index[:, :1]]]).all()
    x = position[source[index]][:, :, 0]
    assert ((x[:, 1] - x[:, 0] == 1) | (x[:, 0] == x[:, 1])).all()
    assert ((x[:, 3] - x[:, 2] == 1) | (x[:, 3] == x[:, 2])).all()
    alone = x[:, 0] == x[:, 1]  # nothing comes before: the first place of its part
    assert (x[alone, 1] == [position[part == p, 0].min() for p in part[source[index[alone, 1]]]]).all()
    assert np.diff(segments(layer).first_segment).max(initial=0) <= RUN


def test_consecutive_runs_share_a_place_and_know_the_next():
    x = np.arange(100.0) ** 1.01
    layer = track(np.column_stack([x, 0 * x, 0 * x]), np.arange(100.0))
    assert len(layer) == 4
    parts = segments(layer)
    assert len(parts.index) == 99
    order = np.argsort(layer.elements["time"][parts.index[:, 1]])
    time = layer.elements["time"][parts.index[order]]
    np.testing.assert_array_equal(time[:, 1], np.arange(99))
    np.testing.assert_array_equal(time[:, 2], np.arange(99) + 1)
    np.testing.assert_array_equal(time[1:, 0], np.arange(98))
    np.testing.assert_array_equal(time[:-1, 3], np.arange(98) + 2)
    caps = layer.elements["time"][(parts.flags & CAP) > 0]
    assert sorted(caps) == [0, 99]
    assert (layer.elements["role"] == SHARED).sum() == 3


def test_repeated_places_turns_and_single_nodes_are_flagged():
    layer = track(ZIGZAG, np.arange(6.0))
    parts = segments(layer)
    assert len(parts.index) == 4  # the repeated place makes none
    capped = layer.elements["position"][(parts.flags & CAP > 0) & (parts.flags & HIDDEN == 0)] + layer.origin
    np.testing.assert_allclose(capped, [(0, 0, 0), (30, 0, 3), (10, 0, 0)], atol=1e-5)
    for places in ([(1, 2, 3)], [(1, 2, 3)] * 40):
        alone = track(places, np.arange(float(len(places))))
        parts = segments(alone)
        assert len(alone) == 1
        assert len(parts.index) == 0
        assert (parts.flags & ALONE > 0).sum() == 1
        assert np.isfinite(alone.bounds[0]).all()


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_boxes_hold_what_is_drawn(seed):
    layer = random_tracks(120, 3, seed, origin=(6e6, 5e6, 0))
    for style in ("tubes", "spheres"):
        mesh = strips(layer, TrajectoryStyle(style=style, radius=(0.0, 2.0), selected=("t1",)))
        owner = np.repeat(np.arange(len(layer)), np.diff(mesh.first_vertex))
        lower, upper = (corner[owner] - layer.origin for corner in layer.bounds)
        np.testing.assert_allclose(np.linalg.norm(mesh.normal, axis=1), 1, atol=1e-6)
        slack = 1e-5 * REACH * layer.parameters["radius"] + 1e-7
        assert (mesh.position >= lower - slack).all()
        assert (mesh.position <= upper + slack).all()


def test_speed_and_acceleration_are_of_the_way_and_the_clock():
    t = np.array([0.0, 1, 2, 3, 5, 5, 6])
    x = t**2
    layer = track(np.column_stack([x, 0 * x, 0 * x]), t)
    nodes = layer.elements[layer.elements["role"] == NODE]
    np.testing.assert_allclose(nodes["speed"], [1, 2, 4, (25 - 4) / 3, (36 - 9) / 3, (36 - 9) / 3, 11], rtol=1e-6)
    assert (nodes["acceleration"] > 0).all()
    stopped = track([(0, 0, 0), (5, 0, 0)], [3.0, 3.0])
    assert (stopped.elements["speed"] == 0).all()
    assert (stopped.elements["acceleration"] == 0).all()
    counted = track([(0, 0, 0), (5, 0, 0), (10, 0, 0)])
    assert (counted.elements["speed"] == 5).all()


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32), slope=st.floats(-100, 100))
def test_the_derivative_of_a_line_is_its_slope(seed, slope):
    rng = np.random.default_rng(seed)
    part = np.sort(rng.integers(0, 4, 50))
    time = np.cumsum(rng.choice([0.0, 0.5, 1.0], 50))
    for p in range(4):
        found = derivative(slope * time, time, part)[part == p]
        expected = slope if len(np.unique(time[part == p])) > 1 else 0.0
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_lengths_begin_anew_with_each_part():
    position = np.array([(0, 0, 0), (3, 4, 0), (3, 4, 1), (9, 9, 9), (9, 9, 8)], np.float64)
    np.testing.assert_allclose(path_length(position, np.array([0, 0, 0, 1, 1])), [0, 5, 6, 0, 1])


def test_speeds_that_are_missing_lie_between_those_that_are_known():
    x = np.arange(5.0)
    speed = np.array([2.0, np.nan, np.nan, 8.0, np.nan])
    layer = track(np.column_stack([x, x, x]), x, speed=speed)
    nodes = layer.elements[layer.elements["role"] == NODE]
    np.testing.assert_allclose(nodes["speed"], [2, 4, 6, 8, 8])


def test_nodes_are_put_in_order_of_time_and_cut_at_gaps():
    x = np.array([3.0, 0, 1, 2, 50, 51])
    t = np.array([3.0, 0, 1, 2, 500, 501])
    places = np.column_stack([x, 0 * x, 0 * x])
    whole, cut = (track(places, t, gap_s=gap) for gap in (None, 100.0))
    assert len(segments(whole).index) == 5
    assert len(segments(cut).index) == 4
    assert len(cut) == 2
    assert cut.elements["speed"].max() == pytest.approx(1)
    assert typical_gap(t, np.zeros(6, np.int64)) == 100.0
    assert typical_gap(np.zeros(3), np.arange(3)) is None


@pytest.mark.parametrize("what", ["position", "time"])
def test_what_is_not_finite_is_refused_by_name(what):
    for bad in (np.nan, np.inf, 1e300):
        values = {"position": np.zeros((3, 3)), "time": np.arange(3.0)}
        values[what][1] = bad
        with pytest.raises(InputError, match=f"{what} of node 1"):
            track(values["position"], values["time"])


@pytest.mark.parametrize("attribute", ["position", "time", "speed", "acceleration", "role", "trajectory"])
def test_damaged_records_are_refused_by_name(attribute):
    layer = track(ZIGZAG, np.arange(6.0))
    if attribute == "trajectory":
        layer.objects["trajectory"] = 7
    else:
        layer.elements[attribute][2] = 1 if attribute == "role" else np.nan
    with pytest.raises(InputError, match=attribute):
        check_layer(layer)


@pytest.mark.parametrize("parameters", [{}, {"names": [1]}, {"names": ["a"], "radius": -1.0, "time_origin": 0.0}])
def test_parameters_are_checked(parameters):
    layer = track(ZIGZAG)
    layer.parameters.clear()
    layer.parameters.update(parameters)
    with pytest.raises(InputError, match="parameter"):
        check_layer(layer)


def test_layers_survive_the_disk(tmp_path):
    layer = random_tracks(200, 4, 1, origin=(6e6, 5e6, 10.0))
    write_layer(layer, tmp_path / "t.layer")
    again = open_layer(tmp_path / "t.layer")
    assert again.elements.dtype == ELEMENT
    for a, b in ((layer.objects, again.objects), (layer.elements, again.elements)):
        assert np.array_equal(a, b)
    assert again.parameters == layer.parameters
    assert np.array_equal(again.octree.n_points, layer.octree.n_points)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (1e-20, 0, 0), (1e20, 1e20, 1e20)])
def test_tubes_have_normals_in_any_direction_and_size(up):
    mesh = strips(track(np.arange(4.0)[:, None] * np.array(up)), TrajectoryStyle(style="tubes"))
    np.testing.assert_allclose(np.linalg.norm(mesh.normal, axis=1), 1, atol=1e-6)
    assert np.isfinite(mesh.position).all()


@pytest.mark.parametrize("numbers", [(1.0,), (1.0, 2.0, 3.0)])
def test_ranges_have_no_number_or_two(numbers):
    with pytest.raises(ValueError, match="no number or two"):
        TrajectoryStyle(highlight=numbers)


def edges(triangles):
    """How often each edge occurs, seen as positions."""
    count = {}
    for triangle in np.round(triangles, 5):
        corners = [tuple(c) for c in triangle]
        if len(set(corners)) == 3:
            for a, b in ((0, 1), (1, 2), (2, 0)):
                key = tuple(sorted((corners[a], corners[b])))
                count[key] = count.get(key, 0) + 1
    return count


@pytest.mark.parametrize("sides", [3, 8])
def test_tubes_have_no_gap_at_joints(sides):
    """Along a bent track every edge is of two triangles, but for the rings at both ends, in which balls are."""
    t = np.linspace(0, 4, 80)  # upwards through the steep directions too, and over several runs
    places = np.column_stack([20 * np.cos(t), 20 * np.sin(t), 3 * t**3 * np.cos(t)])
    layer = track(np.repeat(places, 2, axis=0), np.arange(160.0), radius=0.3)
    mesh = strips(layer, TrajectoryStyle(style="tubes", sides=sides, radius=(0.4, 1.0)))
    triangles = separate(mesh).position.reshape(-1, 3, 3)
    n_tubes = np.diff(segments(layer).first_segment)
    first = separate(mesh).first_vertex // 3
    tubes = np.concatenate([f + np.arange(2 * sides * n) for f, n in zip(first, n_tubes, strict=False)])  # before balls
    assert len(tubes) == 79 * 2 * sides
    counts = edges(triangles[tubes])
    open_edges = [edge for edge, n in counts.items() if n == 1]
    assert len(open_edges) == 2 * sides
    assert set(counts.values()) == {1, 2}
    ends = np.array([corner for edge in open_edges for corner in edge]) + layer.origin
    away = np.minimum(*(np.linalg.norm(ends - places[i], axis=1) for i in (0, -1)))
    assert away.max() < 0.31
    balls = np.setdiff1d(np.arange(len(triangles)), tubes)
    assert len(balls) == 2 * 2 * sides * Templates(sides).bands
    corners = triangles[balls] + layer.origin  # and they are as wide as the rings
    radius = np.minimum(*(np.linalg.norm(corners - places[i], axis=2) for i in (0, -1)))
    np.testing.assert_allclose(radius.max(), away.max(), rtol=1e-3)


def look(layer, seed, **size):
    lower, upper = layer.bounds
    return look_at_box(lower.min(axis=0), upper.max(axis=0), seed, **size)


def picture(layer, camera, technique="avc", value_filter=None, **style):
    from splatpipe.nodes.layers.gl_canvas import GlLayers

    look_of = TrajectoryStyle(**style)
    section = LayerSection(path="", technique=technique, value_filter=value_filter, trajectories=look_of)
    with GlLayers([layer], [section], camera.width, camera.height) as canvas:
        return canvas.draw(camera, [np.array([(0, len(layer), 1)], RENDER_POINT)]).copy()


def captured(layer, vertices_each, value_filter=None, **style):
    """(lines, tubes, nodes): (v, 3) positions and normals of the primitives of each draw call."""
    from splatpipe.nodes.layers.gl_canvas import GlLayers

    section = LayerSection(path="", value_filter=value_filter, trajectories=TrajectoryStyle(**style))
    camera = look(layer, 0, width=64, height=64)
    found = []
    with GlLayers([layer], [section], 64, 64) as canvas, canvas._context:
        canvas._framebuffer.use()
        for part in canvas._layers[0].parts:
            part.set_camera(camera)
            buffer = canvas._context.buffer(np.full(6 * vertices_each, np.nan, "f4"))
            part.vertices.transform(buffer)
            values = np.frombuffer(buffer.read(), "f4").reshape(-1, 2, 3)
            values = values[~np.isnan(values).any(axis=(1, 2))]
            assert len(values) < vertices_each, "the buffer may have been too small"
            found.append(values.astype(np.float64))
    return found


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize("style", ["tubes", "spheres"])
def test_the_geometry_shaders_make_the_triangles_of_the_reference(style):
    for seed, sides in ((0, 8), (1, 5), (2, 3)):
        layer = random_tracks(60, 3, seed, origin=(6e6, 0, 0))
        options = {"style": style, "sides": sides, "selected": ("t1",)}
        mesh = separate(strips(layer, TrajectoryStyle(**options)))
        _, tubes, balls = captured(layer, 40_000, **options)
        drawn = np.concatenate([tubes, balls]).reshape(-1, 3, 2, 3)
        found = sorted_triangles(drawn[:, :, 0], drawn[:, :, 1])
        expected = sorted_triangles(*(a.reshape(-1, 3, 3) for a in (mesh.position, mesh.normal)))
        assert len(found[0]) == len(expected[0])
        np.testing.assert_allclose(found[0], expected[0], atol=2e-3)
        np.testing.assert_allclose(found[1], expected[1], atol=2e-3)


@pytest.mark.gl
@needs_gl
def test_lines_are_the_segments():
    layer = random_tracks(100, 3, 4)
    lines, tubes, _ = captured(layer, 40_000, style="lines")
    assert len(tubes) == 0
    index = segments(layer).index
    expected = layer.elements["position"][index[:, 1:3]].reshape(-1, 6)
    found = lines[:, 0].reshape(-1, 6)
    np.testing.assert_allclose(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)])


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize("seed", [0, 2, 5])
@pytest.mark.parametrize("style", ["tubes", "spheres"])
def test_all_techniques_draw_the_same_picture(seed, style):
    layer = random_tracks(150, 4, seed, origin=(6e6, 5e6, 0), radius=0.4)
    camera = look(layer, seed)
    options = {
        "style": style,
        "selected": ("t2",),
        "value_filter": (float(np.quantile(layer.elements["speed"], 0.2)), 1e9),
    }
    first, *others = (picture(layer, camera, technique, **options) for technique in TECHNIQUES)
    drawn = first != FRAMEBUFFER_EMPTY
    assert drawn.sum() > 50
    for other in others:
        colours = first.astype("<u4") != other.astype("<u4")
        assert (drawn != (other != FRAMEBUFFER_EMPTY)).sum() <= 0.01 * drawn.sum() + 3
        near = [np.abs((w >> np.uint64(s) & np.uint64(255)).astype(int)) for s in (0, 8, 16) for w in (first, other)]
        off = np.max([np.abs(near[i] - near[i + 1]) for i in (0, 2, 4)], axis=0) > 3  # light of interpolated normals
        assert (off & colours).sum() <= 0.02 * drawn.sum() + 3


@pytest.mark.gl
@needs_gl
def test_auto_draws_lines_far_and_tubes_near_and_selected_ones_as_tubes_with_spheres():
    layer = random_tracks(200, 3, 8)
    far, near = (captured(layer, 60_000, style="auto", tube_px=px) for px in (4096.0, 0.0))
    assert len(far[0]) > 0 == len(far[1])
    assert len(near[1]) > 0 == len(near[0])
    some = captured(layer, 60_000, style="auto", tube_px=4096.0, selected=("t1",))
    number = np.repeat(layer.objects["trajectory"], np.diff(layer.first_element))
    parts = segments(layer)
    of_selected = number[parts.index[:, 1]] == 1
    assert len(some[0]) == 2 * (~of_selected).sum()
    assert len(some[1]) == of_selected.sum() * 16 * 3
    nodes = ((number == 1) & (parts.flags & HIDDEN == 0)).sum()
    assert len(some[2]) == nodes * 4 * 16 * 3


@pytest.mark.gl
@needs_gl
def test_a_segment_that_passes_the_eye_is_a_tube_though_its_ends_are_far():
    layer = track([(-500, 0, 0), (500, 0, 0)], radius=0.5)
    pose = look_at(np.array([0.0, -10.0, 3.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    camera = perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.8, width=160, height=120, near=0.1)
    auto, tubes, lines = (picture(layer, camera, style=style, tube_px=4) for style in ("auto", "tubes", "lines"))
    assert np.array_equal(auto, tubes)
    assert (lines != FRAMEBUFFER_EMPTY).sum() < 0.5 * (tubes != FRAMEBUFFER_EMPTY).sum()


@pytest.mark.gl
@needs_gl
def test_restyling_sends_no_record_and_draws_what_a_new_layer_would():
    from splatpipe.nodes.layers.gl_canvas import GlLayers

    layer = random_tracks(150, 3, 2)
    camera = look(layer, 3)
    entries = [np.array([(0, len(layer), 1)], RENDER_POINT)]
    with GlLayers([layer], [LayerSection(path="")], camera.width, camera.height) as canvas:
        (drawn,) = canvas._layers
        before = canvas.draw(camera, entries).copy()
        with canvas._context:
            records = drawn.shared.records.read()
        style = {"style": "splats", "selected": ("t0",), "radius": (0.2, 2.0), "acceleration_range": (0.0, 1.0)}
        with canvas._context:
            drawn.shared.restyle(TrajectoryStyle(**style))
        after = canvas.draw(camera, entries).copy()
        with canvas._context:
            assert drawn.shared.records.read() == records
    assert np.array_equal(after, picture(layer, camera, **style))
    assert not np.array_equal(after, before)


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize("style", ["auto", "lines", "splats", "spheres", "tubes"])
@pytest.mark.parametrize("places", [[(0, 0, 0)], [(0, 0, 0)] * 3, [(0, 0, 0), (9, 0, 0), (0, 0, 0)], ZIGZAG])
def test_extremes_draw_something_finite(style, places):
    layer = track(np.add(places, (6e6, 5e6, 0)), radius=0.5)
    words = picture(layer, look(layer, 1), style=style)
    depth = (words[words != FRAMEBUFFER_EMPTY] >> np.uint64(32)).astype("<u4").view("<f4")
    assert len(depth)
    assert np.isfinite(depth).all()


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize("colour", ["speed", "acceleration", "time", "height"])
def test_filters_and_highlights_are_of_the_value_that_is_coloured(colour):
    layer = random_tracks(150, 3, 5)
    of_nodes = values(layer, TrajectoryStyle(colour=colour))
    index = segments(layer).index
    mean = of_nodes[index[:, 1:3]].mean(axis=1)
    middle = float(np.quantile(mean, 0.6)) + 1e-4
    lines, *_ = captured(layer, 60_000, style="lines", colour=colour, value_filter=(middle, 1e9))
    assert len(lines) == 2 * (mean >= middle).sum()
    lines, tubes, _ = captured(layer, 60_000, style="lines", colour=colour, highlight=(middle, 1e9))
    assert len(lines) == 2 * (mean < middle).sum()
    assert len(tubes) == 48 * (mean >= middle).sum()


@pytest.mark.gl
@needs_gl
def test_radius_zero_draws_tubes_of_no_width_without_harm():
    layer = track(ZIGZAG)
    assert (picture(layer, look(layer, 1), style="tubes", radius=(0.0, 0.0)) == FRAMEBUFFER_EMPTY).mean() > 0.9


@pytest.mark.gl
@needs_gl
@pytest.mark.parametrize(
    ("technique", "style", "said"),
    [
        ("strips", {"style": "lines"}, "style"),
        ("instancing", {"style": "splats"}, "style"),
        ("avc", {"selected": ("nobody",)}, "nobody"),
        ("triangles", {"selected": (7,)}, "7"),
    ],
)
def test_what_cannot_be_drawn_is_one_line(technique, style, said):
    layer = track(ZIGZAG)
    with pytest.raises(ConfigError, match=said):
        picture(layer, look(layer, 1), technique, **style)
