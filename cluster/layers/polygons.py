"""``splatpipe layer polygons``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...shared.errors import InputError
from .save import OutputOption, OverwriteOption, save


def polygons(
    source: Annotated[Path, typer.Argument(help="GeoJSON or CityJSON file.", metavar="INPUT")],
    output: OutputOption,
    height: Annotated[float, typer.Option(help="Height of objects that have none.")] = 10.0,
    height_property: Annotated[
        str | None,
        typer.Option(help="Property that is the height. Default: solids as they are, height, building:levels, …"),
    ] = None,
    height_scale: Annotated[float, typer.Option(help="Factor for heights from properties.")] = 1.0,
    base: Annotated[float, typer.Option(help="Added to all heights: where the ground lies.")] = 0.0,
    value_property: Annotated[
        str | None, typer.Option(help="Property that the colour map colours. Default: the height.")
    ] = None,
    degrees: Annotated[
        bool | None,
        typer.Option(
            "--degrees/--no-degrees",
            help="Coordinates are longitude and latitude. Default: as the file says, or as they look.",
        ),
    ] = None,
    kind: Annotated[
        list[str] | None, typer.Option("--type", help="City objects to take. Default: Building, BuildingPart.")
    ] = None,
    boxes: Annotated[bool, typer.Option("--boxes", help="Make cuboids: the box around each object.")] = False,
    overwrite: OverwriteOption = False,
) -> None:
    """Prisms over outlines, as buildings: GeoJSON polygons with a height, CityJSON with solids or footprints.

    Longitude and latitude become metres east and north of their middle. Outlines that cross themselves are filled by
    the even-odd rule; those without area are left out.

    Example: `splatpipe layer polygons city.geojson --height-property levels --height-scale 3 -o city.layer`
    """
    from ...shared.layers.readers.footprints import HeightRules, bounding_boxes, polygons_from_file

    for name, number in (("--height", height), ("--height-scale", height_scale), ("--base", base)):
        if not abs(number) <= 1e12:
            raise InputError(f"{name}: found {number:g}, expected a number, at most 1e12")
    rules = HeightRules(height, height_property, height_scale, base, value_property)
    read = polygons_from_file(source, rules, degrees=degrees, types=kind)
    save(bounding_boxes(read.layer) if boxes else read.layer, output, overwrite)
    for note in read.notes:
        typer.echo(f"  {note}")
