"""The plan: streets, blocks and what stands in them, as one array of primitives.

A city is n × n blocks of ``BLOCK_M`` (with their pavements) between streets of ``STREET_M``; the pattern of 3 × 3 block
kinds in ``DISTRICT_PLAN`` repeats. City coordinates start at the outer kerb of the first street.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from . import buildings
from .buildings import FACADES, MODULE_M, ROW_DEPTH_M
from .nature import hedge, park, tree
from .primitives import (
    MATERIALS,
    Colour,
    Material,
    blob,
    box,
    disc,
    frustum,
    join,
    moved,
    painted,
    rectangle,
    tiled,
    turned,
)
from .terrain import BLOCK_M, DISTRICT, PITCH_M, STREET_M, height

PAVEMENT_M = 3.0
KERB_M = 0.12

Rectangle = tuple[float, float, float, float]
"""x0, y0, x1, y1 in metres."""


def settle(part: np.ndarray) -> np.ndarray:
    """A thing in city coordinates lifted on to the lowest ground at its corners; draped patches stay as they are."""
    x, y = np.stack([part["origin"].min(axis=0), part["origin"].max(axis=0)])[:, :2].T
    out = part.copy()
    out["origin"][~is_draped(part), 2] += height(x[:, None], y[None, :]).min() + KERB_M
    return out


def is_draped(part: np.ndarray) -> np.ndarray:
    """(n,) bool: which primitives follow the terrain point by point."""
    return np.array([MATERIALS[m].draped for m in Material])[part["material"]]


def open_ground(area: Rectangle, footprints: list[Rectangle], material: Material, z: float = 0.0) -> np.ndarray:
    """Ground over a rectangle but for axis-parallel footprints, which the scanner never saw under."""
    xs = np.unique([area[0], area[2], *(x for f in footprints for x in (f[0], f[2]))])
    ys = np.unique([area[1], area[3], *(y for f in footprints for y in (f[1], f[3]))])
    out = []
    for x0, x1 in pairwise(xs):
        for y0, y1 in pairwise(ys):
            x, y = (x0 + x1) / 2, (y0 + y1) / 2
            if not any(f[0] < x < f[2] and f[1] < y < f[3] for f in footprints):
                out.append(rectangle(material, (x0, y0, z), (x1 - x0, 0, 0), (0, y1 - y0, 0)))
    return join(*out)


@dataclass(frozen=True)
class Contents:
    """What stands in a block: things to settle, footprints the ground leaves out, and what the ground is.

    Coordinates are the block's, from its lower corner.
    """

    things: list[np.ndarray]
    footprints: list[Rectangle]
    ground: Material


def rows_block(rng: np.random.Generator) -> Contents:
    """Town houses around a green courtyard, with passages at the corners."""
    a, b, d, short = PAVEMENT_M, BLOCK_M - PAVEMENT_M, ROW_DEPTH_M, 9
    start = (BLOCK_M - short * MODULE_M) / 2
    stop = BLOCK_M - start
    things = []
    for turns, corner in enumerate([(a, a, 0), (b, start, 0), (b, b, 0), (a, stop, 0)]):
        bays = short if turns % 2 else round((b - a) / MODULE_M)
        things += [moved(turned(house, turns), corner) for house in buildings.row(rng, bays)]
    things += [moved(tree(rng), (*rng.uniform(22, 41, 2), 0)) for _ in range(4)]
    footprints = [(a, a, b, a + d), (b - d, start, b, stop), (a, b - d, b, b), (a, start, a + d, stop)]
    return Contents(things, footprints, Material.GRASS)


def apartments_block(rng: np.random.Generator) -> Contents:
    """Two slabs of flats on a lawn with trees."""
    colours, floors = rng.permutation(len(FACADES))[:2], rng.integers(5, 8, 2)
    x0, y0, width, depth = 7.5, 8.0, 16 * MODULE_M, 4 * MODULE_M
    x1, y1 = x0 + width, BLOCK_M - y0
    south, north = (buildings.apartments(16, int(f), FACADES[c]) for f, c in zip(floors, colours, strict=True))
    things = [moved(south, (x0, y0, 0)), moved(turned(north, 2), (x1, y1, 0))]
    things += [moved(tree(rng), (x, BLOCK_M / 2 + rng.uniform(-5, 5), 0)) for x in np.arange(10, 56, 8.0)]
    return Contents(things, [(x0, y0, x1, y0 + depth), (x0, y1 - depth, x1, y1)], Material.GRASS)


def office_block(rng: np.random.Generator) -> Contents:
    """A tower and a lower slab on a paved plaza."""
    things, footprints = [], []
    for bays, deep, floors, x, y, colour in (
        (5, 5, 11, 8.0, 35.0, (0.72, 0.75, 0.78)),
        (14, 5, 4, 12.0, 8.0, (0.86, 0.84, 0.80)),
    ):
        things.append(moved(buildings.office(bays, deep, floors, colour), (x, y, 0)))
        footprints.append((x, y, x + bays * MODULE_M, y + deep * MODULE_M))
    things += [moved(tree(rng, 0), (x, y, 0)) for x in np.arange(31, 57, 6.5) for y in (33.0, 44.0, 54.0)]
    return Contents(things, footprints, Material.PAVING)


def cottages_block(rng: np.random.Generator) -> Contents:
    """Eight detached houses in gardens behind hedges."""
    things, footprints = [], []
    for x in 4.5 + 14.0 * np.arange(4):
        for turns, corner, y in ((0, (x, 9.0, 0), 9.0), (2, (x + 12, BLOCK_M - 9, 0), BLOCK_M - 18)):
            things.append(moved(turned(buildings.cottage(rng), turns), corner))
            footprints.append((x, y, x + 12, y + 9))
        for y in (3.8, BLOCK_M - 3.8):
            things += [moved(hedge(5.0), (x, y, 0)), moved(hedge(4.0), (x + 8, y, 0))]
        for side in (-1, 1):
            things.append(moved(tree(rng), (x + rng.uniform(1, 11), BLOCK_M / 2 + side * rng.uniform(4, 9), 0)))
    return Contents(things, footprints, Material.GRASS)


def church_block(rng: np.random.Generator) -> Contents:
    """A church on a gravelled square under rows of trees."""
    x, y = 15.0, 24.0
    things = [moved(buildings.church(), (x, y, 0))]
    things += [moved(tree(rng, 1), (px, py, 0)) for px in np.arange(7.5, 60, 8) for py in (8.0, BLOCK_M - 8.0)]
    footprints = [(x, y + 3, x + 9, y + 12), (x + 9, y, x + 33, y + 15)]
    return Contents(things, footprints, Material.GRAVEL)


def park_block(rng: np.random.Generator) -> Contents:
    """A park with a pond; it brings its own ground."""
    a, b = PAVEMENT_M, BLOCK_M - PAVEMENT_M
    return Contents([moved(thing, (a, a, 0)) for thing in park(rng, b - a, KERB_M)], [(a, a, b, b)], Material.GRASS)


BlockKind = Callable[[np.random.Generator], Contents]
DISTRICT_PLAN: tuple[tuple[BlockKind, ...], ...] = (
    (rows_block, cottages_block, rows_block),
    (church_block, park_block, apartments_block),
    (rows_block, rows_block, office_block),
)
"""Block kinds by row (y) and column (x); the park is in the valley."""


def block(rng: np.random.Generator, kind: BlockKind, x: float, y: float) -> list[np.ndarray]:
    """A block with its pavement, kerb, lamps and street trees, its lower corner at x, y."""
    contents = kind(rng)
    inner = (PAVEMENT_M, PAVEMENT_M, BLOCK_M - PAVEMENT_M, BLOCK_M - PAVEMENT_M)
    ground = join(
        open_ground(inner, contents.footprints, contents.ground, KERB_M),
        open_ground((0, 0, BLOCK_M, BLOCK_M), [inner], Material.PAVING, KERB_M),
        box(Material.KERB, (0, 0, 0), (BLOCK_M, BLOCK_M, KERB_M), "xXyY"),
    )
    things = list(contents.things)
    corners = [(0, 0, 0), (BLOCK_M, 0, 0), (BLOCK_M, BLOCK_M, 0), (0, BLOCK_M, 0)]
    for turns, corner in enumerate(corners):
        for at in np.arange(9.0, BLOCK_M, 15.0):
            things.append(moved(turned(moved(lamp(), (at, 0.5, 0)), turns), corner))
            if kind is not rows_block and at + 7.5 < BLOCK_M - PAVEMENT_M:
                things.append(moved(turned(moved(tree(rng, 2, 0.7), (at + 7.5, 1.5, 0)), turns), corner))
    return [moved(ground, (x, y, 0)), *(settle(moved(thing, (x, y, 0))) for thing in things)]


def lamp() -> np.ndarray:
    """A street lamp; its arm reaches over the road at negative y."""
    return join(
        frustum(Material.METAL, (0, 0, 0), 0.11, (0, 0, 6.2), 0.6),
        frustum(Material.METAL, (0, 0, 6.15), 0.05, (0, -1.5, 0.35)),
        painted(blob(Material.METAL, (0, -1.6, 6.45), (0.18, 0.4, 0.12)), {Material.METAL: (0.85, 0.85, 0.80)}),
    )


CARS: tuple[Colour, ...] = (
    (0.72, 0.08, 0.07),
    (0.10, 0.18, 0.42),
    (0.86, 0.86, 0.85),
    (0.12, 0.12, 0.13),
    (0.55, 0.57, 0.60),
    (0.75, 0.62, 0.15),
    (0.16, 0.34, 0.24),
)


def car(colour: Colour) -> np.ndarray:
    """A saloon along x, 4.3 m × 1.76 m, centred on its wheels."""
    body = box(Material.PAINT, (-2.15, -0.88, 0.32), (2.15, 0.88, 0.82))
    roof = rectangle(Material.PAINT, (-1.0, -0.72, 1.42), (1.7, 0, 0), (0, 1.44, 0))
    front = rectangle(Material.CAR_GLASS, (1.35, -0.76, 0.82), (0, 1.52, 0), (-0.65, 0, 0.6))
    back = rectangle(Material.CAR_GLASS, (-1.6, 0.76, 0.82), (0, -1.52, 0), (0.6, 0, 0.6))
    right = rectangle(Material.CAR_GLASS, (-1.4, -0.84, 0.82), (2.6, 0, 0), (0, 0.12, 0.6))
    left = rectangle(Material.CAR_GLASS, (1.2, 0.84, 0.82), (-2.6, 0, 0), (0, -0.12, 0.6))
    wheels = [
        disc(Material.CAR_GLASS, (x, s * 0.9, 0.32), (0.32, 0, 0), (0, 0, -s * 0.32))
        for x in (-1.35, 1.35)
        for s in (-1, 1)
    ]
    return painted(join(body, roof, front, back, right, left, *wheels), {Material.PAINT: colour})


def streets(rng: np.random.Generator, n_blocks: int) -> np.ndarray:
    """Carriageways with their markings and cars, for n × n blocks."""
    edge = n_blocks * PITCH_M + STREET_M
    at = np.arange(n_blocks + 1) * PITCH_M
    out = [rectangle(Material.ASPHALT, (0, y, 0), (edge, 0, 0), (0, STREET_M, 0)) for y in at]
    dash = rectangle(Material.MARKING, (0, -0.07, 0.01), (3.0, 0, 0), (0, 0.14, 0))
    stripe = rectangle(Material.MARKING, (0, -0.25, 0.01), (3.0, 0, 0), (0, 0.5, 0))
    for x in at:
        for y in at[:-1] + STREET_M:
            out.append(rectangle(Material.ASPHALT, (x, y, 0), (STREET_M, 0, 0), (0, BLOCK_M, 0)))
    stretch = join(
        *(moved(dash, (x, STREET_M / 2, 0)) for x in np.arange(6.0, BLOCK_M - 8, 6.0)),
        *(moved(stripe, (x, y, 0)) for x in (1.0, BLOCK_M - 4.0) for y in np.arange(0.75, STREET_M, 1.0)),
    )
    for street in at:
        for start in at[:-1] + STREET_M:
            for across in (False, True):
                cars = [
                    moved(turned(car(CARS[rng.integers(len(CARS))]), turns), (x + rng.uniform(-0.3, 0.3), y, 0))
                    for turns, y in ((0, 1.15), (2, STREET_M - 1.15))
                    for x in np.arange(8.0, BLOCK_M - 7, 5.6)
                    if rng.random() < 0.6
                ]
                for thing in [stretch, *cars]:
                    if across:  # a quarter turn maps the street's width on to negative x
                        placed = moved(turned(thing, 1), (street + STREET_M, start, 0))
                    else:
                        placed = moved(thing, (start, street, 0))
                    out.append(settle(placed))
    return join(*out)


def city(seed: int, n_blocks: int) -> np.ndarray:
    """Every primitive of an n × n block city, in city coordinates."""
    rng = np.random.default_rng(seed)
    out = [streets(rng, n_blocks)]
    for j in range(n_blocks):
        for i in range(n_blocks):
            kind = DISTRICT_PLAN[j % DISTRICT][i % DISTRICT]
            out += block(rng, kind, i * PITCH_M + STREET_M, j * PITCH_M + STREET_M)
    return tiled(join(*out), largest_m=6.0, slimmest=8.0)
