"""Linear groups: points near a line that two others define are held as one byte, their parameter on it. Lossy.

A group is the segment from V1 to V2 and the parameters t of its *inner* points, Q = V1 + t (V2 − V1) with t in
1/256; V1 and V2 may define several groups. All points that are not inner are *kept* as grid points. Coded order: the
kept points by partition, then the inner ones by group. An affine or projective map is applied to the kept points only;
the others are interpolated, in homogeneous coordinates.

====================  =========================================================================================
bytes                 content (numbers as ``varints``)
====================  =========================================================================================
q                     partitions; nothing follows where there is none
q numbers             kept points of each, ≥ 1
q numbers             groups of each
3·q numbers           lowest coordinates of its kept points, x, y and z of each in turn
3·q numbers           bits of their offsets from there, likewise
g numbers             inner points of each group, less one
g numbers             V1, among the kept points of the partition
g numbers             V2 − V1 − 1
a byte an inner point parameters
stream                x, y and z offset of each kept point, first bit in the top bit of a byte, filled up with zeros
====================  =========================================================================================

Decoding refuses what cannot be drawn; which of the possible groupings it was given it cannot tell.
Source: Dinerstein, Egbert, Flann, "Linear Grouping: A Method for Optimizing 3D Vertex Transformation and Clipping".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from ..errors import CodecError
from . import Encoded
from .grid import check_bits, check_points
from .group_search import MOST_IN_PART, STEPS, group_partitions, partitions
from .occupancy_kernels import morton_keys
from .order import sorted_order
from .varints import read_varints, write_varints


@dataclass(frozen=True)
class LinearGroups:
    """Grid points as kept points and groups.

    kept : (k, 3) uint32.
    ends : (g, 2) int64, V1 < V2 of each group in ``kept``, both of its partition.
    first_inner : (g + 1,) int64: group i has the inner points first_inner[i] … first_inner[i + 1] − 1, at least one.
    parameter : (m,) uint8, t of the inner points in 1/256.
    first_kept, first_group : (q + 1,) int64, where the partitions start.
    """

    kept: np.ndarray
    ends: np.ndarray
    first_inner: np.ndarray
    parameter: np.ndarray
    first_kept: np.ndarray
    first_group: np.ndarray

    def __len__(self) -> int:
        return len(self.kept) + len(self.parameter)

    def positions(self) -> np.ndarray:
        """(n, 3) float64 in coded order, in grid steps, not rounded: within ε of the grid points they stand for."""
        return self.transformed(np.eye(3, 4))

    def grid_points(self) -> np.ndarray:
        """(n, 3) uint32 in coded order: ``positions`` rounded to the grid."""
        return np.floor(self.positions() + 0.5).astype(np.uint32)

    def transformed(self, target_from_grid: np.ndarray) -> np.ndarray:
        """(n, r) float64, in coded order: an (r, 4) matrix applied to the kept points, and interpolated.

        Each inner point is within ‖A‖ ε of what it stands for, A the first three columns and ‖A‖ its largest singular
        value. With a row for w a projective map: divide afterwards, point by point.  Source: equations 2 and 3.
        """
        kept = self.kept @ target_from_grid[:, :3].T + target_from_grid[:, 3]
        v1, v2 = (np.repeat(self.ends[:, i], np.diff(self.first_inner)) for i in range(2))
        t = self.parameter[:, None] / STEPS
        return np.concatenate([kept, t * (kept[v2] - kept[v1]) + kept[v1]])


class LinearGroupCodec:
    """The ``Codec`` of linear groups.

    epsilon : ε ≥ 0 in grid steps. For a part of an object's extent: that, over the size of a step.
    detail : ε of a partition is at most this part of its largest extent, so that it adapts to local detail; None: not.
    part_points : most points of a partition, 2 … ``MOST_IN_PART``.
    most_ends : branches searched to their end in each partition; the first solution is mostly the best.
    Raises CodecError for a value out of range.
    Cost: time about n · part_points² / 2; more points in a partition are more that can be grouped.
    """

    name = "groups"

    def __init__(
        self, epsilon: float, *, detail: float | None = None, part_points: int = 128, most_ends: int = 1
    ) -> None:
        if not 0 <= epsilon < math.inf:
            raise CodecError(f"linear groups: found epsilon {epsilon}, expected a finite number of grid steps ≥ 0")
        if detail is not None and not 0 <= detail < math.inf:
            raise CodecError(f"linear groups: found detail {detail}, expected a finite number ≥ 0")
        if not 2 <= part_points <= MOST_IN_PART or most_ends < 1:
            raise CodecError(
                f"linear groups: found {part_points} points a partition and {most_ends} ends, "
                f"expected 2 … {MOST_IN_PART} and at least 1"
            )
        self._epsilon, self._detail, self._part_points, self._most_ends = epsilon, detail, part_points, most_ends

    @property
    def error_bound(self) -> float:
        """Most that ``decode`` moves a point, in grid steps: ε, and what rounding to grid points adds."""
        return self._epsilon + math.sqrt(3) / 2

    def encode(self, points: np.ndarray, bits: int) -> Encoded:
        """(n, 3) integers in [0, 2**bits), duplicates allowed. Raises CodecError for anything else."""
        groups, order = self.group(points, bits)
        return Encoded(write(groups), order)

    def decode(self, data: np.ndarray, bits: int, most_points: int) -> np.ndarray:
        """(n, 3) uint32 grid points, in coded order. Raises CodecError for damaged data or above ``most_points``."""
        return read(data, bits, most_points).grid_points()

    def group(self, points: np.ndarray, bits: int) -> tuple[LinearGroups, np.ndarray]:
        """Groups of (n, 3) grid points and, as ``Encoded.order``, (n,) int64. Raises CodecError as ``encode`` does."""
        points = check_points(points, bits)
        keys = morton_keys(points, bits)
        order = sorted_order(keys, 3 * bits)
        points = points[order]
        starts = partitions(keys[order], bits, self._part_points)
        epsilon = self._partition_epsilon(points, starts, bits)
        group, parameter, ends, first_group = group_partitions(
            points.astype(np.int64),
            starts,
            epsilon.astype(np.int64),
            ((STEPS * epsilon) ** 2).astype(np.int64),
            self._most_ends,
        )
        is_kept = group < 0
        kept_before = np.append(0, np.cumsum(is_kept))
        inner = np.argsort(group, kind="stable")[kept_before[-1] :]
        groups = LinearGroups(
            points[is_kept],
            kept_before[ends],
            np.append(0, np.cumsum(np.bincount(group[inner], minlength=len(ends)))),
            parameter[inner],
            kept_before[starts],
            first_group,
        )
        return groups, np.concatenate([order[is_kept], order[inner]])

    def _partition_epsilon(self, points: np.ndarray, starts: np.ndarray, bits: int) -> np.ndarray:
        """(q,) float64, in grid steps. Nothing on the grid is 2**(bits + 1) apart, so more than that is not needed."""
        epsilon = np.full(len(starts) - 1, min(self._epsilon, 2.0 ** (bits + 1)))
        if self._detail is None or not len(points):
            return epsilon
        extent = np.maximum.reduceat(points, starts[:-1]) - np.minimum.reduceat(points, starts[:-1])
        return np.minimum(epsilon, self._detail * extent.max(axis=1))


def write(groups: LinearGroups) -> np.ndarray:
    """(m,) uint8 of linear groups."""
    n_kept = np.diff(groups.first_kept)
    if not len(n_kept):
        return write_varints(np.zeros(1, np.int64))
    lower = np.minimum.reduceat(groups.kept, groups.first_kept[:-1])
    offsets = groups.kept - np.repeat(lower, n_kept, axis=0)
    widths = np.frexp(np.maximum.reduceat(offsets, groups.first_kept[:-1]))[1]
    v1, v2 = (groups.ends - np.repeat(groups.first_kept[:-1], np.diff(groups.first_group))[:, None]).T
    numbers = [
        np.array([len(n_kept)]),
        n_kept,
        np.diff(groups.first_group),
        lower.ravel(),
        widths.ravel(),
        np.diff(groups.first_inner) - 1,
        v1,
        v2 - v1 - 1,
    ]
    stream = np.zeros((int(n_kept @ widths.sum(axis=1)) + 7) // 8, np.uint8)
    _write_offsets(offsets, widths, n_kept, stream)
    return np.concatenate([write_varints(np.concatenate(numbers)), groups.parameter, stream])


def read(data: np.ndarray, bits: int, most_points: int) -> LinearGroups:
    """Linear groups of (m,) uint8 data. Raises CodecError for damaged data or above ``most_points``."""
    check_bits(bits)
    (q,), at = read_varints(data, 0, 1)
    n_kept, at = read_varints(data, at, int(q))
    n_groups, at = read_varints(data, at, int(q))
    lower, at = read_varints(data, at, 3 * int(q))
    widths, at = read_varints(data, at, 3 * int(q))
    lower, widths = lower.reshape(-1, 3), widths.reshape(-1, 3)
    _check((n_kept >= 1) & (n_kept <= MOST_IN_PART) & (n_groups <= MOST_IN_PART), "partitions of any such size")
    _check((lower < 1 << bits) & (widths <= bits), "partitions in such a place")
    n = int(n_groups.sum())
    n_inner, at = read_varints(data, at, n)
    v1, at = read_varints(data, at, n)
    v2, at = read_varints(data, at, n)
    in_partition = np.repeat(n_kept, n_groups)
    _check((n_inner < MOST_IN_PART) & (v1 < in_partition) & (v2 < in_partition), "groups of such points")
    v2 += v1 + 1
    _check(v2 < in_partition, "groups of such points")
    first_inner, first_kept, first_group = (np.append(0, np.cumsum(c)) for c in (n_inner + 1, n_kept, n_groups))
    total = int(first_inner[-1]) + int(first_kept[-1])
    if total > most_points:
        raise CodecError(f"coded points: found {total} points, expected at most {most_points}")
    parameter, stream = np.split(data[at:], [first_inner[-1]])
    n_bits = int(n_kept @ widths.sum(axis=1))
    if len(parameter) < first_inner[-1] or len(stream) != (n_bits + 7) // 8:
        raise CodecError(f"coded points: found {len(data) - at} bytes of points, expected {total} points")
    kept = np.repeat(lower, n_kept, axis=0)
    _check(_read_offsets(stream, widths, n_kept, kept) & (kept < 1 << bits), "points in such a place")
    ends = np.column_stack([v1, v2]) + np.repeat(first_kept[:-1], n_groups)[:, None]
    return LinearGroups(kept.astype(np.uint32), ends, first_inner, parameter, first_kept, first_group)


def _check(holds: np.ndarray, what: str) -> None:
    if not holds.all():
        raise CodecError(f"coded points: found no {what}")


@njit(nogil=True, cache=True)
def _write_offsets(offsets, widths, counts, stream):
    """Set the bits of (k, 3) offsets, of (q, 3) widths in runs of (q,) points, in the zeros of ``stream``."""
    at, i = np.int64(0), 0
    for part in range(len(counts)):
        for _ in range(counts[part]):
            for axis in range(3):
                for bit in range(widths[part, axis] - 1, -1, -1):
                    stream[at >> 3] |= (np.int64(offsets[i, axis]) >> bit & 1) << 7 - (at & 7)
                    at += 1
            i += 1


@njit(nogil=True, cache=True)
def _read_offsets(stream, widths, counts, points):
    """Add to (k, 3) points what ``_write_offsets`` wrote; False where the bits that fill up the end are not zeros."""
    at, i = np.int64(0), 0
    for part in range(len(counts)):
        for _ in range(counts[part]):
            for axis in range(3):
                value = np.int64(0)
                for _ in range(widths[part, axis]):
                    value = value << 1 | np.int64(stream[at >> 3]) >> 7 - (at & 7) & 1
                    at += 1
                points[i, axis] += value
            i += 1
    return at & 7 == 0 or np.int64(stream[at >> 3]) << (at & 7) & 0xFF == 0
