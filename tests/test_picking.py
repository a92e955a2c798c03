"""Picking against all points projected one by one, and against what the rasterizers draw."""

import math

import numpy as np
import pytest
from build_sources import ArraySource
from splatpipe.nodes.culling import CullingNode
from splatpipe.nodes.picking import Picker, attributes_of
from splatpipe.nodes.point_filter import ClipBox, PointFilter
from splatpipe.nodes.raster import PointSize, SplatSettings
from splatpipe.nodes.raster.choose import make_rasterizer
from splatpipe.nodes.raster.reference import point_indices
from splatpipe.nodes.render import Wanted, load_points
from splatpipe.nodes.sampling import SamplingNode
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.colour import Colouring
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY
from splatpipe.shared.points import pack_normals, pack_rgb
from splatpipe.shared.store import Scene

WIDTH, HEIGHT = 120, 90
FAR = 6.4e6
EVERY_POINT = PointFilter()
SIZES = {
    "1": PointSize(),
    "3": PointSize(3),
    "world": PointSize(1, world=0.03, maximum=12),
    "adaptive": PointSize(1, maximum=9, adaptive=True),
}


@pytest.fixture(scope="module")
def make_scene(tmp_path_factory):
    """A bumpy sheet with a ball above it, 6000 points around (shift, shift, shift), every attribute told apart."""
    made = {}

    def make(shift=0.0, **build):
        key = (shift, *build.items())
        if key not in made:
            rng = np.random.default_rng(3)
            u, v = rng.uniform(-1, 1, (2, 4000))
            sheet = np.column_stack([u, v, 0.1 * np.sin(5 * u) * np.cos(4 * v)])
            ball = rng.normal(size=(2000, 3))
            ball = 0.3 * ball / np.linalg.norm(ball, axis=1)[:, None] + (0, 0, 0.5)
            normals = np.vstack([np.tile([0.0, 0, 1], (4000, 1)), (ball - (0, 0, 0.5)) / 0.3])
            cloud = np.rint(np.vstack([sheet, ball]) * 1024) / 1024 + shift
            i = np.arange(len(cloud))
            columns = {
                "rgb": pack_rgb(*(np.uint8(i >> 8 * k & 255) for k in range(3))),
                "normal": pack_normals(normals),
                "intensity": i.astype(np.float32),
                "classification": (i % 7).astype(np.uint8),
                "gps_time": 1e9 + i / 3,
            }
            path = tmp_path_factory.mktemp("picking") / "s.scene"
            build_scene(
                [ArraySource(cloud, columns)], path, settings=BuildSettings(**{"points_per_cell": 400, **build})
            )
            made[key] = Scene.open(path)
        return made[key]

    return make


def camera_at(shift=0.0, eye=(1.4, -1.9, 1.3), target=(0.0, 0.0, 0.2), near=0.01):
    pose = look_at(np.array(eye) + shift, np.array(target) + shift, np.array([0.0, 0, 1]))
    return perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.9, width=WIDTH, height=HEIGHT, near=near)


class Run:
    """The nodes of a run over a scene, for one camera."""

    def __init__(
        self, scene, camera, size=SIZES["1"], *, threshold=16.0, point_filter=EVERY_POINT, splats=None, **picker
    ):
        self.scene, self.camera, self.size, self.point_filter, self.splats = scene, camera, size, point_filter, splats
        octree = scene.octree()
        culling = CullingNode(octree, backface=False, margin_px=7.0, point_filter=point_filter)
        self.entries = SamplingNode(octree, pixel_threshold=threshold).process(camera, culling.process(camera)).entries
        self.picker = Picker(scene, octree, size, point_filter, splats, **picker)

    def pick(self, x, y, **options):
        return self.picker.pick(self.camera, self.entries, x, y, **options)

    def drawn(self):
        wanted = Wanted(
            splats=self.splats is not None,
            cells=self.size.adaptive,
            spacing=self.size.adaptive,
            point_filter=self.point_filter,
        )
        points = load_points(self.scene, Colouring.choose(self.scene, "rgb"), wanted, verify=False)
        with make_rasterizer("cpu", points, WIDTH, HEIGHT, self.size, 1, splats=self.splats) as rasterizer:
            return rasterizer.draw(self.camera, self.entries).copy()

    def brute(self, x, y, tolerance_px):
        """(index, depth, beside) by the definition: every drawn point, straight into the picture."""
        index = point_indices(self.entries)
        first, origin = self.scene.blocks()
        block = np.searchsorted(first, index, side="right") - 1
        stored = np.column_stack([c[index] for c in self.scene.positions()]).astype(np.float64)
        u, v, w = self.camera.pixel_from_world[:, :3] @ (origin[block] - self.camera.eye + stored).T
        u, v = u / w, v / w
        side = np.full(len(w), float(self.size.pixels))
        if self.size.world:
            side = np.floor(np.clip(self.size.world * self.camera.focal_px / w, side, self.size.maximum) + 0.5)
        left, top = np.floor(u - (side - 1) / 2), np.floor(v - (side - 1) / 2)
        column, row = math.floor(x), math.floor(y)
        ahead = w >= self.camera.near
        covers = ahead & (left <= column) & (column < left + side) & (top <= row) & (row < top + side)
        if covers.any():
            i = np.argmin(np.where(covers, w, np.inf))
            return index[i], w[i], 0.0
        gaps = [np.maximum(abs(p - at - 0.5) - side / 2, 0) for p, at in ((u, column), (v, row))]
        beside = np.where(ahead, np.hypot(*gaps), np.inf)
        i = np.argmin(beside)
        return (index[i], w[i], beside[i]) if beside[i] <= tolerance_px else None


def pixels(n, seed=0):
    return np.random.default_rng(seed).uniform((0, 0), (WIDTH, HEIGHT), (n, 2))


@pytest.mark.parametrize("shift", [0.0, FAR])
@pytest.mark.parametrize("order", ["layered", "depth-first"])
@pytest.mark.parametrize("size", ["1", "3", "world"])
def test_finds_what_looking_at_every_point_finds(make_scene, order, size, shift):
    scene = make_scene(shift, point_order=order)
    for threshold in (0.0, 24.0):
        run = Run(scene, camera_at(shift), SIZES[size], threshold=threshold)
        n_found = 0
        for x, y in pixels(60):
            found, expected = run.pick(x, y), run.brute(x, y, 4.0)
            assert (found is None) == (expected is None)
            if found and expected:
                assert (found.index, found.depth, found.beside_px) == pytest.approx(expected, rel=1e-9, abs=1e-9)
                n_found += 1
        assert 20 < n_found < 60, "some pixels show points and some do not"


@pytest.mark.parametrize("positions", ["float32", "ci", "eci", "occupancy", "groups"])
def test_coded_positions_are_picked_as_they_are_decoded(make_scene, positions):
    run = Run(make_scene(positions=positions), camera_at(), SIZES["3"])
    for x, y in pixels(25, seed=1):
        found, expected = run.pick(x, y), run.brute(x, y, 4.0)
        assert (found and found.index) == (expected and expected[0])


@pytest.mark.parametrize("shift", [0.0, FAR])
@pytest.mark.parametrize("size", SIZES)
def test_the_point_is_the_one_in_the_framebuffer(make_scene, size, shift):
    scene = make_scene(shift)
    run = Run(scene, camera_at(shift), SIZES[size])
    words = run.drawn()
    rows, columns = np.nonzero(words != FRAMEBUFFER_EMPTY)
    chosen = np.random.default_rng(5).choice(len(rows), 150, replace=False)
    same = 0
    for row, column in zip(rows[chosen], columns[chosen], strict=True):
        found = run.pick(column + 0.5, row + 0.5)
        assert found is not None
        depth = (words[row, column] >> np.uint64(32)).astype(np.uint32).view(np.float32)
        if found.attributes["rgb"] == words[row, column : column + 1].view(np.uint8)[:3].tolist():  # each its own
            assert found.depth == pytest.approx(depth, rel=1e-6)
            assert found.beside_px == 0
            same += 1
    assert same >= 148, "all but what float32 rounds across the edge of a pixel"


def test_every_attribute_and_the_position_are_those_of_the_point(make_scene):
    run = Run(make_scene(FAR), camera_at(FAR), SIZES["3"])
    found = run.pick(60.2, 45.9)
    i = round(found.attributes["intensity"])
    rng = np.random.default_rng(3)
    u, v = rng.uniform(-1, 1, (2, 4000))
    ball = rng.normal(size=(2000, 3))
    ball = 0.3 * ball / np.linalg.norm(ball, axis=1)[:, None] + (0, 0, 0.5)
    cloud = np.vstack([np.column_stack([u, v, 0.1 * np.sin(5 * u) * np.cos(4 * v)]), ball])
    expected = np.rint(cloud * 1024) / 1024 + FAR
    assert found.position == tuple(expected[i]), "to the last bit"
    assert found.attributes["classification"] == i % 7
    assert found.attributes["rgb"] == [i & 255, i >> 8 & 255, 0]
    assert found.attributes["gps_time"] == 1e9 + i / 3
    assert np.linalg.norm(found.attributes["normal"]) == pytest.approx(1)
    assert found.attributes == attributes_of(run.scene, found.index)
    camera = run.camera
    assert found.depth == pytest.approx(camera.clip_from_world[3, :3] @ (np.array(found.position) - camera.eye))


def test_what_is_filtered_out_is_not_picked(make_scene):
    scene, size = make_scene(), SIZES["3"]
    above = ClipBox((-2, -2, 0.12), (2, 2, 2), keep_inside=False)
    for point_filter in (PointFilter((2, 5)), PointFilter((), (above,)), PointFilter((1,), (above,))):
        run = Run(scene, camera_at(), size, point_filter=point_filter)
        found = [run.pick(x, y, tolerance_px=0.0) for x, y in pixels(60)]
        kept = [picked for picked in found if picked]
        assert len(kept) > 5
        words = run.drawn()
        shown = [words[int(y), int(x)] != FRAMEBUFFER_EMPTY for x, y in pixels(60)]
        assert sum(bool(picked) != is_shown for picked, is_shown in zip(found, shown, strict=True)) <= 1
        for picked in kept:
            assert not point_filter.classes or picked.attributes["classification"] in point_filter.classes
            assert not point_filter.boxes or picked.position[2] < 0.12


def test_nothing_is_found_in_the_background_or_behind_the_near_plane(make_scene):
    scene = make_scene()
    assert Run(scene, camera_at()).pick(2, 2) is None
    assert Run(scene, camera_at(eye=(0, -3, 0.2), target=(0, -6, 0.2))).pick(60, 45) is None, "turned away"
    through = camera_at(eye=(0, 0, 1.5), target=(0.001, 0, 0), near=1.3)
    found = Run(scene, through, SIZES["3"]).pick(60, 45)
    assert found is None or found.depth >= 1.3, "the top of the ball is nearer than the near plane"


def test_beside_a_point_the_nearest_within_the_tolerance_is_found(make_scene):
    run = Run(make_scene(), camera_at())
    words = run.drawn()
    x, y = next((x, y) for x, y in pixels(500) if words[int(y), int(x)] == FRAMEBUFFER_EMPTY and run.pick(x, y))
    found = run.pick(x, y)
    assert 0 < found.beside_px <= 4
    assert run.pick(x, y, tolerance_px=found.beside_px * 1.001).index == found.index
    assert run.pick(x, y, tolerance_px=found.beside_px * 0.999) is None


def test_few_points_are_looked_at_where_most_may_not_be(make_scene, monkeypatch):
    scene = make_scene()
    looked = []
    original = Picker._offsets
    monkeypatch.setattr(
        Picker, "_offsets", lambda self, pieces: looked.append(pieces["count"].sum()) or original(self, pieces)
    )
    far = camera_at(eye=(300, -300, 200))  # all of it lies within some pixels
    assert Run(scene, far, threshold=0.0).pick(60, 45)
    all_of_it = sum(looked)
    looked.clear()
    assert Run(scene, far, threshold=0.0, most_points=2000).pick(60, 45)
    assert all_of_it > 4000
    assert sum(looked) <= 2400


def test_pooled_cells_are_picked_in_their_stored_points(tmp_path):
    u, v = np.indices((300, 200)).reshape(2, -1) / 300
    sheet = ArraySource(np.column_stack([u, v, 0.1 * np.sin(4 * u) * np.cos(3 * v)]))
    build_scene([sheet], tmp_path / "s", settings=BuildSettings(points_per_cell=6000, pools=True, pool_bits=6))
    scene = Scene.open(tmp_path / "s")
    octree, camera = scene.octree(pools=True), camera_at(eye=(1.9, -1.4, 1.4))
    bits = CullingNode(octree, backface=False).process(camera)
    entries = SamplingNode(octree, pixel_threshold=0, pools="bytes").process(camera, bits).entries
    assert (entries["stride"] == 0).any(), "something is drawn from pools"
    wanted = Wanted(pools=True)
    points = load_points(scene, Colouring.choose(scene, "elevation"), wanted, verify=False)
    with make_rasterizer("cpu", points, WIDTH, HEIGHT, PointSize(), 1) as rasterizer:
        words = rasterizer.draw(camera, entries).copy()
    picker = Picker(scene, octree)
    rows, columns = np.nonzero(words != FRAMEBUFFER_EMPTY)
    for i in range(0, len(rows), len(rows) // 40):
        found = picker.pick(camera, entries, columns[i], rows[i], tolerance_px=1.5)
        assert found is not None, "within a bin, which is less than a pixel"


def test_splats_are_picked_where_their_discs_are(make_scene):
    scene = make_scene(splats=True)
    run = Run(scene, camera_at(), splats=SplatSettings())
    words = run.drawn()
    depths = (words >> np.uint64(32)).astype(np.uint32).view(np.float32)
    rows, columns = np.nonzero(words != FRAMEBUFFER_EMPTY)
    chosen = np.random.default_rng(2).choice(len(rows), 80, replace=False)
    near = 0
    for row, column in zip(rows[chosen], columns[chosen], strict=True):
        found = run.pick(column, row)
        near += found is not None and abs(found.depth - depths[row, column]) < 0.05
    assert near >= 76
