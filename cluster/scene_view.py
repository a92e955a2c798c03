"""A scene that is drawn in this process, picture by picture, from wherever a camera is."""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..nodes.picture.compose import Picture
from ..shared.camera import Camera, look_at, perspective_camera
from ..shared.config import RunConfig, parse_config
from ..shared.errors import ConfigError, InputError
from ..shared.messages import RenderPoints
from ..shared.orbit import Orbit
from ..shared.scene_info import SceneInfo
from .job import Job, RenderStage
from .selected import Selected, enlarged

LAYERS = ("rgba", "depth", "normals")
MAX_STAGES = 3
"""Sizes of pictures that are ready to be drawn, each with its framebuffers; 1 where points are paged or on a device."""

_FIXED = ("scene", "layers")
"""Sections that no change of settings changes: another scene is another view."""


class SceneView:
    """A scene and how it is drawn; made by ``api.open_scene``, a context manager. One call at a time.

    Raises ConfigError for what is not a single view, or does not suit the scene.
    """

    def __init__(self, config: RunConfig) -> None:
        self._stages: dict[tuple[int, int], _Stage] = {}
        self._job = Job(_in_process(config))
        self._points = self._job.load_any(verify=config.scene.verify)
        self._select(self._job)
        self._is_open = True

    def __enter__(self) -> SceneView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of threads, device and points; once more does nothing."""
        self._close_stages()
        self._points, self._is_open = None, False

    # --- what there is -----------------------------------------------------------------------------------------------

    @property
    def info(self) -> SceneInfo:
        """What the scene says of itself."""
        return self._job.scene.info

    @property
    def config(self) -> RunConfig:
        """How it is drawn."""
        return self._job.config

    @property
    def lower(self) -> np.ndarray:
        """(3,) float64, world: least corner of the bounds of the points."""
        return np.array(self.info.lower)

    @property
    def upper(self) -> np.ndarray:
        """(3,) float64, world: largest corner of the bounds of the points."""
        return np.array(self.info.upper)

    @property
    def up(self) -> np.ndarray:
        """(3,) float64, a unit axis."""
        return self._job.views.path.up

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of pictures whose camera does not say otherwise, pixels."""
        return self.config.camera.width, self.config.camera.height

    # --- cameras -----------------------------------------------------------------------------------------------------

    def camera(self, number: int = 0) -> Camera:
        """The camera of a picture of the configured path; of ``open_scene``, 120 pictures of an orbit."""
        if not 0 <= number < self._job.n_pictures:
            raise InputError(f"camera: found picture {number}, expected 0 … {self._job.n_pictures - 1}")
        width, height = self.size
        return replace(self._job.views.path.camera(number), frame=0, width=width, height=height)

    def orbit(
        self,
        azimuth_deg: float = 0.0,
        elevation_deg: float = 25.0,
        *,
        target: Sequence[float] | np.ndarray | None = None,
        distance: float | None = None,
        fov_deg: float | None = None,
        width: int | None = None,
        height: int | None = None,
    ) -> Camera:
        """A camera on a sphere around a target, counter-clockwise seen from above, at a height above the horizon.

        target : world; default: the middle of the scene.  distance : world units; default: all of the scene is seen.
        """
        size = self._sized(width, height)
        orbit = self.first_orbit(azimuth_deg, elevation_deg, fov_deg=fov_deg, size=size)
        if target is not None:
            orbit = replace(orbit, target=np.asarray(target, np.float64))
        if distance is not None:
            orbit = replace(orbit, distance=float(distance))
        return self.camera_of(orbit, *size)

    def first_orbit(
        self,
        azimuth_deg: float = 0.0,
        elevation_deg: float = 25.0,
        *,
        fov_deg: float | None = None,
        size: tuple[int, int] | None = None,
    ) -> Orbit:
        """Where to turn the scene from (``shared.orbit``): all of it is seen."""
        width, height = size or self.size
        return Orbit.around(
            self.lower,
            self.upper,
            self.up,
            fov_y_rad=math.radians(self.config.camera.fov_deg if fov_deg is None else fov_deg),
            aspect=width / height,
            azimuth_rad=math.radians(azimuth_deg),
            elevation_rad=math.radians(elevation_deg),
        )

    def camera_of(self, orbit: Orbit, width: int | None = None, height: int | None = None) -> Camera:
        """The camera of an orbit."""
        return self._made(orbit.pose(), orbit.fov_y_rad, *self._sized(width, height))

    def look_at(
        self,
        eye: Sequence[float] | np.ndarray,
        target: Sequence[float] | np.ndarray,
        up: Sequence[float] | np.ndarray | None = None,
        *,
        fov_deg: float | None = None,
        width: int | None = None,
        height: int | None = None,
    ) -> Camera:
        """A camera at ``eye`` that has ``target`` in the middle of its picture; world coordinates.

        up : what is up in the picture; default: what is up in the scene.  Raises InputError if eye and target coincide.
        """
        up = self.up if up is None else np.asarray(up, np.float64)
        fov_deg = self.config.camera.fov_deg if fov_deg is None else fov_deg
        pose = look_at(np.asarray(eye, np.float64), np.asarray(target, np.float64), up)
        return self._made(pose, math.radians(fov_deg), *self._sized(width, height))

    def _sized(self, width: int | None, height: int | None) -> tuple[int, int]:
        own = self.size
        return width or own[0], height or own[1]

    def _made(self, pose: np.ndarray, fov_y_rad: float, width: int, height: int) -> Camera:
        near = self._job.views.path.near
        return perspective_camera(
            frame=0, world_from_camera=pose, fov_y_rad=fov_y_rad, width=width, height=height, near=near
        )

    # --- pictures ----------------------------------------------------------------------------------------------------

    def render(self, camera: Camera | None = None) -> np.ndarray:
        """(camera.height, camera.width, 4) uint8 RGBA, row 0 on top; uint16 with ``output.png_bits`` = 16.

        camera : default: the first of the configured path.
        """
        rgba = self.picture(camera).rgba
        assert rgba is not None
        return rgba

    def picture(self, camera: Camera | None = None, layers: Collection[str] = ("rgba",)) -> Picture:
        """The picture of a camera with these layers of ``rgba``, ``depth`` and ``normals``; the others are None.

        depth : (h, w) float32, world units along the view axis; 0 where nothing is.
        normals : (h, w, 4) uint8, (n + 1) / 2 in camera space.
        Cost: that of a frame; at the first picture of a size, framebuffers, and where points are drawn by a GPU, or
        paged, these once more.
        """
        for layer in layers:
            if layer not in LAYERS:
                raise InputError(f"layers: found {layer!r}, expected some of {', '.join(LAYERS)}")
        camera = self.camera() if camera is None else replace(camera, frame=0)
        stage = self._stage((camera.width, camera.height), frozenset(layers))
        camera = enlarged(camera, self.config.render.supersampling)
        words = stage.render.rasterize(camera, self._selected.points(camera))
        picture = stage.render.compose(camera, words, self._objects(camera))
        assert picture is not None
        shown = {layer: getattr(picture, layer) for layer in LAYERS if layer in layers}
        return Picture(**shown)

    def pick(self, x: float, y: float, camera: Camera | None = None) -> dict[str, Any] | None:
        """The point that the picture of a camera shows at (x, y), pixels from its upper left corner; None: no point.

        Returns ``position``, three float64, world, and ``attributes``: ``index`` in the point-array, ``depth``, and all
        that the scene holds of the point.
        """
        self._require_open()
        found = self._selected.pick(self.camera() if camera is None else replace(camera, frame=0), x, y)
        return {name: found[name] for name in ("position", "attributes")} if found["found"] else None

    def set(self, settings: Mapping[str, Any]) -> None:
        """Change settings, as of ``open_scene``: all of them or, where one is refused, none (ConfigError).

        What need not be read again is not: positions for other colours, anything for another size of points.
        """
        self._require_open()
        job = self._job.with_config(_in_process(with_settings(self.config.model_dump(), settings, "set", _FIXED)))
        points = job.load_after(self._job, self._points)
        self._close_stages()
        self._points = points
        self._select(job)

    def _select(self, job: Job) -> None:
        held = getattr(self, "_selected", None)
        octree = held.octree if held is not None and held.suits(job) else job.load_octree()
        self._job, self._selected = job, Selected(job, octree)
        self._layers = job.layer_nodes()

    def _objects(self, camera: Camera) -> list[RenderPoints]:
        return [sampling.process(camera, culling.process(camera)) for culling, sampling in self._layers]

    def _stage(self, size: tuple[int, int], layers: frozenset[str]) -> _Stage:
        """What draws pictures of a size with these layers, or more."""
        self._require_open()
        stage = self._stages.pop(size, None)
        if stage is not None and not layers <= stage.layers:
            stage.stack.close()
            layers |= stage.layers
            stage = None
        if stage is None:
            while len(self._stages) >= (MAX_STAGES if self.keeps_sizes else 1):
                self._stages.pop(next(iter(self._stages))).stack.close()
            stage = self._open_stage(size, layers)
        self._stages[size] = stage  # the last in order: the one that is dropped last
        return stage

    @property
    def keeps_sizes(self) -> bool:
        """Whether pictures of several sizes may be drawn in turn at no cost: points are in this process's memory."""
        return self._job.rasterizer == "cpu" and not self._job.paged

    def _open_stage(self, size: tuple[int, int], layers: frozenset[str]) -> _Stage:
        config = self.config
        camera = config.camera.model_copy(update={"width": size[0], "height": size[1]})
        output = config.output.model_copy(update={"depth": "depth" in layers, "normals": "normals" in layers})
        job = self._job.with_config(config.model_copy(update={"camera": camera, "output": output}))
        with ExitStack() as stack:
            opened = job.open_render(lambda *_: None, points=self._points, writes=False)
            return _Stage(stack.enter_context(opened), layers | {"rgba"}, stack.pop_all())

    def _close_stages(self) -> None:
        while self._stages:
            self._stages.popitem()[1].stack.close()

    def _require_open(self) -> None:
        if not self._is_open:
            raise InputError("the view of the scene has been closed")


@dataclass
class _Stage:
    """What draws pictures of one size."""

    render: RenderStage
    layers: frozenset[str]
    stack: ExitStack


def with_settings(
    tables: dict[str, Any], settings: Mapping[str, Any], source: str, fixed: Collection[str] = ()
) -> RunConfig:
    """The configuration of tables in which ``section.key`` settings have taken their places.

    fixed : sections that settings may not be of.  Raises ConfigError naming source and key.
    """
    tables = copy.deepcopy(tables)
    for key, value in settings.items():
        section, dot, name = str(key).partition(".")
        if section in fixed:
            raise ConfigError(f"{source}: {key} cannot be changed, open another view")
        if section == "layers" and not dot:
            tables[section] = value
            continue
        table = tables.setdefault(section, {})
        if not (dot and name and isinstance(table, dict)):
            raise ConfigError(f"{source}: found key {str(key)[:64]!r}, expected section.key such as render.colour")
        table[name] = value
    return parse_config(tables, source)


def _in_process(config: RunConfig) -> RunConfig:
    """A configuration as it is drawn in one process, without outputs."""
    if config.camera.view != "mono":
        raise ConfigError(f"camera.view = {config.camera.view!r}: one view is drawn at a time, expected 'mono'")
    if config.wall.columns * config.wall.rows > 1:
        raise ConfigError("wall: one picture is drawn at a time, expected one column and one row")
    sections = {
        "scene": config.scene.model_copy(update={"delivery": "files"}),
        "pipeline": config.pipeline.model_copy(update={"topology": "single"}),
        "output": config.output.model_copy(update={"png": True, "mp4": False, "resume": False}),
    }
    return config.model_copy(update=sections)
