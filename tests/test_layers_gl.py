"""Cuboids drawn: shaders against NumPy, techniques against each other, layers and points in one picture."""

import numpy as np
import pytest
from layer_example import TECHNIQUES, captured, look_at_box, random_cuboids, sorted_triangles
from splatpipe.nodes.culling import CullingNode
from splatpipe.nodes.layer_sampling import LayerSamplingNode
from splatpipe.nodes.layers.expand_cuboids import strips
from splatpipe.nodes.layers.gl_canvas import GlLayers
from splatpipe.nodes.layers.mesh import separate
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.shared.errors import MessageError
from splatpipe.shared.layer_config import LayerSection
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT

pytestmark = [pytest.mark.gl, pytest.mark.skipif(not gl_available()[0], reason=gl_available()[1])]


@pytest.mark.parametrize("seed", range(3))
def test_the_geometry_shader_makes_the_triangles_of_the_reference(seed):
    layer = random_cuboids(200, seed, origin=(6e6, 0.0, 0.0))
    position, normal = captured(layer, LayerSection(path=""), 13 * len(layer))
    mesh = separate(strips(layer))
    assert len(position) == 12 * len(layer)
    flat = np.repeat(normal[:, 2:], 3, axis=1)  # of its last vertex
    found, expected = (
        sorted_triangles(position, flat),
        sorted_triangles(*(a.reshape(-1, 3, 3) for a in (mesh.position, mesh.normal))),
    )
    np.testing.assert_allclose(found[0], expected[0], atol=2e-4)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-6)


def pictures(layer, camera, **settings):
    chosen = LayerSamplingNode(layer.octree, detail_px=0).process(
        camera, CullingNode(layer.octree, backface=False).process(camera)
    )
    for technique in TECHNIQUES:
        section = LayerSection(path="", technique=technique, **settings)
        with GlLayers([layer], [section], camera.width, camera.height) as canvas:
            yield canvas.draw(camera, [chosen.entries]).copy()


@pytest.mark.parametrize("seed", range(4))
def test_all_techniques_draw_the_same_picture(seed):
    layer = random_cuboids(300, seed, origin=(6e6, 5e6, 0.0))
    lower, upper = layer.bounds
    camera = look_at_box(lower.min(axis=0), upper.max(axis=0), seed)
    first, *others = pictures(layer, camera, value_filter=(-1.0, 5.0))
    drawn = first != FRAMEBUFFER_EMPTY
    assert drawn.any()
    for other in others:
        colours = first.astype("<u4") != other.astype("<u4")
        assert colours.sum() <= 0.002 * drawn.sum() + 2  # edges that fall on a pixel's centre
        both = ~colours & drawn
        depth, other_depth = ((words[both] >> np.uint64(32)).astype("<u4").view("<f4") for words in (first, other))
        np.testing.assert_allclose(depth, other_depth, rtol=1e-4)


def test_a_filter_draws_what_a_layer_without_the_others_would():
    layer = random_cuboids(200, 5)
    lower, upper = layer.bounds
    camera = look_at_box(lower.min(axis=0), upper.max(axis=0), 2)
    some, none = (next(pictures(layer, camera, value_filter=f, value_range=(-2, 2))) for f in ((0, 9), (99, 100)))
    kept = layer.objects["value"] >= 0
    entries = np.zeros(kept.sum(), RENDER_POINT)
    entries["offset"], entries["range"], entries["stride"] = np.flatnonzero(kept), 1, 1
    with GlLayers([layer], [LayerSection(path="", value_range=(-2, 2))], camera.width, camera.height) as canvas:
        assert np.array_equal(canvas.draw(camera, [entries]), some)
        beyond = np.array([(199, 2, 1)], RENDER_POINT)
        with pytest.raises(MessageError, match="range"):
            canvas.draw(camera, [beyond])
    assert (none == FRAMEBUFFER_EMPTY).all()


def test_flat_and_empty_boxes_draw_without_harm():
    layer = random_cuboids(50, 6)
    layer.objects["extent"][:25] = 0
    layer.objects["height"][10:40, 1] = layer.objects["height"][10:40, 0]
    lower, upper = layer.bounds
    camera = look_at_box(lower.min(axis=0), upper.max(axis=0), 0)
    with GlLayers([layer], [LayerSection(path="")], camera.width, camera.height) as canvas:
        words = canvas.draw(camera, [np.array([(0, 50, 1)], RENDER_POINT)])
    depth = (words[words != FRAMEBUFFER_EMPTY] >> np.uint64(32)).astype("<u4").view("<f4")
    assert len(depth)
    assert np.isfinite(depth).all()
    assert (depth >= camera.near * (1 - 1e-5)).all()
