"""The commands that make and examine scenes: build, synth, info, verify."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ..shared.build import BuildReport, BuildSettings, build_scene
from ..shared.errors import InputError
from ..shared.files import write_json
from ..shared.layers.layer_store import LAYER_FILE, open_layer
from ..shared.octree import FEATURES
from ..shared.pooled import PoolCounts
from ..shared.readers import expand_inputs, open_source
from ..shared.readers.source import Source
from ..shared.store import Scene
from .launch import inside_mpi
from .progress import FrameProgress

FLOAT32_BYTES = 12
"""Of a position as float32."""

_console = Console(highlight=False, soft_wrap=True)


def build_command(inputs: list[str], output: Path, settings: BuildSettings, json: Path | None, n_ranks: int) -> int:
    """``splatpipe build``; the exit status."""
    return _build(lambda: [str(path) for path in expand_inputs(inputs)], open_source, output, settings, json, n_ranks)


def synth_command(
    output: Path,
    n_points: int,
    seed: int,
    extent_m: float,
    settings: BuildSettings,
    json: Path | None = None,
    n_ranks: int = 0,
) -> int:
    """``splatpipe synth``: a scene, or a file where the name ends in .las or .laz; the exit status."""
    from ..shared.synth import CityScan, write_las

    if output.suffix.lower() not in (".las", ".laz"):
        return _build(lambda: ["city"], lambda _: CityScan(n_points, seed, extent_m), output, settings, json, n_ranks)
    if n_ranks > 1 or inside_mpi():
        raise InputError(f"{output}: a point file is written by one process, expected a scene, or no ranks")
    if output.exists() and not settings.overwrite:
        raise InputError(f"{output}: exists already; --overwrite replaces it")
    write_las(CityScan(n_points, seed, extent_m), output)
    _console.print(f"wrote {output}: {n_points:,} points")
    return 0


def _build(
    names: Callable[[], list[str]],
    open_named: Callable[[str], Source],
    output: Path,
    settings: BuildSettings,
    json: Path | None,
    n_ranks: int,
) -> int:
    """Build on one rank, or on those that ``mpiexec`` has started, or start ``n_ranks``; the exit status."""
    started = time.perf_counter()

    def tell(report: BuildReport) -> None:
        seconds = time.perf_counter() - started
        _tell_build(output, report, seconds, settings.positions)
        if json is not None:
            write_json(json, {"seconds": seconds, **asdict(report), "path": str(report.path)})

    if inside_mpi():
        from .build_ranks import build_on_ranks

        return build_on_ranks(names, open_named, output, settings, n_ranks, tell)
    if n_ranks > 1:
        from .build_ranks import start_ranks

        return start_ranks(n_ranks)
    with FrameProgress(None) as progress:
        report = build_scene(map(open_named, names()), output, settings=settings, progress=progress.show)
    tell(report)
    return 0


def _tell_build(output: Path, report: BuildReport, seconds: float, positions: str) -> None:
    _console.print(
        f"wrote {output}: {report.n_points:,} points, {report.n_cells:,} cells, "
        f"{seconds:.1f} s, {report.n_points / seconds / 1e6:.1f} M points/s"
    )
    if positions != "float32":
        a_point = report.position_bytes / report.n_stored
        advice = ": fewer --position-bits suit it" if a_point >= FLOAT32_BYTES else ""
        _console.print(f"  positions as {positions}: {a_point:.2f} bytes a point, {FLOAT32_BYTES} as float32{advice}")
    if report.n_dropped:
        _console.print(f"  dropped {report.n_dropped:,} points with coordinates that are not finite")
    for name in report.dropped_attributes:
        _console.print(f"  left out attribute {name}: not in every input")


def info_command(path: Path, json: Path | None) -> None:
    """``splatpipe info``: of a scene directory, a layer directory or a point file."""
    if (path / LAYER_FILE).is_file():
        content = _layer_info(path)
    else:
        content = _scene_info(path) if path.is_dir() else _file_info(path)
    table = Table(show_header=False, box=None)
    for key, value in content.items():
        table.add_row(key.replace("_", " "), _text(value))
    _console.print(table)
    if json is not None:
        write_json(json, content)


def verify_command(path: Path) -> None:
    """``splatpipe verify``."""
    scene = Scene.open(path)
    with FrameProgress(None) as progress:
        scene.verify(progress=progress.show)
    _console.print(f"{path}: whole; {scene.info.n_points:,} points in {scene.info.n_cells:,} cells")


def _scene_info(path: Path) -> dict[str, Any]:
    scene = Scene.open(path)
    info = asdict(scene.info)
    size = sum(array["bytes"] for array in info.pop("arrays").values())
    info["splats"] = scene.info.splats
    if scene.info.coded:
        info |= _coded_info(scene)
    if scene.info.features:
        feature = scene.octree(features=True).feature
        assert feature is not None
        count = np.bincount(feature, minlength=len(FEATURES))
        info["features"] = [f"{n:,} {name}" for name, n in zip(FEATURES, count, strict=True)]
    if scene.info.pool_bits:
        info["pooled_cells"] = PoolCounts.of(scene.octree(pools=True)).texts()
    else:
        info["pooled_cells"] = "none: built without --pools"
    info["sources"] = [f"{source['name']} ({source['n_points']:,})" for source in info["sources"]]
    return {"scene": str(path), **info, "bytes": size}


def _layer_info(path: Path) -> dict[str, Any]:
    layer = open_layer(path)
    lower, upper = layer.bounds
    content = {"layer": str(path), **layer.told}
    if "value" in (layer.objects.dtype.names or ()):
        content["values"] = [float(end(layer.objects["value"])) for end in (np.min, np.max)]
    return content | {
        "origin": layer.origin.tolist(),
        "lower": lower.min(axis=0).tolist(),
        "upper": upper.max(axis=0).tolist(),
        "cells": len(layer.octree),
        "parameters": layer.parameters,
        "bytes": sum(array.stat().st_size for array in path.glob("*.npy")),
    }


def _coded_info(scene: Scene) -> dict[str, float]:
    """What coded positions take, and how far they may lie from those of the input, an axis, world units."""
    octree, info = scene.octree(), scene.info
    bin_edges = np.ldexp(2 * octree.half_edges[octree.is_leaf], -info.position_bits)
    epsilon = info.build.get("group_epsilon") if info.positions == "groups" else None
    if isinstance(epsilon, int | float):
        lost = bin_edges + epsilon * float(np.max(np.subtract(info.upper, info.lower)))
    else:
        lost = bin_edges / 2
    return {
        "position_bytes_per_point": round(info.position_bytes / info.n_stored, 3),
        "position_error_coarsest_leaf": float(f"{lost.max():.3g}"),
        "position_error_finest_leaf": float(f"{lost.min():.3g}"),
    }


def _file_info(path: Path) -> dict[str, Any]:
    info = open_source(path).info
    return {
        "file": str(path),
        "format": info.format,
        "points": info.n_points,
        "lower": None if info.lower is None else info.lower.tolist(),
        "upper": None if info.upper is None else info.upper.tolist(),
        "attributes": list(info.attributes),
        "crs": info.crs,
    }


def _text(value: Any) -> str:
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    if isinstance(value, dict):
        value = ", ".join(f"{key} {_text(held)}" for key, held in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value)
    text = "unknown" if value is None else str(value)
    return text if len(text) <= 200 else text[:200] + " …"
