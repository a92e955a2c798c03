"""``splatpipe layer treemap`` and ``sunburst``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .save import OutputOption, OverwriteOption, save

_Input = Annotated[Path, typer.Argument(help="Folder, or CSV or Parquet table with the columns path, size[, value].")]


def treemap(source: _Input, output: OutputOption, overwrite: OverwriteOption = False) -> None:
    """A squarified treemap of a hierarchy, as cuboids on cuboids.

    Example: `splatpipe layer treemap src -o src.layer`
    """
    from ...shared.layers.hierarchy import treemap as laid_out
    from ...shared.layers.readers.hierarchies import read_hierarchy

    save(laid_out(read_hierarchy(source)), output, overwrite)


def sunburst(source: _Input, output: OutputOption, overwrite: OverwriteOption = False) -> None:
    """A sunburst of a hierarchy, as rings of arcs.

    Example: `splatpipe layer sunburst src -o src.layer`
    """
    from ...shared.layers.hierarchy import sunburst as laid_out
    from ...shared.layers.readers.hierarchies import read_hierarchy

    save(laid_out(read_hierarchy(source)), output, overwrite)
