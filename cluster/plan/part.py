"""A part of the program, and the names of those that an ablation measures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

MPI, OPENGL, PNG, FILM = "MPI", "OpenGL", "PNG encoding", "film encoding"
LAYERS, PAGING = "layers", "paging of points"
NO_NORMALS, BACK_FACE = "normals and back-face test", "back-face test"
LEVEL_OF_DETAIL, SPLAT_LOOP, ADAPTIVE = "level of detail", "splat loop and attenuation", "adaptive point size"
COLOUR, COLOUR_MAPS, CHECKSUMS = "colour column", "colour maps", "checksums"
COMPRESSION = "compression of messages"
CLASSES, BOXES = "class filter", "clip boxes"
LIGHTING, DEPTHS, NORMALS = "eye-dome lighting", "depth pictures", "normal pictures"


@dataclass(frozen=True)
class Part:
    """One part of the program.

    left_out : whether this run does without it.  why : the fact that decides it.
    gain, unit : what leaving it out saves or, of a part that is kept, would save; None where nothing is known.
    basis : ``counted`` (bytes that are not there), ``predicted`` (counts × unit costs) or ``measured``.
    """

    what: str
    left_out: bool
    why: str
    gain: float | None
    unit: str
    basis: str = "predicted"

    def as_dict(self) -> dict[str, Any]:
        """For ``run.json``: what, why and gain."""
        return {"what": self.what, "why": self.why, "gain": self.gain, "unit": self.unit, "basis": self.basis}
