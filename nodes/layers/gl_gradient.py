"""Values → colours and filter, as ``gradient.glsl`` takes them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...shared.colour import colormap_words
from .gl_layer import set_uniform

if TYPE_CHECKING:
    import moderngl

    from ...shared.layer_config import LayerSection

FLOAT_MAX = float(np.finfo(np.float32).max)


class Gradient:
    """The colour map of a layer on the device. Its range and filter are uniforms: changing them sends nothing else."""

    def __init__(self, context: moderngl.Context, settings: LayerSection, values: np.ndarray) -> None:
        self._texture = context.texture((256, 1), 4, colormap_words(settings.colormap, "layers.colormap").tobytes())
        low, high = settings.value_range or (float(values.min()), float(values.max()))
        self.value_range = low, high
        self.value_filter = settings.value_filter or (-FLOAT_MAX, FLOAT_MAX)

    def set(self, program: moderngl.Program) -> None:
        """Bind the colour map and set the uniforms of a program."""
        self._texture.use(0)
        set_uniform(program, "gradient", 0)
        set_uniform(program, "value_range", self.value_range)
        set_uniform(program, "value_filter", self.value_filter)
