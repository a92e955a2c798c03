"""Messages in fewer bytes: the payload of a message to a coded one and back, the same to the bit.

A coded payload is only ever made where it is smaller. Its first byte tells the form, the header that it is coded
(``messages.CODED``). What comes out of ``unpack`` is the payload as ``messages.encode`` made it, so it is checked by
the same decoders, whatever way it came.

======  ===============  =========================================================================================
form    of               after the first byte
======  ===============  =========================================================================================
``R``   VisibilityBits   value of the first bit; bytes of the payload, then lengths of runs of equal bits, as varints
``V``   RenderPoints     number of entries; from the end of each range to the next offset, of both signs; ranges;
                         strides; column after column, as varints
``Z``   RenderPoints     number of bytes of ``V`` without its first, as varint; those in a Zstandard frame
``W``   Framebuffer      runs and words, as varints; in a Zstandard frame: the words in eight planes of bytes, each the
                         difference to the word before (depth; green; red and blue less green; the last byte), then
                         background before each run and length of each run less one, as varints
======  ===============  =========================================================================================

``Z`` and ``W`` need the package zstandard (splatpipe[mpi]). Of zlib 1, LZ4, Zstandard −5 … 3, isa-l and blosc2 on
framebuffers of scans, Zstandard 1 on these planes took the fewest bytes (3.1 … 4.7 of 8 a pixel) of all that code
more than 300 MB/s.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
from numba import njit

from .codecs.varints import read_varints, write_varints
from .errors import CodecError, MessageError
from .messages import RENDER_POINT, Bytes, Kind

_ZSTD_LEVEL = 1
_ZSTD_SIGNIFICANT = 64  # bytes: less is not worth a frame
_MAX_WINDOW_BYTES = 8 << 20
_MOST_OFFSET = 1 << 61
_RUN_BYTES = _WORD_BYTES = 8
_FRAMEBUFFER_HEAD = np.dtype("<u4")
_MOST_VARINT_BYTES = 9

_FORMS = {b"R": "runs of bits", b"V": "varints", b"Z": "varints, zstd", b"W": "planes, zstd"}


def has_zstd() -> bool:
    """Whether this rank can code, and decode, the forms that need Zstandard. Imports nothing."""
    return find_spec("zstandard") is not None


def form_of(coded: Bytes) -> str:
    """What the form of a coded payload is called in records."""
    return _FORMS[bytes(coded[:1])]


def pack(kind: Kind, payload: Bytes, *, zstd: bool = True) -> np.ndarray | None:
    """(m,) uint8: a payload coded, m less than its bytes; None where it would not be smaller or has no coded form.

    zstd : whether the receiver reads the forms that need it.
    Cost: a few passes; see ``splatpipe bench messages``.
    """
    codec = _CODECS.get(kind)
    if codec is None or not len(payload):
        return None
    coded = codec[0](np.frombuffer(payload, np.uint8), zstd)
    return coded if coded is not None and len(coded) < len(payload) else None


def unpack(kind: Kind, coded: Bytes, max_bytes: int) -> np.ndarray:
    """(n,) uint8: the payload that ``pack`` coded, n at most ``max_bytes``.

    Raises MessageError for anything else. No more is allocated than a multiple of ``coded`` and ``max_bytes``.
    """
    codec = _CODECS.get(kind)
    if codec is None:
        raise MessageError(f"{kind.name} message: found a coded one, which it has no form for")
    try:
        return codec[1](np.frombuffer(coded, np.uint8), max_bytes)
    except CodecError as error:
        raise MessageError(f"coded {kind.name} message: {str(error).removeprefix('coded points: ')}") from None


# --- visibility bits -----------------------------------------------------------------------------------------------


def _pack_bits(bits: np.ndarray, _: bool) -> np.ndarray | None:
    out = np.empty(len(bits) + _MOST_VARINT_BYTES, np.uint8)
    n = _write_runs(bits, out[: len(bits)])
    if n < 0:
        return None
    return np.concatenate([_byte(b"R"), bits[:1] & 1, write_varints(np.array([len(bits)])), out[:n]])


@njit(nogil=True, cache=True)
def _write_runs(bits, out):
    """Fill ``out`` with the lengths of runs of equal bits; how many bytes, −1 where they do not fit."""
    at = 0
    value = bits[0] & 1
    run = np.int64(0)
    for byte in bits:
        for k in range(8):
            if k == 0 and byte == (255 if value else 0):
                run += 8
                break
            if (byte >> k) & 1 == value:
                run += 1
                continue
            while run > 127:
                if at >= len(out):
                    return -1
                out[at] = run & 127 | 128
                run >>= 7
                at += 1
            if at >= len(out):
                return -1
            out[at] = run
            at += 1
            value = 1 - value
            run = np.int64(1)
    while run > 127:
        if at >= len(out):
            return -1
        out[at] = run & 127 | 128
        run >>= 7
        at += 1
    if at >= len(out):
        return -1
    out[at] = run
    return at + 1


def _unpack_bits(coded: np.ndarray, max_bytes: int) -> np.ndarray:
    if len(coded) < 2 or coded[0] != ord("R") or coded[1] > 1:
        raise CodecError("found no runs of bits")
    (n_bytes,), at = read_varints(coded, 2, 1)
    _check_size(int(n_bytes), max_bytes)
    bits = np.zeros(n_bytes, np.uint8)
    if not _read_runs(coded, at, coded[1], bits):
        raise CodecError(f"found runs that do not end with {n_bytes} bytes")
    return bits


@njit(nogil=True, cache=True)
def _read_runs(data, at, value, bits):
    """Set the bits of runs in ``bits``, zero before; False unless ``data[at:]`` is runs of just that many bits."""
    n_bits = 8 * len(bits)
    bit = np.int64(0)
    while bit < n_bits:
        run, shift = np.int64(0), 0
        while True:
            if at >= len(data) or shift > 56:
                return False
            byte = np.int64(data[at])
            at += 1
            run |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
        if run < 1 or run > n_bits - bit or (byte == 0 and shift > 7):
            return False
        if value:
            last = bit + run
            while bit < last and bit & 7:
                bits[bit >> 3] |= 1 << (bit & 7)
                bit += 1
            while bit + 8 <= last:
                bits[bit >> 3] = 255
                bit += 8
            while bit < last:
                bits[bit >> 3] |= 1 << (bit & 7)
                bit += 1
        else:
            bit += run
        value = 1 - value
    return at == len(data)


# --- render-points -------------------------------------------------------------------------------------------------


def _pack_render_points(payload: np.ndarray, zstd: bool) -> np.ndarray | None:
    if len(payload) % RENDER_POINT.itemsize:
        return None
    entries = payload.view(RENDER_POINT)
    if entries["offset"].max() >= _MOST_OFFSET:
        return None
    length = entries["range"].astype(np.int64)
    gap = np.diff(entries["offset"].astype(np.int64), prepend=0)
    gap[1:] -= length[:-1]
    columns = (gap << 1) ^ (gap >> 63), length, entries["stride"]  # of both signs: small where near zero
    varints = np.concatenate([write_varints(v) for v in (np.array([len(entries)]), *columns)])
    if zstd and len(varints) > _ZSTD_SIGNIFICANT:
        frame = _compressor().compress(varints.data)
        coded = np.concatenate([_byte(b"Z"), write_varints(np.array([len(varints)])), np.frombuffer(frame, np.uint8)])
        if len(coded) <= len(varints):
            return coded
    return np.concatenate([_byte(b"V"), varints])


def _unpack_render_points(coded: np.ndarray, max_bytes: int) -> np.ndarray:
    form, at = coded[:1].tobytes(), 1
    if form == b"Z":
        (n_bytes,), at = read_varints(coded, 1, 1)
        _check_size(int(n_bytes), 2 * max_bytes + _MOST_VARINT_BYTES)
        coded, at = _decompressed(coded[at:], int(n_bytes)), 0
    elif form != b"V":
        raise CodecError(f"found form {form!r}, expected b'V' or b'Z'")
    (n_entries,), at = read_varints(coded, at, 1)
    _check_size(int(n_entries) * RENDER_POINT.itemsize, max_bytes)
    signed, at = read_varints(coded, at, int(n_entries))
    length, at = read_varints(coded, at, int(n_entries))
    stride, at = read_varints(coded, at, int(n_entries))
    if at != len(coded):
        raise CodecError(f"found {len(coded) - at} bytes behind {n_entries} entries")
    entries = np.empty(n_entries, RENDER_POINT)
    if n_entries and not _take_entries(signed, length, stride, entries["offset"], entries["range"], entries["stride"]):
        raise CodecError("found an entry beyond what an entry holds")
    return entries.view(np.uint8)


@njit(nogil=True, cache=True)
def _take_entries(signed, lengths, strides, offset, length, stride):
    """Fill the columns of entries; False where a number does not fit its column."""
    last = np.int64(0)
    for i in range(len(signed)):
        last += (signed[i] >> 1) ^ -(signed[i] & 1)
        if last < 0 or last >= _MOST_OFFSET or lengths[i] > 0xFFFFFFFF or strides[i] > 0xFFFFFFFF:
            return False
        offset[i], length[i], stride[i] = last, lengths[i], strides[i]
        last += lengths[i]
    return True


# --- framebuffers --------------------------------------------------------------------------------------------------


def _pack_framebuffer(payload: np.ndarray, zstd: bool) -> np.ndarray | None:
    if not zstd or len(payload) < _ZSTD_SIGNIFICANT:
        return None
    n_runs, n_words = payload[:8].view(_FRAMEBUFFER_HEAD).tolist()
    begin = 8 + _RUN_BYTES * n_runs
    if len(payload) != begin + _WORD_BYTES * n_words:
        return None
    first, count = payload[8:begin].view(_FRAMEBUFFER_HEAD).reshape(-1, 2).T.astype(np.int64)
    between = np.diff(first, prepend=0)
    between[1:] -= count[:-1]
    if (count < 1).any() or (between < 0).any():
        return None
    numbers = write_varints(np.concatenate([between, count - 1]))
    body = np.empty(_WORD_BYTES * n_words + len(numbers), np.uint8)
    _write_planes(payload[begin:].view("<u8"), body)
    body[_WORD_BYTES * n_words :] = numbers
    frame = np.frombuffer(_compressor().compress(body.data), np.uint8)
    head = write_varints(np.array([n_runs, n_words, len(body)]))
    return np.concatenate([_byte(b"W"), head, frame])


def _unpack_framebuffer(coded: np.ndarray, max_bytes: int) -> np.ndarray:
    if coded[:1].tobytes() != b"W":
        raise CodecError(f"found form {coded[:1].tobytes()!r}, expected b'W'")
    head, at = read_varints(coded, 1, 3)
    n_runs, n_words, n_body = head.tolist()
    if max(n_runs, n_words) > 0xFFFFFFFF:
        raise CodecError(f"found {n_runs} runs and {n_words} words")
    begin = 8 + _RUN_BYTES * n_runs
    n_bytes = begin + _WORD_BYTES * n_words
    _check_size(n_bytes, max_bytes)
    if not 2 * n_runs <= n_body - _WORD_BYTES * n_words <= 2 * 5 * n_runs:
        raise CodecError(f"found {n_body} bytes for {n_runs} runs and {n_words} words")
    body = _decompressed(coded[at:], n_body)
    numbers, stop = read_varints(body, _WORD_BYTES * n_words, 2 * n_runs)
    if stop != len(body):
        raise CodecError(f"found {len(body) - stop} bytes behind {n_runs} runs")
    if numbers.max(initial=0) > 0xFFFFFFFF:
        raise CodecError("found a run beyond what a run holds")
    count = numbers[n_runs:] + 1
    end = np.cumsum(numbers[:n_runs] + count)
    if n_runs and end[-1] > 1 << 32:
        raise CodecError("found a run beyond what a run holds")
    payload = np.empty(n_bytes, np.uint8)
    payload[:8].view(_FRAMEBUFFER_HEAD)[:] = n_runs, n_words
    runs = payload[8:begin].view(_FRAMEBUFFER_HEAD).reshape(-1, 2)
    runs[:, 0], runs[:, 1] = end - count, count
    _read_planes(body, payload[begin:].view("<u8"))
    return payload


@njit(nogil=True, cache=True)
def _write_planes(words, out):
    """Fill eight planes of n bytes with what lies between (n,) words and the one before each."""
    n = len(words)
    depth = np.uint32(0)
    red, green, blue, alpha = np.uint8(0), np.uint8(0), np.uint8(0), np.uint8(0)
    for i in range(n):
        word = words[i]
        deeper = np.uint32(np.uint32(word >> np.uint64(32)) - depth)
        depth = np.uint32(word >> np.uint64(32))
        signed = np.uint32(np.uint32(deeper << np.uint32(1)) ^ np.uint32(np.int32(deeper) >> np.int32(31)))
        out[i] = np.uint8(signed)
        out[n + i] = np.uint8(signed >> np.uint32(8))
        out[2 * n + i] = np.uint8(signed >> np.uint32(16))
        out[3 * n + i] = np.uint8(signed >> np.uint32(24))
        g = np.uint8(word >> np.uint64(8))
        r, b = np.uint8(np.uint8(word) - g), np.uint8(np.uint8(word >> np.uint64(16)) - g)
        a = np.uint8(word >> np.uint64(24))
        out[4 * n + i], out[5 * n + i] = np.uint8(g - green), np.uint8(r - red)
        out[6 * n + i], out[7 * n + i] = np.uint8(b - blue), np.uint8(a - alpha)
        red, green, blue, alpha = r, g, b, a


@njit(nogil=True, cache=True)
def _read_planes(data, words):
    """Fill (n,) words from the eight planes of ``_write_planes``."""
    n = len(words)
    depth = np.uint32(0)
    red, green, blue, alpha = np.uint8(0), np.uint8(0), np.uint8(0), np.uint8(0)
    for i in range(n):
        signed = np.uint32(data[i]) | np.uint32(data[n + i]) << np.uint32(8)
        signed |= np.uint32(data[2 * n + i]) << np.uint32(16) | np.uint32(data[3 * n + i]) << np.uint32(24)
        signed = np.uint32(signed)
        depth = np.uint32(depth + np.uint32((signed >> np.uint32(1)) ^ np.uint32(-np.int32(signed & np.uint32(1)))))
        green, red = np.uint8(green + data[4 * n + i]), np.uint8(red + data[5 * n + i])
        blue, alpha = np.uint8(blue + data[6 * n + i]), np.uint8(alpha + data[7 * n + i])
        colour = np.uint64(np.uint8(red + green)) | np.uint64(green) << np.uint64(8)
        colour |= np.uint64(np.uint8(blue + green)) << np.uint64(16) | np.uint64(alpha) << np.uint64(24)
        words[i] = np.uint64(depth) << np.uint64(32) | colour


# --- shared --------------------------------------------------------------------------------------------------------


def _byte(form: bytes) -> np.ndarray:
    return np.frombuffer(form, np.uint8)


def _check_size(n_bytes: int, max_bytes: int) -> None:
    if n_bytes > max_bytes:
        raise CodecError(f"found {n_bytes} bytes decoded, expected at most {max_bytes}")


def _compressor() -> Any:
    from zstandard import ZstdCompressor

    return ZstdCompressor(level=_ZSTD_LEVEL)


def _decompressed(frame: np.ndarray, n_bytes: int) -> np.ndarray:
    """(n_bytes,) uint8 of one Zstandard frame that says it holds just that many. Raises CodecError, MessageError."""
    try:
        from zstandard import ZstdDecompressor, ZstdError, frame_content_size
    except ImportError:
        raise MessageError("coded message: zstandard is missing; install splatpipe[mpi]") from None
    try:
        found = frame_content_size(frame.data)
        if found != n_bytes:
            raise CodecError(f"found a frame of {found} bytes, expected {n_bytes}")
        data = ZstdDecompressor(max_window_size=_MAX_WINDOW_BYTES).decompress(
            frame.data, max_output_size=n_bytes, allow_extra_data=False
        )
    except ZstdError as error:
        raise CodecError(f"found a damaged frame: {error}") from None
    if len(data) != n_bytes:
        raise CodecError(f"found {len(data)} bytes in a frame, expected {n_bytes}")
    return np.frombuffer(data, np.uint8)


_CODECS: dict[Kind, tuple[Callable[[np.ndarray, bool], np.ndarray | None], Callable[[np.ndarray, int], np.ndarray]]] = {
    Kind.VISIBILITY: (_pack_bits, _unpack_bits),
    Kind.RENDER_POINTS: (_pack_render_points, _unpack_render_points),
    Kind.FRAMEBUFFER: (_pack_framebuffer, _unpack_framebuffer),
}
CODED_KINDS = frozenset(_CODECS)
"""Kinds that have a coded form."""
