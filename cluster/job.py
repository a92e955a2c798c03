"""One run, made ready: configuration, scene and camera path checked together, the same on every rank."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from ..nodes.culling import CullingNode
from ..nodes.point_filter import PointFilter
from ..nodes.raster import PointSize, Rasterizer, ResidentPoints, SplatSettings
from ..nodes.raster.choose import make_rasterizer
from ..nodes.raster.cpu import kernels_cached
from ..nodes.render import RenderNode, Wanted, load_points
from ..nodes.sampling import SamplingNode
from ..shared.camera import Camera
from ..shared.camera_path import camera_path
from ..shared.colour import Colouring, frame_to_rgba, parse_colour
from ..shared.config import RunConfig
from ..shared.errors import ConfigError
from ..shared.messages import RenderPoints
from ..shared.octree import Octree
from ..shared.store import Scene
from .sink import FrameSink, frame_name


class Job:
    """What a run needs to know, checked: anything wrong with configuration or scene is raised here (InputError)."""

    def __init__(self, config: RunConfig) -> None:
        if not config.scene.path:
            raise ConfigError("scene.path: missing, expected a scene directory made by splatpipe build")
        self.config = config
        self.scene = Scene.open(Path(os.path.normpath(config.scene.path)))
        info = self.scene.info
        self.n_frames = config.output.frames
        self.frames_in_flight = config.pipeline.frames_in_flight
        self.output = Path(os.path.normpath(config.output.directory))
        self.backface = config.culling.backface and "normal" in info.attributes
        self.pixel_threshold = config.sampling.pixel_threshold
        render = config.render
        self.point_size = PointSize(
            render.point_size_px, render.point_size_world, render.point_size_max_px, render.point_size_adaptive
        )
        self.largest_point_px = (
            render.point_size_max_px if render.point_size_world or render.point_size_adaptive else render.point_size_px
        )
        self.splats = SplatSettings(**dict(config.splats)) if render.style == "splats" else None
        self.compact = render.positions == "compact"
        self.point_filter = PointFilter.choose(self.scene, config.filter.classes, config.filter.boxes)
        self.wanted = Wanted(
            splats=self.splats is not None,
            features=self.splats is not None and self.splats.features,
            cells=self.compact or render.point_size_adaptive,
            spacing=render.point_size_adaptive,
            point_filter=self.point_filter,
        )
        self.background = parse_colour(render.background, "render.background")
        self.colouring = Colouring.choose(
            self.scene, render.colour, render.colormap, render.colour_range, render.class_colours
        )
        self._path = camera_path(config.camera, info, self.n_frames)

    def camera(self, frame: int) -> Camera:
        """The camera of a frame."""
        return self._path.camera(frame)

    def culling_node(self, octree: Octree) -> CullingNode:
        """The culling node of this run."""
        margin_px = self.largest_point_px / 2 + 0.5  # a point just outside reaches in; and rounding moves it
        return CullingNode(octree, backface=self.backface, margin_px=margin_px, point_filter=self.point_filter)

    def sampling_node(self, octree: Octree) -> SamplingNode:
        """The sampling node of this run."""
        return SamplingNode(octree, pixel_threshold=self.pixel_threshold)

    def load_points(self, *, verify: bool) -> ResidentPoints:
        """The points of this run, with what it needs of them. Raises StoreError."""
        return load_points(self.scene, self.colouring, self.wanted, verify=verify)

    def make_rasterizer(self, points: ResidentPoints) -> Rasterizer:
        """The rasterizer of this run over ``points``; the caller closes it. Raises DeviceError."""
        render, camera = self.config.render, self.config.camera
        return make_rasterizer(
            render.rasterizer,
            points,
            camera.width,
            camera.height,
            self.point_size,
            render.threads or None,
            splats=self.splats,
            compact=self.compact,
        )

    @contextmanager
    def open_render(self, progress: Callable[[str, int], None]) -> Iterator[RenderStage]:
        """The render node of this run with its points loaded, its kernels compiled and its output open."""
        progress("loading points", 0)
        points = self.load_points(verify=self.config.scene.verify)
        output = self.config.output
        with ExitStack() as stack:
            rasterizer = stack.enter_context(self.make_rasterizer(points))
            node = RenderNode(rasterizer)
            if rasterizer.name == "cpu" and not kernels_cached():
                progress("compiling kernels (once; kept for the next run)", 0)
            node.warm_up(self.camera(0))
            sink = None
            if output.png or output.mp4:
                sink = stack.enter_context(FrameSink(self.output, png=output.png, mp4=output.mp4, fps=output.fps))
            yield RenderStage(node, sink, self.background)

    @property
    def attributes_read(self) -> set[str]:
        """Attributes of the scene that this run reads."""
        read = {
            self.colouring.attribute: True,
            "normal": self.backface or self.splats is not None,
            "radius": self.splats is not None,
            "classification": bool(self.point_filter.classes),
        }
        return {name for name, is_read in read.items() if name is not None and is_read}

    def outputs(self) -> list[str]:
        """What the run has written, for people."""
        output, said = self.config.output, []
        if output.png:
            last = frame_name(self.n_frames - 1)
            said.append(f"{self.output / frame_name(0)} … {last}" if self.n_frames > 1 else str(self.output / last))
        if output.mp4:
            said.append(str(self.output / "film.mp4"))
        return [*said, str(self.output / "run.json")]


class RenderStage:
    """Render node and output of one run."""

    def __init__(self, node: RenderNode, sink: FrameSink | None, background: np.ndarray) -> None:
        self._node = node
        self._sink = sink
        self._background = background
        self.description = node.description

    def draw(self, camera: Camera, chosen: RenderPoints) -> np.ndarray | None:
        """The picture, (height, width, 4) uint8; None where nobody wants it (the frame is drawn all the same)."""
        words = self._node.process(camera, chosen)
        return frame_to_rgba(words, self._background) if self._sink is not None else None

    def show(self, frame: int, picture: np.ndarray | None) -> None:
        """Hand the picture to the output; waits while that is behind."""
        if self._sink is not None and picture is not None:
            self._sink.put(frame, picture)

    def times(self) -> dict[str, list[float]]:
        """Seconds of encoding, frame by frame, by kind of output; complete once the output is closed."""
        return self._sink.times if self._sink is not None else {}
