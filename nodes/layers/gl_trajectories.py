"""Trajectories: attributed vertices that become lines, tubes, balls or discs, and hardware instancing beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...shared.camera import Camera
from .expand_trajectories import (
    Segments,
    Templates,
    acceleration_range,
    fixed_style,
    radius_range,
    segments,
    selection,
    strips,
    values,
)
from .gl_gradient import Gradient
from .gl_layer import VARYINGS, GlLayer, commands, layer_shader, set_uniform
from .gl_mesh import GlMesh
from .mesh import for_technique

if TYPE_CHECKING:
    import moderngl

    from ...shared.layer_config import LayerSection, TrajectoryStyle
    from ...shared.layers.layer import Layer

RECORD = np.dtype([("position", "<f4", 3), ("motion", "<f4", 3), ("owner", "<u4")])
"""A node on the device. owner : 8 × number of its trajectory + flags of ``expand_trajectories``."""

STYLES = ("auto", "lines", "splats", "spheres", "tubes")
COLOURS = ("speed", "acceleration", "time", "height")
_RECORD, _NAMES = "3f4 3f4 1u4", ("position", "motion", "owner")
_RECORDS, _SELECTION = 0, 1  # where the shaders expect them


class _Shared:
    """What the draw calls of a layer share: records, segments, selection, colour map."""

    def __init__(self, context: moderngl.Context, layer: Layer, settings: LayerSection) -> None:
        self._layer = layer
        self.parts: Segments = segments(layer)
        self.templates = Templates(settings.trajectories.sides)
        e = layer.elements
        records = np.empty(len(e), RECORD)
        records["position"] = e["position"]
        records["motion"] = np.column_stack([e["time"], e["speed"], e["acceleration"]])
        number = np.repeat(layer.objects["trajectory"], np.diff(layer.first_element))
        records["owner"] = 8 * number + self.parts.flags
        self.records = context.buffer(records)
        self.index = context.buffer(np.ascontiguousarray(self.parts.index, np.int32)) if len(self.parts.index) else None
        self._selection = context.buffer(reserve=4 * (len(layer.parameters["names"]) // 32 + 1))
        style = settings.trajectories
        self._gradient = Gradient(context, settings, values(layer, style))
        self.bytes = self.records.size + (self.index.size if self.index else 0) + self._selection.size
        self.restyle(style)

    def restyle(self, style: TrajectoryStyle) -> None:
        """Another style, selection or mapping: no record is sent for it. ``colour`` needs its own value range."""
        self.style = style
        chosen = np.packbits(selection(self._layer, style), bitorder="little")
        self._selection.write(chosen.tobytes().ljust(self._selection.size, b"\0"))
        self.has_highlights = bool(style.selected or style.highlight)
        self._radius_range = radius_range(self._layer, style)
        self._acceleration_range = acceleration_range(self._layer, style)

    def set(self, program: moderngl.Program, style: str) -> None:
        """Bind and set what the shaders of all draw calls ask for."""
        self._gradient.set(program)
        self.records.bind_to_storage_buffer(_RECORDS)
        self._selection.bind_to_storage_buffer(_SELECTION)
        set_uniform(program, "style", STYLES.index(style))
        set_uniform(program, "colour_by", COLOURS.index(self.style.colour))
        set_uniform(program, "ground", float(self._layer.origin[2]))
        set_uniform(program, "acceleration_range", self._acceleration_range)
        set_uniform(program, "radius_range", self._radius_range)
        set_uniform(program, "highlight", self.style.highlight or (1.0, 0.0))
        set_uniform(program, "tube_px", self.style.tube_px)


class _Part(GlLayer):
    """One draw call of a layer, of one type of geometry."""

    def __init__(self, context: moderngl.Context, layer: Layer, settings: LayerSection, shared: _Shared) -> None:
        self._shared = shared
        self._defines = (f"SIDES {shared.templates.sides}", f"BANDS {shared.templates.bands}")
        super().__init__(context, layer, settings)

    def _set_uniforms(self, camera: Camera) -> None:
        self._shared.set(self.program, self._style())

    def _style(self) -> str:
        return self._shared.style.style

    def is_wanted(self) -> bool:
        """Whether the style asks for this geometry anywhere."""
        raise NotImplementedError

    def _segments(self, offset: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first = self._shared.parts.first_segment
        return first[offset], first[offset + count] - first[offset]

    def _nodes(self, offset: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first = self._layer.first_element
        return first[offset], first[offset + count] - first[offset]

    def _vertex_shader(self) -> str:
        return layer_shader("gradient", "trajectory", "trajectory_node", "trajectories.vert")

    def _geometry_shader(self, *names: str) -> str:
        before = ("gradient", "trajectory", "trajectory_input")
        return layer_shader(*before, *names, defines=self._defines)


class _Segments(_Part):
    """Something a segment; shader files of what is made of it, and of its fragments."""

    _geometry: tuple[str, ...]
    _fragment: str

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=self._vertex_shader(),
            geometry_shader=self._geometry_shader(*self._geometry),
            fragment_shader=layer_shader("word", self._fragment),
            varyings=VARYINGS,
        )
        self.vertices = self._context.vertex_array(
            self.program,
            [(self._shared.records, _RECORD, *_NAMES)],
            index_buffer=self._shared.index,
            mode=moderngl.LINES_ADJACENCY,
        )

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        first, n = self._segments(offset, count)
        return commands(4 * first, 4 * n)


class _Lines(_Segments):
    """A line a segment."""

    _geometry, _fragment = ("output", "emit", "trajectory_lines.geom"), "line.frag"

    def is_wanted(self) -> bool:
        return self._shared.style.style in ("auto", "lines")


class _Tubes(_Segments):
    """A tube a segment."""

    _geometry, _fragment = ("tube", "output", "emit", "trajectory_tubes.geom"), "surface.frag"

    def is_wanted(self) -> bool:
        return self._shared.style.style in ("auto", "tubes") or self._shared.has_highlights


class _Nodes(_Part):
    """A ball or a disc a node, where there is one."""

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=self._vertex_shader(),
            geometry_shader=self._geometry_shader("ball", "output", "emit", "trajectory_nodes.geom"),
            fragment_shader=layer_shader("word", "surface.frag"),
            varyings=VARYINGS,
        )
        self.vertices = self._context.vertex_array(
            self.program, [(self._shared.records, _RECORD, *_NAMES)], mode=moderngl.POINTS
        )

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        return commands(*self._nodes(offset, count))

    def is_wanted(self) -> bool:
        return True  # trajectories of one place are balls in any style


class _TubeInstances(_Tubes):
    """A strip, drawn once a segment."""

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=layer_shader(
                *("gradient", "trajectory", "trajectory_node", "tube", "output", "trajectory_tubes_instanced.vert"),
                defines=self._defines,
            ),
            fragment_shader=layer_shader("word", "surface.frag"),
        )
        template = self._context.buffer(self._shared.templates.tube)
        self.static_bytes = self._resident_bytes = template.size
        content = [(template, "2i4", "corner"), (self._shared.index, "4i4 /i", "segment")]
        self.vertices = self._context.vertex_array(self.program, content, mode=moderngl.TRIANGLE_STRIP)

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        first, n = self._segments(offset, count)
        return commands(np.zeros_like(offset), np.full_like(offset, len(self._shared.templates.tube)), first, n)

    def _style(self) -> str:
        return _fixed(self._shared.style.style)


class _NodeInstances(_Nodes):
    """A strip of all bands, drawn once a node."""

    def _prepare(self) -> None:
        import moderngl

        self.program = self._context.program(
            vertex_shader=layer_shader(
                *("gradient", "trajectory", "trajectory_node", "ball", "output", "trajectory_nodes_instanced.vert"),
                defines=self._defines,
            ),
            fragment_shader=layer_shader("word", "surface.frag"),
        )
        tube, bands = self._shared.templates.tube, self._shared.templates.bands
        corner = np.column_stack([np.repeat(np.arange(bands, dtype=np.int32), len(tube)), np.tile(tube, (bands, 1))])
        self._length = len(corner)
        template = self._context.buffer(np.ascontiguousarray(corner))
        self.static_bytes = self._resident_bytes = template.size
        content = [(template, "3i4", "corner"), (self._shared.records, f"{_RECORD} /i", *_NAMES)]
        self.vertices = self._context.vertex_array(self.program, content, mode=moderngl.TRIANGLE_STRIP)

    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        first, n = self._nodes(offset, count)
        return commands(np.zeros_like(offset), np.full_like(offset, self._length), first, n)

    def _style(self) -> str:
        return _fixed(self._shared.style.style)


def _fixed(style: str) -> str:
    return "tubes" if style == "auto" else style


class GlTrajectories:
    """A layer of trajectories: a draw call for each type of geometry that its style asks for."""

    def __init__(self, context: moderngl.Context, layer: Layer, settings: LayerSection) -> None:
        instanced = settings.technique == "instancing"
        if instanced:
            fixed_style(layer, settings.trajectories)
        self.shared = _Shared(context, layer, settings)
        kinds = (_TubeInstances, _NodeInstances) if instanced else (_Lines, _Tubes, _Nodes)
        if self.shared.index is None:  # single places only
            kinds = kinds[-1:]
        self.parts = [kind(context, layer, settings, self.shared) for kind in kinds]

    @property
    def resident_bytes(self) -> int:
        """As of ``GlLayer``."""
        return self.shared.bytes + self.static_bytes

    @property
    def static_bytes(self) -> int:
        """As of ``GlLayer``."""
        return sum(part.static_bytes for part in self.parts)

    def draw(self, camera: Camera, entries: np.ndarray) -> None:
        """As of ``GlLayer``, in up to three calls."""
        for part in self.parts:
            if part.is_wanted():
                part.draw(camera, entries)


def trajectory_mesh(context: moderngl.Context, layer: Layer, settings: LayerSection) -> GlMesh:
    """Tubes and balls as triangles or strips, coloured as those of ``GlTrajectories``."""
    mesh, of_nodes = strips(layer, settings.trajectories), values(layer, settings.trajectories)
    ends = settings.value_range or (float(of_nodes.min()), float(of_nodes.max()))
    settings = settings.model_copy(update={"value_range": ends})
    return GlMesh(context, layer, settings, for_technique(mesh, settings.technique))
