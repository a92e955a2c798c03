"""More points than 32 bits count: counts, ranges and offsets, on point-arrays that are holes in a file."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from ...shared.camera import Camera
from ...shared.messages import (
    FRAMEBUFFER_EMPTY,
    RENDER_POINT,
    RenderPoints,
    VisibilityBits,
    decode_render_points,
    encode,
)
from ...shared.octree import Octree
from ...shared.stability.case import OutOfReach, case, cases
from ..raster import ResidentPoints
from ..raster.cpu import CpuRasterizer
from ..raster.pieces import split_entries
from ..sampling import SamplingNode
from .chain import camera_at


def _one_leaf(n_points: int, point_order: str) -> Octree:
    return Octree(
        origin=np.zeros(3),
        edge=1.0,
        level=np.zeros(1, np.uint8),
        code=np.zeros(1, np.uint64),
        parent=np.full(1, -1, np.int32),
        first_child=np.full(1, -1, np.int32),
        n_children=np.zeros(1, np.uint8),
        first_point=np.zeros(1, np.int64),
        n_points=np.array([n_points]),
        n_below=np.array([n_points]),
        cone=None,
        point_order=point_order,
    )


def _looking_at_it() -> Camera:
    return camera_at(np.array([3.0, 0.5, 0.5]), np.full(3, 0.5), width=480, height=270)


_COUNTS = dict.fromkeys((2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**33 + 12345, 2**40 + 1), 0.0)


@cases("large/points of a frame", bounds={f"{n:,}".replace(",", " "): b for n, b in _COUNTS.items()}, unit="points")
def points_of_a_frame(count: str) -> float:
    """Points that sampling a leaf of this many loses or doubles: sum of the render-points entries, of the message that
    carries them, and of the pieces the rasterizer makes of them; last point included.
    """
    n = int(count.replace(" ", ""))
    wrong = 0
    for order in ("layered", "depth-first"):
        node = SamplingNode(_one_leaf(n, order), pixel_threshold=0.0)
        chosen = node.process(_looking_at_it(), VisibilityBits.pack(0, np.ones(1, bool)))
        wrong += abs(chosen.n_points - n)
        wrong += abs(decode_render_points(0, encode(chosen)[1]).n_points - n)
        pieces = split_entries(chosen.entries, np.zeros(1, np.int64), n, 1 << 31)
        wrong += abs(int(pieces["count"].sum(dtype=np.int64)) - n)
        wrong += abs(int(pieces["first"][-1] + pieces["count"][-1]) - n)
    return wrong


@case("large/strided points of a frame", bound=0.0, unit="points")
def strided() -> float:
    """Points of entries with strides 3 and 2³²−1 over 2³⁴ points, as the message counts them and as pieces, against
    integers.
    """
    n = 1 << 34
    entries = np.array([(0, 2**32 - 1, 3), (2**32, 2**32 - 1, 2**32 - 1), (2**33, 2**32 - 1, 1)], RENDER_POINT)
    exact = sum(-(-length // stride) for _, length, stride in entries.tolist())
    pieces = split_entries(entries, np.array([0, 2**32, 2**33 + 5]), n, 1 << 31)
    counted = int(pieces["count"].sum(dtype=np.int64))
    return abs(RenderPoints(0, entries).n_points - exact) + abs(counted - exact)


@cases("large/offset", bounds={"2^29": 0.0, "2^30": 0.0, "2^31": 0.0, "2^32": 0.0}, unit="pixels")
def offset(name: str) -> float:
    """Pixels that are not as the last 1000 points of a point-array of this many say (bytes beyond 2³¹ and 2³²), drawn
    by stride 1 and by stride 2; the points before them are a hole in a file.
    """
    n, tail = 1 << int(name[2:]), 1000
    with tempfile.TemporaryDirectory(prefix="splatpipe-stability-") as folder:
        path = Path(folder) / "column"
        try:
            column = np.memmap(path, np.float32, "w+", shape=(n,))
        except OSError as error:
            raise OutOfReach(f"no file with a hole of {4 * n >> 30} GiB here: {error}") from None
        column[-tail:] = np.linspace(0.0, 1.0, tail)  # points on the cube's diagonal
        wrong = sum(_differing(column, n - tail, stride) for stride in (1, 2))
        del column
    return wrong


def _differing(column: np.ndarray, first: int, stride: int) -> int:
    def frame(column: np.ndarray, first: int) -> np.ndarray:
        points = ResidentPoints(
            column, column, column, column.view(np.uint32), np.zeros(1, np.int64), np.array([[0.0, 0.0, 0.0]])
        )
        camera = camera_at(np.array([3.0, 0.2, 0.5]), np.full(3, 0.5), width=480, height=270)
        with CpuRasterizer(points, camera.width, camera.height, threads=2) as rasterizer:
            return rasterizer.draw(camera, np.array([(first, len(column) - first, stride)], RENDER_POINT)).copy()

    expected = frame(np.array(column[first:]), 0)
    drawn = int((expected != FRAMEBUFFER_EMPTY).sum())
    return int((frame(column, first) != expected).sum()) + (drawn == 0)


@case("large/2 GiB drawn in one frame", bound=0.0, unit="pixels")
def two_gibibytes() -> float:
    """Pixels of a frame of 2²⁷ + 1000 points (16 bytes each) that differ from a frame of the last 1000, all the others
    being in front of the near plane; every one is read.
    """
    n, tail = (1 << 27) + 1000, 1000
    behind = np.float32(-1.0)
    column = np.full(1 << 20, behind)
    column[-tail:] = np.linspace(0.0, 1.0, tail)
    entries = np.ones(n // len(column) + 1, RENDER_POINT)  # the same megabyte again and again, then its tail
    entries["offset"], entries["range"] = 0, len(column) - tail
    entries["offset"][-1], entries["range"][-1] = len(column) - tail, tail
    points = ResidentPoints(column, column, column, column.view(np.uint32), np.zeros(1, np.int64), np.zeros((1, 3)))
    camera = camera_at(np.array([-0.5, -0.4, -0.5]), np.full(3, 0.5), width=480, height=270)
    with CpuRasterizer(points, camera.width, camera.height, threads=2) as rasterizer:
        expected = rasterizer.draw(camera, entries[-1:]).copy()
        found = rasterizer.draw(camera, entries)
        return int((found != expected).sum()) + (not (expected != FRAMEBUFFER_EMPTY).any())
