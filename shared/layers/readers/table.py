"""Tables, a row an object."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import InputError
from ..cuboids import OBJECT
from ..layer import Layer, simple_layer


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV or Parquet file by name. Raises InputError where it cannot be read."""
    try:
        import pyarrow as pa
        from pyarrow import csv, parquet
    except ImportError:
        raise InputError(
            f"{path}: tables are read with pyarrow, which is missing; pip install 'splatpipe[tables]'"
        ) from None
    try:
        table = parquet.read_table(path) if path.suffix.lower() == ".parquet" else csv.read_csv(path)
        columns = {name: values.to_numpy() for name, values in zip(table.column_names, table.columns, strict=True)}
    except (OSError, ValueError, pa.ArrowException) as error:  # ValueError: names that are no UTF-8
        raise InputError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None
    if not table.num_rows:
        raise InputError(f"{path}: found no row, expected at least one")
    return columns


def column(table: dict[str, np.ndarray], name: str, path: Path, default: float | None = None) -> np.ndarray:
    """(n,) float64 column. Raises InputError if it is missing, where there is no default, or holds no numbers."""
    if name not in table:
        if default is None:
            raise InputError(f"{path}: column {name}: not found, expected it among {', '.join(table)}")
        return np.full(len(next(iter(table.values()))), default)
    if table[name].dtype.kind not in "iuf":
        raise InputError(f"{path}: column {name}: found {table[name].dtype}, expected numbers")
    return table[name].astype(np.float64)


def cuboids_from_table(path: Path) -> Layer:
    """Cuboids from the columns x, y, width, depth, height, and base (0) and value (height) where they are.

    x, y : middle, world.  Raises InputError.
    """
    table = read_table(path)
    x, y, width, depth, height = (column(table, name, path) for name in ("x", "y", "width", "depth", "height"))
    base = column(table, "base", path, 0.0)
    value = column(table, "value", path) if "value" in table else height
    origin = np.array([x.mean(), y.mean(), base.min()])
    objects = np.empty(len(x), OBJECT)
    objects["center"] = np.column_stack([x, y]) - origin[:2]
    objects["extent"] = np.column_stack([width, depth])
    objects["height"] = np.column_stack([base, base + height]) - origin[2]
    objects["value"] = value
    return simple_layer(path.stem, "cuboids", origin, objects)
