"""Writing a scene: into ``.OUT.partial`` beside the target, renamed to it once everything is whole."""

from __future__ import annotations

import errno
import fcntl
import math
import os
import shutil
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..crc import crc32_combine
from ..errors import InputError, SplatpipeError
from ..files import DISK_FULL, disk_error
from ..scene_info import SCENE_FILE, ArrayInfo, SceneInfo


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn a failure to write below ``path`` into one line."""
    try:
        yield
    except OSError as error:
        raise disk_error(error, path) from error


def write_all(file: IO[bytes], rows: np.ndarray) -> memoryview:
    """Write a C-contiguous array to an unbuffered file; return the bytes written."""
    data = rows.reshape(-1).view(np.uint8).data
    left = data
    while left:
        left = left[file.write(left) :]
    return data


class ColumnFile:
    """An ``.npy`` file that grows by chunks; its header gets the final shape when it is closed."""

    def __init__(self, directory: Path, name: str, dtype: np.dtype, row_shape: tuple[int, ...] = ()) -> None:
        self.path = directory / f"{name}.npy"
        self.dtype = dtype
        self._row_shape = row_shape
        self._rows = 0
        self._crc = 0
        self._file: IO[bytes] = open(self.path, "wb", buffering=0)  # noqa: SIM115 - closed by close()
        self._write_header()
        self._data_offset = self._file.tell()

    def _write_header(self) -> None:
        np.lib.format.write_array_header_1_0(
            self._file,
            {"descr": self.dtype.str, "fortran_order": False, "shape": (self._rows, *self._row_shape)},
        )

    def write(self, rows: np.ndarray) -> None:
        """Append C-contiguous rows."""
        self._crc = zlib.crc32(write_all(self._file, rows), self._crc)
        self._rows += len(rows)

    def written(self) -> np.ndarray:
        """The rows so far: a read-only map."""
        return self.map_of(self.path, self._rows)

    def map_of(self, path: Path, rows: int) -> np.ndarray:
        """So many rows of another such file, perhaps without its final header: a read-only map."""
        return np.memmap(path, self.dtype, "r", self._data_offset, (rows, *self._row_shape))

    def rename(self, name: str) -> None:
        """Go on under another name."""
        self.path = self.path.rename(self.path.with_name(f"{name}.npy"))

    def close(self) -> ArrayInfo:
        """Write the final header."""
        size = self._file.tell() - self._data_offset
        self._file.seek(0)
        self._write_header()
        assert self._file.tell() == self._data_offset  # numpy leaves room for any length of a first axis
        self._file.close()
        return ArrayInfo(self.dtype.str, (self._rows, *self._row_shape), size, self._crc)

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.close()

    @property
    def part(self) -> tuple[int, int]:
        """(rows, CRC) so far, for ``go_on`` of the file that they are copied behind."""
        return self._rows, self._crc

    def copy_into(self, path: Path, row: int) -> None:
        """Copy the rows, their file closed, to row ``row`` of the ``.npy`` file of such rows at ``path``."""
        self.close()
        width = self.dtype.itemsize * math.prod(self._row_shape)
        with open(self.path, "rb", buffering=0) as source, open(path, "r+b", buffering=0) as target:
            at, to, left = self._data_offset, self._data_offset + row * width, self._rows * width
            while left:
                copied = _copy_range(source.fileno(), target.fileno(), left, at, to)
                at, to, left = at + copied, to + copied, left - copied

    def go_on(self, parts: Iterable[tuple[int, int]]) -> None:
        """Open an abandoned file again behind what other processes have copied to its end, in the order of ``parts``.

        Raises SplatpipeError if the file is not as long as they say.
        """
        width = self.dtype.itemsize * math.prod(self._row_shape)
        for rows, crc in parts:
            self._crc = crc32_combine(self._crc, crc, rows * width)
            self._rows += rows
        self._file = open(self.path, "r+b", buffering=0)  # noqa: SIM115 - closed by close()
        found, expected = self._file.seek(0, os.SEEK_END), self._data_offset + self._rows * width
        if found != expected:
            raise SplatpipeError(f"{self.path}: found {found} bytes that the ranks wrote, expected {expected}")


_COPY_BYTES = 1 << 24


def _copy_range(source: int, target: int, n_bytes: int, at: int, to: int) -> int:
    """Copy at most ``n_bytes`` from one file to another; how many. Inside the kernel, where it can."""
    try:
        copied = os.copy_file_range(source, target, n_bytes, at, to)
    except OSError as error:
        if error.errno in DISK_FULL:
            raise
        copied = os.pwrite(target, os.pread(source, min(n_bytes, _COPY_BYTES), at), to)
    if not copied:
        raise OSError(errno.EIO, "a part of the scene ended early")
    return copied


class ColumnFolder:
    """Growing arrays in a folder; a context manager, which closes them."""

    def __init__(self, partial: Path) -> None:
        self.partial = partial
        self.columns: dict[str, ColumnFile] = {}

    def __enter__(self) -> ColumnFolder:
        return self

    def __exit__(self, *_: object) -> None:
        for column in self.columns.values():
            column.abandon()

    def open_column(self, name: str, dtype: np.dtype, row_shape: tuple[int, ...] = ()) -> ColumnFile:
        """A new growing array."""
        with writing(self.partial):
            self.columns[name] = ColumnFile(self.partial, name, dtype, row_shape)
        return self.columns[name]


def partial_folder(out: Path) -> Path:
    """Where a scene is written before it is whole."""
    return out.with_name(f".{out.name}.partial")


class SceneWriter(ColumnFolder):
    """Owns ``.OUT.partial`` from the start of a build to the rename; a context manager.

    A killed build leaves only that directory, which the next build of the same scene removes: it starts clean.
    Leaving the context without ``commit`` removes it. The data files are not forced to the disk (a scene whose machine
    lost power is found out by its sizes and checksums), ``scene.json`` and the rename are.

    Raises InputError if the target exists and ``overwrite`` is not set, is not a scene, is being built by another
    process, or cannot be written.
    """

    def __init__(self, out: Path, *, overwrite: bool) -> None:
        super().__init__(partial_folder(out))
        self.out = out
        self._replaced = out.with_name(f".{out.name}.replaced")
        self._overwrite = overwrite
        check_target(out, overwrite)

    def __enter__(self) -> SceneWriter:
        with writing(self.out):
            self.out.parent.mkdir(parents=True, exist_ok=True)
            self.partial.mkdir(exist_ok=True)
            self._lock = os.open(self.partial, os.O_RDONLY)
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                os.close(self._lock)
                raise InputError(f"{self.out}: another build of it is running ({self.partial})") from None
            try:
                _empty(self.partial)
                self._recover()
                check_target(self.out, self._overwrite)
            except BaseException:
                self.__exit__()
                raise
        return self

    def _recover(self) -> None:
        """Put right what a build left that was killed between the two renames of ``commit``."""
        if self._replaced.exists():
            if self.out.exists():
                shutil.rmtree(self._replaced)
            else:
                self._replaced.rename(self.out)

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        if self.partial.exists():
            shutil.rmtree(self.partial, ignore_errors=True)
        os.close(self._lock)

    def write_array(self, name: str, array: np.ndarray) -> None:
        """A whole array of the scene."""
        array = np.ascontiguousarray(array)
        with writing(self.partial):
            self.open_column(name, array.dtype, array.shape[1:]).write(array)

    def drop(self, name: str) -> None:
        """Remove an array that the scene is not to have after all; maps of it stay valid."""
        column = self.columns.pop(name)
        column.abandon()
        with writing(self.partial):
            column.path.unlink()

    @contextmanager
    def rewriting(self, names: Iterable[str]) -> Iterator[dict[str, ColumnFile]]:
        """A new file for each of these arrays, empty, which takes its place at the end; maps of the old stay valid."""
        names = list(names)
        files = {name: self.open_column(f"{name}.new", self.columns[name].dtype) for name in names}
        yield files
        for name, file in files.items():
            self.drop(name)
            with writing(self.partial):
                file.rename(name)
            self.columns[name] = self.columns.pop(f"{name}.new")

    def written(self, name: str) -> np.ndarray:
        """What has been written of an array: a read-only map."""
        return self.columns[name].written()

    def close_columns(self) -> dict[str, ArrayInfo]:
        """Finish every array and say what was written."""
        with writing(self.partial):
            return {name: column.close() for name, column in self.columns.items()}

    def commit(self, info: SceneInfo) -> None:
        """Write ``scene.json`` and put the directory in the target's place."""
        with writing(self.partial):
            with open(self.partial / SCENE_FILE, "w", encoding="utf-8") as file:
                file.write(info.to_json())
                file.flush()
                os.fsync(file.fileno())
            check_target(self.out, self._overwrite)
            if self.out.exists():
                self.out.rename(self._replaced)
            self.partial.rename(self.out)
            parent = os.open(self.out.parent, os.O_RDONLY)
            os.fsync(parent)
            os.close(parent)
            shutil.rmtree(self._replaced, ignore_errors=True)


def check_target(out: Path, overwrite: bool) -> None:
    """Raise InputError if a scene must not be written to ``out``."""
    if not out.name:
        raise InputError(f"{out}: cannot be the name of a scene")
    nearest = next((p for p in out.absolute().parents if p.exists()), None)
    if nearest and not (nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)):
        raise InputError(f"{out}: cannot be written: {nearest} is not a writable folder")
    if not out.exists() and not out.is_symlink():
        return
    if not out.is_dir() or not ((out / SCENE_FILE).is_file() or not any(out.iterdir())):
        raise InputError(f"{out}: exists and is not a scene, expected a new name or a scene")
    if not overwrite and (out / SCENE_FILE).is_file():
        raise InputError(f"{out}: the scene exists, expected a new name or overwrite")


def _empty(directory: Path) -> None:
    for entry in directory.iterdir():
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def settings_json(settings: Any) -> dict[str, Any]:
    """A settings dataclass as JSON types, in ``scene.json``."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in vars(settings).items()}
