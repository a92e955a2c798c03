"""Frames drawn from pools: cells of any size and place, eyes among the points, matrices that stretch or flatten."""

from __future__ import annotations

import numpy as np

from ...shared.codecs import streams
from ...shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from ...shared.stability.case import cases, expect
from ..raster import ResidentPoints
from ..raster.cpu import CpuRasterizer
from ..raster.pools import PoolCell, pool_cells
from ..raster.pools_reference import decoded, project_pools
from ..raster.reference import project, reference_frame
from .chain import every_point
from .encoded_views import BOUNDS, VIEWS, camera_on
from .matrices import MATRICES, SEEN, through

_BITS = 7


def _sheet(edge: float, shift: float) -> PoolCell:
    """A wavy sheet in a cell of this edge, its lower corner at ``shift`` on each axis."""
    x, y = np.indices((128, 128)).reshape(2, -1)
    z = (64 + 6 * np.sin(x / 25) * np.cos(y / 32)).astype(int)
    coded = streams.encode(np.column_stack([x, y, z]), _BITS)
    points = streams.read_pools(coded.data, _BITS, len(x))
    expect(points.coverage > 0.5, "pools hold many points")
    colour = np.arange(len(points)).astype(np.uint8)
    return PoolCell(points, np.full(3, shift), edge / 2**_BITS, np.arange(256, dtype=np.uint32), colour)


@cases("pools/image position", bounds=BOUNDS, unit="px")
def image_position(name: str) -> float:
    """Image position of points that are sums of a transformed vertex and translation, in float32 as the kernel rounds,
    against float64; 1920×1080.
    """
    edge, shift, eye = VIEWS[name]
    cell, camera = _sheet(edge, shift), camera_on(edge, shift, eye)
    points, index = decoded([cell]), np.arange(len(cell.points))
    u, v, _ = project_pools([cell])(points, camera, index)
    exact_u, exact_v, w = project(points, camera, index)
    seen = (w >= camera.near) & (exact_u >= 0) & (exact_u < 1920) & (exact_v >= 0) & (exact_v < 1080)
    expect(seen.sum() > 500, "points are in the image")
    return float(np.hypot(u - exact_u, v - exact_v)[seen].max())


@cases("pools/matrix", bounds=dict.fromkeys(MATRICES, 0.0), unit="pixels")
def matrix(name: str) -> float:
    """Pixels of a frame from pools that differ from the NumPy twin's, the camera's matrix stretched, flattened, without
    depth, or too large for float32.
    """
    cell, camera = _sheet(1.0, 0.0), through(camera_on(1.0, 0.0, (0.5, -2.0, 1.5)), name)
    none = np.empty(0, np.float32)
    held = ResidentPoints(
        none, none, none, np.empty(0, np.uint32), np.zeros(1, np.int64), np.zeros((1, 3)), pools=pool_cells([cell])
    )
    with CpuRasterizer(held, camera.width, camera.height, threads=1) as rasterizer:
        found = rasterizer.draw(camera, np.array([(0, len(cell.points), 0)], RENDER_POINT))
        with np.errstate(all="ignore"):
            points = decoded([cell])
            expected = reference_frame(points, camera, every_point(points), projection=project_pools([cell]))
        expect((expected != FRAMEBUFFER_EMPTY).any() == (name in SEEN), "points are in the image, or none can be")
        return int((found != expected).sum())
