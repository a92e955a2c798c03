"""Normals, splat radii and cell features where neighbourhoods are degenerate, tiny, huge or far from the origin."""

from __future__ import annotations

import numpy as np

from ..build.features import classify
from ..build.morton import keys_of, root_cube
from ..build.neighbours import SurfaceRule, add_surface, plane_normals
from ..build.parallel import Workers
from ..octree import EDGE, FLAT
from ..points import NO_NORMAL, PointBatch, radius_table, unpack_normals
from .case import case, cases, expect, fifty_digits

_N = 4000


def _sphere(n: int = _N) -> np.ndarray:
    """(n, 3) float64 points at random on a sphere of radius 1, in steps of 2**-20 so that moves by powers are exact."""
    points = np.random.default_rng(71).normal(size=(n, 3))
    return np.round(points / np.linalg.norm(points, axis=1)[:, None] * 2**20) / 2**20


def _surface(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((n,) normal words, (n,) radii) as a build makes them."""
    lower, upper = positions.min(axis=0), positions.max(axis=0)
    origin, edge = root_cube(lower, upper)
    rule = SurfaceRule(normals=True, radii=True, origin=origin, edge=edge, up=None, center=(lower + upper) / 2)
    with Workers(1) as workers:
        made = add_surface(PointBatch(positions), keys_of(positions, origin, edge, workers), rule, workers)
    return made.attributes["normal"], radius_table(edge)[made.attributes["radius"]]


def _degrees(a: np.ndarray, b: np.ndarray) -> float:
    """Largest angle between rows."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))).max())


@cases("neighbours/moved by", bounds={2.0**23: 0.0, 2.0**30: 0.0}, unit="points")
def moved(by: float) -> float:
    """Points of a sphere whose normal or radius is not the same bits after an exact move by this many metres."""
    points = _sphere()
    expect(np.array_equal(points + by - by, points), "the move is exact")
    here, there = _surface(points), _surface(points + by)
    return int(((here[0] != there[0]) | (here[1] != there[1])).sum())


@case("neighbours/sphere 1e7 m away", bound=6.0, unit="degrees")
def far_away() -> float:
    """Normals of a sphere of radius 1 m, 1e7 m from the origin, against the exact ones: the error is that of 4000
    points, the same as at the origin.
    """
    words, _ = _surface(_sphere() + 1e7)
    return _degrees(unpack_normals(words).astype(float), _sphere())


@cases("neighbours/scale", bounds={1e-150: 0.0, 1e-6: 0.0, 1e6: 0.0, 1e29: 0.0}, unit="degrees")
def scale(factor: float) -> float:
    """Angle between normals of a sphere made larger by about this factor (a power of two) and not."""
    points = _sphere()
    by = 2.0 ** np.round(np.log2(factor))
    words, radii = _surface(points * by)
    here = _surface(points)
    expect(factor < 1e-100 or np.array_equal(radii, here[1] * by), "radii grow with the scene")
    return _degrees(unpack_normals(words).astype(float), unpack_normals(here[0]).astype(float))


_NO_PLANE = {
    "one point": np.zeros((1, 3)),
    "two points": np.eye(3)[:2],
    "coincident": np.full((500, 3), 1e7),
    "on an axis": np.linspace(0, 1, 500)[:, None] * [0.0, 1.0, 0.0],
    "on a diagonal": np.linspace(0, 1, 500)[:, None] * [0.6, -0.3, 1.0] + 1e7,
    "on two spots": np.repeat(np.eye(3)[:2], 250, axis=0),
}


@cases("neighbours/no plane", bounds=dict.fromkeys(_NO_PLANE, 0.0), unit="points")
def no_plane(name: str) -> float:
    """Points that get a normal, or a radius that is not a finite number ≥ 0 and at most the root cube's edge."""
    positions = _NO_PLANE[name]
    words, radii = _surface(positions)
    edge = root_cube(positions.min(axis=0), positions.max(axis=0))[1]
    return int(((words != NO_NORMAL) | ~((radii >= 0) & (radii <= edge))).sum())


@cases("neighbours/nearly on a line", bounds={1e-2: 1e-4, 2e-3: 1e-3}, unit="degrees")
def nearly_a_line(width: float) -> float:
    """Normal of the plane through 17 points this wide for their length of 1, turned and 1e3 m away, against the
    eigenvector of the same float64 offsets in 50 digits.
    """
    mp = fifty_digits()
    rng = np.random.default_rng(73)
    worst = 0.0
    for _ in range(10):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        points = rng.uniform(-0.5, 0.5, (17, 3)) * [1.0, width, 0.0] @ turn.T + 1e3
        found = plane_normals(points, np.arange(17)[None], True, np.zeros(3))[0]
        offsets = [[mp.mpf(float(v)) for v in row] for row in points - points[0]]
        mean = [sum(row[a] for row in offsets) / 17 for a in range(3)]
        central = [[row[a] - mean[a] for a in range(3)] for row in offsets]
        covariance = mp.matrix([[sum(row[a] * row[b] for row in central) for b in range(3)] for a in range(3)])
        _, vectors = mp.eigsy(covariance)
        exact = np.array([float(vectors[a, 0]) for a in range(3)])
        worst = max(worst, _degrees(found[None], exact[None] * np.sign(found @ exact)))
    return worst


@case("neighbours/outlier", bound=8.0, unit="of the median")
def outlier() -> float:
    """Radius of the splat of a point a thousand spacings from a plane, against the median."""
    plane = np.random.default_rng(79).uniform(0, 1, (_N, 3)) * [1, 1, 0]
    _, radii = _surface(np.concatenate([plane, [[0.5, 0.5, 1000 / np.sqrt(_N)]]]))
    return float(radii[-1] / np.median(radii))


@case("neighbours/duplicates", bound=0.0, unit="points")
def duplicates() -> float:
    """Points of a sphere, each up to 40 times, whose normal or radius differs from that of the points taken once."""
    again = np.repeat(np.arange(_N), np.random.default_rng(83).integers(1, 40, _N))
    once, found = _surface(_sphere()), _surface(_sphere()[again])
    return int(((found[0] != once[0][again]) | (found[1] != once[1][again])).sum())


_GRID = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
_FOLDED = np.where(_GRID[:, :1] > 3.5, _GRID[:, [2, 1, 0]] + [3.5, 0, -3.5], _GRID)


@cases("features/scale", bounds={1e-150: 0.0, 1e-20: 0.0, 1.0: 0.0, 1e20: 0.0}, unit="verdicts")
def feature_scale(factor: float) -> float:
    """Wrong verdicts on a flat grid, a right-angled edge and points in one place, of this size."""
    wrong = 0
    for points, expected in ((_GRID, FLAT), (_FOLDED, EDGE), (_GRID * 0, 0)):
        quad = np.zeros((3, 3))
        wrong += classify(points * factor, np.full(len(points), 1.8 * factor), quad) != expected
        wrong += not np.isfinite(quad).all()
    return wrong


@cases("features/radius", bounds={0.0: 0.0, 1e-300: 0.0, 1e-9: 0.0, 1e30: 0.0}, unit="verdicts")
def feature_radius(radius: float) -> float:
    """Wrong verdicts on a flat grid of spacing 1 whose splats have this radius: a quad only where splats meet."""
    quad = np.zeros((3, 3))
    found = classify(_GRID, np.full(len(_GRID), radius), quad)
    return int(found != (FLAT if radius > 0.5 else 0)) + int(not np.isfinite(quad).all())
