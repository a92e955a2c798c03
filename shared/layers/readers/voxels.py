"""Point clouds → block worlds: a block wherever points are."""

from __future__ import annotations

import math

import numpy as np

from ...codecs.palette import to_palette
from ...colour import CLASS_COLOURS, OTHER_CLASS
from ...errors import InputError
from ...points import pack_rgb, unpack_rgb
from ...readers.source import Source
from ..blocks import MOST_CELLS, OBJECT
from ..layer import Layer, simple_layer

COLOUR_BY = ("rgb", "classification", "height")
_BATCH = 1 << 20
_HEIGHTS = 64


def voxelised(source: Source, name: str, block_size: float, colour_by: str = "auto") -> Layer:
    """A block of ``block_size`` world units around each place of a grid that holds a point.

    colour_by : ``rgb`` (the mean of a block's points, at most 256 colours), ``classification`` (the most frequent one)
    or ``height``; ``auto``: rgb where there is any, else classification, else height. Blocks with neighbours on all six
    sides are left out: nothing of them can be seen.
    Raises InputError for a size that is not a number > 0, or so small that a coordinate exceeds ``MOST_CELLS``.
    Cost: O(n log n); memory 40 bytes a block, and a batch of points.
    """
    if not (block_size > 0 and math.isfinite(block_size)):
        raise InputError(f"block size: found {block_size}, expected a number > 0")
    if colour_by == "auto":
        has = source.info.attributes
        colour_by = next((how for how in ("rgb", "classification") if how in has), "height")
    if colour_by != "height" and colour_by not in source.info.attributes:
        raise InputError(f"{source.info.path}: found no {colour_by}, expected it to colour blocks by")
    wanted = () if colour_by == "height" else (colour_by,)
    origin, cells, sums = None, np.empty((0, 4), np.int64), np.empty((0, 4))
    for batch in source.batches(_BATCH, wanted):
        finite = np.isfinite(batch.positions).all(axis=1)
        positions = batch.positions[finite]
        if not len(positions):
            continue
        if origin is None:
            origin = np.floor(positions[0] / block_size) * block_size
        place = np.rint((positions - origin) / block_size)
        if np.abs(place).max() > MOST_CELLS:
            raise InputError(f"block size: found {block_size:g}: {np.abs(place).max():.3g} blocks from the first point")
        more, weights = np.zeros((len(place), 4), np.int64), np.ones((len(place), 4))
        more[:, :3] = place
        if colour_by == "classification":
            more[:, 3] = batch.attributes[colour_by][finite]
        elif colour_by == "rgb":
            weights[:, 1:] = unpack_rgb(batch.attributes[colour_by][finite])[:, :3]
        cells, sums = _joined(cells, sums, more, weights)
    if origin is None:
        raise InputError(f"{source.info.path}: found no finite point, expected at least one")
    cells, sums = _most_frequent(cells, sums)
    seen = ~_enclosed(cells[:, :3])
    cells, sums = cells[seen], sums[seen]
    types, colours = _types(colour_by, cells, sums)
    objects = np.empty(len(cells), OBJECT)
    objects["cell"], objects["type"] = cells[:, :3], types
    return simple_layer(name, "blocks", origin, objects, block_size=float(block_size), colours=colours)


def _joined(
    cells: np.ndarray, sums: np.ndarray, more: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows of places and classes, with the sums of their weights: points, and channels of their colours."""
    every = np.concatenate([cells, more])
    distinct, index = np.unique(every, axis=0, return_inverse=True)
    total = np.zeros((len(distinct), weights.shape[1]))
    if len(cells):
        total[index[: len(cells)]] = sums
    np.add.at(total, index[len(cells) :].ravel(), weights)
    return distinct, total


def _most_frequent(cells: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the rows that are one place, the one with most points."""
    order = np.lexsort((sums[:, 0], *cells[:, 2::-1].T))
    place = cells[order, :3]
    last = np.append((place[1:] != place[:-1]).any(axis=1), True)
    return cells[order[last]], sums[order[last]]


def _enclosed(cells: np.ndarray) -> np.ndarray:
    """(n,) bool: whether all six neighbours are there, of distinct (n, 3) cells."""
    lower = cells.min(axis=0) - 1
    extent = cells.max(axis=0) - lower + 2
    keys = _keys(cells - lower, extent)
    inside = np.ones(len(cells), bool)
    for step in np.vstack([np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)]):
        inside &= np.isin(_keys(cells - lower + step, extent), keys)
    return inside


def _keys(cells: np.ndarray, extent: np.ndarray) -> np.ndarray:
    return (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]


def _types(colour_by: str, cells: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """((n,) type of each block, colours of the types)."""
    if colour_by == "rgb":
        mean = np.rint(sums[:, 1:] / sums[:, :1]).astype(np.uint8)
        palette, types = to_palette(pack_rgb(*mean.T))
        return types, [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in unpack_rgb(palette)[:, :3].tolist()]
    if colour_by == "classification":
        codes, types = np.unique(cells[:, 3], return_inverse=True)
        return types, [CLASS_COLOURS.get(int(code), OTHER_CLASS) for code in codes]
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    z = cells[:, 2] - cells[:, 2].min()
    types = z * (_HEIGHTS - 1) // max(int(z.max()), 1)
    return types, [to_hex(c) for c in colormaps["viridis"](np.linspace(0, 1, _HEIGHTS))]
