"""Buildings: façades from repeated modules, roofs, and what stands on them.

Local frame of a building: its front is the plane y = 0, seen from negative y; x to the right, y into the depth, z up
from the ground floor. ``MODULE_M`` is the width of one bay of a façade; every width is a multiple of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from .primitives import (
    Colour,
    Material,
    Shape,
    box,
    disc,
    frustum,
    join,
    moved,
    painted,
    primitive,
    rectangle,
    triangle,
    turned,
)

MODULE_M = 3.0
FLOOR_M = 3.2
ROW_DEPTH_M = 12.0
ROOF_SLOPE = 0.95

FACADES: tuple[Colour, ...] = (
    (0.91, 0.83, 0.66), (0.88, 0.71, 0.52), (0.80, 0.52, 0.41), (0.93, 0.90, 0.83), (0.74, 0.78, 0.74),
    (0.70, 0.74, 0.80), (0.91, 0.78, 0.72), (0.66, 0.40, 0.31), (0.86, 0.84, 0.58), (0.78, 0.72, 0.66),
)  # fmt: skip
ROOFS: tuple[Colour, ...] = (
    (0.64, 0.36, 0.27),
    (0.57, 0.31, 0.24),
    (0.38, 0.38, 0.41),
    (0.68, 0.44, 0.33),
    (0.45, 0.33, 0.29),
)
DOORS: tuple[Colour, ...] = ((0.32, 0.18, 0.10), (0.12, 0.28, 0.22), (0.45, 0.10, 0.10), (0.14, 0.20, 0.36))


@cache
def opening(
    width: float, height: float, sill: float, floor: float, filling: Material = Material.GLASS, module: float = MODULE_M
) -> np.ndarray:
    """One bay: wall around a recessed pane with its reveals and, above the floor, a sill."""
    x0, x1, z0, z1, recess = (module - width) / 2, (module + width) / 2, sill, sill + height, 0.2
    wall, out = Material.WALL, []
    if z0 > 0:
        out.append(rectangle(wall, (0, 0, 0), (module, 0, 0), (0, 0, z0)))
        out.append(box(Material.TRIM, (x0 - 0.1, -0.12, z0 - 0.08), (x1 + 0.1, 0, z0), "yZ"))
    if z1 < floor:
        out.append(rectangle(wall, (0, 0, z1), (module, 0, 0), (0, 0, floor - z1)))
    out += [
        rectangle(wall, (0, 0, z0), (x0, 0, 0), (0, 0, height)),
        rectangle(wall, (x1, 0, z0), (module - x1, 0, 0), (0, 0, height)),
        rectangle(Material.TRIM, (x0, 0, z0), (0, recess, 0), (0, 0, height)),
        rectangle(Material.TRIM, (x1, recess, z0), (0, -recess, 0), (0, 0, height)),
        rectangle(Material.TRIM, (x0, 0, z1), (0, recess, 0), (width, 0, 0)),
        rectangle(filling, (x0, recess, z0), (width, 0, 0), (0, 0, height)),
    ]
    return join(*out)


@cache
def window() -> np.ndarray:
    """A bay with an upright window."""
    return opening(1.3, 1.7, 0.9, FLOOR_M)


@cache
def balcony() -> np.ndarray:
    """A bay with a glazed door behind a balcony."""
    slab = box(Material.TRIM, (0.3, -1.3, -0.1), (2.7, 0, 0.08), "xXyzZ")
    rail = box(Material.PAINT, (0.3, -1.3, 0.15), (2.7, 0, 1.05), "xXy")
    return join(opening(1.8, 2.3, 0.0, FLOOR_M), slab, painted(rail, {Material.PAINT: (0.55, 0.60, 0.62)}))


def facade(ground: Sequence[np.ndarray], floors: int, upper: np.ndarray) -> np.ndarray:
    """A front on y = 0: one bay after another of ``ground``, and rows of ``upper`` above."""
    x = np.arange(len(ground)) * MODULE_M
    x_upper, z_upper = (v.ravel() for v in np.meshgrid(x, np.arange(1, floors) * FLOOR_M))
    lowest = [moved(bay, (at, 0, 0)) for bay, at in zip(ground, x, strict=True)]
    return join(*lowest, moved(upper, np.column_stack([x_upper, 0 * x_upper, z_upper])))


def around(part_by_side: list[np.ndarray], width: float, depth: float) -> np.ndarray:
    """Four fronts on the sides of a width × depth plan: front, right, back, left."""
    corners = [(0, 0, 0), (width, 0, 0), (width, depth, 0), (0, depth, 0)]
    return join(*(moved(turned(p, k), c) for k, (p, c) in enumerate(zip(part_by_side, corners, strict=True))))


def cornice(width: float, z: float) -> np.ndarray:
    """A moulding along the front at height z."""
    return box(Material.TRIM, (0, -0.3, z - 0.3), (width, 0, z), "xXyzZ")


def gable_roof(width: float, depth: float, eaves: float, rise: float, overhang: float = 0.35) -> np.ndarray:
    """Two slopes with the ridge along x, and the gables under them."""
    slope = rise / (depth / 2)
    low, run, up = eaves - overhang * slope, depth / 2 + overhang, rise + overhang * slope
    ridge = (depth / 2, eaves + rise)
    return join(
        rectangle(Material.ROOF, (0, -overhang, low), (width, 0, 0), (0, run, up)),
        rectangle(Material.ROOF, (width, depth + overhang, low), (-width, 0, 0), (0, -run, up)),
        triangle(Material.WALL, (0, depth, eaves), (0, 0, eaves), (0, *ridge)),
        triangle(Material.WALL, (width, 0, eaves), (width, depth, eaves), (width, *ridge)),
    )


def hip_roof(width: float, depth: float, eaves: float, rise: float, overhang: float = 0.4) -> np.ndarray:
    """Four slopes; the ridge runs along x, or is a point on a square plan."""
    x0, x1, y0, y1 = -overhang, width + overhang, -overhang, depth + overhang
    inset, top = (y1 - y0) / 2, eaves + rise
    a, b = (x0 + inset, (y0 + y1) / 2, top), (x1 - inset, (y0 + y1) / 2, top)
    p, q, r, s = (x0, y0, eaves), (x1, y0, eaves), (x1, y1, eaves), (x0, y1, eaves)
    faces = [(p, q, a), (q, r, b), (r, s, b), (s, p, a)]
    if b[0] - a[0] > 1e-6:
        faces += [(q, b, a), (s, a, b)]
    return join(*(triangle(Material.ROOF, *face) for face in faces))


@cache
def chimney() -> np.ndarray:
    """A brick stack with two pots; its foot is at z = 0 and may stand in a slope."""
    pots = [frustum(Material.ROOF, (x, 0.3, 2.2), 0.13, (0, 0, 0.4), 0.8) for x in (0.3, 0.8)]
    return join(box(Material.BRICK, (0, 0, 0), (1.1, 0.6, 2.2)), *pots)


@cache
def dormer() -> np.ndarray:
    """A dormer with a window, for a roof of ``ROOF_SLOPE`` that passes through its foot."""
    width, tall = 1.5, 1.6
    depth = tall / ROOF_SLOPE
    return join(
        opening(1.0, 1.1, 0.3, tall, module=width),
        triangle(Material.WALL, (0, depth, tall), (0, 0, 0), (0, 0, tall)),
        triangle(Material.WALL, (width, 0, 0), (width, depth, tall), (width, 0, tall)),
        box(Material.METAL, (-0.15, -0.2, tall), (width + 0.15, depth + 0.1, tall + 0.12), "xXyZ"),
    )


def row_house(rng: np.random.Generator, bays: int, low_left: float, low_right: float, floors: int) -> np.ndarray:
    """A town house in a row; side walls start above the neighbours' eaves."""
    width, depth, eaves = bays * MODULE_M, ROW_DEPTH_M, floors * FLOOR_M
    rise = depth / 2 * ROOF_SLOPE
    shop = rng.random() < 0.35
    ground = [opening(2.4, 2.5, 0.25, FLOOR_M) if shop else window()] * bays
    ground[rng.integers(bays)] = opening(1.3, 2.4, 0.0, FLOOR_M, Material.DOOR)
    front = facade(ground, floors, balcony() if rng.random() < 0.25 else window())
    back = moved(turned(facade([window()] * bays, floors, window()), 2), (width, depth, 0))
    sides = []
    if low_left < eaves:
        sides.append(rectangle(Material.WALL, (0, depth, low_left), (0, -depth, 0), (0, 0, eaves - low_left)))
    if low_right < eaves:
        sides.append(rectangle(Material.WALL, (width, 0, low_right), (0, depth, 0), (0, 0, eaves - low_right)))
    roof = [gable_roof(width, depth, eaves, rise), moved(chimney(), (width - 1.6, depth / 2 - 0.3, eaves + rise - 0.8))]
    if rng.random() < 0.6:
        xs = np.arange(bays) * MODULE_M + (MODULE_M - 1.5) / 2
        roof.append(moved(dormer(), np.column_stack([xs, np.full(bays, 1.2), np.full(bays, eaves + 1.2 * ROOF_SLOPE)])))
    house = join(front, back, *sides, *roof, cornice(width, eaves), cornice(width, FLOOR_M + 0.1))
    return painted(
        house,
        {
            Material.WALL: FACADES[rng.integers(len(FACADES))],
            Material.ROOF: ROOFS[rng.integers(len(ROOFS))],
            Material.DOOR: DOORS[rng.integers(len(DOORS))],
        },
    )


def row(rng: np.random.Generator, bays: int) -> list[np.ndarray]:
    """Town houses side by side, ``bays`` modules in all."""
    widths: list[int] = []
    while bays:
        widths.append(bays if bays <= 5 else int(rng.integers(3, min(5, bays - 3) + 1)))
        bays -= widths[-1]
    floors = rng.integers(3, 6, len(widths))
    step = 0.5  # neighbours may stand this much lower on a slope
    tops = np.concatenate([[0.0], floors * FLOOR_M - step, [0.0]])
    starts = np.cumsum([0, *widths[:-1]]) * MODULE_M
    return [
        moved(row_house(rng, w, tops[k], tops[k + 2], int(floors[k])), (starts[k], 0, 0)) for k, w in enumerate(widths)
    ]


def flat_roof(width: float, depth: float, top: float) -> np.ndarray:
    """A gravelled roof with a parapet, a stair head and rows of air handlers."""
    t, h = 0.35, 0.9
    parapet = join(
        box(Material.TRIM, (0, 0, top), (width, t, top + h), "yYZ"),
        box(Material.TRIM, (0, depth - t, top), (width, depth, top + h), "yYZ"),
        box(Material.TRIM, (0, t, top), (t, depth - t, top + h), "xXZ"),
        box(Material.TRIM, (width - t, t, top), (width, depth - t, top + h), "xXZ"),
    )
    head = box(Material.WALL, (width / 2 - 2, depth / 2 - 1.5, top), (width / 2 + 2, depth / 2 + 2.5, top + 2.8))
    handler = join(
        box(Material.METAL, (0, 0, top + 0.3), (1.8, 1.2, top + 1.4)),
        disc(Material.GLASS, (0.9, 0.6, top + 1.42), (0.45, 0, 0), (0, 0.45, 0)),
    )
    xs = np.arange(2.0, width - 3.0, 3.0)
    xs = xs[np.abs(xs + 0.9 - width / 2) > 3.5]
    handlers = moved(
        painted(handler, {Material.METAL: (0.72, 0.74, 0.75)}),
        np.column_stack([xs, np.full(len(xs), depth / 3), 0 * xs]),
    )
    deck = rectangle(Material.FLAT_ROOF, (t, t, top), (width - 2 * t, 0, 0), (0, depth - 2 * t, 0))
    return join(deck, parapet, head, handlers)


def office(bays: int, deep: int, floors: int, colour: Colour) -> np.ndarray:
    """A slab with wide windows on every side."""
    bay = opening(2.5, 2.0, 0.8, FLOOR_M)
    entrance = opening(2.7, 2.7, 0.05, FLOOR_M)
    width, depth = bays * MODULE_M, deep * MODULE_M
    sides = [facade([entrance] * n, floors, bay) for n in (bays, deep, bays, deep)]
    return painted(
        join(around(sides, width, depth), flat_roof(width, depth, floors * FLOOR_M)), {Material.WALL: colour}
    )


def apartments(bays: int, floors: int, colour: Colour) -> np.ndarray:
    """A slab of flats: every other bay of the front and the back has a balcony. ``bays`` is even."""
    entrance = opening(1.4, 2.4, 0, FLOOR_M, Material.DOOR)
    pair = join(window(), moved(balcony(), (MODULE_M, 0, 0)))
    x, z = (v.ravel() for v in np.meshgrid(np.arange(0, bays, 2) * MODULE_M, np.arange(1, floors) * FLOOR_M))
    front = join(facade([window(), entrance] * (bays // 2), 1, window()), moved(pair, np.column_stack([x, 0 * x, z])))
    width, depth = bays * MODULE_M, 4 * MODULE_M
    side = facade([window()] * 4, floors, window())
    return painted(
        join(around([front, side, front, side], width, depth), flat_roof(width, depth, floors * FLOOR_M)),
        {Material.WALL: colour},
    )


def cottage(rng: np.random.Generator) -> np.ndarray:
    """A detached house of 4 × 3 bays and two floors with a hipped roof and a porch."""
    width, depth, eaves = 4 * MODULE_M, 3 * MODULE_M, 2 * FLOOR_M
    sides = [facade([window()] * n, 2, window()) for n in (4, 3, 4, 3)]
    porch = join(
        box(Material.TRIM, (4.6, -1.6, 2.5), (7.4, -0.01, 2.7), "xXyzZ"),
        *(frustum(Material.TRIM, (x, -1.45, 0), 0.1, (0, 0, 2.5)) for x in (4.8, 7.2)),
        rectangle(Material.DOOR, (5.4, -0.03, 0), (1.2, 0, 0), (0, 0, 2.3)),
    )
    house = join(
        around(sides, width, depth), hip_roof(width, depth, eaves, 3.4), porch, moved(chimney(), (7.6, 3.4, 8.0))
    )
    return painted(
        house, {Material.WALL: FACADES[rng.integers(len(FACADES))], Material.ROOF: ROOFS[rng.integers(len(ROOFS))]}
    )


def church() -> np.ndarray:
    """A nave of seven bays with buttresses and a tower with clocks and a spire, its front at the tower. 33 m × 15 m."""
    stone: Colour = (0.80, 0.74, 0.62)
    eaves, depth, x0, nave = 10.0, 15.0, 9.0, 24.0
    bay = opening(1.3, 6.0, 2.2, eaves)
    buttress = box(Material.WALL, (-0.35, -0.9, 0), (0.35, 0, 7.5), "xXyZ")
    side = join(
        *(moved(bay, (k * MODULE_M, 0, 0)) for k in range(8)),
        *(moved(buttress, (k * MODULE_M, 0, 0)) for k in range(9)),
    )
    end = rectangle(Material.WALL, (0, 0, 0), (depth, 0, 0), (0, 0, eaves))
    body = moved(join(around([side, end, side, end], nave, depth), gable_roof(nave, depth, eaves, 8.5)), (x0, 0, 0))
    w, top = 9.0, 28.0
    belfry = opening(1.2, 4.0, 3.0, 8.0)
    high = join(
        *(moved(belfry, (k * MODULE_M, 0, 20)) for k in range(3)),
        disc(Material.TRIM, (w / 2, -0.06, 17), (1.3, 0, 0), (0, 0, 1.3)),
        box(Material.METAL, (w / 2 - 0.06, -0.1, 17), (w / 2 + 0.06, -0.07, 18.1), "y"),
        cornice(w, 20),
        cornice(w, top),
    )
    wall = join(rectangle(Material.WALL, (0, 0, 0), (w, 0, 0), (0, 0, 20)), high)
    portal = opening(3.0, 4.5, 0.2, 6.0, Material.DOOR, module=w)
    portal = join(portal, rectangle(Material.WALL, (0, 0, 6), (w, 0, 0), (0, 0, 14)), high)
    spire = primitive(
        Shape.FRUSTUM, Material.ROOF, (w / 2, w / 2, top), (w * 0.52, 0, 0), (0, w * 0.52, 0), (0, 0, 17), 0.02
    )
    ball = box(Material.METAL, (w / 2 - 0.08, w / 2 - 0.08, top + 16.8), (w / 2 + 0.08, w / 2 + 0.08, top + 19))
    tower = moved(join(around([wall, wall, wall, portal], w, w), spire, ball), (0, (depth - w) / 2, 0))
    return painted(join(body, tower), {Material.WALL: stone, Material.ROOF: (0.36, 0.42, 0.42)})
