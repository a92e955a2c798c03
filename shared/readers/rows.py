"""Rows of decimal numbers in text, as text, PLY and PCD files hold them: one pass over the bytes, compiled.

Fields are separated by blanks, or by a comma or semicolon with or without blanks around it; an empty field between
two commas is NaN. Empty lines and lines that start with ``#`` or ``//`` are passed over.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numba import njit

from ..errors import InputError

MAX_LINE_BYTES = 1 << 22
"""Bytes read at a time; no line may be longer."""

_MAX_MANTISSA = 922_337_203_685_477_000  # another digit still fits into int64
_SPLIT = 2.0**27 + 1
_POWERS_OF_TEN = 10.0 ** np.arange(23)  # all exact in float64
_NEWLINE, _RETURN, _TAB, _SPACE, _COMMA, _SEMICOLON = 10, 13, 9, 32, 44, 59
_HASH, _SLASH, _PLUS, _MINUS, _DOT, _ZERO, _E = 35, 47, 43, 45, 46, 48, 101


def read_rows(
    path: Path,
    file: BinaryIO,
    n_columns: int,
    wanted: Sequence[int],
    max_rows: int,
    n_rows: int | None = None,
) -> Iterator[np.ndarray]:
    """(≤ max_rows, len(wanted)) float64 arrays of the columns ``wanted``, from where ``file`` stands.

    n_rows : stop after so many rows; None: read to the end.
    Values are correctly rounded. Columns that are not wanted may hold anything. Memory: one array and 4 MiB.
    Raises InputError, naming the line, for a row of another number of columns or a field that is not a number.
    """
    left = _bytes_left(file) // n_columns + 1  # a row has at least one byte a column
    left = left if n_rows is None else min(left, n_rows)
    target = np.full(n_columns, -1, np.int64)
    target[list(wanted)] = np.arange(len(wanted))
    slow = np.empty((1 << 14, 4), np.int64)
    out, filled = np.empty((min(max_rows, left), len(wanted))), 0
    for start, block in _whole_lines(path, file):
        text, at = np.frombuffer(block, np.uint8), 0
        while at < len(text) and left:
            n, at, n_slow, bad = parse_rows(text, at, target, out[filled : filled + left], slow)
            fields = slow[:n_slow]
            out[filled + fields[:, 0], fields[:, 1]] = [
                _to_float(path, start + begin, block[begin:end]) for begin, end in fields[:, 2:].tolist()
            ]
            if bad >= 0:
                raise _bad_line(path, start + at, f"{bad} columns", f"{n_columns}")
            filled += n
            left -= n
            if filled == len(out):
                yield out
                out, filled = np.empty((min(max_rows, left), len(wanted))), 0
        if not left:
            break
    if filled:
        yield out[:filled]


def skip_rows(file: BinaryIO, n_rows: int) -> None:
    """Pass over so many lines that are not empty, or to the end of the file."""
    while n_rows and (line := file.readline(MAX_LINE_BYTES)):
        n_rows -= line.endswith(b"\n") and not line.isspace()


@njit(nogil=True, cache=True)
def parse_rows(text, at, target, out, slow):
    """Parse whole lines until ``text`` ends or ``out`` or ``slow`` is full.

    text : (n,) uint8 that ends with a newline.  at : where to start, the begin of a line.
    target : (n_columns,) int64, column of ``out`` or −1.  out : (rows, k) float64, filled.
    slow : (m, 4) int64, m ≥ n_columns, filled with (row, column, begin, end) of fields that are left to ``float``.
    Returns (rows, position, entries of slow, −1); or, as the last, the number of columns of a line that has not
    ``n_columns``, and the position is in that line.
    """
    n_columns, n_bytes = len(target), len(text)
    row = n_slow = 0
    while at < n_bytes and row < len(out) and n_slow + n_columns <= len(slow):
        while _is_blank(text[at]):
            at += 1
        if _ends_line(text[at]):
            at += 1
            continue
        if text[at] == _HASH or (text[at] == _SLASH and text[at + 1] == _SLASH):
            while not _ends_line(text[at]):
                at += 1
            continue
        line, column, more = at, 0, True
        while more:
            begin = at
            while not (_is_blank(text[at]) or _is_separator(text[at]) or _ends_line(text[at])):
                at += 1
            if column < n_columns and target[column] >= 0:
                exact, value = _decimal(text, begin, at)
                out[row, target[column]] = value
                if not exact:
                    slow[n_slow, 0], slow[n_slow, 1] = row, target[column]
                    slow[n_slow, 2], slow[n_slow, 3] = begin, at
                    n_slow += 1
            column += 1
            while _is_blank(text[at]):
                at += 1
            if _is_separator(text[at]):
                at += 1
                while _is_blank(text[at]):
                    at += 1
                more = column < n_columns or not _ends_line(text[at])  # a last separator may end the line
            else:
                more = not _ends_line(text[at])
        if column != n_columns:
            return row, line, n_slow, column
        row += 1
    return row, at, n_slow, -1


@njit(nogil=True, cache=True, forceinline=True)
def _is_blank(byte):
    return byte in (_SPACE, _TAB)


@njit(nogil=True, cache=True, forceinline=True)
def _is_separator(byte):
    return byte in (_COMMA, _SEMICOLON)


@njit(nogil=True, cache=True, forceinline=True)
def _ends_line(byte):
    return byte in (_NEWLINE, _RETURN)


@njit(nogil=True, cache=True, forceinline=True)
def _decimal(text, at, end):
    """(True, value) of text[at:end], correctly rounded: up to 18 digits times a power of ten up to 10**22.

    (False, 0) where that does not decide it. NaN for no text at all. Below 2**53 one operation is exact enough
    (Clinger, "How to read floating point numbers accurately", 1990); above, see ``_scale``.
    """
    if at == end:
        return True, np.nan
    negative = text[at] == _MINUS
    if negative or text[at] == _PLUS:
        at += 1
    mantissa, exponent, n_digits, fraction = 0, 0, 0, 0
    while at < end:
        digit = np.int64(text[at]) - _ZERO
        if 0 <= digit <= 9:
            if mantissa > _MAX_MANTISSA:
                return False, 0.0
            mantissa = mantissa * 10 + digit
            exponent -= fraction
            n_digits += 1
        elif text[at] == _DOT and not fraction:
            fraction = 1
        else:
            break
        at += 1
    if n_digits == 0:
        return False, 0.0
    if at < end and text[at] | 32 == _E:
        at += 1
        negative_exponent = at < end and text[at] == _MINUS
        if at < end and (text[at] == _MINUS or text[at] == _PLUS):
            at += 1
        if at == end or end - at > 3:
            return False, 0.0
        power = 0
        while at < end and _ZERO <= text[at] <= _ZERO + 9:
            power = power * 10 + np.int64(text[at]) - _ZERO
            at += 1
        exponent += -power if negative_exponent else power
    if at != end or exponent < -22 or exponent > 22:
        return False, 0.0
    exact, value = True, np.float64(mantissa)
    if mantissa > 1 << 53:
        exact, value = _scale(mantissa, exponent)
    elif exponent < 0:
        value /= _POWERS_OF_TEN[-exponent]
    else:
        value *= _POWERS_OF_TEN[exponent]
    return exact, -value if negative else value


@njit(nogil=True, cache=True)
def _scale(mantissa, exponent):
    """(True, mantissa · 10**exponent), correctly rounded, or (False, …) if it is too near the middle of two float64.

    In double-double arithmetic (Dekker 1971) the result is off by less than 2**-100 of it, so where both ends of
    twice that error round to one number, it is the right one.
    """
    high = np.float64(mantissa)
    low = np.float64(mantissa - np.int64(high))
    power = _POWERS_OF_TEN[abs(exponent)]
    if exponent < 0:
        value = high / power
        product, error = _exact_product(value, power)
        rest = ((high - product) - error + low) / power
    else:
        value, error = _exact_product(high, power)
        rest = error + low * power
    slack = value * 2.0**-99
    return value + (rest - slack) == value + (rest + slack), value + rest


@njit(nogil=True, cache=True)
def _exact_product(a, b):
    """(rounded product, its error), exact together."""
    a_high, b_high = a * _SPLIT - (a * _SPLIT - a), b * _SPLIT - (b * _SPLIT - b)
    a_low, b_low = a - a_high, b - b_high
    product = a * b
    return product, a_low * b_low - (((product - a_high * b_high) - a_low * b_high) - a_high * b_low)


def _to_float(path: Path, offset: int, field: bytes) -> float:
    try:
        return float(field)
    except ValueError:
        raise _bad_line(path, offset, repr(field[:40].decode("ascii", "replace")), "a number") from None


def _whole_lines(path: Path, file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """(offset in the file, bytes) of blocks that end where a line ends. Raises InputError for a line over 4 MiB."""
    start, rest = file.tell(), b""
    while block := file.read(MAX_LINE_BYTES):
        end = max(block.rfind(b"\n"), block.rfind(b"\r")) + 1
        if end == 0 and len(rest) + len(block) > MAX_LINE_BYTES:
            raise _bad_line(path, start, f"more than {MAX_LINE_BYTES} bytes", "a line of numbers")
        if end:
            yield start, rest + block[:end]
            start, rest = start + len(rest) + end, block[end:]
        else:
            rest += block
    if rest:
        yield start, rest + b"\n"


def _bytes_left(file: BinaryIO) -> int:
    here = file.tell()
    end = file.seek(0, 2)
    file.seek(here)
    return end - here


def _bad_line(path: Path, offset: int, found: str, expected: str) -> InputError:
    """The error for what stands at byte ``offset``."""
    with path.open("rb") as file:
        line = 1
        while offset > 0 and (block := file.read(min(offset, MAX_LINE_BYTES))):
            line += block.count(b"\n")
            offset -= len(block)
    return InputError(f"{path}: line {line}: found {found}, expected {expected}")
