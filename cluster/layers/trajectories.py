"""``splatpipe layer trajectories``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...shared.errors import InputError
from .save import OutputOption, OverwriteOption, save


def trajectories(
    source: Annotated[Path, typer.Argument(help="CSV, Parquet, GPX or PLY file.", metavar="INPUT")],
    output: OutputOption,
    columns: Annotated[
        list[str] | None,
        typer.Option(
            "--column",
            help="ROLE=NAME: which column is x, y, z, lon, lat, time, id or speed. Default: those called so, or alike.",
        ),
    ] = None,
    speed_unit: Annotated[
        str | None,
        typer.Option(
            help="Of the speed column: m/s, km/h, kt or mph. Default: kt if it is called groundspeed, else m/s."
        ),
    ] = None,
    degrees: Annotated[
        bool | None,
        typer.Option(
            "--degrees/--no-degrees", help="x and y are longitude and latitude. Default: as columns are called."
        ),
    ] = None,
    gap: Annotated[
        float | None,
        typer.Option(
            help="Cut where nothing was seen for so many seconds; 0: nowhere. Default: 100 × the median step."
        ),
    ] = None,
    radius: Annotated[float | None, typer.Option(help="Of a tube, world units. Default: 1/2000 of the extent.")] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Tracks of what moves: a node a row of a table, a point of GPX, a vertex of PLY.

    Nodes without position or time are left out. Longitude and latitude become metres east and north of their middle.
    Speed is that of a column, else that between nodes.

    Example: `splatpipe layer trajectories flights.csv --column id=callsign -o flights.layer`
    """
    from ...shared.layers.readers.tracks import COLUMN_NAMES, SPEED_UNITS, TrackRules, trajectories_from_file

    named = {}
    for text in columns or []:
        role, _, name = text.partition("=")
        if role not in COLUMN_NAMES or not name:
            raise InputError(f"--column {text}: expected ROLE=NAME, a role being one of {', '.join(COLUMN_NAMES)}")
        named[role] = name
    if speed_unit is not None and speed_unit not in SPEED_UNITS:
        raise InputError(f"--speed-unit {speed_unit}: expected {', '.join(SPEED_UNITS)}")
    for option, number, least in (("--gap", gap, 0.0), ("--radius", radius, 1e-9)):
        if number is not None and not least <= number <= 1e12:
            raise InputError(f"{option}: found {number:g}, expected {least:g} to 1e12")
    layer, notes = trajectories_from_file(source, TrackRules(named, speed_unit, degrees, gap, radius))
    save(layer, output, overwrite)
    for note in [f"trajectories: {len(layer.parameters['names']):,}, nodes: {_n_nodes(layer):,}", *notes]:
        typer.echo(f"  {note}")


def _n_nodes(layer: object) -> int:
    from ...shared.layers.trajectories import NODE

    return int((layer.elements["role"] == NODE).sum())  # type: ignore[attr-defined]
