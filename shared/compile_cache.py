"""Where compiled kernels are kept when the usual places cannot be written."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


def ensure_compile_cache() -> None:
    """Give numba a folder for compiled kernels if neither the package nor the user's cache folder can be written.

    numba raises on import of a cached kernel when it finds none (a read-only installation without a home folder, as
    in many containers). To be called before numba is imported; child processes inherit the choice. A compiled kernel
    is code, so the folder must be this user's alone; where it is not, this process gets one of its own.
    """
    if VARIABLE in os.environ or _can_make_folders(Path(__file__).parent) or _can_make_folders(_user_cache()):
        return
    folder = Path(tempfile.gettempdir()) / f"splatpipe-kernels-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.stat(follow_symlinks=False)
        ours = status.st_uid == os.getuid() and status.st_mode & 0o777 == 0o700 and not folder.is_symlink()
    except OSError:
        ours = False
    os.environ[VARIABLE] = str(folder) if ours else tempfile.mkdtemp(prefix="splatpipe-kernels-")


def _user_cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))


def _can_make_folders(folder: Path) -> bool:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return os.access(folder, os.W_OK | os.X_OK)
