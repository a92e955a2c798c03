"""What ``splatpipe bench codecs`` measures on: cells of scenes, as grid points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ...nodes.raster import ResidentPoints
from ...shared.build import BuildSettings, build_scene
from ...shared.camera import Camera
from ...shared.codecs.grid import to_grid
from ...shared.config import RunConfig
from ...shared.octree import Octree
from ...shared.readers import Source, expand_inputs, open_source
from ...shared.scene_info import SCENE_FILE
from ...shared.synth.sphere import SphereScan
from ..job import Job


@dataclass(frozen=True)
class Cell:
    """The points of a cell, those that share a grid point left out but for one.

    positions : (n, 3) float64, relative to the cube's lower corner, world units, as exact as they are stored.
    points : (n, 3) uint32 grid points, all different.  colour : (n,) uint32 colour words.
    lower : (3,) float64, lower corner of the cube, world frame.  edge : of the cube, world units.
    """

    positions: np.ndarray
    points: np.ndarray
    colour: np.ndarray
    lower: np.ndarray
    edge: float


@dataclass(frozen=True)
class CellScene:
    """Some cells of a scene, and a camera that looks at all of it.

    extent : longest side of the scene's bounding box, world units.  n_owners : cells that own points.
    n_stored : points of the chosen cells, those that share a grid point included.
    """

    name: str
    cells: list[Cell]
    camera: Camera
    extent: float
    n_owners: int
    n_stored: int


@contextmanager
def scene_paths(inputs: Sequence[str], n_default: int, points_per_cell: int) -> Iterator[list[tuple[str, Path]]]:
    """(name, scene directory) of each scene, and of each point file, built for as long as this is open. Names differ.

    n_default : points of the generated surface that stands in where there are no inputs.
    Raises InputError for what is neither.
    """
    with TemporaryDirectory(prefix="splatpipe-bench-") as folder:
        sources: list[tuple[str, Source | Path]] = []
        for text in inputs:
            path = Path(text)
            if (path / SCENE_FILE).is_file():
                sources.append((path.stem, path))
            else:
                sources += [(file.stem, open_source(file)) for file in expand_inputs([text])]
        if not inputs:
            sources.append(("sphere", SphereScan(n_default)))
        scenes = []
        for i, (name, source) in enumerate(sources):
            if isinstance(source, Source):
                path = Path(folder) / f"{i}.scene"
                build_scene([source], path, settings=BuildSettings(points_per_cell=points_per_cell))
                source = path
            same = sum(taken.split(" (")[0] == name for taken, _ in scenes)
            scenes.append((f"{name} ({same + 1})" if same else name, source))
        yield scenes


def load_cells(name: str, path: Path, *, bits: int, most_cells: int, leaves: bool, size: int) -> CellScene:
    """At most ``most_cells`` cells of a scene, evenly spread over the stored order, on grids of ``bits`` bits an axis.

    leaves : leaves only, else whatever cell owns points.  size : width and height of the camera's image, pixels.
    Raises StoreError.  Memory: 52 bytes a point of the chosen cells.
    """
    job = Job(
        RunConfig.model_validate(
            {
                "scene": {"path": str(path), "verify": False},
                "camera": {"width": size, "height": size},
                "render": {"rasterizer": "cpu", "positions": "compact"},
                "output": {"frames": 1},
            }
        )
    )
    octree = job.scene.octree()
    points = job.load_points(verify=False)
    owners = octree.n_points > 0 if octree.point_order == "layered" else octree.is_leaf
    chosen = np.flatnonzero(owners & octree.is_leaf if leaves else owners)
    chosen = chosen[np.argsort(octree.first_point[chosen])]
    if len(chosen) > most_cells:
        chosen = chosen[np.linspace(0, len(chosen) - 1, most_cells).round().astype(int)]
    info = job.scene.info
    return CellScene(
        name,
        [_cell(points, octree, int(cell), bits) for cell in chosen],
        job.camera(0),
        float(np.max(np.subtract(info.upper, info.lower))),
        int(owners.sum()),
        int(octree.n_points[chosen].sum()),
    )


def _cell(points: ResidentPoints, octree: Octree, cell: int, bits: int) -> Cell:
    first = int(octree.first_point[cell])
    own = slice(first, first + int(octree.n_points[cell]))
    edge = float(np.ldexp(octree.edge, -int(octree.level[cell])))
    lower = octree.centers[cell] - edge / 2
    block = np.searchsorted(points.block_first_point, first, side="right") - 1
    stored = np.column_stack([points.x[own], points.y[own], points.z[own]]).astype(np.float64)
    positions = stored + (points.block_origin[block] - lower)
    grid = to_grid(positions, np.zeros(3), edge, bits)
    _, different = np.unique(grid, axis=0, return_index=True)
    different.sort()  # the stored order
    return Cell(positions[different], grid[different], np.asarray(points.colour[own])[different], np.array(lower), edge)
