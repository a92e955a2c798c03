"""The pooled form of cells that gain by it, beside their points."""

from __future__ import annotations

import numpy as np

from .parallel import Workers
from .settings import BuildSettings
from .writer import SceneWriter


def suited_bits(points_per_cell: int) -> int:
    """Bits an axis of the grid on which cells of a surface with that many points are about saturated."""
    return int(np.clip(np.round(np.log2(points_per_cell) / 2), 4, 8))


def pool_positions(
    cells: dict[str, np.ndarray],
    origin: np.ndarray,
    edge: float,
    bits: int,
    settings: BuildSettings,
    writer: SceneWriter,
    workers: Workers,
) -> dict[str, np.ndarray]:
    """Write ``pool_codes``; the new cell arrays ``cell_pool_points`` and ``cell_pool_bytes``."""
    raise NotImplementedError
