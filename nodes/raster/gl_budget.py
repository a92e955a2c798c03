"""Less device memory than points: what does not fit is sent with every frame.

Source: Kim, Lee, Varshney, "Vertex Transformation Streams", section 7, the constant GPU memory model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import moderngl


class SentEachFrame:
    """The ends of buffers on a device, sent anew before each frame as if there were no room for them.

    parts : buffers, and the first byte of each that is sent.
    """

    def __init__(self, context: moderngl.Context, parts: Sequence[tuple[moderngl.Buffer, int]]) -> None:
        self._context = context
        with context:
            self._parts = [(buffer, first, buffer.read(offset=first)) for buffer, first in parts if first < buffer.size]

    @property
    def n_bytes(self) -> int:
        """Bytes of a frame."""
        return sum(len(data) for _, _, data in self._parts)

    def send(self) -> None:
        """Copy them to the device. Cost: ``n_bytes``."""
        with self._context:
            for buffer, first, data in self._parts:
                buffer.write(data, offset=first)
