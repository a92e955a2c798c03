"""The synthetic city: counts, determinism, columns, bounds and exact repetition."""

import dataclasses

import numpy as np
import pytest
from splatpipe.shared.errors import InputError
from splatpipe.shared.points import concatenate, unpack_normals, unpack_rgb
from splatpipe.shared.synth import CityScan, write_las
from splatpipe.shared.synth.buildings import FLOOR_M, MODULE_M, facade, window
from splatpipe.shared.synth.city import city, is_draped
from splatpipe.shared.synth.primitives import (
    MATERIALS,
    Material,
    Shape,
    areas,
    blob,
    box,
    boxes,
    disc,
    frustum,
    join,
    rectangle,
    tiled,
    triangle,
    turned,
)
from splatpipe.shared.synth.sampling import Surfaces, allot
from splatpipe.shared.synth.scan import CHUNK_POINTS, RANGE_NOISE_M
from splatpipe.shared.synth.terrain import HIGHEST_M, LOWEST_M, height

N_POINTS = 2 * CHUNK_POINTS + 1234


@pytest.fixture(scope="module")
def scan():
    return CityScan(N_POINTS, seed=3)


@pytest.fixture(scope="module")
def points(scan):
    return next(scan.batches(N_POINTS))


def assert_same(a, b):
    assert np.array_equal(a.positions, b.positions)
    assert a.attributes.keys() == b.attributes.keys()
    for name, column in a.attributes.items():
        assert np.array_equal(column, b.attributes[name]), name


@pytest.mark.parametrize("n_points", [1, 7, CHUNK_POINTS, CHUNK_POINTS + 1])
def test_count_is_exact(n_points):
    batches = list(CityScan(n_points, extent_m=80).batches(10_000))
    assert sum(map(len, batches)) == n_points
    assert all(len(b) == 10_000 for b in batches[:-1])
    assert 0 < len(batches[-1]) <= 10_000


@pytest.mark.parametrize("max_points", [997, CHUNK_POINTS - 1, CHUNK_POINTS, 50_001])
def test_batching_changes_nothing(scan, points, max_points):
    assert_same(concatenate(list(scan.batches(max_points))), points)


def test_same_seed_same_points_other_seed_others(points):
    assert_same(next(CityScan(N_POINTS, seed=3).batches(N_POINTS)), points)
    other = next(CityScan(N_POINTS, seed=4).batches(N_POINTS))
    assert not np.array_equal(other.positions, points.positions)


@pytest.mark.parametrize("wanted", [(), ("rgb",), ("intensity", "classification"), ("normal", "return_number")])
def test_leaving_out_columns_changes_no_other(scan, points, wanted):
    found = next(scan.batches(N_POINTS, wanted))
    assert_same(found, dataclasses.replace(points, attributes={k: points.attributes[k] for k in found.attributes}))
    assert set(found.attributes) == set(wanted)


def test_columns_are_valid(scan, points):
    points.check()
    assert tuple(points.attributes) == scan.info.attributes
    assert np.isfinite(points.positions).all()
    assert np.allclose(np.linalg.norm(unpack_normals(points.attributes["normal"]), axis=1), 1, atol=1e-6)
    assert set(np.unique(points.attributes["classification"])) == {1, 2, 5, 6, 9, 11}
    assert set(np.unique(points.attributes["return_number"])) == {1, 2, 3}
    intensity = points.attributes["intensity"]
    assert intensity.min() > 0
    assert intensity.max() <= 65535
    assert np.array_equal(intensity, np.rint(intensity))
    rgb = unpack_rgb(points.attributes["rgb"])
    assert (rgb[:, 3] == 255).all()
    assert (rgb[:, :3].std(axis=0) > 30).all()


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (6.4e6, -6.4e6, 6.4e6)])
def test_bounds_hold_every_point_and_little_else(offset):
    scan = CityScan(N_POINTS, seed=3, offset=offset)
    positions = next(scan.batches(N_POINTS, ())).positions
    lower, upper = scan.info.lower, scan.info.upper
    assert (positions >= lower).all()
    assert (positions <= upper).all()
    assert (positions.min(axis=0) - lower < 1.0).all()
    assert (upper - positions.max(axis=0) < 1.0).all()


def test_an_offset_moves_the_city_and_changes_nothing_else(points):
    offset = np.array([4096.0, -8192.0, 1024.0])
    moved = next(CityScan(N_POINTS, seed=3, offset=offset).batches(N_POINTS))
    assert np.abs(moved.positions - offset - points.positions).max() < 1e-11
    assert all(np.array_equal(moved.attributes[k], points.attributes[k]) for k in points.attributes)


def test_ground_lies_on_the_terrain_and_nothing_but_water_below(points):
    x, y, z = points.positions.T
    above = z - height(x, y)
    is_water = points.attributes["classification"] == 9
    assert above[~is_water].min() > -0.5  # the bank of the pond
    road = above[points.attributes["classification"] == 11]
    assert np.abs(road).max() < 0.02 + 6 * RANGE_NOISE_M
    span = np.linspace(0, 500, 400)
    terrain = height(span[:, None], span)
    assert terrain.min() >= LOWEST_M
    assert terrain.max() <= HIGHEST_M + 1e-12


def test_a_larger_city_has_whole_blocks():
    upper = [CityScan(1000, extent_m=e).info.upper[0] for e in (1, 100, 225, 300)]
    assert np.allclose(upper, [81, 81, 225, 297], atol=0.1)


def test_bays_of_a_facade_repeat_exactly():
    """The points of equal windows differ by whole modules and floors, and by nothing else."""
    bays, floors = 5, 4
    front = facade([window()] * bays, floors, window())
    per_bay = len(window())
    which = np.repeat(np.arange(len(front)), 9)
    index = np.tile(np.arange(9), len(front))
    positions, normals, _ = Surfaces(front).points(which, index)
    cells = positions.T.reshape(bays * floors, per_bay * 9, 3)
    column, storey = np.arange(bays * floors) % bays, np.arange(bays * floors) // bays
    shift = np.column_stack([column * MODULE_M, 0 * column, storey * FLOOR_M])
    assert np.abs(cells - shift[:, None] - cells[0]).max() < 1e-12
    assert np.array_equal(
        normals.T.reshape(cells.shape), np.broadcast_to(normals.T.reshape(cells.shape)[0], cells.shape)
    )


def test_city_repeats_its_parts():
    """Panes of few kinds make up all windows, and equal panes of one façade get equal counts but for one point."""
    primitives = city(1, 3)
    panes = primitives["material"] == Material.GLASS
    sizes = np.round(np.column_stack([np.abs(primitives[k][panes]).sum(axis=1) for k in "uv"]), 6)
    kinds, counts = np.unique(sizes, axis=0, return_counts=True)
    assert panes.sum() > 2000
    assert len(kinds) < 12
    n = np.diff(allot(primitives, 2_000_000))[panes]
    for kind in kinds[counts > 10]:
        of_kind = n[(sizes == kind).all(axis=1)]
        assert np.ptp(of_kind) <= 1


def test_points_are_spread_by_area_and_weight():
    part = join(
        rectangle(Material.WALL, (0, 0, 0), (2, 0, 0), (0, 0, 1)),
        rectangle(Material.KERB, (5, 0, 0), (2, 0, 0), (0, 0, 1)),
    )
    n = np.diff(allot(part, 3001))
    assert n.sum() == 3001
    assert n[1] / n[0] == pytest.approx(MATERIALS[Material.KERB].weight, rel=1e-2)


SHAPES = {
    "rectangle": (rectangle(Material.WALL, (1, 2, 3), (2, 0, 0), (0, 1, 1)), 2 * np.sqrt(2)),
    "triangle": (triangle(Material.WALL, (0, 0, 0), (2, 0, 0), (0, 3, 0)), 3.0),
    "disc": (disc(Material.WALL, (1, 1, 1), (2, 0, 0), (0, 3, 0)), 6 * np.pi),
    "cylinder": (frustum(Material.WALL, (0, 0, 0), 2.0, (0, 0, 5)), 20 * np.pi),
    "cone": (frustum(Material.WALL, (0, 0, 0), 3.0, (0, 0, 4), 0.0), 15 * np.pi),
    "sphere": (blob(Material.WALL, (0, 0, 0), (2, 2, 2)), 16 * np.pi),
    "ellipsoid": (
        blob(Material.WALL, (0, 0, 0), (3, 1, 1)),
        2 * np.pi * (1 + 9 / 8**0.5 * np.arcsin(8**0.5 / 3)),
    ),  # prolate
}


@pytest.mark.parametrize("name", SHAPES)
def test_area_box_and_normals_of_a_shape(name):
    part, area = SHAPES[name]
    assert areas(part)[0] == pytest.approx(area, rel=0.012)
    n = 4000
    positions, normals, patch = Surfaces(part).points(np.zeros(n, np.int64), np.arange(n))
    lower, upper = boxes(part)
    assert (lower - 1e-12 <= positions.T).all()
    assert (upper + 1e-12 >= positions.T).all()
    assert np.allclose((normals**2).sum(axis=0), 1)
    assert patch.min() >= 0
    assert patch.max() < 1
    if name == "cone":
        assert np.allclose(normals[2], 0.6)  # 3-4-5
        # half of the area lies below 1 − √½ of the height
        assert (positions[2] < 4 * (1 - np.sqrt(0.5))).mean() == pytest.approx(0.5, abs=0.01)
    if name == "sphere":
        assert np.allclose(positions, 2 * normals)


def test_box_faces_look_outwards():
    part = box(Material.WALL, (0, 0, 0), (1, 2, 3), "xXyYzZ")
    middle = part["origin"] + (part["u"] + part["v"]) / 2
    assert (np.sum((middle - (0.5, 1, 1.5)) * part["w"], axis=1) > 0).all()
    assert areas(part).sum() == pytest.approx(22)
    back = turned(turned(part, 3), 1)
    assert all(np.array_equal(back[k], part[k]) for k in ("origin", "u", "v", "w"))


def test_tiles_cover_the_same_patch():
    part = join(
        rectangle(Material.WALL, (1, 0, 0), (20, 0, 0), (0, 0, 0.5)),
        disc(Material.WALL, (0, 0, 0), (50, 0, 0), (0, 50, 0)),
    )
    tiles = tiled(part, largest_m=6, slimmest=4)
    assert len(tiles) == 10 + 1
    assert areas(tiles).sum() == pytest.approx(areas(part).sum())
    lower, upper = boxes(tiles[:10])
    assert np.allclose(lower.min(axis=0), (1, 0, 0))
    assert np.allclose(upper.max(axis=0), (21, 0, 0.5))


def test_every_primitive_is_sound():
    primitives = city(2, 2)
    assert np.isfinite(areas(primitives)).all()
    assert (areas(primitives) > 0).all()
    assert (primitives["taper"] <= 1).all()
    assert set(np.unique(primitives["shape"])) == set(Shape)
    assert is_draped(primitives).any()
    assert ((primitives["colour"] >= 0) & (primitives["colour"] <= 1)).all()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_written_file_holds_the_points(tmp_path, suffix):
    import laspy

    offset = (6.4e6, 5.0e5, 100.0)
    scan = CityScan(5000, extent_m=80, offset=offset)
    path = tmp_path / f"city{suffix}"
    write_las(scan, path)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    las = laspy.read(path)
    points = next(scan.batches(5000))
    assert np.abs(las.xyz - points.positions).max() <= 0.0005 + 1e-8
    rgb = np.column_stack([las.red, las.green, las.blue])
    assert np.array_equal(rgb >> 8, unpack_rgb(points.attributes["rgb"])[:, :3])
    for name in ("intensity", "classification", "return_number"):
        assert np.array_equal(np.asarray(las[name]), points.attributes[name]), name
    assert (np.asarray(las.number_of_returns) >= np.asarray(las.return_number)).all()


def test_unwritable_or_unknown_files_are_refused(tmp_path):
    scan = CityScan(100, extent_m=80)
    with pytest.raises(InputError, match=r"expected \.las or \.laz"):
        write_las(scan, tmp_path / "city.xyz")
    with pytest.raises(InputError, match="cannot be written"):
        write_las(scan, tmp_path / "missing" / "city.las")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "wrong",
    [
        {"n_points": 0},
        {"seed": -1},
        {"extent_m": 0},
        {"extent_m": 1e6},
        {"extent_m": np.nan},
        {"offset": (0, np.inf, 0)},
        {"offset": (0, 0)},
    ],
)
def test_values_out_of_range_are_refused(wrong):
    with pytest.raises(InputError, match=f"synth: {next(iter(wrong))} = .*expected"):
        CityScan(**{"n_points": 10, **wrong})
