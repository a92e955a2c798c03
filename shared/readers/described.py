"""Sources that another process has opened: what they said of themselves, and opened here only to be read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..points import PointBatch
from .source import Source, SourceInfo


def described(source: Source) -> dict[str, Any]:
    """What a source says of itself, in JSON types."""
    content = asdict(source.info) | {"path": str(source.info.path), "part_points": source.part_points}
    for name in ("lower", "upper"):
        if content[name] is not None:
            content[name] = content[name].tolist()
    return content


class DescribedSource(Source):
    """A source known by what ``described`` gave; ``open_named`` opens its path where points are asked for."""

    def __init__(self, content: dict[str, Any], open_named: Callable[[str], Source]) -> None:
        content = dict(content)
        self.part_points = content.pop("part_points")
        for name in ("lower", "upper"):
            if content[name] is not None:
                content[name] = np.array(content[name], np.float64)
        content |= {"path": Path(content["path"]), "attributes": tuple(content["attributes"])}
        self.info = SourceInfo(**content)
        self._open = open_named

    def _read(self, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        return self._open(str(self.info.path))._read(max_points, attributes)

    def _read_part(self, first: int, last: int, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        return self._open(str(self.info.path))._read_part(first, last, max_points, attributes)
