"""Random layers for tests."""

import numpy as np
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.layers import cuboids
from splatpipe.shared.layers.layer import simple_layer


def random_cuboids(n, seed=0, origin=(0.0, 0.0, 0.0), size=100.0):
    rng = np.random.default_rng(seed)
    objects = np.zeros(n, cuboids.OBJECT)
    objects["center"] = rng.uniform(-size, size, (n, 2))
    objects["extent"] = rng.uniform(0.0, size / 10, (n, 2))
    objects["height"] = rng.uniform(-size / 10, size / 5, (n, 2))
    objects["value"] = rng.normal(size=n)
    return simple_layer("random", "cuboids", np.array(origin), objects)


def look_at_box(lower, upper, seed, width=160, height=120):
    """A camera somewhere around a box, or in it, that looks at a point of it."""
    rng = np.random.default_rng(seed)
    extent = np.linalg.norm(upper - lower)
    eye = (lower + upper) / 2 + rng.normal(size=3) * extent * rng.choice([0.1, 0.6, 1.5])
    pose = look_at(eye, rng.uniform(lower, upper), np.array([0.0, 0.0, 1.0]))
    return perspective_camera(
        frame=0, world_from_camera=pose, fov_y_rad=0.8, width=width, height=height, near=1e-3 * extent
    )


TECHNIQUES = ("avc", "instancing", "triangles", "strips")


def captured(layer, settings, most_triangles):
    """(t, 3, 3) positions and (t, 3, 3) normals of the triangles that the shaders of technique ``avc`` make."""
    from splatpipe.nodes.layers.gl_canvas import GlLayers

    with GlLayers([layer], [settings], 64, 64) as canvas, canvas._context:
        (drawn,) = canvas._layers
        camera = look_at_box(*(corner.mean(axis=0) for corner in layer.bounds), 0, 64, 64)
        canvas._framebuffer.use()  # a complete one, though nothing is drawn to it
        drawn.set_camera(camera)
        buffer = canvas._context.buffer(np.full(18 * most_triangles, np.nan, "f4"))
        drawn.vertices.transform(buffer)
        found = np.frombuffer(buffer.read(), "f4").reshape(-1, 3, 2, 3)
        found = found[~np.isnan(found).any(axis=(1, 2, 3))]
        assert len(found) < most_triangles, "the buffer may have been too small"
        return found[:, :, 0].astype(np.float64), found[:, :, 1].astype(np.float64)


def sorted_triangles(position, normal, decimals=3):
    """Triangles and normals in an order that does not depend on who made them, each begun at its least corner."""
    start = np.lexsort(np.round(position, decimals).transpose(2, 0, 1)[::-1], axis=-1)[:, 0]
    turn = (start[:, None] + np.arange(3)) % 3
    rows = np.arange(len(position))[:, None]
    position, normal = position[rows, turn], normal[rows, turn]
    order = np.lexsort(np.round(np.concatenate([position, normal], axis=1), decimals).reshape(len(position), -1).T)
    return position[order], normal[order]
