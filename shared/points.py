"""Columns of a point batch, and the packing of colours and normals into words.

A *batch* is what readers yield and the builder takes: float64 world positions and one column per attribute.
Every attribute column is one-dimensional, so gathering, writing and checking need no special case.

==============  =======  ===================================================================
column          dtype    meaning
==============  =======  ===================================================================
rgb             uint32   colour word ``R | G << 8 | B << 16 | 255 << 24`` (RGBA bytes in memory)
normal          uint32   unit normal, octahedral, two int16 (``NO_NORMAL``: none)
intensity       float32  as in the file
classification  uint8    ASPRS class code
return_number   uint8    1 = first return
gps_time        float64  seconds, as in the file
radius          uint8    splat radius, a logarithm of its share of the root cube's edge (``pack_radii``)
==============  =======  ===================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from .errors import InputError

ATTRIBUTES: Mapping[str, np.dtype] = {
    "rgb": np.dtype("<u4"),
    "normal": np.dtype("<u4"),
    "intensity": np.dtype("<f4"),
    "classification": np.dtype("u1"),
    "return_number": np.dtype("u1"),
    "gps_time": np.dtype("<f8"),
    "radius": np.dtype("u1"),
}

NO_NORMAL = np.uint32(0x8000_8000)
"""Normal word of a point whose normal is absent, zero or not finite (both components −32768)."""

_OCT_MAX = 32767.0


@dataclass
class PointBatch:
    """Some points in world coordinates.

    positions : (n, 3) float64, metres (or the file's unit), world frame, C-contiguous.
    attributes : name → (n,) array of ``ATTRIBUTES[name]``.

    Raises InputError from ``check`` if a column has an unknown name, another dtype or another length.
    """

    positions: np.ndarray
    attributes: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.positions)

    def check(self) -> PointBatch:
        """Return self if every column is as documented, else raise InputError."""
        if self.positions.ndim != 2 or self.positions.shape[1] != 3 or self.positions.dtype != np.float64:
            raise InputError(f"positions: found {self.positions.dtype} {self.positions.shape}, expected float64 (n, 3)")
        for name, column in self.attributes.items():
            expected = ATTRIBUTES.get(name)
            if expected is None:
                raise InputError(f"attribute {name}: unknown, expected one of {', '.join(ATTRIBUTES)}")
            if column.dtype != expected or column.shape != (len(self),):
                raise InputError(
                    f"attribute {name}: found {column.dtype} {column.shape}, expected {expected} ({len(self)},)"
                )
        return self

    def select(self, which: np.ndarray | slice) -> PointBatch:
        """The points picked by a boolean mask, an index array or a slice."""
        return PointBatch(self.positions[which], {k: v[which] for k, v in self.attributes.items()})


def concatenate(batches: list[PointBatch]) -> PointBatch:
    """One batch of several that carry the same columns. Cost: one copy."""
    names = batches[0].attributes.keys()
    return PointBatch(
        np.concatenate([b.positions for b in batches]),
        {k: np.concatenate([b.attributes[k] for b in batches]) for k in names},
    )


def pack_rgb(red: np.ndarray, green: np.ndarray, blue: np.ndarray) -> np.ndarray:
    """Colour words of three (n,) uint8 channels: (n,) uint32, alpha 255."""
    words = np.empty((len(red), 4), np.uint8)
    words[:, 0], words[:, 1], words[:, 2], words[:, 3] = red, green, blue, 255
    return words.view("<u4").ravel()


def unpack_rgb(words: np.ndarray) -> np.ndarray:
    """(n, 4) uint8 RGBA of (n,) uint32 colour words. A view where the words are contiguous."""
    return np.ascontiguousarray(words, "<u4").view(np.uint8).reshape(-1, 4)


def pack_normals(normals: np.ndarray) -> np.ndarray:
    """Octahedral words of (n, 3) vectors of any positive length; zero or non-finite ones become ``NO_NORMAL``.

    Error: below 0.004° after ``unpack_normals``. Source: Meyer et al. 2010, "On floating-point normal vectors".
    """
    x, y, z = np.ascontiguousarray(np.asarray(normals, np.float64).T)  # by component: four times faster than rows
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        scale = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z))  # first, so that nothing over- or underflows
        valid = np.isfinite(scale) & (scale > 0)
        scale = np.where(valid, scale, 1.0)
        x, y, z = (np.where(valid, v, 1.0) / scale for v in (x, y, z))
    length = np.abs(x) + np.abs(y) + np.abs(z)
    x, y = x / length, y / length
    folded = (1.0 - np.abs(y)) * np.where(x >= 0, 1.0, -1.0), (1.0 - np.abs(x)) * np.where(y >= 0, 1.0, -1.0)
    oct_ = np.empty((len(x), 2), "<i2")
    for k, flat in enumerate((x, y)):
        oct_[:, k] = np.rint(np.where(z < 0, folded[k], flat) * _OCT_MAX)
    return np.where(valid, oct_.view("<u4").ravel(), NO_NORMAL)


def unpack_normals(words: np.ndarray) -> np.ndarray:
    """(n, 3) float32 unit normals of octahedral words; zero vectors for ``NO_NORMAL``."""
    words = np.ascontiguousarray(words, "<u4")
    o = words.view("<i2").reshape(-1, 2).astype(np.float64) / _OCT_MAX
    n = np.column_stack([o, 1.0 - np.abs(o).sum(axis=1)])
    sign = np.where(o >= 0, 1.0, -1.0)
    n[:, :2] = np.where((n[:, 2] < 0)[:, None], (1.0 - np.abs(o[:, ::-1])) * sign, n[:, :2])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    n[words == NO_NORMAL] = 0.0
    return n.astype(np.float32)


RADIUS_STEPS = 8
"""Codes an octave of splat radii: neighbouring radii differ by 9 %."""


def pack_radii(radii: np.ndarray, root_edge: float) -> np.ndarray:
    """(n,) uint8 codes of (n,) radii in world units: radius = root_edge · 2**(−code / RADIUS_STEPS).

    Rounded up, so that a splat never shrinks: at most 9 % too large. Radii below root_edge · 2**−31.875, zero and NaN
    get code 255, those above root_edge code 0.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        code = np.floor(-np.log2(np.asarray(radii, np.float64) / root_edge) * RADIUS_STEPS + 1e-9)
    return np.clip(np.nan_to_num(code, nan=255.0, posinf=255.0, neginf=0.0), 0, 255).astype(np.uint8)


def radius_table(root_edge: float) -> np.ndarray:
    """(256,) float64: radius in world units of each code of ``pack_radii``."""
    return root_edge * np.exp2(-np.arange(256) / RADIUS_STEPS)
