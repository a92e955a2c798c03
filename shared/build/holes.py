"""Disk space of parts of files that are not read again."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

_KEEP_SIZE_PUNCH_HOLE = 0x01 | 0x02  # linux/falloc.h


def punch_hole(path: Path, first: int, n_bytes: int) -> None:
    """Give back the disk space of ``n_bytes`` from ``first`` on, which read as zeros from then on.

    Whole blocks of the file system only. Does nothing where system or file system cannot: it is only room.
    """
    if n_bytes <= 0 or (fallocate := getattr(ctypes.CDLL(None), "fallocate", None)) is None:
        return
    descriptor = os.open(path, os.O_WRONLY)
    try:
        fallocate(descriptor, _KEEP_SIZE_PUNCH_HOLE, ctypes.c_int64(first), ctypes.c_int64(n_bytes))
    finally:
        os.close(descriptor)
