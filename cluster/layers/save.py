"""What every command of ``splatpipe layer`` does with the layer it made."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from ...shared.layers.layer import Layer

OutputOption = Annotated[Path, typer.Option("--output", "-o", help="Layer directory to make.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an existing layer.")]


def save(layer: Layer, output: Path, overwrite: bool) -> None:
    """Write the layer and say what it holds."""
    from rich.console import Console

    from ...shared.layers.kinds import objects_of
    from ...shared.layers.layer_store import write_layer

    write_layer(layer, output, overwrite=overwrite)
    lower, upper = layer.bounds
    size = " × ".join(f"{s:.4g}" for s in upper.max(axis=0) - lower.min(axis=0))
    Console(highlight=False, soft_wrap=True).print(f"wrote {output}: {len(layer):,} {objects_of(layer.kind)}, {size}")
