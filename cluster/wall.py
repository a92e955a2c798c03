"""A display wall on ranks: where each render rank draws a screen, and writes it itself.

Tiles are screens where there is one for each. What is behind mullions is then drawn by no rank, but for what eye-dome
lighting and normals look at beside a screen. With ``wall.output`` = ``tiles`` no framebuffer crosses: each rank
composes its screen, the pixels of the whole picture. Everywhere else the display rank cuts the whole picture up.
"""

from __future__ import annotations

from ..shared.windows import Window
from .job import Job
from .layout import Layout


def screen_windows(job: Job, layout: Layout) -> list[Window]:
    """The window of each render rank, drawn pixels, where tiles are screens; none where they are not.

    Windows overlap where they reach beyond their screens.
    """
    wall = job.wall
    if wall is None or layout.split != "tiles" or len(layout.render) != len(wall.screens):
        return []
    settings = job.picture_settings
    around = [screen.window.grown(settings.reach_px, wall.width, wall.height) for screen in wall.screens]
    return [window.scaled(settings.supersampling) for window in around]


def writes_screens(job: Job, layout: Layout) -> bool:
    """Whether each render rank writes its screen. Layers are drawn by the display rank, over whole pictures."""
    return bool(job.wall and job.wall.apart and not job.layers and screen_windows(job, layout))
