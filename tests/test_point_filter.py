"""Filters: exact in world coordinates, blind to where the scene is, and conservative where cells are left out."""

from dataclasses import replace

import numpy as np
import pytest
from build_sources import ArraySource
from helpers_octree import leaf_of_points, scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.nodes.culling import CullingNode
from splatpipe.nodes.frustum import padded_half_edges
from splatpipe.nodes.point_filter import ClipBox, PointFilter, features_left
from splatpipe.nodes.raster import CellFeatures, PointSize, ResidentPoints, SplatSettings
from splatpipe.nodes.raster.choose import make_rasterizer
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.nodes.render import RenderNode, Wanted, load_points
from splatpipe.nodes.sampling import SamplingNode
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.colour import Colouring
from splatpipe.shared.config import Box
from splatpipe.shared.errors import ConfigError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT, VisibilityBits
from splatpipe.shared.points import pack_normals, pack_radii
from splatpipe.shared.store import Scene

EXAMPLES = settings(max_examples=100, derandomize=True, deadline=None)
WIDTH, HEIGHT = 96, 64
needs_gl = pytest.param("gl", marks=[pytest.mark.gl, pytest.mark.skipif(not gl_available()[0], reason="no OpenGL")])
needs_gl_points = pytest.param("gl-points", marks=needs_gl.marks)


def kept_twin(world, codes, point_filter):
    """(n,) bool by the definition."""
    kept = np.isin(codes, point_filter.classes) if point_filter.classes else np.ones(len(world), bool)
    for box in point_filter.boxes:
        inside = ((world >= box.lower) & (world <= box.upper)).all(axis=1)
        kept &= inside == box.keep_inside
    return kept


def world_of(scene):
    """(n, 3) float64 world positions of the stored points."""
    first, origin = scene.blocks()
    block = np.searchsorted(first, np.arange(scene.info.n_stored), side="right") - 1
    return origin[block] + np.column_stack(scene.positions()).astype(np.float64)


@pytest.fixture(scope="module")
def make_scene(tmp_path_factory):
    """3000 points of a unit ball around (shift, shift, shift) on a grid of 1/64, of classes 0 … 7."""
    made = {}

    def make(shift, order="layered"):
        if (shift, order) not in made:
            rng = np.random.default_rng(4)
            cloud = np.rint(rng.normal(size=(3000, 3)) * 0.4 * 64) / 64 + shift
            columns = {"classification": rng.integers(0, 8, len(cloud)).astype(np.uint8)}
            path = tmp_path_factory.mktemp("filter") / "s.scene"
            settings = BuildSettings(point_order=order, points_per_cell=40, threads=1)
            build_scene([ArraySource(cloud, columns)], path, settings=settings)
            made[shift, order] = Scene.open(path)
        return made[shift, order]

    return make


corner = st.tuples(*[st.integers(-100, 100).map(lambda i: i / 64)] * 3)


@st.composite
def filters(draw, shift=0.0, classes=True):
    """Up to three boxes whose faces lie on the grid that the points lie on, and some classes."""
    boxes = []
    for _ in range(draw(st.integers(0 if classes else 1, 3))):
        ends = np.sort([draw(corner), draw(corner)], axis=0) + shift
        boxes.append(ClipBox(tuple(ends[0].tolist()), tuple(ends[1].tolist()), draw(st.booleans())))
    codes = draw(st.sets(st.integers(0, 9), max_size=3)) if classes else ()
    return PointFilter(tuple(sorted(codes)), tuple(boxes))


@pytest.mark.parametrize("shift", [0.0, 6.4e6])
@pytest.mark.parametrize("order", ["layered", "depth-first"])
def test_points_are_kept_as_their_world_coordinates_and_classes_say(make_scene, shift, order):
    scene = make_scene(shift, order)
    world, codes = world_of(scene), np.asarray(scene.attribute("classification"))
    x, y, z = scene.positions()

    @EXAMPLES
    @given(filters(shift))
    def check(point_filter):
        found = point_filter.filtered_x(scene, x, y, z)
        kept = kept_twin(world, codes, point_filter)
        np.testing.assert_array_equal(found, np.where(kept, x, np.float32(np.nan)))

    check()


def test_a_box_far_from_the_origin_cuts_between_neighbours(make_scene):
    """Two points a 64th apart: float32 world coordinates would make them one (steps of 0.5 at 6.4e6)."""
    scene = make_scene(6.4e6)
    world = world_of(scene)
    face = float(np.median(world[:, 0]))
    assert (world[:, 0] == face).any(), "points on the face"
    assert (world[:, 0] == face + 1 / 64).any(), "and just beyond it"
    box = ClipBox((0.0, 0.0, 0.0), (face, 1e7, 1e7))
    inside = PointFilter(boxes=(box,)).filtered_x(scene, *scene.positions())
    outside = PointFilter(boxes=(replace(box, keep_inside=False),)).filtered_x(scene, *scene.positions())
    np.testing.assert_array_equal(np.isfinite(inside), world[:, 0] <= face)
    np.testing.assert_array_equal(np.isnan(inside), np.isfinite(outside))


def cameras():
    """Around, in and along the axes of the ball, so that rows of the projection have zeros."""
    rng = np.random.default_rng(8)
    eyes = [(4.0, 0, 0), (0, 4.0, 0), (0, 0, 4.0), (-4.0, 0, 0), (0.1, 0, 0), *rng.normal(size=(3, 3))]
    for frame, eye in enumerate(eyes):
        pose = look_at(np.array(eye), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        yield perspective_camera(
            frame=frame, world_from_camera=pose, fov_y_rad=0.8, width=WIDTH, height=HEIGHT, near=0.01
        )


def everything(octree):
    return SamplingNode(octree, pixel_threshold=0.0), np.ones(len(octree), np.uint8)


@pytest.mark.parametrize("rasterizer", ["cpu", needs_gl, needs_gl_points])
@pytest.mark.parametrize(
    "size", [PointSize(), PointSize(3), PointSize(1, world=0.05, maximum=9)], ids=["1px", "3px", "world"]
)
def test_points_that_are_filtered_out_are_never_drawn(make_scene, rasterizer, size):
    """Also along the axes, where a camera's row has a zero for x."""
    scene = make_scene(0.0)
    colouring = Colouring.choose(scene, "classification")
    codes = np.asarray(scene.attribute("classification"))
    sampling, bits = everything(scene.octree())
    for point_filter, n_kept in ((PointFilter((3,)), (codes == 3).sum()), (PointFilter((9,)), 0)):
        points = load_points(scene, colouring, Wanted(point_filter=point_filter), verify=True)
        assert np.isfinite(points.x).sum() == n_kept
        with make_rasterizer(rasterizer, points, WIDTH, HEIGHT, size, 2) as drawer:
            for camera in cameras():
                chosen = sampling.process(camera, VisibilityBits.pack(camera.frame, bits))
                words = RenderNode(drawer).process(camera, chosen)
                shown = np.unique(words[words != FRAMEBUFFER_EMPTY].astype(np.uint32))
                assert len(shown) == (n_kept > 0), "one class, one colour"


@pytest.mark.parametrize("order", ["layered", "depth-first"])
@pytest.mark.parametrize("threshold", [0.0, 6.0])
def test_cells_left_out_by_boxes_change_no_pixel(make_scene, order, threshold):
    scene = make_scene(0.0, order)
    octree = scene.octree()
    sampling = SamplingNode(octree, pixel_threshold=threshold)
    plain = CullingNode(octree, backface=False)
    colouring = Colouring.choose(scene, "elevation")
    n_spared = []

    @settings(EXAMPLES, max_examples=25)
    @given(filters(classes=False))
    def check(point_filter):
        boxed = CullingNode(octree, backface=False, point_filter=point_filter)
        points = load_points(scene, colouring, Wanted(point_filter=point_filter), verify=False)
        with make_rasterizer("cpu", points, WIDTH, HEIGHT, PointSize(), 1) as drawer:
            node = RenderNode(drawer)
            for camera in cameras():
                chosen = sampling.process(camera, plain.process(camera))
                expected = node.process(camera, chosen).copy()
                fewer = sampling.process(camera, boxed.process(camera))
                np.testing.assert_array_equal(node.process(camera, fewer), expected)
                n_spared.append(chosen.n_points - fewer.n_points)

    check()
    assert sum(n_spared) > 10_000


@EXAMPLES
@given(scenes(), st.data())
def test_no_cell_with_a_point_that_is_kept_is_left_out(scene, data):
    cloud, _ = scene
    point_filter = data.draw(filters(cloud.positions.mean(axis=0), classes=False))
    left = point_filter.cells_left(cloud.octree, padded_half_edges(cloud.octree))
    kept = kept_twin(cloud.positions, None, point_filter)
    leaf = leaf_of_points(cloud)
    assert left[leaf[kept & (leaf >= 0)]].all()
    parent = cloud.octree.parent
    assert left[parent[left & (parent >= 0)]].all(), "a cell that is left has ancestors that are"


def test_boxes_leave_out_what_lies_beyond_them(make_scene):
    octree = make_scene(0.0).octree()
    half = padded_half_edges(octree)
    assert PointFilter((1,)).cells_left(octree, half) is None
    far = ClipBox((50.0, 50.0, 50.0), (51.0, 51.0, 51.0))
    all_of_it = ClipBox((-50.0, -50.0, -50.0), (50.0, 50.0, 50.0), keep_inside=False)
    for box in (far, all_of_it):
        assert not PointFilter(boxes=(box,)).cells_left(octree, half).any()
        assert PointFilter(boxes=(replace(box, keep_inside=not box.keep_inside),)).cells_left(octree, half).all()


def test_a_damaged_class_column_is_named_when_classes_are_filtered(make_scene, tmp_path):
    scene = make_scene(0.0)
    copy = tmp_path / "copy.scene"
    copy.mkdir()
    for path in scene.path.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    data = bytearray((copy / "attr_classification.npy").read_bytes())
    data[-1] ^= 1
    (copy / "attr_classification.npy").write_bytes(data)
    damaged = Scene.open(copy)
    colouring = Colouring.choose(damaged, "elevation")
    load_points(damaged, colouring, verify=True)
    with pytest.raises(Exception, match=r"attr_classification\.npy: checksum"):
        load_points(damaged, colouring, Wanted(point_filter=PointFilter((2,))), verify=True)


def test_what_makes_no_sense_is_refused(make_scene, tmp_path):
    scene = make_scene(0.0)
    assert PointFilter.choose(scene, [2, 1, 2], []) == PointFilter((1, 2))
    assert not PointFilter.choose(scene, [], [])
    box = Box(lower=(0, 0, 0), upper=(0, 1, 2), keep="outside")
    assert PointFilter.choose(scene, [], [box]).boxes == (ClipBox((0, 0, 0), (0, 1, 2), False),)
    with pytest.raises(ConfigError, match=r"filter\.boxes\[1\]: found lower y = 2, expected at most 1"):
        PointFilter.choose(scene, [], [box, Box(lower=(0, 2, 0), upper=(0, 1, 2))])
    build_scene([ArraySource(np.eye(3))], tmp_path / "bare.scene")
    with pytest.raises(ConfigError, match=r"filter\.classes = \[2\]: the scene has no attribute, expected classific"):
        PointFilter.choose(Scene.open(tmp_path / "bare.scene"), [2], [])


def test_a_cell_that_lost_a_point_is_no_flat_cell():
    x = np.zeros(10, np.float32)
    x[[4, 9]] = np.nan
    first, n = np.array([0, 3, 5, 8]), np.array([3, 2, 3, 2])
    quads = np.zeros((4, 3)), np.zeros((4, 2, 3), np.float32)
    left = features_left(CellFeatures(first, n, np.array([1, 1, 2, 3], np.uint8), *quads), x)
    assert left.feature.tolist() == [1, 0, 2, 0]
    assert left.feature.dtype == np.uint8


@pytest.mark.parametrize(("rasterizer", "style"), [("cpu", "compact"), ("cpu", "splats"), ("gl", "splats")])
def test_no_form_of_a_filtered_point_is_drawn(rasterizer, style):
    """Red points of NaN among green ones, single in their block and first in it: no red in any pixel."""
    if rasterizer == "gl" and not gl_available()[0]:
        pytest.skip("no OpenGL")
    rng = np.random.default_rng(6)
    n = 2000
    x, y, z = rng.normal(size=(3, n)).astype(np.float32) * 0.4
    first = np.array([0, 1, 500, 1000, 1700])
    gone = rng.random(n) < 0.5
    gone[[0, 500]] = True  # a block of one point; the first of a block
    gone[1000:1700] = True  # a whole block
    x[gone] = np.nan
    colour = np.where(gone, 0xFF0000FF, 0xFF00FF00).astype(np.uint32)
    normal = pack_normals(np.column_stack([y, z, np.ones(n)]))
    radius = pack_radii(np.full(n, 0.02), 4.0)
    points = ResidentPoints(x, y, z, colour, first, np.zeros((5, 3)), normal, radius, 4.0)
    splats = SplatSettings(lighting=False) if style == "splats" else None
    everything = np.array([(0, n, 1), (1, n - 1, 3)], RENDER_POINT)
    with make_rasterizer(
        rasterizer, points, WIDTH, HEIGHT, PointSize(), 2, splats=splats, compact=style == "compact"
    ) as drawer:
        for camera in cameras():
            words = drawer.draw(camera, everything)
            shown = words[words != FRAMEBUFFER_EMPTY].astype(np.uint32)
            assert len(shown) > 20
            assert (shown & 0xFF == 0).all()
