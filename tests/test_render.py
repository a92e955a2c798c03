"""The render node behind culling and sampling: the picture is that of all points, and what is wrong is said."""

import numpy as np
import pytest
from build_sources import ArraySource
from splatpipe.nodes.culling import CullingNode
from splatpipe.nodes.raster import PointSize, gl_context
from splatpipe.nodes.raster.choose import make_rasterizer
from splatpipe.nodes.raster.cpu import CpuRasterizer
from splatpipe.nodes.render import RenderNode, load_points
from splatpipe.nodes.sampling import SamplingNode
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.colour import Colouring
from splatpipe.shared.errors import ConfigError, MessageError, StoreError
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RenderPoints, VisibilityBits
from splatpipe.shared.points import pack_normals
from splatpipe.shared.store import Scene

WIDTH, HEIGHT = 200, 150
SHIFT = 6.4e6


@pytest.fixture(scope="module")
def make_scene(tmp_path_factory):
    """A sphere with outward normals, 100 units across, each point in a colour of its own."""

    def make(order="layered", n=20_000):
        outward = np.random.default_rng(1).normal(size=(n, 3))
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        columns = {"rgb": np.arange(n, dtype=np.uint32) | np.uint32(0xFF000000), "normal": pack_normals(outward)}
        path = tmp_path_factory.mktemp("render") / "s.scene"
        settings = BuildSettings(point_order=order, points_per_cell=30, threads=1)
        build_scene([ArraySource(50 * outward + SHIFT, columns)], path, settings=settings)
        return Scene.open(path)

    return make


def cameras(n):
    """Inside, on, near and far from the sphere, looking anywhere."""
    rng = np.random.default_rng(2)
    for frame in range(n):
        eye = SHIFT + rng.normal(size=3) * [5.0, 30.0, 60.0, 500.0][frame % 4]
        pose = look_at(eye, SHIFT + rng.normal(size=3) * 40, rng.normal(size=3))
        fov = [0.2, 1.0, 2.5][frame % 3]
        yield perspective_camera(
            frame=frame, world_from_camera=pose, fov_y_rad=fov, width=WIDTH, height=HEIGHT, near=0.05
        )


@pytest.mark.parametrize("order", ["layered", "depth-first"])
@pytest.mark.parametrize(
    "size", [PointSize(), PointSize(pixels=7), PointSize(pixels=1, world=2.0, maximum=33)], ids=["1px", "7px", "world"]
)
def test_culling_changes_no_pixel(make_scene, order, size):
    scene = make_scene(order)
    octree = scene.octree()
    margin_px = (size.maximum if size.world else size.pixels) / 2 + 0.5
    culling = CullingNode(octree, backface=False, margin_px=margin_px)
    sampling = SamplingNode(octree, pixel_threshold=0.0)
    points = load_points(scene, Colouring.choose(scene, "rgb"), verify=False)
    with make_rasterizer("cpu", points, WIDTH, HEIGHT, size, 1) as rasterizer:
        node = RenderNode(rasterizer)
        n_culled = n_drawn = 0
        for camera in cameras(24):
            bits = culling.process(camera)
            everything = VisibilityBits.pack(camera.frame, np.ones(len(octree), np.uint8))
            expected = node.process(camera, sampling.process(camera, everything)).copy()
            np.testing.assert_array_equal(node.process(camera, sampling.process(camera, bits)), expected)
            n_culled += int((bits.unpack() == 0).sum())
            n_drawn += int((expected != FRAMEBUFFER_EMPTY).sum())
        assert n_culled > len(octree)
        assert n_drawn > 1000


def test_back_face_culling_takes_only_what_faces_away(make_scene):
    scene = make_scene()
    octree = scene.octree()
    points = load_points(scene, Colouring.choose(scene, "rgb"), verify=False)
    pose = look_at(np.array([SHIFT + 200, SHIFT, SHIFT]), np.full(3, SHIFT), np.array([0.0, 0.0, 1.0]))
    camera = perspective_camera(frame=0, world_from_camera=pose, fov_y_rad=0.7, width=WIDTH, height=HEIGHT, near=0.1)
    sampling = SamplingNode(octree, pixel_threshold=0.0)
    with make_rasterizer("cpu", points, WIDTH, HEIGHT, PointSize(), 1) as rasterizer:
        frames = []
        for backface in (False, True):
            bits = CullingNode(octree, backface=backface).process(camera)
            chosen = sampling.process(camera, bits)
            frames.append((chosen.n_points, RenderNode(rasterizer).process(camera, chosen).copy()))
    (n_all, both), (n_front, front) = frames
    assert n_front < 0.65 * n_all
    kept = front != FRAMEBUFFER_EMPTY
    np.testing.assert_array_equal(front[kept], both[kept])
    hidden = (both >> np.uint64(32)).astype(np.uint32).view(np.float32)[~kept & (both != FRAMEBUFFER_EMPTY)]
    assert (hidden > 200 - 50 * 50 / 200 - 1).all()  # behind the horizon of the sphere


def test_a_damaged_array_is_named_before_it_is_drawn(make_scene):
    scene = make_scene(n=100)
    path = scene.path / "attr_rgb.npy"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    colouring = Colouring.choose(scene, "rgb")
    with pytest.raises(StoreError, match=r"attr_rgb\.npy"):
        load_points(scene, colouring, verify=True)
    assert len(load_points(scene, Colouring.choose(scene, "elevation"), verify=True)) == scene.info.n_stored


def test_messages_of_different_frames_are_refused(make_scene):
    scene = make_scene(n=100)
    points = load_points(scene, Colouring.choose(scene, "#ffffff"), verify=True)
    camera = next(cameras(1))
    with make_rasterizer("cpu", points, WIDTH, HEIGHT, PointSize(), 1) as rasterizer:
        node = RenderNode(rasterizer)
        node.warm_up(camera)
        assert node.description == "cpu (1 CPU thread)"
        sampling = SamplingNode(scene.octree(), pixel_threshold=0.0)
        chosen = sampling.process(camera, VisibilityBits.pack(0, np.ones(scene.info.n_cells, np.uint8)))
        with pytest.raises(MessageError, match="found frame 7, expected frame 0"):
            node.process(camera, RenderPoints(7, chosen.entries))


@pytest.mark.parametrize("found", [(False, "no EGL"), (True, "llvmpipe (LLVM 15)")])
def test_auto_is_the_cpu_where_no_gpu_draws(make_scene, monkeypatch, found):
    monkeypatch.setattr(gl_context, "gl_available", lambda: found)
    scene = make_scene(n=10)
    points = load_points(scene, Colouring.choose(scene, "auto"), verify=False)
    with make_rasterizer("auto", points, 4, 4, PointSize(), None) as rasterizer:
        assert isinstance(rasterizer, CpuRasterizer)


def test_an_unknown_rasterizer_is_refused(make_scene):
    scene = make_scene(n=10)
    points = load_points(scene, Colouring.choose(scene, "auto"), verify=False)
    with pytest.raises(ConfigError, match=r"render\.rasterizer = 'vulkan', expected one of auto, cpu, gl, gl-points"):
        make_rasterizer("vulkan", points, 4, 4, PointSize(), None)
