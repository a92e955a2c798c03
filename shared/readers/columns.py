"""Named columns of any file → columns of a point batch.

Every format but LAS is a table whose columns have names: a structured array, or a mapping from name to array. This
module knows which names mean what, and what range colours are in.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import numpy as np

from ..errors import InputError
from ..points import ATTRIBUTES, PointBatch, pack_normals, pack_rgb
from .source import Source, SourceInfo

Table = Mapping[str, np.ndarray] | np.ndarray
"""(n,) columns by name: a mapping, or a structured array."""

SAMPLE_POINTS = 1 << 16
"""Points looked at to find the range of a file's colours."""

_NAMES = {
    "x": ("x", "cartesianx"),
    "y": ("y", "cartesiany"),
    "z": ("z", "cartesianz"),
    "red": ("red", "r", "diffuse_red", "colorred"),
    "green": ("green", "g", "diffuse_green", "colorgreen"),
    "blue": ("blue", "b", "diffuse_blue", "colorblue"),
    "packed": ("rgb", "rgba"),
    "nx": ("nx", "normal_x", "normalx", "nor:normalx"),
    "ny": ("ny", "normal_y", "normaly", "nor:normaly"),
    "nz": ("nz", "normal_z", "normalz", "nor:normalz"),
    "intensity": ("intensity", "i", "reflectance", "scalar_intensity"),
    "classification": ("classification", "class", "scalar_classification", "label"),
    "return_number": ("return_number", "returnnumber", "scalar_return_number"),
    "gps_time": ("gps_time", "gpstime", "scalar_gpstime"),
}
_GROUPS = {
    **dict.fromkeys(("xyz", "position", "positions", "points", "pos", "coords"), ("x", "y", "z")),
    **dict.fromkeys(("rgb", "color", "colors", "colour", "colours"), ("red", "green", "blue")),
    **dict.fromkeys(("normal", "normals"), ("nx", "ny", "nz")),
}
_PARTS = (  # attribute, the roles it is made of; of two entries for one attribute the later is preferred
    ("rgb", ("packed",)),
    ("rgb", ("red", "green", "blue")),
    ("normal", ("nx", "ny", "nz")),
    *((name, (name,)) for name in ("intensity", "classification", "return_number", "gps_time")),
)


def find_roles(names: Collection[str]) -> dict[str, str]:
    """What a file's columns are: role (``x``, ``red``, ``nx``, ``intensity``, …) → the file's own name.

    Letter case, spaces, quotes and comment marks around a name do not matter; the first name of a role wins.
    """
    plain = {}
    for name in names:
        plain.setdefault(name.strip(" \t\"'/#").lower(), name)
    return {
        role: next(plain[a] for a in aliases if a in plain)
        for role, aliases in _NAMES.items()
        if any(a in plain for a in aliases)
    }


def guess_names(rows: np.ndarray) -> list[str]:
    """Names of the columns of (n, k) numbers without a header, k ≥ 3; see the table in ``text``."""
    n_columns = rows.shape[1]
    names = ["x", "y", "z"]
    rest = rows[:, 3:6].astype(np.float64)
    if n_columns == 4:
        names += ["intensity"]
    elif n_columns == 6 and np.all((rest >= 0) & (rest <= 255) & (rest == np.rint(rest))):
        names += ["red", "green", "blue"]
    elif n_columns == 6 and np.all(np.isnan(rest) | (np.abs(rest) <= 1.001)):
        names += ["nx", "ny", "nz"]
    elif n_columns == 7:
        names += ["intensity", "red", "green", "blue"]
    return (names + [f"column {i}" for i in range(len(names), n_columns)])[:n_columns]


def split_group(name: str) -> tuple[str, ...]:
    """Names of the first columns of an (n, ≥ 3) array called ``name``; empty for an unknown one."""
    return _GROUPS.get(name.lower(), ())


class ColourRange:
    """How a file's colour values map to 0…255.

    Formats leave the range open (LAS often holds 8-bit colours in 16-bit fields, PLY and text hold floats in [0, 1]),
    so it is taken from the largest value of a sample: ≤ 1 → unit interval, ≤ 255 → 8 bits, else 16 bits (the upper byte
    is kept). The limit of this rule: a 16-bit file whose sample is all but black (≤ 255 of 65535) is shown too bright.
    A sample that is zero throughout means the file holds no colours.
    """

    def __init__(self, largest: float):
        self.present = largest > 0
        self.factor = 255.0 if largest <= 1 else 1.0 if largest <= 255 else 1 / 256

    @classmethod
    def of(cls, *channels: np.ndarray) -> ColourRange:
        """From a sample of each channel. 8-bit integers are taken as they are."""
        if all(c.dtype == np.uint8 for c in channels):
            return cls(255.0 if any(c.any() for c in channels) else 0.0)
        finite = [c[np.isfinite(c)] for c in channels]
        return cls(max((float(c.max()) for c in finite if len(c)), default=0.0))

    def to_bytes(self, channel: np.ndarray) -> np.ndarray:
        """(n,) uint8 of one channel; values beyond the range are clipped, NaN becomes 0."""
        if channel.dtype == np.uint8:
            return channel
        if channel.dtype == np.uint16 and self.factor < 1:
            return (channel >> 8).astype(np.uint8)
        if self.factor < 1:
            return to_uint8(channel * self.factor)
        return to_uint8(np.rint(channel * self.factor))


def to_uint8(column: np.ndarray) -> np.ndarray:
    """(n,) uint8 of any numbers: cut to whole, clipped to 0…255, NaN becomes 0."""
    if column.dtype == np.uint8:
        return column
    return np.nan_to_num(np.clip(column, 0, 255), nan=0.0).astype(np.uint8)


def colour_channels(columns: list[np.ndarray]) -> list[np.ndarray]:
    """Red, green and blue of three columns, or of one that packs them as PCL does (``R << 16 | G << 8 | B``).

    A packed float32 column holds the bits of that word, any other its value.
    """
    if len(columns) == 3:
        return columns
    (packed,) = columns
    if packed.dtype.kind == "f":
        packed = packed.view("<u4") if packed.dtype.itemsize == 4 else np.nan_to_num(packed, nan=0.0)
    word_bytes = np.ascontiguousarray(packed.astype(np.int64)).view(np.uint8).reshape(-1, 8)
    return [word_bytes[:, 2], word_bytes[:, 1], word_bytes[:, 0]]


class TableSource(Source):
    """A reader of named columns. A subclass yields tables; this class makes batches of them."""

    def __init__(self, names: Collection[str], **info: Any):
        """Names : the file's columns. info : the fields of SourceInfo but ``attributes``.

        Raises InputError if x, y or z is missing.
        """
        self._names = tuple(names)
        roles = find_roles(names)
        if not {"x", "y", "z"} <= roles.keys():
            found = ", ".join(names) or "none"
            raise InputError(f"{info['path']}: found columns {found[:200]}; expected x, y and z among them")
        self._positions = [roles[axis] for axis in "xyz"]
        self._columns = {  # attribute → the file's columns it is made of
            attribute: [roles[part] for part in parts]
            for attribute, parts in _PARTS
            if all(part in roles for part in parts)
        }
        if "rgb" in self._columns:
            columns = self._columns["rgb"]
            sample = self._sample(columns)
            self._colours = ColourRange.of(*colour_channels([np.asarray(sample[name]) for name in columns]))
            if not self._colours.present:
                del self._columns["rgb"]
        self.info = SourceInfo(attributes=tuple(a for a in ATTRIBUTES if a in self._columns), **info)

    def columns(self) -> dict[str, np.ndarray]:
        """All columns of the file by their own names, also those that no attribute is made of.

        Raises InputError where the file ends early. Memory: the file's points.
        """
        names = list(self._names)
        tables = [[np.asarray(table[name]) for name in names] for table in self._tables(SAMPLE_POINTS, names)]
        return {name: np.concatenate([table[i] for table in tables]) for i, name in enumerate(names)}

    @abstractmethod
    def _tables(self, max_points: int, columns: Collection[str]) -> Iterator[Table]:
        """Tables of 1 to ``max_points`` points, in file order, that carry ``columns`` at least."""

    def _sample(self, columns: Collection[str]) -> Table:
        """Up to ``SAMPLE_POINTS`` of the file's points, always the same ones."""
        return next(self._tables(SAMPLE_POINTS, columns), {name: np.empty(0) for name in columns})

    def _read(self, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        return self._batches_of(self._tables(max_points, self._columns_of(attributes)), attributes)

    def _columns_of(self, attributes: tuple[str, ...]) -> set[str]:
        """The columns that positions and attributes are made of."""
        return {*self._positions, *(name for a in attributes for name in self._columns[a])}

    def _batches_of(self, tables: Iterator[Table], attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        for table in tables:
            positions = np.empty((len(table[self._positions[0]]), 3))
            for axis, name in enumerate(self._positions):
                positions[:, axis] = table[name]
            yield PointBatch(
                positions,
                {a: self._attribute(a, [np.asarray(table[name]) for name in self._columns[a]]) for a in attributes},
            )

    def _attribute(self, attribute: str, columns: list[np.ndarray]) -> np.ndarray:
        if attribute == "rgb":
            return pack_rgb(*(self._colours.to_bytes(c) for c in colour_channels(columns)))
        if attribute == "normal":
            return pack_normals(np.column_stack(columns))
        dtype = ATTRIBUTES[attribute]
        if dtype == np.uint8:
            return np.array(to_uint8(columns[0]))
        with np.errstate(over="ignore"):
            return columns[0].astype(dtype)
