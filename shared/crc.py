"""Checksums of bytes that several processes wrote: CRC-32 of a whole from those of its parts."""

from __future__ import annotations

_POLYNOMIAL = 0xEDB88320
"""Of CRC-32 as in zlib, bits reversed: bit 31 is the coefficient of x⁰."""
_ONE = 1 << 31


def crc32_combine(first: int, second: int, n_bytes: int) -> int:
    """``zlib.crc32(a + b)`` from ``zlib.crc32(a)``, ``zlib.crc32(b)`` and the length of b, ≥ 0.

    To append n zero bits multiplies a remainder by xⁿ. Cost: O(log n_bytes).
    Source: M. Adler, zlib 1.2.12, ``crc32_combine``.
    """
    return _multiply(_power(8 * n_bytes), first) ^ second


def _multiply(a: int, b: int) -> int:
    """Product modulo the polynomial."""
    product = 0
    for bit in range(31, -1, -1):
        if a >> bit & 1:
            product ^= b
        b = b >> 1 ^ (_POLYNOMIAL if b & 1 else 0)
    return product


def _power(n: int) -> int:
    """The power xⁿ modulo the polynomial, by squaring."""
    result, square = _ONE, _ONE >> 1
    while n:
        if n & 1:
            result = _multiply(square, result)
        square = _multiply(square, square)
        n >>= 1
    return result
