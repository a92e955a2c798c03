"""What the city is made of: materials, and surface primitives placed by translation and quarter turns.

A primitive is one row of ``PRIMITIVE``: a patch of surface ``origin + a·u + b·v + c·w`` whose ``(a, b, c)`` its shape
gives. Parts are arrays of such rows in a local frame (x along the front, y into the depth, z up), so that a window is
described once and repeated exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

Vector = Sequence[float] | np.ndarray
Colour = tuple[float, float, float]


class Shape(IntEnum):
    """How ``(a, b, c)`` runs over the patch, and its normal."""

    RECTANGLE = 0  # a, b in [0, 1]; w is the unit normal u × v
    TRIANGLE = 1  # a + b ≤ 1; w as above
    DISC = 2  # a² + b² ≤ 1; w as above
    FRUSTUM = 3  # side of a cone: radii u, v at the bottom and taper times that at the top (≤ 1); w is the axis
    ELLIPSOID = 4  # half axes u, v, w
    FOLIAGE = 5  # the outer half of an ellipsoid, in clumps


class Material(IntEnum):
    """What a patch is made of: index into ``MATERIALS``."""

    ASPHALT = 0
    PAVING = 1
    KERB = 2
    MARKING = 3
    GRASS = 4
    GRAVEL = 5
    WATER = 6
    WALL = 7
    GLASS = 8
    TRIM = 9
    DOOR = 10
    ROOF = 11
    FLAT_ROOF = 12
    BRICK = 13
    METAL = 14
    BARK = 15
    LEAVES = 16
    PAINT = 17
    CAR_GLASS = 18


@dataclass(frozen=True)
class Surface:
    """How a material looks to a scanner.

    classification : ASPRS class.  colour : RGB in [0, 1] unless a part is painted otherwise.
    weight : points per area relative to a wall.  grain, patches : relative colour variation from point to point, and
    over a metre.  reflectance : in [0, 1], at the scanner's wavelength.  draped : lies on the terrain.
    """

    classification: int
    colour: Colour
    weight: float = 1.0
    grain: float = 0.04
    patches: float = 0.08
    reflectance: float = 0.5
    draped: bool = False


GROUND, HIGH_VEGETATION, BUILDING, WATER, ROAD, OTHER = 2, 5, 6, 9, 11, 1

MATERIALS: Mapping[Material, Surface] = {
    Material.ASPHALT: Surface(ROAD, (0.36, 0.37, 0.39), grain=0.06, patches=0.16, reflectance=0.15, draped=True),
    Material.PAVING: Surface(GROUND, (0.68, 0.66, 0.62), patches=0.10, reflectance=0.4, draped=True),
    Material.KERB: Surface(GROUND, (0.78, 0.77, 0.74), weight=2.0, reflectance=0.45, draped=True),
    Material.MARKING: Surface(ROAD, (0.95, 0.95, 0.92), weight=2.0, patches=0.15, reflectance=0.9, draped=True),
    Material.GRASS: Surface(GROUND, (0.42, 0.52, 0.28), grain=0.10, patches=0.30, reflectance=0.55, draped=True),
    Material.GRAVEL: Surface(GROUND, (0.80, 0.73, 0.58), grain=0.07, patches=0.12, reflectance=0.5, draped=True),
    Material.WATER: Surface(WATER, (0.20, 0.40, 0.50), grain=0.05, patches=0.18, reflectance=0.04),
    Material.WALL: Surface(BUILDING, (0.85, 0.78, 0.66), patches=0.07, reflectance=0.6),
    Material.GLASS: Surface(BUILDING, (0.17, 0.22, 0.28), grain=0.10, patches=0.5, reflectance=0.08),
    Material.TRIM: Surface(BUILDING, (0.90, 0.87, 0.80), weight=1.3, reflectance=0.7),
    Material.DOOR: Surface(BUILDING, (0.32, 0.18, 0.10), reflectance=0.35),
    Material.ROOF: Surface(BUILDING, (0.70, 0.33, 0.22), grain=0.09, patches=0.20, reflectance=0.45),
    Material.FLAT_ROOF: Surface(BUILDING, (0.62, 0.61, 0.59), grain=0.06, patches=0.15, reflectance=0.35),
    Material.BRICK: Surface(BUILDING, (0.58, 0.30, 0.22), grain=0.10, reflectance=0.4),
    Material.METAL: Surface(OTHER, (0.30, 0.34, 0.36), weight=3.0, reflectance=0.3),
    Material.BARK: Surface(HIGH_VEGETATION, (0.36, 0.27, 0.19), weight=2.0, grain=0.12, reflectance=0.35),
    Material.LEAVES: Surface(
        HIGH_VEGETATION, (0.33, 0.50, 0.16), weight=1.1, grain=0.16, patches=0.22, reflectance=0.6
    ),
    Material.PAINT: Surface(OTHER, (0.7, 0.1, 0.1), weight=2.0, patches=0.03, reflectance=0.6),
    Material.CAR_GLASS: Surface(OTHER, (0.12, 0.15, 0.18), weight=2.0, reflectance=0.05),
}

PRIMITIVE = np.dtype(
    [
        ("shape", "u1"),
        ("material", "u1"),
        ("origin", "<f8", 3),
        ("u", "<f8", 3),
        ("v", "<f8", 3),
        ("w", "<f8", 3),
        ("taper", "<f8"),
        ("colour", "<f8", 3),
    ],
    align=True,
)


def primitive(
    shape: Shape, material: Material, origin: Vector, u: Vector, v: Vector, w: Vector | None = None, taper: float = 1.0
) -> np.ndarray:
    """(1,) PRIMITIVE. Without ``w`` the patch is flat and looks along u × v."""
    if w is None:
        w = np.cross(u, v)
        w = w / np.linalg.norm(w)
    out = np.empty(1, PRIMITIVE)
    out["shape"], out["material"], out["taper"] = shape, material, taper
    out["origin"], out["u"], out["v"], out["w"] = origin, u, v, w
    out["colour"] = MATERIALS[material].colour
    return out


def rectangle(material: Material, origin: Vector, u: Vector, v: Vector) -> np.ndarray:
    """A parallelogram from its corner along its two edges; it looks along u × v."""
    return primitive(Shape.RECTANGLE, material, origin, u, v)


def triangle(material: Material, p: Vector, q: Vector, r: Vector) -> np.ndarray:
    """A triangle, counter-clockwise as seen from outside."""
    return primitive(Shape.TRIANGLE, material, p, np.subtract(q, p), np.subtract(r, p))


def disc(material: Material, centre: Vector, u: Vector, v: Vector) -> np.ndarray:
    """An ellipse with half axes u and v, looking along u × v."""
    return primitive(Shape.DISC, material, centre, u, v)


def frustum(material: Material, base: Vector, radius: float, axis: Vector, taper: float = 1.0) -> np.ndarray:
    """The side of a cone or cylinder around ``axis``."""
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    u = side / np.linalg.norm(side) * radius
    v = np.cross(axis, u) / np.linalg.norm(axis)
    return primitive(Shape.FRUSTUM, material, base, u, v, axis, taper)


def blob(material: Material, centre: Vector, radii: Vector, shape: Shape = Shape.ELLIPSOID) -> np.ndarray:
    """An axis-aligned ellipsoid."""
    u, v, w = np.diag(np.asarray(radii, float))
    return primitive(shape, material, centre, u, v, w)


def box(material: Material, lower: Vector, upper: Vector, faces: str = "xXyYZ") -> np.ndarray:
    """The faces of an axis-aligned box: small letters lower, capitals upper; the underside ``z`` only on demand."""
    (x0, y0, z0), (x1, y1, z1) = lower, upper
    dx, dy, dz = (x1 - x0, 0, 0), (0, y1 - y0, 0), (0, 0, z1 - z0)
    sides = {
        "x": ((x0, y1, z0), (0, y0 - y1, 0), dz),
        "X": ((x1, y0, z0), dy, dz),
        "y": ((x0, y0, z0), dx, dz),
        "Y": ((x1, y1, z0), (x0 - x1, 0, 0), dz),
        "z": ((x0, y0, z0), dy, dx),
        "Z": ((x0, y0, z1), dx, dy),
    }
    return join(*(rectangle(material, *sides[face]) for face in faces))


def join(*parts: np.ndarray) -> np.ndarray:
    """All primitives of several parts."""
    return np.concatenate([np.empty(0, PRIMITIVE), *parts])


def moved(part: np.ndarray, offsets: np.ndarray | Vector) -> np.ndarray:
    """One copy of a part at each of (k, 3) offsets, metres."""
    offsets = np.atleast_2d(np.asarray(offsets, float))
    copies = np.tile(part, len(offsets))
    copies["origin"] += np.repeat(offsets, len(part), axis=0)
    return copies


def turned(part: np.ndarray, quarter_turns: int) -> np.ndarray:
    """A part turned counter-clockwise around z in exact steps of 90°."""
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter_turns % 4]
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], float)
    out = part.copy()
    for name in ("origin", "u", "v", "w"):
        out[name] = part[name] @ rotation.T
    return out


def painted(part: np.ndarray, colours: Mapping[Material, Colour]) -> np.ndarray:
    """A part with other colours on some of its materials."""
    out = part.copy()
    for material, colour in colours.items():
        out["colour"][part["material"] == material] = colour
    return out


def tiled(part: np.ndarray, largest_m: float, slimmest: float) -> np.ndarray:
    """A part with its rectangles cut into equal tiles: no side above ``largest_m`` or ``slimmest`` times the other.

    Long patches would show the rows of the point sequence that covers them.
    """
    u, v = (np.linalg.norm(part[name], axis=1) for name in "uv")
    n_u = np.ceil(u / np.minimum(largest_m, slimmest * v) - 1e-9).astype(np.int64)
    n_v = np.ceil(v / np.minimum(largest_m, slimmest * u) - 1e-9).astype(np.int64)
    n_u, n_v = (np.where(part["shape"] == Shape.RECTANGLE, n, 1) for n in (n_u, n_v))
    n = n_u * n_v
    which = np.repeat(np.arange(len(part)), n)
    tile = np.arange(len(which)) - (np.cumsum(n) - n)[which]
    out, n_u, n_v = part[which], n_u[which], n_v[which]
    out["u"] /= n_u[:, None]
    out["v"] /= n_v[:, None]
    out["origin"] += (tile % n_u)[:, None] * out["u"] + (tile // n_u)[:, None] * out["v"]
    return out


def boxes(part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) lower and (n, 3) upper corners of boxes that hold each patch."""
    ranges = np.array([(0, 1, 0, 0), (0, 1, 0, 0), (-1, 1, 0, 0), (-1, 1, 0, 1), (-1, 1, -1, 1), (-1, 1, -1, 1)])
    low_uv, high_uv, low_w, high_w = (column[:, None] for column in ranges[part["shape"]].T)
    lower, upper = part["origin"].copy(), part["origin"].copy()
    for name, low, high in (("u", low_uv, high_uv), ("v", low_uv, high_uv), ("w", low_w, high_w)):
        lower += np.minimum(low * part[name], high * part[name])
        upper += np.maximum(low * part[name], high * part[name])
    return lower, upper


def areas(part: np.ndarray) -> np.ndarray:
    """(n,) float64 surface areas, m². An ellipsoid's by Thomsen's formula (error below 1.1 %)."""
    flat = np.linalg.norm(np.cross(part["u"], part["v"]), axis=1)
    u, v, w = (np.linalg.norm(part[name], axis=1) for name in "uvw")
    slant = np.hypot(w, u * (1 - part["taper"]))
    p = 1.6075
    ellipsoid = 4 * np.pi * (((u * v) ** p + (u * w) ** p + (v * w) ** p) / 3) ** (1 / p)
    by_shape = [flat, flat / 2, np.pi * flat, np.pi * u * (1 + part["taper"]) * slant, ellipsoid, ellipsoid]
    return np.choose(part["shape"], by_shape)
