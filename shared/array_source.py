"""Where the arrays of a scene come from: files of its directory, or whatever else gives the same bytes by name."""

from __future__ import annotations

import io
import math
import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np

from .errors import StoreError
from .scene_info import ArrayInfo, SceneInfo

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
        begin = self._data_offset(name)
        path, promised = self._file(name), self._info.arrays[name]
        dtype = np.dtype(promised.dtype)
        with _reading(path):
            if mmap:
                return np.memmap(path, dtype, "r", begin, promised.shape)
            return np.fromfile(path, dtype, offset=begin).reshape(promised.shape)

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


class ReadColumn:
    """A column of an ``.npy`` file that is read where it is indexed; unlike a map, none of it counts as resident.

    n : its entries, from entry ``first`` of the file on.
    The file stays open until the column is dropped. Threads may read at once.
    Raises StoreError naming the file: not as promised, or, while reading, failing or ending early.
    """

    def __init__(self, path: Path, promised: ArrayInfo, first: int = 0, n: int | None = None) -> None:
        self.dtype = np.dtype(promised.dtype)
        self._path = path
        self._n = promised.shape[0] if n is None else n
        self._begin = data_offset(path, self.dtype, promised.shape) + first * self.dtype.itemsize
        with _reading(path):
            self._file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        weakref.finalize(self, os.close, self._file)

    def __len__(self) -> int:
        return self._n

    def __getitem__(self, part: slice | np.ndarray) -> np.ndarray:
        """The entries of a slice with both ends, or of (k,) indices, one read each."""
        if isinstance(part, slice):
            out = np.empty(part.stop - part.start, self.dtype)
            self.read_into(part.start, out)
            return out
        out = np.empty(len(part), self.dtype)
        for i, first in enumerate(part.tolist()):
            self.read_into(first, out[i : i + 1])
        return out

    def read_into(self, first: int, out: np.ndarray) -> None:
        """Fill ``out``, contiguous and of the column's type, with the entries from ``first`` on."""
        data = out.view(np.uint8).data
        at = self._begin + first * self.dtype.itemsize
        with _reading(self._path):
            while data:
                n_read = os.preadv(self._file, [data], at)
                if not n_read:
                    raise StoreError(f"{self._path}: ended early, at byte {at}: it was cut while in use")
                data, at = data[n_read:], at + n_read


Column = np.ndarray | ReadColumn
"""A column of stored points that may be indexed by a slice with both ends, or by indices."""


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
        written = _header(dtype, shape)
        if file.read(len(written)) == written:  # parsing it is slower, and not for two threads in Python before 3.11.8
            found_shape, fortran, found = shape, False, dtype
        else:
            file.seek(0)
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


def _header(dtype: np.dtype, shape: tuple[int, ...]) -> bytes:
    """The first bytes of an ``.npy`` file as NumPy, and so a build, writes them."""
    file = io.BytesIO()
    promised = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, promised)
    return file.getvalue()


def _name(dtype: np.dtype) -> str:
    return str(dtype) if dtype.names else dtype.str
