"""A cell's colours as a byte a point, into a palette of the cell's own.

A column of colour words costs four bytes a point: more than positions in pools, whose gain it would eat up. The colours
of a cell are few or alike, so a byte holds them: exactly where there are at most 256, else by median cut.
"""

from __future__ import annotations

import numpy as np

from ..points import pack_rgb, unpack_rgb

MOST_COLOURS = 256


def to_palette(words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(k ≤ 256,) uint32 palette and (n,) uint8 index into it, of (n,) uint32 colour words.

    Exact for at most 256 different words; otherwise what is alike becomes one colour, opaque. Cost: O(n log n).
    """
    different, index = np.unique(words, return_inverse=True)
    if len(different) <= MOST_COLOURS:
        return different, index.astype(np.uint8)
    from PIL import Image

    rgb = np.ascontiguousarray(unpack_rgb(np.ascontiguousarray(words))[:, :3])
    image = Image.fromarray(rgb[None]).quantize(MOST_COLOURS, Image.Quantize.MEDIANCUT, kmeans=1)
    colours = np.array(image.getpalette() or [], np.uint8).reshape(-1, 3)
    return pack_rgb(*colours.T), np.asarray(image)[0]
