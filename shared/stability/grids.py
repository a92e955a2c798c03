"""Keys, cell centres and packed normals at the ends of their ranges, against integers, rationals and float64."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from ..build.morton import keys_of, root_cube
from ..build.parallel import Workers
from ..octree import MAX_LEVEL, cell_centers, cell_coordinates
from ..points import NO_NORMAL, pack_normals, unpack_normals
from .case import case, cases, expect

_CUBES = {"unit": (0.0, 1.0), "6.4e6 m away": (6.4e6, 200.0), "1e9 m away": (1e9, 200.0), "1e-9 m": (1 / 3, 1e-9)}


@cases("grid/cell of a point", bounds=dict.fromkeys((*_CUBES,), 0.0), unit="points")
def cell_of_a_point(name: str) -> float:
    """Points whose key is more than one deepest cell off the cell that rational arithmetic puts them in, and points
    exactly on a face of level 10 whose key is off at all (a face belongs to the cell above it), at four places.
    """
    corner, extent = _CUBES[name]
    origin, edge = root_cube(np.full(3, corner), np.full(3, corner + extent))
    rng = np.random.default_rng(53)
    inside = corner + rng.uniform(0, extent, (500, 3))
    faces = origin + rng.integers(0, 1023, (500, 3)) * (edge / 1024)
    with Workers(1) as workers:
        found = cell_coordinates(keys_of(np.concatenate([inside, faces]), origin, edge, workers).astype(np.uint64))
    cells = Fraction(2**MAX_LEVEL) / Fraction(edge)

    def off(points: np.ndarray, keys: np.ndarray) -> np.ndarray:
        exact = [[int((Fraction(p) - Fraction(o)) * cells) for p, o in zip(row, origin, strict=True)] for row in points]
        return np.abs(np.array(exact) - keys).max(axis=1)

    return int((off(inside, found[:500]) > 1).sum() + (off(faces, found[500:]) > (0 if corner == 0 else 1)).sum())


@cases("grid/centre of a cell", bounds=dict.fromkeys((*_CUBES,), 1.0), unit="float64 steps")
def center_of_a_cell(name: str) -> float:
    """Centres of 500 cells of every level against rationals, in float64 steps of the coordinate."""
    corner, extent = _CUBES[name]
    origin, edge = root_cube(np.full(3, corner), np.full(3, corner + extent))
    rng = np.random.default_rng(59)
    level = rng.integers(0, MAX_LEVEL + 1, 500)
    code = rng.integers(0, 2**63, 500).astype(np.uint64) >> (np.uint64(3) * (21 - level).astype(np.uint64))
    found, grid = cell_centers(origin, edge, level, code), cell_coordinates(code)
    worst = 0.0
    for i in range(len(code)):
        size = Fraction(edge) / 2 ** int(level[i])
        for axis in range(3):
            exact = Fraction(float(origin[axis])) + (int(grid[i, axis]) + Fraction(1, 2)) * size
            worst = max(worst, abs(float(Fraction(float(found[i, axis])) - exact)) / np.spacing(abs(float(exact))))
    return worst


@cases("normals/length", bounds=dict.fromkeys((1e-320, 1e-300, 1e-3, 1.0, 1e300), 0.004), unit="degrees")
def normals(length: float) -> float:
    """Angle between a normal of this length and the same after packing; at 1e-320 only along the axes (a denormal has
    no more digits).
    """
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    if length > 1e-310:
        directions = np.concatenate([directions, np.random.default_rng(61).normal(size=(20_000, 3))])
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    back = unpack_normals(pack_normals(directions * length)).astype(np.float64)
    sine = np.linalg.norm(np.cross(directions, back), axis=1)
    expect(((directions * back).sum(axis=1) > 0).all(), "no normal is turned round")
    return float(np.degrees(np.arcsin(sine)).max())


@case("normals/none", bound=0.0, unit="normals")
def no_normal() -> float:
    """Zero and non-finite normals that are not packed as "no normal"."""
    bad = np.array([[0, 0, 0], [-0.0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0], [1, -np.inf, np.nan]])
    return int((pack_normals(bad) != NO_NORMAL).sum())
