"""What the kinds of layers share: programs from shader files, camera uniforms, one draw call a frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from importlib.resources import files
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ...shared.camera import Camera
from ...shared.layers.layer import Layer
from ..raster.pieces import check_entries

if TYPE_CHECKING:
    import moderngl

    from ...shared.layer_config import LayerSection

COMMAND = np.dtype(
    {
        "names": ["count", "instances", "first", "first_instance"],
        "formats": ["<u4"] * 4,
        "itemsize": 20,
    }
)
"""Of glMultiDrawArraysIndirect, at the stride that the binding takes; with indices, when only the first three count, of
glMultiDrawElementsIndirect."""

VARYINGS = ("layer_position", "layer_normal")
"""Outputs of the last stage before rasterization that tests capture: vec3, relative to the layer's origin."""


class Drawn(Protocol):
    """A layer on the device, however many calls draw it."""

    @property
    def resident_bytes(self) -> int:
        """Device memory of the layer's records or vertices."""
        ...

    @property
    def static_bytes(self) -> int:
        """Of ``resident_bytes``: templates that are there once, however many objects there are."""
        ...

    def draw(self, camera: Camera, entries: np.ndarray) -> None:
        """Draw objects into the framebuffer in use. Raises MessageError for entries beyond the objects."""
        ...


class GlLayer(ABC):
    """A layer on the device, drawn with one technique.

    Subclasses make ``program`` and ``vertices`` in ``_prepare`` and say in ``_commands`` what a frame draws.
    """

    program: moderngl.Program
    vertices: moderngl.VertexArray

    def __init__(self, context: moderngl.Context, layer: Layer, settings: LayerSection) -> None:
        self._context = context
        self._layer = layer
        self._settings = settings
        self._indirect = context.buffer(reserve=COMMAND.itemsize << 6)
        self._prepare()

    @abstractmethod
    def _prepare(self) -> None:
        """Make the program and the vertex array: what is sent once."""

    @abstractmethod
    def _commands(self, offset: np.ndarray, count: np.ndarray) -> np.ndarray:
        """(m,) COMMAND that draw ``count`` objects from ``offset`` on, each (m,) int64."""

    @abstractmethod
    def _set_uniforms(self, camera: Camera) -> None:
        """What depends on the camera or may change between frames, besides the projection."""

    @property
    def resident_bytes(self) -> int:
        """Device memory of the layer's records or vertices; set by ``_prepare``."""
        return self._resident_bytes

    _resident_bytes = 0
    static_bytes = 0
    """Of ``resident_bytes``: a template that is there once, however many objects there are."""

    def draw(self, camera: Camera, entries: np.ndarray) -> None:
        """Draw objects into the framebuffer in use, in one call. Raises MessageError for entries beyond the objects."""
        check_entries(entries, len(self._layer))
        if not len(entries):
            return
        commands = self._commands(entries["offset"].astype(np.int64), entries["range"].astype(np.int64))
        if commands.nbytes > self._indirect.size:
            self._indirect.release()
            self._indirect = self._context.buffer(reserve=2 * commands.nbytes)
        self._indirect.write(commands)
        self.set_camera(camera)
        self.vertices.render_indirect(self._indirect, count=len(commands))

    def set_camera(self, camera: Camera) -> None:
        """Set the uniforms of a frame. The eye is subtracted in float64, and the matrix rounded once."""
        set_uniform(
            self.program, "clip_from_layer", clip_from_layer(camera, self._layer.origin).T.astype("f4").tobytes()
        )
        set_uniform(self.program, "eye", tuple(camera.eye - self._layer.origin))
        set_uniform(self.program, "near", camera.near)
        set_uniform(self.program, "viewport", (camera.width, camera.height))
        set_uniform(self.program, "focal_px", camera.focal_px)
        self._set_uniforms(camera)


def commands(
    first: np.ndarray, count: np.ndarray, first_instance: np.ndarray | int = 0, instances: np.ndarray | int = 1
) -> np.ndarray:
    """(m,) COMMAND from its columns."""
    made = np.zeros(len(first), COMMAND)
    made["first"], made["count"], made["first_instance"], made["instances"] = first, count, first_instance, instances
    return made


def clip_from_layer(camera: Camera, origin: np.ndarray) -> np.ndarray:
    """(4, 4) float64: row 0 of the image is at y = −1, so nothing is flipped on the way back; w is the depth.

    z / w is −1 at the near plane and 1 infinitely far away.
    """
    x, y, w = camera.pixel_from_world[:, :3]
    clip = np.zeros((4, 4))
    clip[0, :3], clip[1, :3], clip[2, :3], clip[3, :3] = 2 / camera.width * x - w, 2 / camera.height * y - w, w, w
    clip[:, 3] = clip[:, :3] @ (origin - camera.eye)
    clip[2, 3] -= 2 * camera.near
    return clip


def set_uniform(program: moderngl.Program, name: str, value: object) -> None:
    """Set a uniform, where the program has it: compilers leave out what does not matter."""
    if name not in program:
        return
    if isinstance(value, bytes):
        program[name].write(value)  # type: ignore[union-attr]
    else:
        program[name].value = value  # type: ignore[union-attr]


def layer_shader(*names: str, defines: tuple[str, ...] = ()) -> str:
    """One GLSL source of the named files of ``shaders/`` behind version and definitions."""
    folder = files(str(__package__)) / "shaders"
    lines = ["#version 450", *(f"#define {name}" for name in defines)]
    return "\n".join(lines + [(folder / f"{name}.glsl").read_text(encoding="utf-8") for name in names])
