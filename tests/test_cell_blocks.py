"""Blocks as single cells: no point moves, and the spacing of each is that of its neighbours."""

import numpy as np
import pytest
from build_sources import ArraySource
from scipy.spatial import cKDTree
from splatpipe.nodes.cell_blocks import HEAD_POINTS, NEIGHBOUR, SAMPLES, cell_blocks, cell_spacing
from splatpipe.nodes.render import Wanted, load_points
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.colour import Colouring
from splatpipe.shared.store import Scene

SHIFT = 6.4e6


def scene_of(cloud, path, order="layered", points_per_cell=300):
    settings = BuildSettings(point_order=order, points_per_cell=points_per_cell, threads=1)
    build_scene([ArraySource(cloud)], path, settings=settings)
    return Scene.open(path)


def blob(n=4000):
    """A curved sheet with outliers, far from the origin."""
    rng = np.random.default_rng(3)
    u, v = rng.uniform(-1, 1, (2, n))
    sheet = np.column_stack([u, v, 0.3 * np.sin(3 * u)])
    return np.concatenate([sheet, rng.uniform(-1, 1, (20, 3))]) + SHIFT


def spacing_twin(scene, octree, cells):
    """By a tree of each cell's head instead of by comparing all pairs; float64."""
    columns = np.column_stack(scene.positions()).astype(np.float64)
    out = []
    for cell in cells:
        first, n = int(octree.first_point[cell]), int(octree.n_points[cell])
        head = columns[first : first + min(n, HEAD_POINTS)]
        if len(head) > NEIGHBOUR:
            distance = cKDTree(head).query(head[:SAMPLES], NEIGHBOUR + 1)[0][:, -1]
            out.append(np.median(distance**2) ** 0.5 * (len(head) / n) ** 0.5)
        else:
            parent = max(int(octree.parent[cell]), 0)
            share = min(4 * octree.n_below[cell] / octree.n_below[parent], 1)
            out.append(2 * octree.half_edges[cell] * (share / n) ** 0.5)
    return np.array(out)


@pytest.mark.parametrize("order", ["layered", "depth-first"])
def test_blocks_are_the_cells_that_own_points_and_no_point_moves(tmp_path, order):
    scene = scene_of(blob(), tmp_path / "s.scene", order, points_per_cell=30)
    octree = scene.octree()
    first, origin, cells = cell_blocks(scene, octree)
    owners = np.flatnonzero(octree.n_points > 0 if order == "layered" else octree.is_leaf)
    assert sorted(cells) == owners.tolist()
    np.testing.assert_array_equal(first, octree.first_point[cells])
    np.testing.assert_array_equal(np.diff(first, append=scene.info.n_stored), octree.n_points[cells])
    index = np.arange(scene.info.n_stored)
    stored_first, stored_origin = scene.blocks()
    stored = stored_origin[np.searchsorted(stored_first, index, side="right") - 1]
    np.testing.assert_array_equal(origin[np.searchsorted(first, index, side="right") - 1], stored)


@pytest.mark.parametrize("order", ["layered", "depth-first"])
@pytest.mark.parametrize("points_per_cell", [4, 300])
def test_the_spacing_equals_its_twin(tmp_path, order, points_per_cell):
    scene = scene_of(blob(1000), tmp_path / "s.scene", order, points_per_cell)
    octree = scene.octree()
    _, _, cells = cell_blocks(scene, octree)
    np.testing.assert_allclose(cell_spacing(scene, octree, cells), spacing_twin(scene, octree, cells), rtol=1e-5)


def test_the_spacing_of_a_grid_is_its_diagonal_and_outliers_do_not_blow_up(tmp_path):
    """Half a cell of grid and a lone point far off: a surface that filled its cube would be told nothing by either."""
    u, v = np.meshgrid(np.arange(64.0), np.arange(30.0))
    grid = np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)])
    scene = scene_of(np.concatenate([grid, [[63.0, 63.0, 63.0]]]), tmp_path / "s.scene", points_per_cell=100)
    octree = scene.octree()
    _, _, cells = cell_blocks(scene, octree)
    spacing = cell_spacing(scene, octree, cells)
    full = octree.is_leaf[cells] & (octree.n_points[cells] > NEIGHBOUR)
    assert full.sum() > 20
    assert np.median(spacing[full]) == pytest.approx(2**0.5, rel=0.01)
    alone = octree.n_points[cells] == 1
    assert alone.any()
    assert (spacing[alone] < octree.half_edges[cells][alone]).all()


def test_only_what_is_wanted_is_loaded(tmp_path):
    scene = scene_of(blob(500), tmp_path / "s.scene")
    colouring = Colouring.choose(scene, "elevation")
    by_block, by_cell, spaced = (
        load_points(scene, colouring, wanted, verify=False)
        for wanted in (Wanted(), Wanted(cells=True), Wanted(cells=True, spacing=True))
    )
    assert by_block.block_spacing is None
    assert by_cell.block_spacing is None
    assert spaced.block_spacing is not None
    assert len(spaced.block_spacing) == len(spaced.block_first_point) == len(by_cell.block_first_point)
    np.testing.assert_array_equal(by_block.x, spaced.x)
