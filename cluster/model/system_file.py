"""System files: the parameters of ``splatpipe model`` as TOML, written by ``--save-system`` and read by ``--system``.

Every parameter has to be there. A value is a number ≥ 0 in the unit that the key ends in, or the text "not applicable"
(no such device, no such traffic) or "unknown" (nobody measured it). Ranks are counted from 0, in file order.
"""

from __future__ import annotations

import difflib
import sys
import tomllib
from pathlib import Path
from typing import Any, TypeVar

from ...shared.errors import InputError
from ...shared.files import write_whole
from .parameters import (
    Application,
    Link,
    Quantity,
    RankLoad,
    RankSystem,
    Source,
    System,
    Traffic,
    is_frame_rate,
    parameters,
)

VERSION = 1
_ABSENT = (Source.NOT_APPLICABLE, Source.UNKNOWN)
_PAIR = ("sender", "receiver")

Part = TypeVar("Part", RankSystem, Link, RankLoad, Traffic)


def read_system_file(path: Path) -> tuple[System, Application | None]:
    """The system of a file, and the application if the file holds one.

    Raises InputError naming file and key, what was found and what was expected.
    """
    try:
        data = tomllib.loads(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    reader = _Reader(path)
    reader.refuse_unknown(data, ("version", "title", "system", "application"), "")
    if data.get("version") != VERSION:
        raise reader.wrong("version", data.get("version", "nothing"), f"{VERSION}")
    system = reader.table(data, "system", ("rank", "link"))
    ranks = reader.parts(RankSystem, system, "system.rank", 0)
    if not ranks:
        raise reader.wrong("system.rank", "no rank", "a [[system.rank]] for each rank")
    links = reader.parts(Link, system, "system.link", len(ranks))
    for i, link in enumerate(links):
        if any((link.sender, link.receiver) == (other.sender, other.receiver) for other in links[:i]):
            raise reader.wrong(f"system.link[{i}]", f"{link.sender} to {link.receiver} again", "each pair once")
    application = None
    if "application" in data:
        table = reader.table(data, "application", ("frames_per_s", "rank", "traffic"))
        frames_per_s = reader.number(table, "application.frames_per_s")
        if not is_frame_rate(frames_per_s):
            raise reader.wrong("application.frames_per_s", frames_per_s, "a number > 0")
        loads = reader.parts(RankLoad, table, "application.rank", 0)
        if len(loads) != len(ranks):
            raise reader.wrong("application.rank", f"{len(loads)} ranks", f"{len(ranks)} as in system.rank")
        traffic = reader.parts(Traffic, table, "application.traffic", len(ranks))
        application = Application(frames_per_s, tuple(loads), tuple(traffic))
    return System(tuple(ranks), tuple(links)), application


def write_system_file(path: Path, title: str, system: System, application: Application) -> None:
    """Write both, whole or not at all. Raises InputError when it cannot be written."""
    lines = [f"version = {VERSION}", f"title = {_text(title)}"]
    for key, parts in (("system.rank", system.ranks), ("system.link", system.links)):
        lines += _written(key, parts)
    lines += ["", "[application]", f"frames_per_s = {application.frames_per_s!r}  # F"]
    for key, parts in (("application.rank", application.ranks), ("application.traffic", application.traffic)):
        lines += _written(key, parts)
    write_whole(path, lambda part: part.write_text("\n".join(lines) + "\n", encoding="utf-8"))


def _written(key: str, parts: tuple[Any, ...]) -> list[str]:
    lines = []
    for part in parts:
        lines += ["", f"[[{key}]]"]
        if hasattr(part, "role"):
            lines.append(f"role = {_text(part.role)}")
        else:
            lines += [f"{name} = {getattr(part, name)}" for name in _PAIR]
        for item in parameters(part):
            quantity: Quantity = getattr(part, item.name)
            value = _text(quantity.source) if quantity.value is None else repr(quantity.value)
            lines.append(f"{item.name} = {value}  # {item.metadata['symbol']}, {item.metadata['unit']}")
    return lines


def _text(text: str) -> str:
    """A TOML string: quotes, backslashes and control characters escaped."""
    plain = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in plain) + '"'


class _Reader:
    """Takes tables apart, and names the file and the key in every complaint."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def wrong(self, key: str, found: Any, expected: str) -> InputError:
        return InputError(f"{self._path}: {key}: found {found}, expected {expected}")

    def refuse_unknown(self, table: dict[str, Any], known: tuple[str, ...], prefix: str) -> None:
        for key in table:
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
                raise InputError(f"{self._path}: unknown key {prefix}{key}, did you mean {prefix}{near[0]}?")

    def table(self, data: dict[str, Any], key: str, known: tuple[str, ...]) -> dict[str, Any]:
        table = data.get(key, "nothing")
        if not isinstance(table, dict):
            raise self.wrong(key, table, "a table")
        self.refuse_unknown(table, known, f"{key}.")
        return table

    def number(self, table: dict[str, Any], key: str) -> float:
        value = table.get(key.rpartition(".")[2], "nothing")
        if not _is_number(value):
            raise self.wrong(key, value, "a finite number ≥ 0")
        return float(value)

    def parts(self, kind: type[Part], table: dict[str, Any], key: str, n_ranks: int) -> list[Part]:
        """The tables ``[[key]]`` as a class of ``parameters``; n_ranks bounds sender and receiver."""
        found = table.get(key.rpartition(".")[2], [])
        if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
            raise self.wrong(key, found, f"tables [[{key}]]")
        return [self._part(kind, item, f"{key}[{i}]", n_ranks) for i, item in enumerate(found)]

    def _part(self, kind: type[Part], table: dict[str, Any], key: str, n_ranks: int) -> Part:
        names = [item.name for item in parameters(kind)]
        who = _PAIR if n_ranks else ("role",)
        self.refuse_unknown(table, (*who, *names), f"{key}.")
        values: dict[str, Any] = {name: self._quantity(table, f"{key}.{name}") for name in names}
        for name in who:
            value = table.get(name, "nothing")
            good = isinstance(value, str) and name in table if name == "role" else _is_rank(value, n_ranks)
            if not good:
                raise self.wrong(f"{key}.{name}", value, "a text" if name == "role" else f"a rank, 0…{n_ranks - 1}")
            values[name] = value
        if n_ranks and values["sender"] == values["receiver"]:
            raise self.wrong(f"{key}.receiver", values["receiver"], "another rank than the sender")
        return kind(**values)

    def _quantity(self, table: dict[str, Any], key: str) -> Quantity:
        value = table.get(key.rpartition(".")[2], "nothing")
        if value in _ABSENT:
            return Quantity(None, Source(value))
        if not _is_number(value):
            raise self.wrong(key, value, 'a finite number ≥ 0, "not applicable" or "unknown"')
        return Quantity(float(value), Source.FILE)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= sys.float_info.max


def _is_rank(value: Any, n_ranks: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < n_ranks
