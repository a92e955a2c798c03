"""A display wall: screens in columns and rows, and the mullions between them.

The picture goes on behind the mullions, the frames of the screens: their pixels are part of its geometry, as what is
behind a window's bars, and no screen shows them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .colour import parse_colour
from .errors import ConfigError
from .windows import Window

if TYPE_CHECKING:
    from .config import RunConfig


class Screen(NamedTuple):
    """Column and row from the top left, and what it shows of the picture, pixels."""

    column: int
    row: int
    window: Window

    @property
    def name(self) -> str:
        """As in names of files."""
        return f"c{self.column}_r{self.row}"


@dataclass(frozen=True, eq=False)
class Wall:
    """columns, rows : of screens.  screen_width, screen_height : of each, pixels.

    mullion_x, mullion_y : pixels between neighbours in a row, and in a column.
    apart : a file a screen is written, else one of the wall.
    colour : (4,) uint8 RGBA that mullions are then painted with; None: left out.
    """

    columns: int
    rows: int
    screen_width: int
    screen_height: int
    mullion_x: int
    mullion_y: int
    apart: bool = False
    colour: np.ndarray | None = None

    @property
    def width(self) -> int:
        """Of the whole picture, mullions included, pixels."""
        return self.columns * (self.screen_width + self.mullion_x) - self.mullion_x

    @property
    def height(self) -> int:
        """Of the whole picture, mullions included, pixels."""
        return self.rows * (self.screen_height + self.mullion_y) - self.mullion_y

    @property
    def file_size(self) -> tuple[int, int]:
        """Width and height of a file, pixels."""
        if self.apart:
            return self.screen_width, self.screen_height
        if self.colour is not None:
            return self.width, self.height
        return self.columns * self.screen_width, self.rows * self.screen_height

    @property
    def screens(self) -> list[Screen]:
        """Row after row."""
        across, down = self.screen_width + self.mullion_x, self.screen_height + self.mullion_y
        return [
            Screen(c, r, Window(x, y, x + self.screen_width, y + self.screen_height))
            for r, y in ((r, r * down) for r in range(self.rows))
            for c, x in ((c, c * across) for c in range(self.columns))
        ]

    @property
    def shown(self) -> tuple[np.ndarray, np.ndarray]:
        """(height,) bool rows and (width,) bool columns of the picture that are on screens."""
        rows = np.arange(self.height) % (self.screen_height + self.mullion_y) < self.screen_height
        columns = np.arange(self.width) % (self.screen_width + self.mullion_x) < self.screen_width
        return rows, columns


def wall_of(config: RunConfig) -> Wall | None:
    """The wall of a run, whose ``camera.width`` × ``height`` is a screen's; None for one screen, which is no wall.

    Raises ConfigError for what a wall cannot show.
    """
    section, camera = config.wall, config.camera
    n = f"{section.columns} × {section.rows}"
    apart = section.output == "tiles"
    if section.columns * section.rows == 1:
        if apart:
            raise ConfigError(f"wall.output = 'tiles': wall.columns × rows is {n}, expected more than one screen")
        return None
    if camera.view != "mono":
        raise ConfigError(f"camera.view = {camera.view!r}: wall.columns × rows is {n}, expected 'mono'")
    if apart and config.output.mp4:
        raise ConfigError("output.mp4 = true: wall.output = 'tiles' writes a file a screen, expected 'assembled'")
    colour = parse_colour(section.mullion_colour, "wall.mullion_colour") if section.mullion_colour else None
    if config.output.mp4 and colour is not None and not colour[3]:
        raise ConfigError("wall.mullion_colour = 'transparent', expected a colour: a film (output.mp4) has no alpha")
    size, mullions = (camera.width, camera.height), (section.mullion_x_px, section.mullion_y_px)
    return Wall(section.columns, section.rows, *size, *mullions, apart=apart, colour=colour)
