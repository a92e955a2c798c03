"""The compiled loops against plain Python: decimal rows and LZF."""

import math
import re
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reader_files import lzf_compress
from splatpipe.shared.errors import InputError
from splatpipe.shared.readers.lzf import MAX_EXPANSION, decompress
from splatpipe.shared.readers.rows import MAX_LINE_BYTES, read_rows


def rows_of(path, text, n_columns, wanted=None, max_rows=7, n_rows=None):
    path.write_bytes(text)
    wanted = range(n_columns) if wanted is None else wanted
    with path.open("rb") as file:
        blocks = [b.copy() for b in read_rows(path, file, n_columns, wanted, max_rows, n_rows)]
    assert all(len(b) <= max_rows for b in blocks)
    return np.concatenate(blocks) if blocks else np.empty((0, len(wanted)))


def reference(text):
    """Rows as ``float`` reads them."""
    lines = [line.split() for line in text.decode().splitlines()]
    return np.array([[float(v) for v in line] for line in lines if line])


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("rows") / "rows.txt"


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    rows=st.lists(st.lists(st.floats(width=64), min_size=3, max_size=3), min_size=1, max_size=40),
    style=st.sampled_from(["{!r}", "{:.3f}", "{:.18e}", "{:+.6G}", "{:.0f}", "{:.17g}"]),
    separator=st.sampled_from([" ", "\t", "  \t "]),
    newline=st.sampled_from(["\n", "\r\n", "\n\n", " \n"]),
)
def test_values_are_correctly_rounded(scratch, rows, style, separator, newline):
    text = newline.join(separator.join(style.format(v) for v in row) for row in rows).encode()
    np.testing.assert_array_equal(rows_of(scratch, text, 3), reference(text))


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    parts=st.tuples(
        st.sampled_from(["", "+", "-", "--"]),
        st.text("0123456789", max_size=22),
        st.sampled_from(["", ".", ".."]),
        st.text("0123456789", max_size=22),
        st.sampled_from(["", "e", "E+", "e-", "f"]),
        st.text("0123456789", max_size=4),
    )
)
def test_any_decimal_number(scratch, parts):
    field = "".join(parts)
    try:
        value = float(field)
    except ValueError:
        value = math.nan if field == "" else None
    line = f"0,{field},0".encode()
    if value is None:
        with pytest.raises(InputError, match=r"line 1: found .* expected a number"):
            rows_of(scratch, line, 3)
    else:
        np.testing.assert_array_equal(rows_of(scratch, line, 3), [[0, value, 0]])


def test_numbers_next_to_the_middle_of_two_floats(scratch):
    rng = np.random.default_rng(11)
    lower = rng.random(3000) * 2.0 ** rng.integers(-20, 60, 3000)
    fields = []
    for a, b in zip(lower.tolist(), np.nextafter(lower, np.inf).tolist(), strict=True):
        middle = (Decimal(a) + Decimal(b)) / 2
        fields += [f"{middle:.{digits}e}" for digits in (16, 17, 18, 19)]
    rows = rows_of(scratch, "\n".join(fields).encode(), 1, max_rows=20_000)
    np.testing.assert_array_equal(rows[:, 0], [float(field) for field in fields])


@settings(max_examples=200, deadline=None, derandomize=True)
@given(text=st.text(alphabet="012.-+e \t,;\n\r#/x", max_size=60))
def test_any_text_gives_rows_or_one_line(scratch, text):
    lines = [
        line for line in re.split("[\n\r]", text) if line.strip(" \t") and not line.strip(" \t").startswith(("#", "//"))
    ]
    try:
        rows = rows_of(scratch, text.encode(), 2)
    except InputError as error:
        rows, message = None, str(error)
    if rows is None:
        assert message.startswith(f"{scratch}: line ")
        assert lines
    else:
        assert len(rows) == len(lines)


def test_separators_comments_and_empty_fields(scratch):
    text = b"# head\n1 , 2;3\n// more\n\n4,,6\n7;8;\n  9\t10 11 \r\n,,\n"
    nan = np.nan
    expected = [[1, 2, 3], [4, nan, 6], [7, 8, nan], [9, 10, 11], [nan, nan, nan]]
    np.testing.assert_array_equal(rows_of(scratch, text, 3), expected)


def test_columns_that_are_not_wanted_may_hold_anything(scratch):
    text = b"tree 1 2 a\nhouse 3 4 b\n"
    np.testing.assert_array_equal(rows_of(scratch, text, 4, [2, 1]), [[2, 1], [4, 3]])


def test_number_of_rows_bounds_what_is_read(scratch):
    np.testing.assert_array_equal(rows_of(scratch, b"1 2\n3 4\nthe rest\n", 2, n_rows=2), [[1, 2], [3, 4]])


def test_rows_across_blocks(scratch):
    values = np.arange(600_000, dtype=np.float64).reshape(-1, 2) / 8
    text = "\n".join(f"{a!r} {b!r}" for a, b in values.tolist()).encode()
    assert len(text) > MAX_LINE_BYTES
    np.testing.assert_array_equal(rows_of(scratch, text, 2, max_rows=70_000), values)
    with pytest.raises(InputError, match=r"line 300001: found 'x', expected a number"):
        rows_of(scratch, text + b"\n1 x\n", 2, max_rows=70_000)


def test_a_line_without_end_is_refused(scratch):
    with pytest.raises(InputError, match="line 1: found more than"):
        rows_of(scratch, b"1 " * MAX_LINE_BYTES, 2)


def lzf_reference(data, n_bytes):
    """Plain Python on a growing list, or None where the stream makes no sense."""
    out, at = [], 0
    while at < len(data):
        control, at = data[at], at + 1
        if control < 32:
            run = data[at : at + control + 1]
            at += control + 1
            if len(run) <= control:
                return None
            out += run
        else:
            extra = 1 if control >> 5 == 7 else 0
            if at + extra >= len(data):
                return None
            n = (control >> 5) + 2 + (data[at] if extra else 0)
            start = len(out) - ((control & 31) << 8) - data[at + extra] - 1
            at += 1 + extra
            if start < 0:
                return None
            for i in range(n):
                out.append(out[start + i])
        if len(out) > n_bytes:
            return None
    return bytes(out)


def lzf(data, n_bytes):
    out = np.zeros(n_bytes, np.uint8)
    written = decompress(np.frombuffer(data, np.uint8), out)
    return None if written < 0 else out[:written].tobytes()


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.binary(min_size=1, max_size=5), st.integers(1, 300)), max_size=20))
def test_lzf_round_trip(runs):
    plain = b"".join(part * n for part, n in runs)
    packed = lzf_compress(plain)
    assert len(plain) <= MAX_EXPANSION * len(packed)
    assert lzf(packed, len(plain)) == plain == lzf_reference(packed, len(plain))


@settings(max_examples=300, deadline=None, derandomize=True)
@given(data=st.binary(max_size=80), n_bytes=st.integers(0, 400))
def test_lzf_of_anything(data, n_bytes):
    assert lzf(data, n_bytes) == lzf_reference(data, n_bytes)
