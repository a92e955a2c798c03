"""Coded messages: the payload again to the bit, nothing larger, and no damaged one that is believed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.shared import message_codecs
from splatpipe.shared.codecs.varints import write_varints
from splatpipe.shared.errors import MessageError
from splatpipe.shared.framebuffer_runs import encode_runs, most_bytes
from splatpipe.shared.message_codecs import CODED_KINDS, form_of, has_zstd, pack, unpack
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT, Kind, header, is_coded, parse_header

needs_zstd = pytest.mark.skipif(not has_zstd(), reason="zstandard is missing: splatpipe[mpi]")


def again(kind: Kind, payload: np.ndarray, **how) -> np.ndarray | None:
    """What is coded of a payload, after it was held against the payload; None where it has no smaller form."""
    payload = payload.view(np.uint8)
    coded = pack(kind, payload.data, **how)
    if coded is not None:
        assert len(coded) < len(payload)
        assert np.array_equal(unpack(kind, coded.data, len(payload)), payload)
        with pytest.raises(MessageError):
            unpack(kind, coded.data, len(payload) - 1)
    return coded


def render_points(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n,) entries as a sampling rank makes them: ascending ranges, then pooled ones."""
    entries = np.zeros(n, RENDER_POINT)
    length = rng.integers(1, 4000, n)
    entries["offset"] = np.cumsum(length + rng.integers(0, 3000, n))
    entries["range"], entries["stride"] = length, rng.choice([1, 3], n)
    entries["offset"][2 * n // 3 :] //= 7
    entries["stride"][2 * n // 3 :] = 0
    return entries


def picture(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n,) uint64 words, half of them background in runs, depth and colour changing slowly."""
    depth = (5 + np.cumsum(rng.normal(0, 0.01, n))).astype(np.float32).view(np.uint32).astype(np.uint64)
    grey = (128 + np.cumsum(rng.integers(-2, 3, n))).astype(np.uint8).astype(np.uint64)
    words = depth << 32 | np.uint64(255 << 24) | grey * np.uint64(0x10101)
    words[np.repeat(rng.random(n // 16 + 1) < 0.5, 16)[:n]] = FRAMEBUFFER_EMPTY
    return words


def sample(kind: Kind, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    match kind:
        case Kind.VISIBILITY:
            return np.packbits(np.repeat(rng.random(40) < 0.5, rng.integers(1, 200, 40)))
        case Kind.RENDER_POINTS:
            return render_points(rng, 60).view(np.uint8)
        case _:
            return encode_runs(picture(rng, 500))


def varints(*numbers: int) -> bytes:
    return write_varints(np.array(numbers)).tobytes()


# --- round trips -----------------------------------------------------------------------------------------------------


@settings(max_examples=200, derandomize=True, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.integers(1, 90)), max_size=30))
def test_bits_survive_in_whatever_runs(runs):
    again(Kind.VISIBILITY, np.packbits(np.array([bit for bit, n in runs for _ in range(n)], bool), bitorder="little"))


@settings(max_examples=200, derandomize=True, deadline=None)
@given(st.binary(max_size=60))
def test_any_bytes_survive_as_bits(payload):
    again(Kind.VISIBILITY, np.frombuffer(payload, np.uint8))


entry = st.tuples(st.integers(0, 2**64 - 1) | st.integers(0, 300), st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))


@settings(max_examples=200, derandomize=True, deadline=None)
@given(st.lists(entry, max_size=30), st.booleans())
def test_any_entries_survive(entries, zstd):
    again(Kind.RENDER_POINTS, np.array(entries, RENDER_POINT), zstd=zstd and has_zstd())


word = st.just(int(FRAMEBUFFER_EMPTY)) | st.integers(0, 2**64 - 1) | st.integers(2**40, 2**40 + 9)


@needs_zstd
@settings(max_examples=200, derandomize=True, deadline=None)
@given(st.lists(word, max_size=40), st.integers(1, 9))
def test_any_words_survive(words, times):
    again(Kind.FRAMEBUFFER, encode_runs(np.repeat(np.array(words, np.uint64), times)))


@settings(max_examples=200, derandomize=True, deadline=None)
@given(st.sampled_from(list(Kind)), st.binary(max_size=200))
def test_any_payload_survives_or_is_sent_as_it_is(kind, payload):
    again(kind, np.frombuffer(payload, np.uint8), zstd=has_zstd())


# --- the kernels beside NumPy ----------------------------------------------------------------------------------------


@settings(max_examples=100, derandomize=True, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.integers(1, 300)), min_size=2, max_size=20))
def test_runs_of_bits_are_those_that_numpy_finds(runs):
    bits = np.packbits(np.array([bit for bit, n in runs for _ in range(n)], bool), bitorder="little")
    flat = np.unpackbits(bits, bitorder="little")
    edges = np.flatnonzero(np.diff(flat, prepend=1 - flat[0], append=1 - flat[-1]))
    expected = b"R" + bytes(flat[:1]) + varints(len(bits), *np.diff(edges))
    coded = pack(Kind.VISIBILITY, bits.data)
    assert coded is None or coded.tobytes() == expected
    assert unpack(Kind.VISIBILITY, expected, len(bits)).tobytes() == bits.tobytes()


@settings(max_examples=100, derandomize=True, deadline=None)
@given(st.lists(word, min_size=1, max_size=40))
def test_planes_are_the_differences_that_numpy_finds(words):
    words = np.array(words, np.uint64)
    depth = np.diff((words >> np.uint64(32)).astype(np.uint32), prepend=np.uint32(0))
    depth = depth << 1 ^ (depth.view(np.int32) >> 31).view(np.uint32)
    red, green, blue, last = (words.astype("<u8").view(np.uint8).reshape(-1, 8)[:, i] for i in range(4))
    colour = [np.diff(column, prepend=np.uint8(0)) for column in (green, red - green, blue - green, last)]
    expected = np.concatenate([depth.astype("<u4").view(np.uint8).reshape(-1, 4).T.ravel(), *colour])
    planes = np.empty(8 * len(words), np.uint8)
    message_codecs._write_planes(words, planes)
    assert np.array_equal(planes, expected)
    again = np.empty_like(words)
    message_codecs._read_planes(expected, again)
    assert np.array_equal(again, words)


# --- sizes -----------------------------------------------------------------------------------------------------------


@needs_zstd
def test_render_points_take_under_four_bytes_an_entry_with_zstd():
    rng = np.random.default_rng(1)
    entries = render_points(rng, 3000)
    sizes = {}
    for zstd in (False, True):
        coded = again(Kind.RENDER_POINTS, entries, zstd=zstd)
        assert coded is not None
        sizes[form_of(coded.data)] = len(coded) / 3000
    assert sizes["varints"] < 5.2
    assert sizes["varints, zstd"] < 4


@needs_zstd
def test_a_framebuffer_takes_about_half():
    coded = again(Kind.FRAMEBUFFER, encode_runs(picture(np.random.default_rng(1), 100_000)))
    assert coded is not None
    assert len(coded) < 0.45 * len(encode_runs(picture(np.random.default_rng(1), 100_000)))
    assert pack(Kind.FRAMEBUFFER, encode_runs(picture(np.random.default_rng(1), 100_000)).data, zstd=False) is None


def test_bits_that_are_all_the_same_take_a_few_bytes_and_noise_is_left_alone():
    for value in (0, 255):
        coded = again(Kind.VISIBILITY, np.full(100_000, value, np.uint8))
        assert coded is not None
        assert len(coded) < 10
    assert pack(Kind.VISIBILITY, np.random.default_rng(1).bytes(1000)) is None


def test_kinds_without_a_form_and_empty_payloads_are_left_alone():
    for kind in Kind:
        assert pack(kind, b"") is None
        if kind not in CODED_KINDS:
            assert pack(kind, bytes(1000)) is None
            with pytest.raises(MessageError, match=f"{kind.name} message: found a coded one"):
                unpack(kind, b"R", 1000)


def test_the_header_says_whether_a_payload_is_coded():
    for coded in (False, True):
        head = header(Kind.FRAMEBUFFER, 7, 9, coded=coded)
        assert parse_header(head) == (Kind.FRAMEBUFFER, 7, 9)
        assert is_coded(head) == coded


# --- damage ----------------------------------------------------------------------------------------------------------


@needs_zstd
@pytest.mark.parametrize("kind", sorted(CODED_KINDS))
@pytest.mark.parametrize("zstd", [False, True])
def test_damaged_payloads_are_refused_or_give_one_of_its_size(kind, zstd):
    """24 000 of each form: bytes changed, cut, put in; bytes of no sense behind each form's first byte."""
    rng = np.random.default_rng(int(kind))
    refused = 0
    for i in range(24):
        payload = sample(kind, i)
        coded = pack(kind, payload.data, zstd=zstd)
        if coded is None:
            assert kind is Kind.FRAMEBUFFER
            return
        for _ in range(1000):
            bad = coded.copy()
            for at in rng.integers(0, len(bad), rng.integers(1, 4)):
                bad[at] = rng.integers(0, 256)
            match rng.integers(0, 4):
                case 0:
                    bad = bad[: rng.integers(0, len(bad))]
                case 1:
                    bad = np.concatenate([bad, bad[: rng.integers(0, 9)]])
                case 2:
                    bad = np.concatenate([bad[:1], rng.integers(0, 256, rng.integers(0, 40), np.uint8)])
            try:
                assert len(unpack(kind, bad.data, len(payload))) <= len(payload)
            except MessageError:
                refused += 1
    assert refused > 5000


def framed(data: bytes, **how) -> bytes:
    from zstandard import ZstdCompressor

    return ZstdCompressor(**how).compress(data)


HUGE = 1 << 50


@needs_zstd
@pytest.mark.parametrize(
    ("kind", "coded", "expected"),
    [
        (Kind.VISIBILITY, lambda: b"R\x01" + varints(HUGE, HUGE), "found 1125899906842624 bytes decoded"),
        (Kind.VISIBILITY, lambda: b"R\x02" + varints(1, 8), "no runs of bits"),
        (Kind.VISIBILITY, lambda: b"R\x01" + varints(1, 7), "do not end with 1 bytes"),
        (Kind.VISIBILITY, lambda: b"R\x01" + varints(1, 9), "do not end with 1 bytes"),
        (Kind.VISIBILITY, lambda: b"R\x01" + varints(1, 0, 8), "do not end with 1 bytes"),
        (Kind.VISIBILITY, lambda: b"R\x01" + varints(1, 8, 1), "do not end with 1 bytes"),
        (Kind.VISIBILITY, lambda: b"R\x01" + varints(1) + b"\x88\x00", "do not end with 1 bytes"),
        (Kind.RENDER_POINTS, lambda: b"", "found form b''"),
        (Kind.RENDER_POINTS, lambda: b"V" + varints(HUGE), "bytes decoded, expected at most"),
        (Kind.RENDER_POINTS, lambda: b"V" + varints(9, 1, 1, 1), "expected 9 numbers"),
        (Kind.RENDER_POINTS, lambda: b"V" + varints(1, 2, 1, 1, 0), "1 bytes behind 1 entries"),
        (Kind.RENDER_POINTS, lambda: b"V" + varints(1, 1, 1, 1), "beyond what an entry holds"),
        (Kind.RENDER_POINTS, lambda: b"V" + varints(1, 2, 1 << 32, 1), "beyond what an entry holds"),
        (Kind.RENDER_POINTS, lambda: b"V" + varints(1, 2, 1, 1 << 32), "beyond what an entry holds"),
        (Kind.RENDER_POINTS, lambda: b"V" + varints(1, (1 << 63) - 2, 1, 1), "beyond what an entry holds"),
        (Kind.RENDER_POINTS, lambda: b"Z" + varints(HUGE) + framed(bytes(9)), "bytes decoded, expected at most"),
        (Kind.RENDER_POINTS, lambda: b"Z" + varints(8) + framed(bytes(9)), "a frame of 9 bytes, expected 8"),
        (Kind.RENDER_POINTS, lambda: b"Z" + varints(9) + framed(bytes(9)) + b"x", "damaged frame"),
        (Kind.RENDER_POINTS, lambda: b"Z" + varints(9) + framed(bytes(9), write_content_size=False), "a frame of"),
        (Kind.FRAMEBUFFER, lambda: b"W" + varints(HUGE, 0, 0), "1125899906842624 runs"),
        (Kind.FRAMEBUFFER, lambda: b"W" + varints(0, 1 << 31, 0), "bytes decoded, expected at most"),
        (Kind.FRAMEBUFFER, lambda: b"W" + varints(1, 1, 9) + framed(bytes(9)), "9 bytes for 1 runs and 1 words"),
        (Kind.FRAMEBUFFER, lambda: b"W" + varints(1, 1, 12) + framed(bytes(12)), "2 bytes behind 1 runs"),
        (
            Kind.FRAMEBUFFER,
            lambda: b"W" + varints(1, 1, 18) + framed(bytes(8) + varints(1 << 32, 1 << 31)),
            "beyond what a run holds",
        ),
        (
            Kind.FRAMEBUFFER,
            lambda: b"W" + varints(1, 1, 18) + framed(bytes(8) + varints(2**32 - 1, 2**32 - 1)),
            "beyond what a run holds",
        ),
    ],
)
def test_what_lies_is_refused_before_it_is_believed(kind, coded, expected):
    with pytest.raises(MessageError, match=expected):
        unpack(kind, coded(), most_bytes(100))


def test_a_rank_without_zstandard_says_what_it_needs(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(MessageError, match=r"zstandard is missing; install splatpipe\[mpi\]"):
        unpack(Kind.RENDER_POINTS, b"Z" + varints(9) + b"x", 1000)
