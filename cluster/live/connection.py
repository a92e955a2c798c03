"""Where a live run is and the keys that let one in: the connection file of programs, the variables of ranks.

The file is JSON: ``protocol``, ``address``, ``server_key``, ``public_key``, ``secret_key`` (CURVE, Z85), ``url`` (of
the page, with its token) and ``pid`` of the hub. Only its owner can read it, and it goes with the run.
"""

from __future__ import annotations

import json
import os
import stat
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from ...shared.errors import InputError
from .protocol import PROTOCOL_VERSION

_VARIABLE = "SPLATPIPE_LIVE_"
_MAX_FILE_BYTES = 64 << 10


@dataclass(frozen=True)
class RunAddress:
    """How ranks reach the hub. address : ``tcp://host:port``. Keys in Z85; the secret one is for ranks only."""

    address: str
    server_key: str
    public_key: str
    secret_key: str

    def to_variables(self) -> dict[str, str]:
        """Environment variables of the ranks."""
        return {_VARIABLE + name.upper(): value for name, value in asdict(self).items()}

    @classmethod
    def from_variables(cls, variables: Mapping[str, str]) -> RunAddress | None:
        """What ``to_variables`` gave, of the environment or another mapping; None in a run that nobody looks at."""
        names = [field.name for field in fields(cls)]
        values = {name: variables.get(_VARIABLE + name.upper(), "") for name in names}
        return cls(**values) if all(values.values()) else None

    @classmethod
    def from_environment(cls) -> RunAddress | None:
        """That of the environment."""
        return cls.from_variables(os.environ)


@dataclass(frozen=True)
class Connection:
    """Content of a connection file."""

    protocol: int
    address: str
    server_key: str
    public_key: str
    secret_key: str
    url: str
    pid: int

    def write(self, path: Path) -> None:
        """Write it for its owner only (mode 600), in one step. Raises InputError where that fails."""
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            part.unlink(missing_ok=True)
            file = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
            with os.fdopen(file, "w") as stream:
                json.dump(asdict(self), stream)
            part.replace(path)
        except OSError as error:
            with suppress(OSError):  # as where there is no such folder
                part.unlink(missing_ok=True)
            raise InputError(f"{path}: cannot write the connection file: {error.strerror}") from None

    @classmethod
    def read(cls, path: Path) -> Connection:
        """What ``write`` wrote. Raises InputError, also for another version."""
        try:
            with path.open("rb") as stream:
                content = json.loads(stream.read(_MAX_FILE_BYTES))
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}; is the run over?") from None
        except (ValueError, RecursionError):
            raise InputError(f"{path}: no JSON, expected the connection file of a live run") from None
        types = {"protocol": int, "pid": int}
        for field in fields(cls):
            wanted = types.get(field.name, str)
            if not isinstance(content, dict) or type(content.get(field.name)) is not wanted:
                raise InputError(f"{path}: {field.name}: missing, expected the connection file of a live run")
        if content["protocol"] != PROTOCOL_VERSION:
            raise InputError(f"{path}: protocol {content['protocol']}, expected {PROTOCOL_VERSION}")
        return cls(**{field.name: content[field.name] for field in fields(cls)})

    def remove(self, path: Path) -> None:
        """Remove what ``write`` wrote, unless it is another run's by now."""
        with suppress(InputError, OSError):
            if Connection.read(path) == self:
                path.unlink()

    @property
    def lives(self) -> bool:
        """Whether the process of the hub is there."""
        if self.pid <= 0:
            return False
        try:
            os.kill(self.pid, 0)
        except (ProcessLookupError, OverflowError):
            return False
        except PermissionError:  # another user's
            return True
        return True


def runtime_directory() -> Path:
    """Where connection files are, made if need be: ``$XDG_RUNTIME_DIR/splatpipe``, or ``splatpipe-UID`` among temporary
    files. Raises InputError where it is another user's or open to others.
    """
    base = Path(os.environ.get("XDG_RUNTIME_DIR") or "/dev/null")
    path = base / "splatpipe" if base.is_dir() else Path(tempfile.gettempdir()) / f"splatpipe-{os.getuid()}"
    try:
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
        found = path.lstat()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}, expected a directory for connection files") from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise InputError(f"{path}: expected a directory of this user's with mode 700")
    return path


def new_connection_file() -> Path:
    """Where this process's hub keeps its connection file unless told otherwise. Removes those of killed runs."""
    directory = runtime_directory()
    for file in directory.glob("*.json"):
        with suppress(InputError, OSError):
            if not Connection.read(file).lives:
                file.unlink()
    return directory / f"{os.getpid()}.json"


def find_connection(path: Path | None = None) -> Connection:
    """The run of a connection file, or without one this user's newest that lives. Raises InputError where none does."""
    if path is not None:
        return Connection.read(path)
    directory = runtime_directory()
    written: list[tuple[float, Path]] = []
    for file in directory.glob("*.json"):
        with suppress(OSError):  # gone meanwhile
            written.append((file.stat().st_mtime, file))
    for _, file in sorted(written, reverse=True):
        with suppress(InputError):
            connection = Connection.read(file)
            if connection.lives:
                return connection
    raise InputError(f"{directory}: no live run found; start one with splatpipe view, or name its connection file")
