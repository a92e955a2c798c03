"""``splatpipe layer KIND``: files → layers."""

from __future__ import annotations

import typer

from .blocks import blocks
from .cuboids import cuboids
from .hierarchies import sunburst, treemap
from .polygons import polygons
from .trajectories import trajectories

layer_app = typer.Typer(help="Make a layer of objects to draw besides the points: buildings, tracks, treemaps.")
layer_app.command("blocks")(blocks)
layer_app.command("cuboids")(cuboids)
layer_app.command("polygons")(polygons)
layer_app.command("sunburst")(sunburst)
layer_app.command("trajectories")(trajectories)
layer_app.command("treemap")(treemap)
