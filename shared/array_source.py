"""Where the arrays of a scene come from: files of its directory, or whatever else gives the same bytes by name."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np

from .errors import StoreError
from .scene_info import SceneInfo

_CHUNK = 1 << 22


class ArraySource(Protocol):
    """Gives arrays as ``scene.json`` promises them, by the names it has for them. Checksums are the caller's."""

    def load(self, name: str, mmap: bool) -> np.ndarray:
        """The array: read-only and shared with whoever asks for it again, or a copy of the caller's own."""
        ...

    def chunks(self, name: str) -> Iterator[bytes | memoryview]:
        """The bytes of the array, from the first to the last, some at a time."""
        ...

    def release(self) -> None:
        """Nothing more will be asked for: let go of what is held. Arrays that were given out stay valid."""
        ...


class ArrayFiles:
    """The ``.npy`` files of a directory; nothing is held open between calls.

    Raises StoreError naming the file that is missing, cannot be read, or is not of the promised type, shape and size.
    """

    def __init__(self, path: Path, info: SceneInfo) -> None:
        self._path = path
        self._info = info

    def check_sizes(self) -> None:
        """Hold header and size of each file against the promise. Cost: a few milliseconds."""
        for name in self._info.arrays:
            self._data_offset(name)

    def load(self, name: str, mmap: bool) -> np.ndarray:
        """The array, mapped read-only from its file, or read whole."""
        self._data_offset(name)
        path = self._file(name)
        with _reading(path):
            return np.load(path, mmap_mode="r" if mmap else None, allow_pickle=False)

    def chunks(self, name: str) -> Iterator[bytes]:
        """The bytes of the array; read, not mapped, so that a failing disk is an error and no signal."""
        path = self._file(name)
        with _reading(path), path.open("rb") as file:
            file.seek(self._data_offset(name))
            while chunk := file.read(_CHUNK):
                yield chunk

    def release(self) -> None:
        """Files are closed already."""

    def _file(self, name: str) -> Path:
        return self._path / f"{name}.npy"

    def _data_offset(self, name: str) -> int:
        promised = self._info.arrays[name]
        return data_offset(self._file(name), np.dtype(promised.dtype), promised.shape)


@contextmanager
def _reading(path: Path, whose: str = "scene") -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise StoreError(f"{path}: not found, expected an array of the {whose}") from None
    except (OSError, ValueError, SyntaxError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error


def data_offset(path: Path, dtype: np.dtype, shape: tuple[int, ...], whose: str = "scene") -> int:
    """Where the data of an ``.npy`` file begin, after its header and size were held against what is promised.

    Raises StoreError naming what differs, or that an array of the ``whose`` is missing or cannot be read.
    """
    with _reading(path, whose), path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        if version != (1, 0):
            raise StoreError(f"{path}: found npy version {version}, expected (1, 0)")
        found_shape, fortran, found = np.lib.format.read_array_header_1_0(file)
        offset = file.tell()
    if (found_shape, fortran, found) != (shape, False, dtype):
        raise StoreError(f"{path}: header says {_name(found)} {found_shape}, expected {_name(dtype)} {shape}")
    size, expected = path.stat().st_size, offset + math.prod(shape) * dtype.itemsize
    if size != expected:
        raise StoreError(f"{path}: found {size} bytes, expected {expected}")
    return offset


def _name(dtype: np.dtype) -> str:
    return str(dtype) if dtype.names else dtype.str
