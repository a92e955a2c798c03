"""Words, shades and background → the colours of a picture, 8 or 16 bits a channel.

Several drawn pixels become one by averaging *light*: stored values are decoded to linear light (sRGB), weighted by
their alpha, averaged, and encoded again. Averages of stored values would darken every edge and make fine textures
change their tone with the distance. Alpha is averaged as it is, and colours are stored unmultiplied, as PNG wants
them. Shades (``edl``) multiply stored values before that, as in Potree and CloudCompare.

Source: IEC 61966-2-1 (sRGB); Porter, Duff 1984 (weights).
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit

from ...shared.messages import FRAMEBUFFER_EMPTY
from .rows import Rows

_EMPTY = np.uint64(FRAMEBUFFER_EMPTY)
_BYTE = np.uint64(0xFF)
_DECODE_STEPS = 16  # a stored step of 255: an interpolated table is off by 1e-8
_ENCODE_STEPS = 1 << 16  # of linear light: off by 1e-7, 0.005 steps of 16 bits


def colours(
    words: np.ndarray, shades: np.ndarray | None, background: np.ndarray, supersampling: int, bits: int, rows: Rows
) -> np.ndarray:
    """(h, w, 4) uint8 or uint16 RGBA, alpha not multiplied in, of (h · s, w · s) uint64 words, s = ``supersampling``.

    shades : (h · s, w · s) float32 factors on the colours of points, or None.
    background : (4,) uint8 RGBA.  bits : 8 or 16.
    Cost: about 10 ns a drawn pixel and thread.
    """
    height, width = (side // supersampling for side in words.shape)
    out = np.empty((height, width, 4), np.uint8 if bits == 8 else np.uint16)
    if shades is None:
        shades = np.empty((0, 0), np.float32)
    rows.run(height, _colour_rows, words, shades, background, supersampling, *_tables(), 2.0**bits - 1, out)
    return out


def to_linear(stored: np.ndarray) -> np.ndarray:
    """Linear light of stored sRGB values, both in [0, 1]."""
    return np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)


def to_stored(linear: np.ndarray) -> np.ndarray:
    """Stored sRGB values of linear light, both in [0, 1]."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


@cache
def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Decoding by 16ths of 255, encoding by 65 536ths of 1; one entry more, for interpolation at the end."""
    decode = to_linear(np.arange(255 * _DECODE_STEPS + 2) / (255 * _DECODE_STEPS))
    encode = to_stored(np.arange(_ENCODE_STEPS + 2) / _ENCODE_STEPS)
    return decode, encode


@njit(nogil=True, cache=True)
def _colour_rows(words, shades, background, s, decode, encode, top, out, first, end):
    """Fill rows of ``out``; ``top`` is its largest value. Sums are of light for s > 1, else of stored values."""
    behind = np.empty(3)
    behind_alpha = background[3] / 255.0
    for k in range(3):
        stored = np.float64(background[k])
        behind[k] = behind_alpha * (stored if s == 1 else _at(decode, stored * _DECODE_STEPS))
    for row in range(first, end):
        for column in range(out.shape[1]):
            red = green = blue = total = 0.0
            for y in range(row * s, row * s + s):
                for x in range(column * s, column * s + s):
                    word = words[y, x]
                    if word == _EMPTY:
                        red, green, blue = red + behind[0], green + behind[1], blue + behind[2]
                        total += behind_alpha
                        continue
                    shade = np.float64(shades[y, x]) if shades.size else 1.0
                    alpha = (word >> np.uint64(24) & _BYTE) * (1.0 / 255.0)
                    r = (word & _BYTE) * shade
                    g = (word >> np.uint64(8) & _BYTE) * shade
                    b = (word >> np.uint64(16) & _BYTE) * shade
                    if s > 1:
                        r = _at(decode, r * _DECODE_STEPS)
                        g = _at(decode, g * _DECODE_STEPS)
                        b = _at(decode, b * _DECODE_STEPS)
                    red, green, blue, total = red + alpha * r, green + alpha * g, blue + alpha * b, total + alpha
            scale = 1.0 / total if total > 0.0 else 0.0
            for k, mean in enumerate((red * scale, green * scale, blue * scale)):
                stored = mean * (1.0 / 255.0) if s == 1 else _at(encode, mean * _ENCODE_STEPS)
                out[row, column, k] = np.int64(stored * top + 0.5)
            out[row, column, 3] = np.int64(total / (s * s) * top + 0.5)


@njit(nogil=True, cache=True, inline="always")
def _at(table, place):
    """Value between two entries of a table."""
    i = np.int64(place)
    return table[i] + (table[i + 1] - table[i]) * (place - i)
