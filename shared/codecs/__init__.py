"""Cell codecs: other ways to hold the positions of a cell's points than three float32.

A codec works on *grid points*: whole coordinates 0 … 2**bits − 1 an axis inside a cell's cube. Going there from
positions and back is ``grid``, the same for all. What the papers behind them call a cell, a cube or a pool stays
inside each codec's own module.

======================  ==================================================================================
module                  source
======================  ==================================================================================
``grid``                positions ↔ grid points, and the order of points that codecs change
``order``               keys, and the stable sort by them
``varints``             whole numbers in few bytes
``container``           what stands before a bit stream: number of points, repeats, blocks that hold some
``ci``                  Mallón et al., "Algorithms and Hardware for Data Compression in Point Rendering", 3.1
``eci``                 the same, 3.2: layers of neighbours
``ci_reference`` …      the paper's two in plain form, bit by bit
``streams``             Kim, Lee, Varshney, "Vertex Transformation Streams": bytes, and the gate that leaves them out
``pools``               the same, 3 and 4: vertices, translations and tags
``autocorrelation``     the same, 5: the most common translations
``pools_reference``     tables and pools in plain form
``palette``             colours beside points in coded order, a byte each
``occupancy``           octree occupancy, entropy coded (not in the papers)
``mixing``              adaptive probabilities from several contexts, Mahoney 2005
``range_coder``         yes or no at as many bits as its probability says
``positions``           which of these a scene may store its positions with
``linear_groups``       Dinerstein, Egbert, Flann, "Linear Grouping": bytes, and maps of end points. Lossy
``group_search`` …      the same, 3: which points define lines for which; and in plain form
======================  ==================================================================================

Data that comes from a file or a socket is never believed: decoders raise ``CodecError`` on anything that no encoder
writes, and allocate no more than the caller's bound on the number of points allows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

MAX_BITS = 21
"""Most bits an axis: three of them fit a Morton code of 63."""

MAX_STREAM_BITS = 8
"""Most bits an axis of transformation streams: above, scans are sparse on the grid, and translations long."""


@dataclass(frozen=True)
class Encoded:
    """A cell's grid points in the form of one codec.

    data : (m,) uint8, everything that decoding needs but ``bits``.
    order : (n,) int64: the i-th decoded point is point ``order[i]`` of what was encoded, so that attributes can follow.
    """

    data: np.ndarray
    order: np.ndarray

    @property
    def bits_per_point(self) -> float:
        """Bits of ``data`` for each point; not a number where there is none."""
        return 8 * len(self.data) / len(self.order) if len(self.order) else float("nan")


class Codec(Protocol):
    """What every codec of grid points offers."""

    name: str

    def encode(self, points: np.ndarray, bits: int) -> Encoded:
        """(n, 3) integers in [0, 2**bits), duplicates allowed. Raises CodecError for anything else."""
        ...

    def decode(self, data: np.ndarray, bits: int, most_points: int) -> np.ndarray:
        """(n, 3) uint32 grid points, in coded order. Raises CodecError for damaged data or above ``most_points``."""
        ...
