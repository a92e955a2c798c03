"""``splatpipe layer cuboids``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .save import OutputOption, OverwriteOption, save


def cuboids(
    table: Annotated[Path, typer.Argument(help="CSV or Parquet table with a row an object.")],
    output: OutputOption,
    overwrite: OverwriteOption = False,
) -> None:
    """Boxes from a table with the columns x, y, width, depth, height and, if there is one, base and value.

    Example: `splatpipe layer cuboids towers.csv -o towers.layer`
    """
    from ...shared.layers.readers.table import cuboids_from_table

    save(cuboids_from_table(table), output, overwrite)
