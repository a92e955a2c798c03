"""Trajectories as segments, tubes and balls, in NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...shared.errors import ConfigError
from ...shared.layer_config import TrajectoryStyle
from ...shared.layers.layer import Layer
from ...shared.layers.trajectories import NEIGHBOUR, SHARED
from .mesh import Mesh

HIDDEN, CAP, ALONE = 1, 2, 4
"""Of a node on the device: it is drawn with another run; no joint, as tubes end here or turn by more than 60°;
nothing but a node, as its trajectory has a single place."""

SHARPEST = 0.5
"""Cosine of the turn up to which two tubes share a ring."""

BALL = 2.0
"""Radius of spheres and splats in radii of the tube."""

_STEEP = 0.9


@dataclass(frozen=True)
class Segments:
    """What tubes and lines are between.

    index : (s, 4) int64 elements: the place before, start, end, the place after.
    first_segment : (n + 1,) int64, where the segments of each object begin.
    flags : (m,) uint8 of the elements.
    """

    index: np.ndarray
    first_segment: np.ndarray
    flags: np.ndarray


def segments(layer: Layer) -> Segments:
    """The segments between places that differ."""
    position, role = layer.elements["position"], layer.elements["role"]
    guard = role == NEIGHBOUR
    starts = np.append(True, (position[1:] != position[:-1]).any(axis=1)) | guard | np.append(True, guard[:-1])
    place = np.flatnonzero(starts)
    at, is_node = position[place].astype(np.float64), ~guard[place]
    real = np.flatnonzero(is_node)
    comes, goes = (_direction(at[real + b] - at[real + a]) for a, b in ((-1, 0), (0, 1)))
    starts_here, ends_here = (~d.any(axis=1) for d in (comes, goes))
    flags = np.where(guard | (role == SHARED), HIDDEN, 0).astype(np.uint8)
    turn = (comes * goes).sum(axis=1)  # 0 at ends
    flags[place[real]] |= np.where(turn < SHARPEST, CAP, 0).astype(np.uint8)
    flags[place[real]] |= np.where(starts_here & ends_here, ALONE, 0).astype(np.uint8)
    k = np.flatnonzero(is_node[:-1] & is_node[1:])
    index = place[k[:, None] + np.arange(-1, 3)]
    return Segments(index, np.searchsorted(index[:, 1], layer.first_element), flags)


@dataclass(frozen=True)
class Look:
    """What the transfer function makes of nodes, whatever is drawn of them.

    value, radius : (m,) float64.  selected : (m,) bool.  highlight : least and largest value that is drawn so too.
    """

    value: np.ndarray
    radius: np.ndarray
    selected: np.ndarray
    highlight: tuple[float, ...]

    @classmethod
    def of(cls, layer: Layer, style: TrajectoryStyle) -> Look:
        """The twin of ``trajectory.glsl``."""
        low, high = acceleration_range(layer, style)
        span = high - low
        strength = np.abs(layer.elements["acceleration"].astype(np.float64))
        t = np.clip((strength - low) / span, 0, 1) if span else np.full(len(strength), 0.5)
        radius = radius_range(layer, style)
        number = np.repeat(layer.objects["trajectory"], np.diff(layer.first_element))
        chosen = selection(layer, style)[number]
        value = values(layer, style).astype(np.float64)
        return cls(value, radius[0] + t * (radius[1] - radius[0]), chosen, style.highlight or (1.0, 0.0))

    def is_highlighted(self, value: np.ndarray, element: np.ndarray) -> np.ndarray:
        """Of nodes or segments with these values."""
        return self.selected[element] | ((value >= self.highlight[0]) & (value <= self.highlight[1]))


def values(layer: Layer, style: TrajectoryStyle) -> np.ndarray:
    """(m,) float32: what the colour map colours; heights are of the world."""
    if style.colour == "height":
        return layer.elements["position"][:, 2] + np.float32(layer.origin[2])
    return layer.elements[style.colour]


def radius_range(layer: Layer, style: TrajectoryStyle) -> tuple[float, float]:
    """World units."""
    radius = float(layer.parameters["radius"])
    return style.radius[0] * radius, style.radius[1] * radius


def acceleration_range(layer: Layer, style: TrajectoryStyle) -> tuple[float, float]:
    """That of the configuration, else from 0 up to what 98 % of the nodes stay below."""
    if style.acceleration_range:
        low, high = style.acceleration_range
        return low, high
    nodes = layer.elements["role"] != NEIGHBOUR
    return 0.0, float(np.quantile(np.abs(layer.elements["acceleration"][nodes]), 0.98))


def selection(layer: Layer, style: TrajectoryStyle) -> np.ndarray:
    """(trajectories,) bool. Raises ConfigError for a name that there is not."""
    names = layer.parameters["names"]
    wanted = {str(name) for name in style.selected}
    missing = wanted - set(names)
    if missing:
        known = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
        raise ConfigError(
            f"layer {layer.name}: trajectories.selected: found {min(missing)!r}, expected some of {known}"
        )
    return np.array([name in wanted for name in names], bool)


@dataclass(frozen=True)
class Templates:
    """The vertices of a tube and of a ball with so many sides.

    tube : (2 s + 2, 2) int32 of a strip: 0 start, 1 end; which vertex of the ring.
    ball : (bands, 2 s + 2, 3) float64 unit vectors, a strip a band.
    """

    sides: int

    @property
    def bands(self) -> int:
        """From pole to pole."""
        return max(self.sides // 2, 2)

    @cached_property
    def tube(self) -> np.ndarray:
        """Both ends in turn, so that triangles go around."""
        turn = np.repeat(np.arange(self.sides + 1) % self.sides, 2)
        return np.column_stack([np.tile([1, 0], self.sides + 1), turn]).astype(np.int32)

    @cached_property
    def ball(self) -> np.ndarray:
        """Lower and upper end in turn."""
        side, end = self.tube[:, 1], self.tube[:, 0]
        angle = 2 * np.pi * side / self.sides
        down = np.pi * (np.arange(self.bands)[:, None] + 1 - end) / self.bands
        return np.stack([np.sin(down) * np.cos(angle), np.sin(down) * np.sin(angle), np.cos(down)], axis=-1)


def strips(layer: Layer, style: TrajectoryStyle) -> Mesh:
    """A strip a tube and a strip a band of a ball, of what is drawn near, at any distance.

    Raises ConfigError for styles that are neither tubes nor spheres.
    """
    fixed_style(layer, style)
    parts, look, template = segments(layer), Look.of(layer, style), Templates(style.sides)
    index, start = parts.index, parts.index[:, 1]
    value = look.value[index[:, 1:3]].mean(axis=1)
    drawn = np.full(len(index), style.style != "spheres") | look.is_highlighted(value, start)
    index, value = index[drawn], value[drawn]
    position, normal = _tubes(layer, look, parts.flags, index, template)

    nodes = np.flatnonzero(parts.flags & HIDDEN == 0)
    large = np.full(len(nodes), style.style == "spheres") | look.is_highlighted(look.value[nodes], nodes)
    balls = large | (parts.flags[nodes] & CAP > 0)
    nodes, large = nodes[balls], large[balls]
    radius = look.radius[nodes] * np.where(large, BALL, 1.0)
    out = np.broadcast_to(template.ball, (len(nodes), *template.ball.shape))
    middle = layer.elements["position"][nodes].astype(np.float64)
    ball_position = middle[:, None, None] + radius[:, None, None, None] * out

    of_tube, of_ball = (np.searchsorted(layer.first_element, e, side="right") - 1 for e in (index[:, 1], nodes))
    owner = np.concatenate([of_tube, np.repeat(of_ball, template.bands)])
    order = np.argsort(owner, kind="stable")
    length = len(template.tube)
    position, normal = (
        np.concatenate([tube, ball.reshape(-1, length, 3)])[order].reshape(-1, 3)
        for tube, ball in ((position, ball_position), (normal, out))
    )
    strip_value = np.concatenate([value, np.repeat(look.value[nodes], template.bands)])[order]
    first_strip = length * np.arange(len(order) + 1)
    first = length * np.searchsorted(owner[order], np.arange(len(layer) + 1))
    return Mesh(position, normal, np.repeat(strip_value, length), first, first_strip)


def fixed_style(layer: Layer, style: TrajectoryStyle) -> None:
    """Raise ConfigError for what only attributed vertices draw."""
    if style.style in ("lines", "splats"):
        raise ConfigError(
            f"layer {layer.name}: trajectories.style = {style.style!r}: other techniques than 'avc' draw tubes and"
            " spheres only"
        )


def _tubes(
    layer: Layer, look: Look, flags: np.ndarray, index: np.ndarray, template: Templates
) -> tuple[np.ndarray, np.ndarray]:
    """((s, v, 3) positions, (s, v, 3) normals) of the strips of segments."""
    before, start, end, after = layer.elements["position"].astype(np.float64)[index.T]
    along = _direction(end - start)
    ends = np.stack(
        [
            np.where(flags[index[:, 1:2]] & CAP, along, _direction(_direction(start - before) + along)),
            np.where(flags[index[:, 2:3]] & CAP, along, _direction(along + _direction(after - end))),
        ]
    )
    u = _direction(np.where(np.abs(ends[..., 2:]) < _STEEP, _across_z(ends), _across_x(ends)))
    v = np.cross(ends, u)
    angle = np.arctan2((u[0] * v[1]).sum(axis=1), (u[0] * u[1]).sum(axis=1))
    step = 2 * np.pi / template.sides
    shift = np.stack([np.zeros(len(index)), np.rint(angle / step)])
    which, side = template.tube.T
    turn = step * ((side + shift[which].T) % template.sides)
    normal = np.cos(turn)[..., None] * u[which].swapaxes(0, 1) + np.sin(turn)[..., None] * v[which].swapaxes(0, 1)
    centre = np.stack([start, end])[which].swapaxes(0, 1)
    radius = look.radius[index[:, 1:3]].T[which].T
    return centre + radius[..., None] * normal, normal


def _across_z(t: np.ndarray) -> np.ndarray:
    return np.stack([t[..., 1], -t[..., 0], np.zeros(t.shape[:-1])], axis=-1)


def _across_x(t: np.ndarray) -> np.ndarray:
    return np.stack([np.zeros(t.shape[:-1]), t[..., 2], -t[..., 1]], axis=-1)


def _direction(v: np.ndarray) -> np.ndarray:
    """Of length 1; 0 stays 0. No square overflows or vanishes."""
    largest = np.abs(v).max(axis=-1, keepdims=True)
    v = np.divide(v, largest, out=np.zeros_like(v), where=largest > 0)
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, length, out=v, where=length > 0)
