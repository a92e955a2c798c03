"""Hierarchies from folders and tables."""

from __future__ import annotations

import os
from pathlib import Path

from ...errors import InputError
from ..hierarchy import MOST_NODES, Hierarchy, from_paths
from .table import column, read_table


def read_hierarchy(path: Path) -> Hierarchy:
    """Of a folder, files with their bytes; of a CSV or Parquet table, the columns path, size and, where it is, value.

    Links are not followed, and what cannot be read is passed over. Raises InputError.
    """
    if path.is_dir():
        return from_paths(path.resolve().name or "root", _file_sizes(path))
    table = read_table(path)
    if "path" not in table:
        raise InputError(f"{path}: column path: not found, expected it among {', '.join(table)}")
    names = [str(name) for name in table["path"]]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: column path: found {twice} twice")
    sizes = dict(zip(names, column(table, "size", path).tolist(), strict=True))
    values = dict(zip(names, column(table, "value", path).tolist(), strict=True)) if "value" in table else None
    return from_paths(path.stem, sizes, values)


def _file_sizes(folder: Path) -> dict[str, float]:
    sizes: dict[str, float] = {}
    for top, folders, files in os.walk(folder):
        folders.sort()
        for name in sorted(files):
            file = Path(top) / name
            if not file.is_symlink():
                try:
                    sizes[file.relative_to(folder).as_posix()] = float(file.stat().st_size)
                except OSError:
                    continue
        if len(sizes) > MOST_NODES:
            raise InputError(f"{folder}: found more than {MOST_NODES} files")
    return sizes
