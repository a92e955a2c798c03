"""JSON files of others, within bounds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ...errors import InputError

MAX_BYTES = 1 << 28
"""Of a file: its content takes ten to thirty times as much memory."""

LARGEST = 1e30
"""Of numbers: those above are taken for errors, as what is not finite."""


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises InputError where it cannot be read, is too large or nested too deep."""
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(f"{path}: found {size} bytes, expected at most {MAX_BYTES}")
        content = json.loads(path.read_bytes().decode("utf-8-sig"), parse_constant=_no_number)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except RecursionError:
        raise InputError(f"{path}: not valid JSON: nested too deep") from None
    except ValueError as error:
        raise InputError(f"{path}: not valid JSON: {str(error)[:120]}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: found {describe(content)}, expected an object")
    return content


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number")


def wrong(path: Path, where: str, found: Any, expected: str) -> InputError:
    """The error for a value of the wrong kind."""
    return InputError(f"{path}: {where}: found {describe(found)}, expected {expected}")


def describe(value: Any) -> str:
    """A value for a message: short, on one line."""
    if isinstance(value, (dict, list)):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    text = (
        json.dumps(value, ensure_ascii=True) if not isinstance(value, int) or abs(value) < 1 << 64 else "a huge number"
    )
    return text if len(text) <= 40 else text[:37] + "…"


def expect_list(path: Path, where: str, value: Any, expected: str) -> list[Any]:
    """The value, a list. Raises InputError if it is none."""
    if not isinstance(value, list):
        raise wrong(path, where, value, expected)
    return value


def numbers(path: Path, where: str, value: Any, least: int, most: int) -> np.ndarray:
    """(n, k) float64 from a list of lists of ``least`` to ``most`` numbers; k is the least length found.

    Raises InputError, naming the entry, for anything else and for numbers that are not finite.
    """
    rows = expect_list(path, where, value, "a list of positions")
    kind = f"{least} finite numbers" if least == most else f"{least} to {most} finite numbers"
    for i, row in enumerate(rows):
        if type(row) is not list or not least <= len(row) <= most:
            raise wrong(path, f"{where}[{i}]", row, kind)
        for number in row:
            if type(number) not in (int, float) or not is_finite(number):
                raise wrong(path, f"{where}[{i}]", number, kind)
    length = min(map(len, rows), default=least)
    return np.array([row[:length] for row in rows], np.float64).reshape(len(rows), length)


def is_finite(number: float) -> bool:
    """Whether a number of JSON is one to reckon with: it may have any number of digits."""
    return abs(number) <= LARGEST
