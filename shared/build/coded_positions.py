"""Positions of a scene cell by cell in the form of a codec, in place of three columns of float32."""

from __future__ import annotations

import numpy as np

from .parallel import Workers
from .settings import BuildSettings
from .writer import SceneWriter


def code_positions(
    cells: dict[str, np.ndarray],
    origin: np.ndarray,
    edge: float,
    extent: float,
    settings: BuildSettings,
    writer: SceneWriter,
    workers: Workers,
) -> dict[str, np.ndarray]:
    """Replace the columns x, y, z by ``position_codes``; the new cell array ``cell_position_bytes``."""
    raise NotImplementedError
