"""Trees, hedges and the park with its pond."""

from __future__ import annotations

from functools import cache

import numpy as np

from .primitives import (
    Material,
    Shape,
    areas,
    blob,
    box,
    frustum,
    join,
    moved,
    painted,
    rectangle,
    triangle,
)

LEAVES = ((0.36, 0.48, 0.22), (0.44, 0.52, 0.24), (0.30, 0.42, 0.22), (0.50, 0.53, 0.27), (0.40, 0.46, 0.27))
N_SPECIES = 4
_CONIFER = 3


@cache
def _specimen(species: int, scale: float) -> np.ndarray:
    """Trunk, boughs and crown of a species, its foot at the origin; three broad-leaved kinds and a conifer."""
    rng = np.random.default_rng(species)
    if species == _CONIFER:
        trunk = frustum(Material.BARK, (0, 0, 0), 0.25 * scale, (0, 0, 3 * scale), 0.8)
        tiers = [
            blob(Material.LEAVES, (0, 0, z * scale), np.array([r, r, h]) * scale, Shape.FOLIAGE)
            for z, r, h in ((2.6, 2.5, 1.5), (4.2, 2.1, 1.6), (5.8, 1.6, 1.7), (7.4, 1.1, 1.7), (8.8, 0.6, 1.5))
        ]
        return join(trunk, *tiers)
    tall, wide = ((5.0, 2.6), (6.2, 2.2), (4.4, 2.3))[species]
    trunk = frustum(Material.BARK, (0, 0, 0), 0.22 * scale, (0, 0, tall * scale), 0.6)
    out = [
        trunk,
        blob(Material.LEAVES, (0, 0, (tall + 1.0) * scale), np.array([wide, wide, wide]) * scale * 0.9, Shape.FOLIAGE),
    ]
    for k in range(5):
        angle = 2 * np.pi * (k + rng.uniform(0, 0.6)) / 5
        reach, up = wide * rng.uniform(0.55, 0.8) * scale, (tall + rng.uniform(-0.8, 1.2)) * scale
        tip = np.array([reach * np.cos(angle), reach * np.sin(angle), up])
        foot = np.array([0, 0, tall * 0.65 * scale])
        out.append(frustum(Material.BARK, foot, 0.08 * scale, tip - foot, 0.4))
        out.append(
            blob(Material.LEAVES, tip, wide * scale * rng.uniform(0.5, 0.7) * np.array([1, 1, 0.85]), Shape.FOLIAGE)
        )
    return join(*out)


def tree(rng: np.random.Generator, species: int | None = None, scale: float = 1.0) -> np.ndarray:
    """A tree of the given or any species, in one of three sizes, with its own green."""
    species = int(rng.integers(N_SPECIES)) if species is None else species
    size = scale * (0.85, 1.0, 1.2)[rng.integers(3)]
    green = np.array(LEAVES[rng.integers(len(LEAVES))]) * rng.uniform(0.9, 1.1)
    if species == _CONIFER:
        green = green * (0.62, 0.78, 0.95)
    return painted(_specimen(species, size), {Material.LEAVES: (green[0], green[1], green[2])})


@cache
def hedge(length: float) -> np.ndarray:
    """A clipped hedge along x."""
    return box(Material.LEAVES, (0, -0.4, 0), (length, 0.4, 1.3))


@cache
def bench() -> np.ndarray:
    """A park bench that faces negative y."""
    return join(
        box(Material.DOOR, (-0.9, -0.25, 0.42), (0.9, 0.25, 0.48), "xXyZ"),
        rectangle(Material.DOOR, (-0.9, 0.25, 0.55), (1.8, 0, 0), (0, 0.08, 0.4)),
        *(box(Material.METAL, (x - 0.04, -0.2, 0), (x + 0.04, 0.2, 0.42), "xX") for x in (-0.7, 0.7)),
    )


def park(rng: np.random.Generator, edge: float, z: float) -> list[np.ndarray]:
    """Things in an edge × edge park: lawns about a pond, a path, trees and benches; and its ground at height z.

    The ground is fans of triangles between the shore, a path around it and the park's border, so no point of the lawn
    lies under the water.
    """
    n, middle = 48, edge / 2
    angle = 2 * np.pi * np.arange(n) / n
    ray = np.column_stack([np.cos(angle), np.sin(angle)])
    shore = 12.5 + 1.8 * np.sin(2 * angle + 0.5) + 0.9 * np.sin(3 * angle) + 0.6 * np.sin(5 * angle + 1)
    border = middle / np.abs(ray).max(axis=1)

    def ring(radius: np.ndarray, z: float) -> np.ndarray:
        return np.column_stack([middle + ray * radius[:, None], np.full(n, z)])

    def between(material: Material, inner: np.ndarray, outer: np.ndarray) -> list[np.ndarray]:
        turned_inner, turned_outer = np.roll(inner, -1, axis=0), np.roll(outer, -1, axis=0)
        quads = zip(inner, outer, turned_inner, turned_outer, strict=True)
        return [
            t for p, q, r, s in quads for t in (triangle(material, p, q, r), triangle(material, r, q, s))
        ]  # fmt: skip

    water, bank = ring(shore, -0.45), ring(shore + 0.9, z)
    path0, path1, rim = ring(shore + 3.0, z), ring(shore + 5.2, z), ring(border, z)
    centre = (middle, middle, -0.45)
    pond = join(
        *(triangle(Material.WATER, centre, p, q) for p, q in zip(water, np.roll(water, -1, axis=0), strict=True))
    )
    ground = join(
        *between(Material.GRASS, water, bank),
        *between(Material.GRASS, bank, path0),
        *between(Material.GRAVEL, path0, path1),
        *between(Material.GRASS, path1, rim),
    )
    things = [pond, ground[areas(ground) > 1e-6]]
    for _ in range(26):
        a = rng.uniform(0, 2 * np.pi)
        r = rng.uniform(21, 0.94 * middle / max(abs(np.cos(a)), abs(np.sin(a))))
        things.append(moved(tree(rng), (middle + r * np.cos(a), middle + r * np.sin(a), 0)))
    for a in range(0, n, 8):
        x, y = middle + ray[a] * (shore[a] + 5.8)
        things.append(moved(bench(), (x, y, 0)))
    return things
