"""Positions in a cell's cube ↔ grid points: whole coordinates of 2**bits bins an axis."""

from __future__ import annotations

import numpy as np

from ..errors import CodecError
from . import MAX_BITS


def check_bits(bits: int) -> None:
    """Raise CodecError unless 1 ≤ bits ≤ ``MAX_BITS``."""
    if not 1 <= bits <= MAX_BITS:
        raise CodecError(f"bits: found {bits}, expected 1 … {MAX_BITS}")


def check_points(points: np.ndarray, bits: int) -> np.ndarray:
    """(n, 3) grid points as uint32. Raises CodecError for another shape, kind or range."""
    check_bits(bits)
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "ui":
        raise CodecError(f"grid points: found {points.dtype} {points.shape}, expected integers (n, 3)")
    if points.size and (points.min() < 0 or points.max() >= 1 << bits):
        raise CodecError(f"grid points: found {points.min()} … {points.max()}, expected 0 … {(1 << bits) - 1}")
    return points.astype(np.uint32)


def to_grid(positions: np.ndarray, lower: np.ndarray, edge: float, bits: int) -> np.ndarray:
    """(n, 3) uint32 grid points of (n, 3) float64 positions in the cube of this lower corner and edge.

    Positions outside by rounding are clamped. Error of ``from_grid``: at most edge / 2**(bits + 1) an axis.
    """
    check_bits(bits)
    step = np.ldexp(edge, -bits)
    return np.clip(np.floor((positions - lower) / step), 0, (1 << bits) - 1).astype(np.uint32)


def from_grid(points: np.ndarray, lower: np.ndarray, edge: float, bits: int) -> np.ndarray:
    """(n, 3) float64 positions at the centres of the bins of (n, 3) grid points."""
    return lower + (points + 0.5) * np.ldexp(edge, -bits)
