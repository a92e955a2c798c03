"""``splatpipe layer blocks``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .save import OutputOption, OverwriteOption, save


def blocks(
    points: Annotated[Path, typer.Argument(help="Scene directory or point file.")],
    output: OutputOption,
    size: Annotated[float, typer.Option(help="Edge of a block, world units.")] = 1.0,
    colour: Annotated[str, typer.Option(help="Of blocks by: auto, rgb, classification or height.")] = "auto",
    overwrite: OverwriteOption = False,
) -> None:
    """A block world of a point cloud: a block wherever points are.

    Example: `splatpipe layer blocks city.scene --size 0.5 -o city-blocks.layer`
    """
    from ...shared.errors import InputError
    from ...shared.layers.readers.voxels import COLOUR_BY, voxelised
    from ...shared.readers import open_source
    from ...shared.rebuild import SceneSource
    from ...shared.store import Scene

    if colour not in ("auto", *COLOUR_BY):
        raise InputError(f"--colour {colour}: expected auto, {', '.join(COLOUR_BY)}")
    source = SceneSource(Scene.open(points)) if points.is_dir() else open_source(points)
    save(voxelised(source, output.stem, size, colour), output, overwrite)
