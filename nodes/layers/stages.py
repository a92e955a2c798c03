"""How many components each stage of a technique is given, from the declarations of its shaders."""

from __future__ import annotations

import re

from .gl_layer import layer_shader

_DECLARED = re.compile(r"^(?:flat )?in (float|int|i?vec[234]) ([^;]*);", re.MULTILINE)
_POSITION = 4

_BLOCK_SHADERS = {
    "avc": ("blocks.vert", "blocks.geom"),
    "instancing": ("blocks_instanced.vert", None),
    "triangles": ("block_mesh.vert", None),
    "strips": ("block_mesh.vert", None),
}


def input_components(technique: str) -> tuple[int, int | None, int]:
    """Components that vertex shader, geometry shader (None: there is none) and rasterizer get of a vertex of a block.

    A three-dimensional position has three; what follows the first stage has ``gl_Position`` besides.
    Source: "Attributed Vertex Clouds", table 1.2.
    """
    vertex, geometry = _BLOCK_SHADERS[technique]
    return (
        _declared(vertex),
        None if geometry is None else _POSITION + _declared(geometry),
        _POSITION + _declared("blocks.frag"),
    )


def _declared(shader: str) -> int:
    """Components of the inputs that a shader declares."""
    return sum(
        (int(kind[-1]) if "vec" in kind else 1) * len(names.split(","))
        for kind, names in _DECLARED.findall(layer_shader(shader))
    )
