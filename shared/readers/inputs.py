"""Which files are meant, and what format a file is in."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError
from .source import Source, foreign_errors

KNOWN_EXTENSIONS: tuple[str, ...] = (
    *(".las", ".laz", ".ply", ".pcd", ".npy", ".npz", ".e57"),
    *(".xyz", ".txt", ".csv", ".pts", ".asc"),
)
"""Lower case; what a directory or a glob is searched for. COPC files end in ``.copc.laz``."""

_TEXT = (".xyz", ".txt", ".csv", ".pts", ".asc")
_MAGIC = {
    b"LASF": "las",
    b"ply": "ply",
    b"# .PCD": "pcd",
    b"ASTM-E57": "e57",
    b"\x93NUMPY": "npy",
    b"PK\x03\x04": "npz",
}


def expand_inputs(patterns: Sequence[str]) -> list[Path]:
    """The files that paths, globs (``**`` goes down) and directories stand for: sorted, each once.

    A file that is named is taken as it is; a directory (its own files only) or a glob gives those with a known
    extension. Raises InputError, naming the pattern, if one gives no file.
    """
    found: dict[Path, Path] = {}
    for pattern in patterns:
        path = Path(pattern)
        if path.is_file():
            matches = [path]
        else:
            candidates = list(path.iterdir()) if path.is_dir() else map(Path, glob.glob(pattern, recursive=True))
            matches = [p for p in candidates if p.suffix.lower() in KNOWN_EXTENSIONS and p.is_file()]
        if not matches:
            raise InputError(
                f"{pattern}: found no file, expected one, or a glob or directory with {', '.join(KNOWN_EXTENSIONS)}"
            )
        for match in matches:
            found.setdefault(match.resolve(), match)
    return sorted(found.values())


def open_source(path: str | Path) -> Source:
    """The reader of a file, by its first bytes or else its extension.

    Reads the header, and a sample of at most 65 536 points where only they tell what the columns hold.
    Raises InputError, one line: missing or empty file, directory, unknown format, malformed header, no points, or a
    count that the file's size contradicts.
    """
    path = Path(path)
    match _format(path):
        case "las":
            from .las import LasSource

            return LasSource(path)
        case "ply":
            from .ply import open_ply

            return open_ply(path)
        case "pcd":
            from .pcd import open_pcd

            return open_pcd(path)
        case "npy":
            from .npy import open_npy

            return open_npy(path)
        case "npz":
            from .npy import NpzSource

            return NpzSource(path)
        case "e57":
            from .e57 import E57Source

            return E57Source(path)
        case _:
            from .text import TextSource

            return TextSource(path)


def _format(path: Path) -> str:
    if path.is_dir():
        raise InputError(f"{path}: found a directory, expected a file")
    with foreign_errors(path), path.open("rb") as file:
        head = file.read(16)
    if not head:
        raise InputError(f"{path}: found an empty file, expected points")
    extension = path.suffix.lower()
    for magic, name in _MAGIC.items():
        if head.startswith(magic) and (magic != b"ply" or head[3:4] in b"\r\n "):
            return name
    if extension in _TEXT:
        return "text"
    if extension == ".pcd":  # its first line is a comment, and some writers leave it out
        return "pcd"
    if extension in KNOWN_EXTENSIONS:
        raise InputError(f"{path}: found {head[:8]!r} at its begin, expected a file of the format {extension[1:]}")
    raise InputError(f"{path}: found an unknown format, expected one of {', '.join(KNOWN_EXTENSIONS)}")
