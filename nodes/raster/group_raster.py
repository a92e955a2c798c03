"""The ``cpu`` rasterizer over linear groups: whole cells in the form in which they are stored, none of them decoded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ...shared.camera import Camera
from ...shared.errors import MessageError
from . import PointSize, world_sides
from .framebuffers import FramebufferRasterizer
from .groups import GroupCells, draw_groups
from .pieces import check_entries


@dataclass(frozen=True)
class ResidentGroups:
    """The render rank's half of a scene in linear groups: what ``ResidentPoints`` is of positions.

    cells : those that own points, in stored order.
    first_point : (c + 1,) int64, ascending from 0: cell i is the points first_point[i] … first_point[i + 1] − 1 of the
        point-array, in no order.
    block_spacing : (c,) float32 or None, as of ``ResidentPoints``, blocks being cells.
    """

    cells: GroupCells
    first_point: np.ndarray
    block_spacing: np.ndarray | None = None

    def __len__(self) -> int:
        return int(self.first_point[-1])

    @property
    def block_origin(self) -> np.ndarray:
        """(c, 3) float64, world frame."""
        return self.cells.origin

    def cells_of(self, entries: np.ndarray) -> np.ndarray:
        """(k,) int64, the cells that (m,) RENDER_POINT entries draw, in their order.

        Raises MessageError for an entry beyond the point-array, of another stride than 1, or not of whole cells (a
        longer range is split, and goes on where the entry ends).  Cost: O(m log c + k).
        """
        check_entries(entries, len(self))
        begin = entries["offset"].astype(np.int64)
        end = begin + entries["range"]
        first, last = np.searchsorted(self.first_point, [begin, end])
        starts = (self.first_point[first] == begin) | (begin == np.append(-1, end[:-1]))
        stops = (self.first_point[last] == end) | (end == np.append(begin[1:], -1))
        good = starts & stops & (entries["stride"] == 1)
        if not good.all():
            i = int(good.argmin())
            raise MessageError(
                f"render-points entry {i}: found offset {begin[i]}, range {end[i] - begin[i]}, "
                f"stride {entries['stride'][i]}, expected whole cells with a stride of 1 for linear groups"
            )
        counts = last - first  # cells that start in the entry
        return np.repeat(first - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())


class CpuGroupRasterizer(FramebufferRasterizer):
    """Draws linear groups on the CPU; a context manager that owns its threads and framebuffers.

    points, width, height, size, threads : as of ``CpuRasterizer``; ``size`` may be adaptive if groups have a spacing.
    Frames have the same bits for any number of threads.
    Raises InputError if one of them is out of range.  Memory: that of the framebuffers.
    """

    name = "cpu"

    def __init__(
        self,
        points: ResidentGroups,
        width: int,
        height: int,
        size: PointSize = PointSize(),  # noqa: B008 (frozen)
        threads: int | None = None,
    ) -> None:
        super().__init__(width, height, size, threads)
        self._points = points
        self._cells = points.cells._replace(world_side=world_sides(points, size))

    def draw(self, camera: Camera, entries: np.ndarray) -> np.ndarray:
        """(height, width) uint64 framebuffer words, row 0 on top; valid until the next call.

        entries : (m,) RENDER_POINT.  Raises MessageError as ``ResidentGroups.cells_of`` does, and for a camera of
        another viewport.
        """
        cells = self._points.cells_of(entries)
        n_points = int(np.diff(self._points.first_point)[cells].sum())
        return self._draw_frame(camera, n_points, (partial(draw_groups, self._cells, cells), len(cells)))
