"""Borders of pixels, and the smallest and largest images."""

from __future__ import annotations

import numpy as np

from ...shared.build.settings import available_memory_bytes
from ...shared.camera import Camera
from ...shared.messages import FRAMEBUFFER_EMPTY
from ...shared.stability.case import OutOfReach, case, cases, expect
from ..raster import MAX_SIDE_PX
from ..raster.reference import project_float32
from .chain import draw_all, in_one_block


def _exact_camera(width: int, height: int) -> Camera:
    """At the origin along z, x to the right and y downwards, one pixel a world unit at depth one, all numbers exact."""
    clip = np.array([[2 / width, 0, 0, 0], [0, -2 / height, 0, 0], [0, 0, 0, 2.0**-10], [0, 0, 1.0, 0]])
    return Camera(0, clip, np.zeros(3), width, height, 2.0**-10)


@cases("viewport/pixel borders at depth 2^", bounds=dict.fromkeys((-8, 0, 8, 20), 0.0), unit="points")
def pixel_borders(exponent: int) -> float:
    """Points on the wrong pixel (against integers) among points exactly on the borders between 512 columns and 256
    rows, the image's own borders and ±0 included, all in exact arithmetic: a border belongs to the pixel after it.
    """
    width, height = 512, 256
    depth = 2.0**exponent
    u, v = (a.ravel() for a in np.meshgrid(np.arange(-1, width + 2), np.arange(-1, height + 2)))
    x, y = (u - width / 2) * depth, (v - height / 2) * depth
    frame = draw_all(in_one_block(np.column_stack([x, y, np.full(len(x), depth)])), _exact_camera(width, height))
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    number = np.arange(len(u))[inside]
    found = frame & np.uint64(0xFFFFFFFF)
    expect((frame != FRAMEBUFFER_EMPTY).sum() > 0, "points are drawn")
    return int((found[v[inside], u[inside]] != number.astype(np.uint64)).sum())


@case("viewport/one float32 step from the border", bound=0.0, unit="points")
def beside_the_border() -> float:
    """Points kept outside or lost inside the image, one float32 step of u either side of 0 and of 512, and at −0.0."""
    width, height = 512, 256
    camera = _exact_camera(width, height)
    wrong = 0
    left, right = np.float32(-width / 2), np.float32(width / 2)
    for x, kept in (
        (left, 1),
        (np.nextafter(left, np.float32(0)), 1),
        (right, 0),
        (right - np.float32(2**-14), 1),
        (np.nextafter(left, np.float32(-np.inf)), 0),
        (np.float32(-0.0), 1),
    ):
        frame = draw_all(in_one_block(np.array([[x, -0.0, 1.0]])), camera)
        wrong += abs(int((frame != FRAMEBUFFER_EMPTY).sum()) - kept)
    return wrong


@cases(
    "viewport/size",
    bounds=dict.fromkeys(("1×1", f"1×{MAX_SIDE_PX}", f"{MAX_SIDE_PX}×1", "16384×16384"), 0.0),
    unit="pixels",
)
def size(name: str) -> float:
    """Pixels that differ from the NumPy twin for 100 000 points over all of an image of this size and its corners."""
    width, height = map(int, name.split("×"))
    needed = 3 * 8 * width * height  # a frame, and one for each thread
    if available_memory_bytes() < needed + (2 << 30):
        raise OutOfReach(f"needs {needed / 2**30:.0f} GiB of memory")
    rng = np.random.default_rng(43)
    z = rng.uniform(0.5, 2.0, 100_000)
    u, v = rng.uniform(-0.1, 1.1, len(z)) * width, rng.uniform(-0.1, 1.1, len(z)) * height
    u[:4], v[:4] = [0.25, width - 0.25] * 2, [0.25, 0.25, height - 0.25, height - 0.25]
    points = in_one_block(np.column_stack([(u - width / 2) * z, (v - height / 2) * z, z]))
    camera = _exact_camera(width, height)
    found = draw_all(points, camera).reshape(-1)
    u, v, w = project_float32(points, camera, np.arange(len(z)))
    seen = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    expect(seen[:4].all(), "the corners are in the image")
    place = v[seen].astype(np.int64) * width + u[seen].astype(np.int64)
    word = w[seen].view(np.uint32).astype(np.uint64) << np.uint64(32) | points.colour[seen]
    order = np.lexsort((word, place))
    place, first = np.unique(place[order], return_index=True)
    n_drawn = sum(int((part != FRAMEBUFFER_EMPTY).sum()) for part in np.array_split(found, max(1, len(found) >> 22)))
    return int((found[place] != word[order][first]).sum()) + abs(n_drawn - len(place))
