"""Layers of degenerate, crossing and far objects; drawn ones against the triangles of the NumPy expansion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...shared.camera import Camera
from ...shared.layer_config import ArcStyle, LayerSection, TrajectoryStyle
from ...shared.layers import arcs, blocks, cuboids
from ...shared.layers.box_octree import box_octree
from ...shared.layers.layer import Layer, simple_layer
from ...shared.layers.polygons import polygon_layer
from ...shared.layers.trajectories import trajectory_layer
from ...shared.messages import RENDER_POINT
from ...shared.stability.case import OutOfReach, case, cases, expect
from .chain import camera_at, is_drawn

_SHARE = 0.002
"""Of pixels: edges of a triangle fall to either side where positions differ in their last bit."""

_HALF = 50
_FAR = np.array([6e6, 5e6, 100.0])
_SQUARE = np.array([(0, 0), (6, 0), (6, 6), (0, 6)], np.float64)
_BOW_TIE = np.array([(0, 0), (8, 8), (8, 0), (0, 8)], np.float64)


def _draw(layer: Layer, camera: Camera, technique: str = "avc", segments: int = 64) -> np.ndarray:
    """The words of all objects, in one draw."""
    from ..raster.gl_context import gl_available

    available, reason = gl_available()
    if not available:
        raise OutOfReach(reason)
    from ..layers.gl_canvas import GlLayers

    styles = {"arcs": ArcStyle(segments=segments), "trajectories": TrajectoryStyle(style="tubes")}
    settings = LayerSection(path="", technique=technique, **styles)  # type: ignore[arg-type]
    entries = np.ones(1, RENDER_POINT)
    entries["offset"], entries["range"] = 0, len(layer)
    with GlLayers([layer], [settings], camera.width, camera.height) as canvas:
        return canvas.draw(camera, [entries]).copy()


def _camera(by: np.ndarray | float = 0.0) -> Camera:
    """Above a corner of the objects; its numbers are short, so that the same ones far away are exact."""
    eye, target = np.array([90.0, 70.0, 60.0]) + by, np.array([0.0, 0.0, 5.0]) + by
    return camera_at(eye, target, fov_deg=50.0, width=320, height=240, near=0.5)


def _places(n: int, seed: int) -> np.ndarray:
    """(n, 2) float64 in multiples of 1/8."""
    return np.random.default_rng(seed).integers(-8 * _HALF, 8 * _HALF, (n, 2)) / 8


def _cuboids(n: int = 80, seed: int = 1) -> np.ndarray:
    objects = np.zeros(n, cuboids.OBJECT)
    objects["center"], objects["extent"] = _places(n, seed), (6, 9)
    objects["height"][:, 1], objects["value"] = np.arange(n) % 12, np.arange(n)
    return objects


def _arcs(n: int = 80, seed: int = 2) -> np.ndarray:
    objects = np.zeros(n, arcs.OBJECT)
    objects["center"], objects["radius"] = _places(n, seed), (2, 6)
    objects["angle"][:, 0] = np.arange(n)
    objects["angle"][:, 1] = objects["angle"][:, 0] + 2
    objects["height"][:, 1], objects["value"] = 1 + np.arange(n) % 12, np.arange(n)
    return objects


def _polygons(outlines: list[np.ndarray], seed: int = 3) -> Layer:
    places = _places(len(outlines), seed)
    height = np.column_stack([np.zeros(len(outlines)), 1.0 + np.arange(len(outlines)) % 12])
    shapes = [[[outline + place]] for outline, place in zip(outlines, places, strict=True)]
    return polygon_layer("made", shapes, height, np.arange(float(len(outlines))))[0]


def _blocks() -> Layer:
    objects = np.zeros(400, blocks.OBJECT)
    objects["cell"] = np.random.default_rng(4).integers((-12, -12, 0), (12, 12, 4), (400, 3))
    objects["type"] = np.arange(400) % 3
    colours = ["#b04030", "#30a050", "#3050b0"]
    return simple_layer("made", "blocks", np.zeros(3), objects, block_size=4.0, colours=colours)


def _changed(objects: np.ndarray, kind: str, **values: object) -> Layer:
    """A layer of records of which every other one has these values."""
    for name, value in values.items():
        objects[name][::2] = value
    return simple_layer("made", kind, np.zeros(3), objects)


def _tracks(track: Callable[[np.ndarray], np.ndarray]) -> Layer:
    """20 tracks; track : (n,) whole numbers → (n, 3) places of one."""
    nodes = np.arange(24)
    places = np.column_stack([_places(20, 7), np.arange(20) % 12])
    position = np.concatenate([place + track(nodes) for place in places])
    number = np.repeat(np.arange(20), len(nodes))
    names = [str(i) for i in range(20)]
    return trajectory_layer("made", position, number, names, np.tile(nodes.astype(np.float64), 20), radius=2.5)


def _winding(node: np.ndarray) -> np.ndarray:
    return np.column_stack([6 * np.cos(node / 3), 6 * np.sin(node / 3), node / 4])


_LAYERS: dict[str, Callable[[], Layer]] = {
    "cuboids of zero extent": lambda: _changed(_cuboids(), "cuboids", extent=0, height=(3, 3)),
    "cuboids flat along x": lambda: _changed(_cuboids(), "cuboids", extent=(0, 9)),
    "arcs of radius 0": lambda: _changed(_arcs(), "arcs", radius=0),
    "arcs from radius 0": lambda: _changed(_arcs(), "arcs", radius=(0, 6)),
    "arcs of span 0": lambda: _changed(_arcs(), "arcs", angle=(1, 1)),
    "arcs of span 2π": lambda: _changed(_arcs(), "arcs", angle=(1, 1 + 2 * np.pi)),
    "outlines that cross themselves": lambda: _polygons([_BOW_TIE, _SQUARE] * 40),
    "tracks of repeated points": lambda: _tracks(lambda node: _winding(node // 4 * 4)),
    "tracks that turn back": lambda: _tracks(lambda node: np.column_stack([node % 2 * 8, node * 0, node * 0])),
    "tracks of one place": lambda: _tracks(lambda node: _winding(node * 0)),
}


@cases("layers/expanded", bounds=dict.fromkeys(_LAYERS, _SHARE), unit="of pixels")
def expanded(name: str) -> float:
    """Share of the pixels whose colour differs between objects that shaders make of their records, every other one of
    them degenerate, and the triangles of the NumPy expansion.
    """
    layer, camera = _LAYERS[name](), _camera()
    ours, expected = (_draw(layer, camera, technique) for technique in ("avc", "triangles"))
    expect(is_drawn(expected).sum() > 1000, "the picture shows something")
    return float((ours.astype(np.uint32) != expected.astype(np.uint32)).mean())


@case("layers/outlines without area", bound=0.0, unit="pixels")
def without_area() -> float:
    """Pixels that outlines of one point, one line or no extent change, among others that are sound."""
    flat = [_SQUARE * (1, 0), _SQUARE * 0, _SQUARE[:2], np.concatenate([_SQUARE[:3], _SQUARE[1::-1]])]
    outlines = [_SQUARE, *flat] * 10
    sound = [i for i in range(len(outlines)) if i % 5 == 0]
    places = np.repeat(_places(len(sound), 5), 5, axis=0)
    height = np.column_stack([np.zeros(len(outlines)), 1.0 + np.arange(len(outlines)) % 12])

    def layer_of(chosen: list[int]) -> Layer:
        shapes = [[[outlines[i] + places[i]]] for i in chosen]
        return polygon_layer("made", shapes, height[chosen], np.array(chosen, np.float64))[0]

    camera = _camera()
    both, alone = _draw(layer_of(list(range(len(outlines)))), camera), _draw(layer_of(sound), camera)
    expect(is_drawn(alone).sum() > 1000, "the picture shows something")
    return float((both != alone).sum())


_KINDS: dict[str, Callable[[], Layer]] = {
    "blocks": _blocks,
    "cuboids": lambda: simple_layer("made", "cuboids", np.zeros(3), _cuboids()),
    "arcs": lambda: simple_layer("made", "arcs", np.zeros(3), _arcs()),
    "polygons": lambda: _polygons([_BOW_TIE, _SQUARE] * 40),
    "trajectories": lambda: _tracks(_winding),
}


@cases("layers/6e6 m away", bounds=dict.fromkeys(_KINDS, 0.0), unit="pixels")
def far_away(name: str) -> float:
    """Pixels, their depths included, of objects 6e6 m from the origin that differ from the same at the origin."""
    layer = _KINDS[name]()
    near = _draw(layer, _camera())
    expect(is_drawn(near).sum() > 1000, "the picture shows something")
    moved = replace(layer, origin=layer.origin + _FAR)
    return float((_draw(moved, _camera(_FAR)) != near).sum())


@case("layers/200 000 arcs", bound=_SHARE, unit="of pixels")
def many_arcs() -> float:
    """Share of the pixels whose colour differs between 200 000 arcs, each of the fewest segments, in one draw, and
    instances of a template.
    """
    n = 200_000
    objects = _arcs(n)
    objects["radius"] *= 0.1
    layer = simple_layer("made", "arcs", np.zeros(3), objects)
    camera = _camera()
    ours, expected = (_draw(layer, camera, technique, segments=1) for technique in ("avc", "instancing"))
    expect(is_drawn(expected).sum() > 1000, "the picture shows something")
    return float((ours.astype(np.uint32) != expected.astype(np.uint32)).mean())


@cases("layers/area of an outline that crosses itself", bounds=dict.fromkeys((1e-6, 1.0, 1e12), 1e-5), unit="of it")
def area(size: float) -> float:
    """Relative error of the area that the fans of a zigzag have, whose 40 edges there cross those back."""
    n = 40
    there = np.column_stack([np.arange(n + 1), np.arange(n + 1) % 2])
    back = np.column_stack([np.arange(n, -1, -1), (np.arange(n, -1, -1) + 1) % 2])
    layer, _ = polygon_layer("made", [[[np.concatenate([there, back]) * size]]], np.array([[0.0, 1.0]]), np.zeros(1))
    start, apex = (layer.elements[name].astype(np.float64) for name in ("position", "apex"))
    a, b = start[:-1] - apex[:-1], start[1:] - apex[:-1]
    same_fan = (apex[1:] == apex[:-1]).all(axis=1)
    found = np.abs((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])[same_fan]).sum() / 2
    return float(abs(found / (n / 2 * size**2) - 1))


_BOXES: dict[str, tuple[float, float, float]] = {
    "1e-30 m": (1e-30, 0.0, 0.1),
    "1e-9 m": (1e-9, 0.0, 0.1),
    "1e12 m": (1e12, 0.0, 0.1),
    "1e29 m": (1e29, 0.0, 0.1),
    "1 m, 6e6 m away": (1.0, 6e6, 0.1),
    "1e-9 m, 6e6 m away": (1e-9, 6e6, 0.1),
    "no extent": (0.0, 1.0, 0.0),
    "points": (1.0, 0.0, 0.0),
    "a millionth in size": (1.0, 0.0, 1e-6),
}


@cases("layers/boxes of", bounds=dict.fromkeys(_BOXES, 8.0), unit="float64 steps")
def boxes(name: str) -> float:
    """How far boxes reach out of the cells of the octree that own them, in steps of their largest coordinate."""
    size, by, share = _BOXES[name]
    rng = np.random.default_rng(6)
    lower = by + size * rng.uniform(-1, 1, (3000, 3))
    upper = lower + size * share * rng.exponential(size=(3000, 3))
    octree, order = box_octree(lower, upper, 64)
    expect(size == 0 or len(octree) > 50, "there is more than one cell")
    owner = np.repeat(np.arange(len(octree)), octree.n_points)
    half = octree.half_edges[owner, None]
    out = np.maximum(octree.centers[owner] - half - lower[order], upper[order] - octree.centers[owner] - half)
    return float(out.max() / np.spacing(np.maximum(np.abs(lower), np.abs(upper)).max()))
