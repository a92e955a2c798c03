"""Sizes as people write them: ``500MB``, ``4GiB``."""

from __future__ import annotations

from .errors import InputError

_UNITS = {"": 1, "B": 1, "K": 1e3, "KB": 1e3, "M": 1e6, "MB": 1e6, "G": 1e9, "GB": 1e9, "T": 1e12, "TB": 1e12}
_UNITS |= {"KIB": 2**10, "MIB": 2**20, "GIB": 2**30, "TIB": 2**40}


def parse_bytes(text: str, option: str) -> int:
    """Bytes of ``4GB``, ``500 MB``, ``2GiB`` or a plain number. Raises InputError naming the option."""
    digits = text.strip().rstrip("BKMGTIbkmgti ")
    unit = text.strip()[len(digits) :].strip().upper()
    try:
        value = float(digits) * _UNITS[unit]
    except (ValueError, KeyError):
        raise InputError(f"{option} {text}: expected a size such as 500MB or 4GiB") from None
    if not 0 < value < 2**60:
        raise InputError(f"{option} {text}: expected a size above 0")
    return int(value)
