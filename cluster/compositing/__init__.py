"""The framebuffers of render ranks meet on the display rank. One policy a file.

``tiles``: each has the words of its window.  ``direct`` and the others: sort-last, the minimum of words.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from ...shared.config import PipelineSection
from ...shared.windows import Window
from ..layout import Layout
from ..transport import Transport


class Assembler(Protocol):
    """Brings together what the render ranks have drawn of a frame."""

    def assemble(self, frame: int, words: np.ndarray, windows: Sequence[Window]) -> np.ndarray | None:
        """(height, width) uint64 words of all render ranks on the display rank, None elsewhere; collective.

        words : what this rank has drawn, not changed.  windows : of each render rank, where they draw tiles.
        """
        ...


def make_assembler(pipeline: PipelineSection, layout: Layout, transport: Transport) -> Assembler:
    """How the framebuffers of a layout's render ranks meet."""
    if layout.split == "tiles":
        from .tiles import Tiles

        return Tiles(transport, layout.render)
    from .direct import Direct

    return Direct(transport, layout.render)
