"""Pictures of a display wall: screens cut out, mullions painted or left out."""

from __future__ import annotations

import numpy as np

from ...shared.wall import Wall
from .compose import Picture


def seen(picture: Picture, wall: Wall) -> list[tuple[str, Picture]]:
    """What is written of a picture: each screen's name and what it shows, views; or the wall, without a name.

    Mullions are painted in place; nothing has a depth or a normal there.
    """
    if wall.apart:
        return [(screen.name, picture.of_each(screen.window.of)) for screen in wall.screens]
    rows, columns = wall.shown
    if wall.colour is None:
        on_screens = np.ix_(rows, columns)
        return [("", picture.of_each(lambda layer: layer[on_screens]))]
    for layer, value in ((picture.rgba, wall.colour), (picture.depth, 0), (picture.normals, 0)):
        if layer is not None:
            value = value * np.uint16(257) if layer.dtype == np.uint16 else value
            layer[~rows] = value
            layer[:, ~columns] = value
    return [("", picture)]
