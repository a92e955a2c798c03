"""What every reader offers, and the guard that turns any library's failure into one line."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..points import PointBatch


@dataclass(frozen=True)
class SourceInfo:
    """What a file says of itself, before its points are read.

    format : ``las``, ``laz``, ``copc``, ``ply``, ``pcd``, ``text``, ``npy``, ``npz`` or ``e57``.
    n_points : as the header promises; None where the format has no count.
    lower, upper : (3,) float64, world frame, the header's bounds: a hint, never checked; None where there are none.
    attributes : the columns that every batch carries (names of ``points.ATTRIBUTES``).
    crs : well-known text of the coordinate reference system, if the file holds any.
    """

    path: Path
    format: str
    n_points: int | None
    attributes: tuple[str, ...]
    lower: np.ndarray | None = None
    upper: np.ndarray | None = None
    crs: str | None = None


class Source(ABC):
    """A file of points whose header has been read and believed."""

    info: SourceInfo
    part_points: int | None = None
    """Parts are read best from multiples of this; None where only the whole file can be read."""

    def part(self, first: int, last: int) -> Source:
        """The points ``first`` … ``last`` − 1, as a source of its own, where ``part_points`` is not None."""
        return _Part(self, first, last)

    def batches(self, max_points: int, attributes: Collection[str] | None = None) -> Iterator[PointBatch]:
        """The points in file order, at most ``max_points`` (≥ 1) at a time; can be called again.

        attributes : columns to keep, None for all; those the file lacks are passed over. Fewer columns cost less.
        Non-finite positions are passed on. Memory: a few times one batch.
        Raises InputError for a file that ends early, is damaged, or holds no point at all.
        """
        if max_points < 1:
            raise InputError(f"batch size: found {max_points}, expected at least 1")
        keep = self.info.attributes
        if attributes is not None:
            keep = tuple(name for name in keep if name in attributes)
        n_read = 0
        with foreign_errors(self.info.path):
            for batch in self._read(max_points, keep):
                n_read += len(batch)
                yield batch
        promised = self.info.n_points
        if promised is not None and n_read != promised:
            raise InputError(f"{self.info.path}: found {n_read} points, expected the {promised} of its header")
        if n_read == 0:
            raise no_points(self.info.path)

    @abstractmethod
    def _read(self, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        """The batches, none of them empty, carrying exactly ``attributes``."""

    def _read_part(self, first: int, last: int, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        """The same of a part, where ``part_points`` is not None."""
        raise NotImplementedError


class _Part(Source):
    def __init__(self, whole: Source, first: int, last: int) -> None:
        self._whole, self._first, self._last = whole, first, last
        self.info = replace(whole.info, n_points=last - first)

    def _read(self, max_points: int, attributes: tuple[str, ...]) -> Iterator[PointBatch]:
        return self._whole._read_part(self._first, self._last, max_points, attributes)


def no_points(path: Path) -> InputError:
    """The error for a file that is sound and empty."""
    return InputError(f"{path}: found no points, expected at least one")


def check_promise(path: Path, n_points: int, record_bytes: float, available_bytes: int) -> None:
    """Hold a header's count against the bytes there are, before anything is allocated for it.

    Raises InputError for no points, or for more points than ``available_bytes`` can hold at ``record_bytes`` each.
    """
    if n_points == 0:
        raise no_points(path)
    if n_points < 0 or n_points * record_bytes > available_bytes:
        raise InputError(
            f"{path}: truncated or damaged: the header promises {n_points} points "
            f"(at least {n_points * record_bytes:.0f} bytes), found {max(available_bytes, 0)} bytes of point data"
        )


@contextmanager
def foreign_errors(path: Path) -> Iterator[None]:
    """Turn whatever a format library raises into an InputError that names ``path``.

    ``BaseException`` is caught since a panic of a Rust extension derives from it.
    """
    try:
        yield
    except (InputError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise InputError(f"{path}: damaged, or a batch does not fit into memory") from error
    except BaseException as error:
        first_line = next(iter(str(error).splitlines()), "") or type(error).__name__
        raise InputError(f"{path}: malformed file: {first_line[:300]}") from error
