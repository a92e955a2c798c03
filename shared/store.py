"""The scene store: a directory of plain ``.npy`` arrays with a ``scene.json``.

====================================  =========  ======================================================
array                                 dtype      content
====================================  =========  ======================================================
cell_level … cell_n_below, cell_cone  see below  the sequential octree (``octree.Octree``), breadth-first
cell_area                             float32    surface in each cell, in layered order (``build.sets``)
cell_feature, cell_quad               see below  what cells look like, where the build was asked for it
x, y, z                               float32    stored points, relative to the origin of their block
attr_NAME                             see        one column per attribute (``points.ATTRIBUTES``)
block_first_point                     int64      blocks of the point-array: first point, ascending from 0
block_origin                          float64    (b, 3) world origin of each block
cell_position_bytes, position_codes   <u4, u1    coded positions in place of x, y, z: bytes of each cell's code, and
                                                 the codes of the cells that own points, in stored order
cell_pool_points, cell_pool_bytes     <u4        pooled form of each cell: distinct points, and bytes; 0 for none
pool_codes                            u1         the pooled forms (``codecs.streams``), in stored order of their cells
====================================  =========  ======================================================

Opening reads ``scene.json`` and the arrays' headers only. Nothing is unpickled, and no length is believed before it is
held against the size of the file.

Format versions
    1. The first.
    2. Attribute ``radius``; ``cell_feature``, ``cell_quad`` and the key ``features`` that says whether they are there.
       Layered: sets in stratified order, and ``cell_area``.
    3. Coded positions and pooled cells, and the keys that say whether they are there.
"""

from __future__ import annotations

import os
import weakref
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .array_source import ArrayFiles, ArraySource, Column, ReadColumn
from .errors import CodecError, StoreError
from .octree import FEATURES, MAX_LEVEL, Octree
from .scene_info import CELL_ARRAYS, SCENE_FILE, ArrayInfo, SceneInfo, parse_info

if TYPE_CHECKING:
    from .coded_positions import CodedPositions

PositionReader = Callable[[int, int], np.ndarray]
"""(3, stop − start) float32 of the stored points ``start`` … ``stop`` − 1."""

_CHUNK = 1 << 22
_POSITION_BYTES = 12


class Scene:
    """A scene. Get one on disk by ``Scene.open``; nothing is held open between calls, so there is nothing to close.

    path : the directory; of a scene that stands on other arrays, what errors call it.  info : ``SceneInfo``.
    arrays : where its arrays come from; default: the files of the directory.
    mapped : whether ``column`` maps files, or reads them.
    """

    def __init__(self, path: Path, info: SceneInfo, arrays: ArraySource | None = None, *, mapped: bool = True) -> None:
        self.path = path
        self.info = info
        self.mapped = mapped
        self._arrays = ArrayFiles(path, info) if arrays is None else arrays
        self._decoded: Callable[[], np.ndarray | None] = lambda: None

    @classmethod
    def open(cls, path: str | Path, *, mapped: bool = True) -> Scene:
        """The scene in directory ``path``, checked as far as sizes and headers go. Cost: a few milliseconds.

        mapped : whether ``column`` maps files, or reads them.
        Raises StoreError if it is missing, of a newer version, or an array's header or size is not as promised.
        """
        path = Path(path)
        info = parse_info(path / SCENE_FILE)
        files = ArrayFiles(path, info)
        files.check_sizes()
        return cls(path, info, files, mapped=mapped)

    def octree(self, *, features: bool = False, pools: bool = False) -> Octree:
        """The cells in memory, checksums and links checked, so that kernels may index by them unchecked.

        features : load what they look like as well.  pools : load the sizes of their pooled forms as well.
        Raises StoreError naming the array or the rule that is broken, or if the scene was built without those.
        Cost: 43 bytes and about 0.2 µs a cell, 37 bytes more with features, 8 with pools.
        """
        if features and not self.info.features:
            raise StoreError(f"{self.path}: no features of cells: build it with --features")
        if pools and not self.info.pool_bits:
            raise StoreError(f"{self.path}: no pooled cells: build it with --pools")
        left_out = ["cell_position_bytes"]  # of the positions alone
        left_out += [] if features else ["cell_feature", "cell_quad"]
        left_out += [] if pools else ["cell_pool_points", "cell_pool_bytes"]
        arrays = {
            name.removeprefix("cell_"): self._load_checked(name)
            for name in CELL_ARRAYS
            if name in self.info.arrays and name not in left_out
        }
        cone, area = arrays.pop("cone", None), arrays.pop("area", None)
        octree = Octree(
            origin=np.array(self.info.origin),
            edge=self.info.edge,
            cone=cone,
            area=area,
            point_order=self.info.point_order,
            pool_bits=self.info.pool_bits if pools else 0,
            **arrays,
        )
        check_octree(octree, self.info, self.path)
        return octree

    def positions(self, mmap: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x, y, z: (n_stored,) float32 relative to their block's origin, read-only.

        float32 : memory maps of the files, or read whole.
        Coded : decoded on all cores, 12 bytes a point in memory, which stay there while any of the three columns is in
        use; asked for meanwhile, they are not decoded again. About 0.2 µs a point of one core for ci and eci, 2 µs for
        occupancy.
        Raises StoreError naming the array, and the cell whose code is damaged.
        """
        if not self.info.coded:
            return self._load("x", mmap), self._load("y", mmap), self._load("z", mmap)
        columns = self._decoded()
        if columns is None:
            columns = self.position_reader()(0, self.info.n_stored)
            columns.flags.writeable = False
            self._decoded = weakref.ref(columns)
        return columns[0], columns[1], columns[2]

    def position_reader(self) -> PositionReader:
        """``positions`` of any range of stored points, (3, n) float32, in no more memory than the range takes.

        Of coded positions, the cells in the range are decoded at each call, those that lie in it partly whole.
        Raises StoreError as ``positions`` does, and so does the reader.
        """
        if not self.info.coded:
            columns = self.positions()
            return lambda start, stop: np.stack([column[start:stop] for column in columns])
        coded, threads = self.coded_positions(), len(os.sched_getaffinity(0))
        memory_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")

        def read(start: int, stop: int) -> np.ndarray:
            if _POSITION_BYTES * (stop - start) > memory_bytes:  # what repeats takes hardly a byte of code
                raise StoreError(
                    f"{self.path}/position_codes.npy: found {stop - start} points, expected as many as fit into the "
                    f"{memory_bytes} bytes of this machine's memory"
                )
            try:
                return coded.columns(start, stop, threads)
            except CodecError as error:
                raise StoreError(f"{self.path}/position_codes.npy: {error}") from error

        return read

    def coded_positions(self) -> CodedPositions:
        """The positions as they are coded, mapped; cells and their byte counts are checked, the codes are not.

        Raises StoreError naming the array or the rule that is broken, or if positions are float32.
        Cost: that of ``octree`` and ``blocks``.
        """
        from .coded_positions import CodedPositions, OwnerCells

        info = self.info
        if not info.coded:
            raise StoreError(f"{self.path}: positions are float32, expected coded ones: build it with --positions")
        octree = self.octree()
        cells = OwnerCells.of(octree, *self.blocks())
        n_bytes = self._load_checked("cell_position_bytes")
        owned = np.zeros(len(octree), bool)
        owned[cells.cell] = True
        if ((n_bytes > 0) != owned).any():
            bad = int(np.flatnonzero((n_bytes > 0) != owned)[0])
            rule = "a cell that owns no points" if n_bytes[bad] else "no code for a cell that owns points"
            raise StoreError(f"{self.path}/cell_position_bytes.npy: entry {bad}: found {n_bytes[bad]}, {rule}")
        first_byte = np.append(0, np.cumsum(n_bytes[cells.cell], dtype=np.int64))
        if first_byte[-1] != info.position_bytes:
            raise StoreError(
                f"{self.path}/cell_position_bytes.npy: their sum is {first_byte[-1]}, expected {info.position_bytes}"
            )
        codes = self._load("position_codes", mmap=True)
        return CodedPositions(cells, first_byte, codes, info.positions, info.position_bits, info.point_order)

    def attribute(self, name: str, mmap: bool = True) -> np.ndarray:
        """(n_stored,) column of an attribute. Raises StoreError if the scene has none of that name."""
        if name not in self.info.attributes:
            raise StoreError(
                f"{self.path}: attribute {name} not found, expected one of {', '.join(self.info.attributes) or 'none'}"
            )
        return self._load(f"attr_{name}", mmap)

    def column(self, name: str) -> Column:
        """(n_stored,) array of that name to be indexed: mapped, or read where it is indexed.

        A map keeps what was looked at resident for as long as memory lasts, and the pages around it.
        Raises StoreError as ``attribute`` does.
        """
        if self.mapped:
            return self._load(name, mmap=True)
        return ReadColumn(self.path / f"{name}.npy", self.info.arrays[name])

    def pool_codes(self) -> np.ndarray:
        """(pool_bytes,) uint8, the pooled forms of cells end to end; a read-only memory map.

        Raises StoreError if the scene was built without them.
        """
        if not self.info.pool_bits:
            raise StoreError(f"{self.path}: no pooled cells: build it with --pools")
        return self._load("pool_codes", mmap=self.info.pool_bytes > 0)

    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """((b,) int64 first point, (b, 3) float64 world origin) of the blocks, checked."""
        first, origin = self._load_checked("block_first_point"), self._load_checked("block_origin")
        if first[0] != 0 or (np.diff(first) <= 0).any() or first[-1] >= self.info.n_stored:
            raise StoreError(f"{self.path}/block_first_point.npy: not ascending from 0 to {self.info.n_stored}")
        if not np.isfinite(origin).all():
            raise StoreError(f"{self.path}/block_origin.npy: found a value that is not finite")
        return first, origin

    def check(self, names: Iterable[str], progress: Callable[[str, int, int | None], None] | None = None) -> None:
        """Hold the checksums of the named arrays (``x``, ``attr_rgb``, …) against ``scene.json``.

        Raises StoreError naming the first array that differs. Cost: one read of each.
        """
        names = list(names)
        total = sum(self.info.arrays[name].bytes for name in names)
        done = 0
        for name in names:
            crc = 0
            for chunk in self._arrays.chunks(name):
                crc = zlib.crc32(chunk, crc)
                done += len(chunk)
                if progress:
                    progress("check", done, total)
            _expect_crc(self.path / f"{name}.npy", crc, self.info.arrays[name])

    def verify(self, progress: Callable[[str, int, int | None], None] | None = None) -> None:
        """Check everything: checksums, links of the octree, blocks, that each point lies in its cell's cube, and that
        pooled forms hold the grid points of their cells.

        Raises StoreError naming the array or cell. Cost: one read of the scene, bounded memory.
        """
        self.check(self.info.arrays, progress)
        octree = self.octree(features=self.info.features, pools=self.info.pool_bits > 0)
        first, origin = self.blocks()
        owner_first = octree.first_point[octree.owners]
        read = self.position_reader()
        slack = float(np.max(np.spacing(np.abs([self.info.lower, self.info.upper])))) * 8
        for start in range(0, self.info.n_stored, _CHUNK // 8):
            stop = min(start + _CHUNK // 8, self.info.n_stored)
            index = np.arange(start, stop)
            block = np.searchsorted(first, index, side="right") - 1
            cell = octree.owners[np.searchsorted(owner_first, index, side="right") - 1]
            half, centers = octree.half_edges[cell], octree.centers[cell]
            for axis, column in enumerate(read(start, stop)):
                offset = column.astype(np.float64)
                from_center = offset + (origin[block, axis] - centers[:, axis])
                allowed = half * (1 + 2.0**-20) + np.abs(offset) * 2.0**-23 + slack
                if not (np.abs(from_center) <= allowed).all():
                    bad = int(index[~(np.abs(from_center) <= allowed)][0])
                    array = self.info.position_arrays[0 if self.info.coded else axis]
                    raise StoreError(
                        f"{self.path}/{array}.npy: point {bad} lies outside the cube of cell {cell[bad - start]}"
                    )
            if progress:
                progress("points", stop, self.info.n_stored)
        if self.info.pool_bits:
            from .pooled import verify_pools

            verify_pools(self, octree, progress)

    def stored_bytes(self, name: str) -> np.ndarray:
        """(n,) uint8: the bytes of an array as they are stored, mapped and unchecked, for sending them on."""
        return self._load(name, mmap=True).reshape(-1).view(np.uint8)

    def release(self) -> None:
        """Say that no array will be asked for any more. Files need it not; a scene that another rank sends does."""
        self._arrays.release()

    def _load(self, name: str, mmap: bool) -> np.ndarray:
        return self._arrays.load(name, mmap)

    def _load_checked(self, name: str) -> np.ndarray:
        array = self._load(name, mmap=False)
        _expect_crc(self.path / f"{name}.npy", zlib.crc32(np.ascontiguousarray(array).data), self.info.arrays[name])
        return array


def check_octree(octree: Octree, info: SceneInfo, path: Path) -> None:
    """Raise StoreError unless links, codes, counts and ranges of the cells hold together; vectorised, O(cells)."""

    def require(holds: ArrayLike, array: str, rule: str) -> None:
        if not np.all(holds):
            bad = int(np.flatnonzero(~np.asarray(holds))[0]) if np.ndim(holds) else 0
            raise StoreError(f"{path}/cell_{array}.npy: entry {bad}: {rule}")

    n = len(octree)
    level, code = octree.level.astype(np.int64), octree.code
    parent, n_children = octree.parent.astype(np.int64), octree.n_children.astype(np.int64)
    require(level[:1] == 0, "level", "the root is not of level 0")
    require((np.diff(level) >= 0) & (level[1:] > 0), "level", "not breadth-first")
    require(level <= MAX_LEVEL, "level", f"above {MAX_LEVEL}")
    require(code < np.uint64(1) << (3 * level).astype(np.uint64), "code", "does not fit its level")
    require((np.diff(level) > 0) | (code[1:] > code[:-1]), "code", "not ascending within its level")
    require(parent[:1] == -1, "parent", "the root has a parent")
    require((parent[1:] >= 0) & (parent[1:] < np.arange(1, n)), "parent", "not a cell before it")
    require(np.diff(parent) >= 0, "parent", "not ascending")
    require(level[parent[1:]] + 1 == level[1:], "parent", "not one level above")
    require(code[parent[1:]] == code[1:] >> np.uint64(3), "parent", "its code is not the prefix")
    require(np.bincount(parent[1:], minlength=n) == n_children, "n_children", "not the number of cells that say so")
    first_child = np.where(n_children > 0, 1 + np.cumsum(n_children) - n_children, -1)
    require(octree.first_child == first_child, "first_child", "not the first of the children")

    first, count, below = octree.first_point, octree.n_points, octree.n_below
    require((first >= 0) & (count >= 0) & (count <= info.n_stored), "n_points", "beyond the point-array")
    require(first <= info.n_stored - count, "first_point", "beyond the point-array")
    require(below > 0, "n_below", "a cell without points")
    require(below[:1] == info.n_points, "n_below", f"the root does not hold the {info.n_points} points of the scene")
    leaf = octree.is_leaf
    require(count[leaf] == below[leaf], "n_points", "a leaf without all its points")
    sums = np.zeros(n, np.int64)
    np.add.at(sums, parent[1:], below[1:])
    require((sums == below) | leaf, "n_below", "not the sum of the children")
    if octree.point_order == "depth-first":
        own = np.arange(n)
        first_child, last_child = np.where(leaf, own, first_child), np.where(leaf, own, first_child + n_children - 1)
        spans = (first == first[first_child]) & (count == below)
        ends = first + count == first[last_child] + count[last_child]
        require(leaf | (spans & ends), "first_point", "an inner cell does not span its leaves")
    owner = leaf if octree.point_order == "depth-first" else np.ones(n, bool)
    order = np.argsort(first[owner], kind="stable")
    ends = np.cumsum(count[owner][order])
    tiled = ends[-1] == info.n_stored and np.array_equal(first[owner][order], ends - count[owner][order])
    require(bool(tiled), "first_point", f"the ranges do not tile the {info.n_stored} stored points")
    if octree.pool_points is not None and octree.pool_bytes is not None:
        require((octree.pool_points == 0) == (octree.pool_bytes == 0), "pool_bytes", "of a cell without pooled points")
        require(octree.pool_points <= np.where(owner, count, 0), "pool_points", "more than the cell owns")
        total = int(octree.pool_bytes.sum(dtype=np.int64))
        require(total == info.pool_bytes, "pool_bytes", f"their sum is not {info.pool_bytes}")
    if octree.area is not None:
        require(np.isfinite(octree.area) & (octree.area > 0), "area", "not a finite number > 0")
    if octree.cone is not None:
        require(
            np.isfinite(octree.cone).all(axis=1) & (np.abs(octree.cone) <= 1.0001).all(axis=1), "cone", "not a cone"
        )
    if octree.feature is not None and octree.quad is not None:
        require(octree.feature < len(FEATURES), "feature", f"above {len(FEATURES) - 1}")
        require(np.isfinite(octree.quad).all(axis=(1, 2)), "quad", "not finite")


def _expect_crc(path: Path, found: int, promised: ArrayInfo) -> None:
    if found != promised.crc32:
        raise StoreError(f"{path}: checksum {found:08x}, expected {promised.crc32:08x}: the file is damaged")
