"""Hierarchies with a size at each node, and their two layouts: squarified treemap and sunburst."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..errors import InputError
from . import arcs, cuboids
from .layer import Layer, simple_layer

MOST_NODES = 2_000_000
SIDE = 100.0
"""Of the root's square in a treemap, and the diameter of a sunburst, world units."""

_MARGIN = 0.02
_GAP = 0.15  # between neighbours, so that their sides do not coincide
_STEP = 1.0
_TALLEST = 20.0


@dataclass(frozen=True)
class Hierarchy:
    """A tree, parents before children, the root first.

    parent : (n,) int64, −1 for the root.  size : (n,) float64, of a node with all below it, ≥ 0.
    value : (n,) float64, what is coloured and gives the height of leaves.  depth : (n,) int64.
    """

    name: str
    parent: np.ndarray
    size: np.ndarray
    value: np.ndarray
    depth: np.ndarray

    @property
    def is_leaf(self) -> np.ndarray:
        """(n,) bool."""
        leaf = np.ones(len(self.parent), bool)
        leaf[self.parent[1:]] = False
        return leaf

    def children(self) -> list[np.ndarray]:
        """Children of each node, largest first; those of size 0 are left out."""
        order = np.lexsort((-self.size, self.parent))
        order = order[(self.parent[order] >= 0) & (self.size[order] > 0)]
        starts = np.searchsorted(self.parent[order], np.arange(len(self.parent) + 1))
        return [order[a:b] for a, b in pairwise(starts)]


def from_paths(name: str, sizes: Mapping[str, float], values: Mapping[str, float] | None = None) -> Hierarchy:
    """The tree of paths with "/" between their parts; a path above others has what they sum up to, and its own.

    values : of the paths; by default the logarithm of their size.
    Raises InputError for none, a size that is not a finite number ≥ 0, a sum of 0, or too many.
    """
    parts = {tuple(part for part in path.split("/") if part): path for path in sizes}
    nodes: dict[tuple[str, ...], int] = {(): 0}
    for keys in sorted(parts, key=len):
        for k in range(1, len(keys) + 1):
            nodes.setdefault(keys[:k], len(nodes))
        if len(nodes) > MOST_NODES:
            raise InputError(f"hierarchy {name}: found more than {MOST_NODES} nodes")
    keys = sorted(nodes, key=lambda key: (len(key), key))
    index = {key: i for i, key in enumerate(keys)}
    parent = np.array([-1] + [index[key[:-1]] for key in keys[1:]], np.int64)
    size, value = np.zeros(len(keys)), np.full(len(keys), np.nan)
    for key, path in parts.items():
        number = float(sizes[path])
        if not (number >= 0 and math.isfinite(number)):
            raise InputError(f"hierarchy {name}: size of {path}: found {number}, expected a finite number ≥ 0")
        size[index[key]] += number
        value[index[key]] = math.log10(1 + number) if values is None else float(values[path])
    for i in range(len(keys) - 1, 0, -1):
        size[parent[i]] += size[i]
    if not size[0] > 0:
        raise InputError(f"hierarchy {name}: found a size of 0 in all, expected more")
    bad = np.isinf(value)
    if bad.any():
        raise InputError(f"hierarchy {name}: value of {'/'.join(keys[int(bad.argmax())])}: expected a finite number")
    depth = np.array([len(key) for key in keys])
    return Hierarchy(name, parent, size, _inherited(parent, size, value), depth)


def _inherited(parent: np.ndarray, size: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Values in which nodes without one have the mean of their children, weighted by size."""
    total, weight = np.zeros(len(parent)), np.zeros(len(parent))
    value = value.copy()
    for i in range(len(parent) - 1, -1, -1):
        if np.isnan(value[i]):
            value[i] = total[i] / weight[i] if weight[i] else 0.0
        if i:
            total[parent[i]] += value[i] * size[i]
            weight[parent[i]] += size[i]
    return value


def treemap(tree: Hierarchy) -> Layer:
    """Cuboids: nodes stand on their parent, leaves as high as their value.

    Source: Bruls, Huizing, van Wijk, "Squarified Treemaps" (2000).
    """
    rectangle = np.zeros((len(tree.parent), 4))  # x, y, width, height
    rectangle[0] = 0, 0, SIDE, SIDE
    drawn = np.zeros(len(tree.parent), bool)
    drawn[0] = True
    for node, children in enumerate(tree.children()):
        if drawn[node] and len(children):
            x, y, width, height = rectangle[node]
            margin = _MARGIN * min(width, height) if node else 0.0
            inner = x + margin, y + margin, width - 2 * margin, height - 2 * margin
            rectangle[children] = squarified(tree.size[children], *inner)
            drawn[children] = True
    return _cuboids(tree, rectangle, drawn)


def _cuboids(tree: Hierarchy, rectangle: np.ndarray, drawn: np.ndarray) -> Layer:
    heights = np.where(tree.is_leaf, _leaf_heights(tree), _STEP)
    objects = np.empty(int(drawn.sum()), cuboids.OBJECT)
    x, y, width, height = rectangle[drawn].T
    objects["center"] = np.column_stack([x + width / 2, y + height / 2])
    gap = np.minimum(_GAP, 0.1 * np.minimum(width, height))
    objects["extent"] = np.column_stack([width - gap, height - gap])
    base = _STEP * tree.depth[drawn]
    objects["height"] = np.column_stack([base, base + heights[drawn]])
    objects["value"] = tree.value[drawn]
    return simple_layer(tree.name, "cuboids", np.zeros(3), objects)


def _leaf_heights(tree: Hierarchy) -> np.ndarray:
    low, high = tree.value.min(), tree.value.max()
    return _STEP + _TALLEST * (tree.value - low) / (high - low) if high > low else np.full(len(tree.value), _STEP)


def squarified(sizes: np.ndarray, x: float, y: float, width: float, height: float) -> np.ndarray:
    """(n, 4) rectangles x, y, width, height, near squares, that share one out by (n,) sizes > 0, largest first."""
    out = np.empty((len(sizes), 4))
    areas = sizes * (width * height / sizes.sum())
    begin = 0
    while begin < len(areas):
        side = min(width, height)
        end = begin + 1
        row = worst = areas[begin]
        worst = _worst(areas[begin], areas[begin], row, side)
        while end < len(areas):
            longer = row + areas[end]
            next_worst = _worst(areas[begin], areas[end], longer, side)
            if next_worst > worst:
                break
            row, worst, end = longer, next_worst, end + 1
        thickness = row / side if side else 0.0
        along = areas[begin:end] / thickness if thickness else np.zeros(end - begin)
        starts = np.concatenate([[0], np.cumsum(along)[:-1]])
        if width >= height:
            out[begin:end] = np.column_stack(
                [np.full(end - begin, x), y + starts, np.full(end - begin, thickness), along]
            )
            x, width = x + thickness, max(width - thickness, 0.0)
        else:
            out[begin:end] = np.column_stack(
                [x + starts, np.full(end - begin, y), along, np.full(end - begin, thickness)]
            )
            y, height = y + thickness, max(height - thickness, 0.0)
        begin = end
    return out


def _worst(largest: float, smallest: float, row: float, side: float) -> float:
    """Largest aspect ratio of a row of these areas along a side."""
    return max(side**2 * largest / row**2, row**2 / (side**2 * smallest)) if side and smallest else math.inf


def sunburst(tree: Hierarchy) -> Layer:
    """Arcs: a ring a level around the root's disc, the span of a node by its size, heights by value."""
    start, span = np.zeros(len(tree.parent)), np.zeros(len(tree.parent))
    span[0] = arcs.FULL
    for node, children in enumerate(tree.children()):
        spans = span[node] * tree.size[children] / tree.size[node] if len(children) else np.empty(0)
        start[children] = start[node] + np.cumsum(spans) - spans
        span[children] = spans
    drawn = span > 0
    ring = SIDE / 2 / (tree.depth[drawn].max() + 1)
    objects = np.zeros(int(drawn.sum()), arcs.OBJECT)
    gap = np.where(span[drawn] < arcs.FULL, np.minimum(_GAP / ring, 0.1 * span[drawn]), 0.0)
    objects["angle"] = np.column_stack([start[drawn] + gap / 2, start[drawn] + span[drawn] - gap / 2])
    objects["radius"] = np.column_stack([ring * tree.depth[drawn], ring * (tree.depth[drawn] + 1)])
    objects["height"][:, 1] = np.where(tree.is_leaf, _leaf_heights(tree), _STEP)[drawn]
    objects["value"] = tree.value[drawn]
    return simple_layer(tree.name, "arcs", np.zeros(3), objects)
