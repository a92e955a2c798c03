"""Files written whole or not at all, and what to say when the disk will not have them."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .errors import InputError, SplatpipeError

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers of a disk, quota or file-size limit that is used up."""


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under a hidden name and rename it, so that nothing half-written has the name.

    Raises InputError when the disk is full or the folder unwritable.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        write(part)
        os.replace(part, path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        raise disk_error(error, path) from None


def disk_error(error: BaseException, path: Path) -> BaseException:
    """The error a user can act on: a full or unwritable disk becomes InputError; anything else stays."""
    if isinstance(error, OSError) and not isinstance(error, SplatpipeError):
        if error.errno in DISK_FULL:
            return InputError(f"{path}: disk full")
        return InputError(f"{path}: cannot be written: {error.strerror or error}")
    return error


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file whole or not at all. Raises InputError when it cannot be written."""
    write_whole(path, lambda part: part.write_text(json.dumps(content, indent=1) + "\n"))
