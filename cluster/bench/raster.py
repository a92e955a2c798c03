"""``splatpipe bench raster``: every rasterizer present, VTK and NumPy draw the same points in one run.

All points are drawn, one pixel and one colour each, and the frame is read back. The camera moves between frames, so
nothing can be kept from the last one. Speed never stands alone: a row also says how many pixels of its first frame
differ from the float64 reference, and how far it is from the time that reading the points takes.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from numba import njit

from ...nodes.raster import PointSize, ResidentPoints
from ...nodes.raster.choose import make_rasterizer
from ...nodes.raster.reference import reference_frame
from ...shared.camera import Camera, look_at, perspective_camera
from ...shared.errors import DeviceError
from ...shared.messages import FRAMEBUFFER_EMPTY, RENDER_POINT
from ...shared.surfaces import RUN_POINTS, bumpy_sphere, point_orders
from ..record import machine_record, spread_ms

ONE_PIXEL = "one pixel"
"""The order in which all points fall on one pixel: the worst case for whoever shares a framebuffer."""

SHUFFLED_BATCHES = "shuffled batches"
"""Stored order, but the runs shuffled: cells in any order, as a scene of many draws is."""

_BLOCK_POINTS = RUN_POINTS // 2
"""Points of a block, where points that are close lie close in the array: half a full cell."""

_FOV_Y_RAD = 0.7
_DISTANCE = 3.6
_STEP_RAD = 0.001
_WARM_UP_FRAMES = 2
_CASE_S = 4.0  # a slow case stops here, after no less than three frames

Draw = Callable[[int], np.ndarray]
"""Frame number → framebuffer words, or (height, width, 3) uint8 colours."""


def bench_raster(
    n_points: int = 4_000_000, size: int = 1024, repeats: int = 15, rasterizers: Sequence[str] | None = None
) -> dict[str, Any]:
    """Time frames of ``size``² pixels of each rasterizer, for each order of the points.

    rasterizers : some of cpu, cpu compact, gl, gl-points, vtk, numpy; None: all of them.

    Returns a JSON-able dict: ``rows`` (one for each rasterizer and order), ``omitted`` (rasterizer and reason),
    ``read_limit`` (reading 16 bytes a point with all threads), the machine.
    """
    rows, omitted = [], {}
    read_s: list[float] = []
    for order, points in bench_cases(n_points, camera_of(0, size, size)):
        read_s += read_times([points.x, points.y, points.z, points.colour], repeats)
        expected = _rgb(reference_frame(points, camera_of(0, size, size), everything(points)))
        for name in rasterizers or _CONTESTANTS:
            if name in omitted:
                continue
            try:
                with _CONTESTANTS[name](points, size) as (device, draw):
                    row = _measure(draw, expected, repeats)
                    rows.append({"rasterizer": name, "device": device(), "order": order, **row})
            except (DeviceError, ImportError) as error:
                omitted[name] = str(error)
    read_limit = {"ms": spread_ms(read_s), "threads": len(os.sched_getaffinity(0)), "bytes_per_point": 16}
    vtk = {row["order"]: row["ms"]["median"] for row in rows if row["rasterizer"] == "vtk"}
    for row in rows:
        median = row["ms"]["median"]
        row["points_per_s"] = n_points / median * 1e3
        row["share_of_read_limit"] = read_limit["ms"]["median"] / median
        row["times_vtk"] = vtk[row["order"]] / median if row["order"] in vtk else None
    return {
        "benchmark": "raster",
        "n_points": n_points,
        "size_px": size,
        "read_limit": read_limit,
        "rows": rows,
        "omitted": [{"rasterizer": name, "reason": reason} for name, reason in omitted.items()],
        "machine": machine_record(),
    }


def print_raster(results: dict[str, Any], console: Any) -> None:
    """The result as a table."""
    from rich.table import Table

    table = Table(title=f"{results['n_points']:,} points, {results['size_px']}² pixels, frame read back")
    table.add_column("rasterizer", no_wrap=True)
    table.add_column("order", no_wrap=True)
    for heading in ("ms median", "min", "max", "frames", "M points/s", "× VTK", "of read limit", "pixels differing"):
        table.add_column(heading, justify="right")
    for row in results["rows"]:
        ms = row["ms"]
        table.add_row(
            row["rasterizer"],
            row["order"],
            *(f"{ms[key]:.2f}" for key in ("median", "min", "max")),
            str(row["frames"]),
            f"{row['points_per_s'] / 1e6:.1f}",
            "–" if row["times_vtk"] is None else f"{row['times_vtk']:.1f}",
            f"{row['share_of_read_limit']:.1%}",
            "–" if row["differing_share"] is None else f"{row['differing_share']:.3%}",
        )
    console.print(table)
    devices = {row["rasterizer"]: row["device"] for row in results["rows"]}
    for name, device in devices.items():
        console.print(f"{name}: {device}")
    for item in results["omitted"]:
        console.print(f"{item['rasterizer']}: left out, {item['reason']}")
    limit, machine = results["read_limit"], results["machine"]
    read_bytes = results["n_points"] * limit["bytes_per_point"]
    console.print(
        f"read limit: {limit['ms']['median']:.2f} ms for {limit['bytes_per_point']} bytes a point "
        f"with {limit['threads']} threads ({read_bytes / limit['ms']['median'] / 1e6:.1f} GB/s)"
    )
    console.print(f"{machine['cpu']}, {machine['cores']} cores, commit {machine['commit'] or 'unknown'}")


def _measure(draw: Draw, expected: np.ndarray, repeats: int) -> dict[str, Any]:
    """Times of frames, and the share of foreground pixels of frame 0 that differ (None: too few to tell)."""
    found = _rgb(draw(0))
    differing = int((found != expected).any(axis=2).sum())
    for frame in range(1, _WARM_UP_FRAMES):
        draw(frame)
    times: list[float] = []
    while len(times) < repeats and not (len(times) >= 3 and sum(times) > _CASE_S):
        start = time.perf_counter()
        draw(_WARM_UP_FRAMES + len(times))
        times.append(time.perf_counter() - start)
    foreground = int(expected.any(axis=2).sum())
    return {
        "ms": spread_ms(times),
        "frames": len(times),
        "differing_share": differing / foreground if foreground >= 100 else None,
        "foreground_px": foreground,
    }


def bench_cases(n_points: int, camera: Camera) -> Iterator[tuple[str, ResidentPoints]]:
    """Order of the points and the points: a closed surface, and all of it within one pixel of ``camera``."""
    surface = bumpy_sphere(n_points)
    colour = np.random.default_rng(1).integers(1 << 24, dtype=np.uint32, size=n_points) | np.uint32(255 << 24)
    orders = point_orders(surface)
    whole = n_points // RUN_POINTS * RUN_POINTS
    runs = np.random.default_rng(2).permutation(orders["stored"][:whole].reshape(-1, RUN_POINTS)).ravel()
    orders[SHUFFLED_BATCHES] = np.append(runs, orders["stored"][whole:])
    for order, p in orders.items():
        yield order, _resident(surface[p], colour[p], n_points if order == "random" else _BLOCK_POINTS)
    yield ONE_PIXEL, _resident(_within_one_pixel(surface, camera), colour, n_points)


Contestant = Callable[[ResidentPoints, int], Any]
"""(points, size) → context manager of (device name, known once something is drawn, and draw)."""


@contextmanager
def _splatpipe(
    name: str, points: ResidentPoints, size: int, *, compact: bool = False
) -> Iterator[tuple[Callable[[], str], Draw]]:
    with make_rasterizer(name, points, size, size, PointSize(), None, compact=compact) as rasterizer:
        yield lambda: rasterizer.device, lambda i: rasterizer.draw(camera_of(i, size, size), everything(points))


@contextmanager
def _vtk(points: ResidentPoints, size: int) -> Iterator[tuple[Callable[[], str], Draw]]:
    from .vtk_points import VtkPoints

    positions = np.column_stack([points.x, points.y, points.z])
    with VtkPoints(positions, points.colour, size, size) as window:
        yield lambda: window.device, lambda i: window.draw(camera_of(i, size, size), _pose(i), _FOV_Y_RAD)


@contextmanager
def _numpy(points: ResidentPoints, size: int) -> Iterator[tuple[Callable[[], str], Draw]]:
    yield (
        lambda: f"NumPy {np.__version__}",
        lambda i: reference_frame(points, camera_of(i, size, size), everything(points)),
    )


_CONTESTANTS: dict[str, Contestant] = {
    "cpu": partial(_splatpipe, "cpu"),
    "cpu compact": partial(_splatpipe, "cpu", compact=True),
    **{name: partial(_splatpipe, name) for name in ("gl", "gl-points")},
    "vtk": _vtk,
    "numpy": _numpy,
}


def _pose(frame: int) -> np.ndarray:
    angle = frame * _STEP_RAD
    eye = _DISTANCE * np.array([math.sin(angle), 0.0, math.cos(angle)])
    return look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0]))


def camera_of(frame: int, width: int, height: int) -> Camera:
    """The camera of a frame; it moves between frames."""
    return perspective_camera(
        frame=frame, world_from_camera=_pose(frame), fov_y_rad=_FOV_Y_RAD, width=width, height=height, near=0.01
    )


def _within_one_pixel(surface: np.ndarray, camera: Camera) -> np.ndarray:
    """The surface shrunk into the middle of the pixel right of and below the image's centre."""
    pixel = _DISTANCE / camera.focal_px
    return surface * (0.1 * pixel) + np.array([0.5 * pixel, -0.5 * pixel, 0.0])


def _resident(positions: np.ndarray, colour: np.ndarray, block_points: int) -> ResidentPoints:
    x, y, z = (np.ascontiguousarray(column, np.float32) for column in positions.T)
    first = np.arange(0, len(x), block_points)
    return ResidentPoints(x, y, z, colour, first, np.zeros((len(first), 3)))


def everything(points: ResidentPoints) -> np.ndarray:
    """(1,) RENDER_POINT, all points."""
    return np.array([(0, len(points), 1)], RENDER_POINT)


def _rgb(frame: np.ndarray) -> np.ndarray:
    """(height, width, 3) uint8 of framebuffer words, background black."""
    if frame.ndim == 3:
        return frame
    colour = np.where(frame == FRAMEBUFFER_EMPTY, 0, frame).astype(np.uint32)
    return colour[..., None].view(np.uint8)[..., :3]


def read_times(columns: Sequence[np.ndarray], repeats: int) -> list[float]:
    """Seconds to read every byte of 4-byte columns once with all threads: no rasterizer can be faster."""
    threads = len(os.sched_getaffinity(0))
    times = []
    with ThreadPoolExecutor(threads) as executor:
        for _ in range(repeats + 1):
            start = time.perf_counter()
            list(executor.map(partial(read_share, columns, threads=threads), range(threads)))
            times.append(time.perf_counter() - start)
    return times[1:]  # the first one compiles


def read_share(columns: Sequence[np.ndarray], thread: int, threads: int) -> None:
    """Read one thread's share of 4-byte columns."""
    for column in columns:
        n = len(column)
        _read(column.view(np.uint32), n * thread // threads, n * (thread + 1) // threads)


@njit(nogil=True, cache=True)
def _read(column, begin, end):
    """Something that depends on every bit of a (n,) uint32 column, at a cost that memory hides."""
    mixed = np.uint32(0)
    for i in range(end - begin):
        mixed ^= column[np.uintp(begin) + np.uintp(i)]  # without the sign the compiler vectorises it
    return mixed
