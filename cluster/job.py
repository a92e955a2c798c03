"""One run, made ready: configuration, scene and camera path checked together, the same on every rank."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..nodes.culling import CullingNode
from ..nodes.picture.compose import Composer, Picture, PictureSettings
from ..nodes.point_filter import PointFilter
from ..nodes.raster import MAX_SIDE_PX, PointSize, Rasterizer, ResidentPoints, SplatSettings
from ..nodes.raster.choose import check_style, make_rasterizer, resolve_rasterizer
from ..nodes.raster.cpu import kernels_cached
from ..nodes.raster.gl_context import require_gl
from ..nodes.render import RenderNode, Wanted, load_drawn, load_points, recoloured, refiltered
from ..nodes.sampling import Pools, SamplingNode, check_point_budget
from ..shared.camera import Camera
from ..shared.colour import Colouring, colormap_words, parse_colour
from ..shared.config import RunConfig
from ..shared.errors import ConfigError
from ..shared.messages import RenderPoints
from ..shared.octree import Octree
from ..shared.store import Scene
from ..shared.views import camera_views
from ..shared.wall import Screen, wall_of
from .paging import check_paging
from .sink import Film, FrameSink, H264Film, layer_name
from .topologies import check_topology

if TYPE_CHECKING:
    from ..nodes.layer_render import LayerRenderNode
    from ..nodes.layer_sampling import LayerSamplingNode
    from ..nodes.raster.group_raster import ResidentGroups
    from ..nodes.raster.paged_points import PagedPoints, Residency
    from ..shared.layers.layer import Layer

SPLAT_COLOUR = "#d0d0d0"
"""Colour of lit splats where points have none but the shading of their normals."""


class Job:
    """What a run needs to know, checked: anything wrong with configuration or scene is raised here (InputError).

    Frames are what the pipeline draws, views of pictures: ``n_frames`` of ``views.width`` × ``views.height`` pixels,
    ``views.per_picture`` to a picture. Sizes of points are in drawn pixels, so that they do not depend on
    ``render.supersampling`` in the picture. ``threads`` is for whoever shares the cores with other ranks to lower.
    ``frames`` are those to draw, views of whole pictures, ascending: all, unless ``draw_only`` says otherwise.

    scene : the one to draw; default: that of ``scene.path``, or one without points where there are only layers.
    layers : those of ``layers`` where they are open already.
    """

    def __init__(self, config: RunConfig, scene: Scene | None = None, layers: list[Layer] | None = None) -> None:
        if scene is None and not (config.scene.path or config.layers):
            raise ConfigError("scene.path: missing, expected a scene directory made by splatpipe build")
        check_topology(config)
        self.config = config
        self.threads = config.render.threads or len(os.sched_getaffinity(0))
        self.paged = config.memory.residency == "paged"
        self.layers = layers or (self._read_layers() if config.layers else [])
        self.scene = scene or self._open_scene()
        info = self.scene.info
        self.n_pictures = config.output.frames
        self.frames_in_flight = config.pipeline.frames_in_flight
        self.output = Path(os.path.normpath(config.output.directory))
        self.backface = config.culling.backface and "normal" in info.attributes
        self.pixel_threshold = config.sampling.pixel_threshold
        render = config.render
        smallest_px, largest_px = (
            side * render.supersampling for side in (render.point_size_px, render.point_size_max_px)
        )
        self.point_size = PointSize(smallest_px, render.point_size_world, largest_px, render.point_size_adaptive)
        self.largest_point_px = largest_px if render.point_size_world or render.point_size_adaptive else smallest_px
        self.splats = SplatSettings(**dict(config.splats)) if render.style == "splats" else None
        self.compact = render.positions == "compact"
        self.coded = render.positions == "coded"
        self.point_filter = PointFilter.choose(self.scene, config.filter.classes, config.filter.boxes)
        self.why_no_pools = self._why_no_pools()
        self.pools: Pools = "off" if self.why_no_pools else config.sampling.pools
        if self.paged:
            check_paging(config, info)
        check_point_budget(config.sampling.point_budget, self.pixel_threshold, self.coded, self.pools)
        self.wanted = Wanted(
            splats=self.splats is not None,
            features=self.splats is not None and self.splats.features,
            cells=self.compact or render.point_size_adaptive,
            spacing=render.point_size_adaptive,
            groups=self.coded,
            pools=self.pools != "off",
            point_filter=self.point_filter,
        )
        self.wanted.check(self.scene)
        check_style(render.rasterizer, self.splats, groups=self.coded)
        if self.coded and self.point_filter:
            raise ConfigError("render.positions = 'coded': found a filter, which takes points out of their groups")
        self.background = parse_colour(render.background, "render.background")
        self.colouring = Colouring.choose(
            self.scene, render.colour, render.colormap, render.colour_range, render.class_colours
        )
        self.colour = self.colouring.mode if render.colour == "auto" else render.colour
        if self.splats and self.splats.lighting and self.colouring.mode == "normal":  # light falls on a splat once
            self.colouring = Colouring.choose(self.scene, SPLAT_COLOUR)
        self.wall = wall_of(config)
        camera = config.camera  # of all screens together
        if self.wall:
            camera = camera.model_copy(update={"width": self.wall.width, "height": self.wall.height})
        self._panel_px = camera.width, camera.height
        self._check_sides()
        self.views = camera_views(camera, info, self.n_pictures, render.supersampling)
        self.n_frames = self.n_pictures * self.views.per_picture
        self.frames: Sequence[int] = range(self.n_frames)  # to be drawn: all views of some pictures
        self.make_film: Callable[[Path, float], Film] = H264Film  # for whoever has not all pictures to replace
        if config.output.mp4 and not self.background[3]:
            raise ConfigError("render.background = 'transparent', expected a colour: a film (output.mp4) has no alpha")
        if self.film_afterwards and not config.output.png:
            raise ConfigError("output.resume = true: a film is then made of the PNG files, expected output.png = true")

    def with_config(self, config: RunConfig) -> Job:
        """The job of another configuration of the same scene and layers. Raises ConfigError."""
        return Job(config, self.scene, self.layers)

    def draw_only(self, pictures: Sequence[int]) -> None:
        """Draw these pictures, ascending, and no others."""
        views = self.views.per_picture
        self.frames = [picture * views + view for picture in pictures for view in range(views)]

    @property
    def pictures(self) -> list[int]:
        """Numbers of the pictures to draw."""
        views = self.views.per_picture
        return [frame // views for frame in self.frames[::views]]

    @property
    def film_afterwards(self) -> bool:
        """Whether the film is made of the pictures on disk at the end: no run that is resumed has them all in order."""
        return self.config.output.mp4 and self.config.output.resume

    def _check_sides(self) -> None:
        supersampling, sides = self.config.render.supersampling, self._panel_px
        if max(sides) * supersampling <= MAX_SIDE_PX:
            return
        if self.wall and max(sides) > MAX_SIDE_PX:
            i = sides.index(max(sides))
            key = ("columns", "rows")[i]
            raise ConfigError(
                f"wall.{key} = {getattr(self.wall, key)}: the screens and mullions are {sides[i]} px together, "
                f"expected at most {MAX_SIDE_PX}"
            )
        raise ConfigError(
            f"render.supersampling = {supersampling}: {supersampling * max(sides)} px a side are to be drawn, "
            f"expected at most {MAX_SIDE_PX}"
        )

    def _why_no_pools(self) -> str:
        """Why this run draws nothing from pools; empty if it may."""
        config = self.config
        if config.sampling.pools == "off":
            return "sampling.pools is off"
        if self.point_filter:
            return "points are filtered, and pooled ones cannot be taken out"
        if config.render.positions == "coded":
            return "render.positions is coded: its rasterizer draws no pools"
        if self.splats:
            return "splats are drawn, and pooled points have no radii"
        return ""

    @property
    def rasterizer(self) -> str:
        """Name of the rasterizer that draws, ``auto`` resolved."""
        return "cpu" if self.coded or self.paged else resolve_rasterizer(self.config.render.rasterizer)

    @property
    def resizes(self) -> bool:
        """Whether pictures of another size cost no more than their framebuffers: no point is held in another form."""
        return self.rasterizer == "cpu" and not (self.compact or self.paged or self.layers)

    @property
    def position_bytes(self) -> float:
        """Bytes of a position as it is read; compact ones as where cells are small on the screen, at least; coded ones
        as they are stored.
        """
        if self.coded:
            return self.scene.info.position_bytes / self.scene.info.n_stored
        return 4 if self.compact else 12

    @property
    def attribute_bytes(self) -> int:
        """Bytes of a point's colour, and of a splat's normal and radius."""
        return (0 if self.colouring.mode == "constant" else 4) + (5 if self.splats else 0)

    @property
    def frames_ahead(self) -> int:
        """How many frames the render rank is told of before it is their turn (``RenderStage.expect``)."""
        return self.frames_in_flight - 1 if self.paged and self.config.memory.prefetch else 0

    def load_octree(self) -> Octree:
        """The cells, with what the sampling node of this run needs of them. Raises StoreError."""
        return self.scene.octree(features=self.wanted.features, pools=self.wanted.pools)

    def camera(self, frame: int) -> Camera:
        """The camera of a frame."""
        return self.views.camera(frame)

    def culling_node(self, octree: Octree) -> CullingNode:
        """The culling node of this run."""
        return CullingNode(octree, backface=self.backface, margin_px=self._margin_px, point_filter=self.point_filter)

    @property
    def _margin_px(self) -> float:
        """A point so far outside reaches in; and rounding moves it."""
        return self.largest_point_px / 2 + 0.5

    def sampling_node(self, octree: Octree, own: np.ndarray | None = None) -> SamplingNode:
        """The sampling node of this run, or of a part of its octree that answers for the cells ``own``.

        Its threshold is in pixels of the picture; how many points cover a cell is counted in drawn pixels, so that each
        of those that are averaged has points of its own.
        """
        points_per_pixel = self.config.sampling.points_per_pixel
        return SamplingNode(
            octree,
            pixel_threshold=self.pixel_threshold * self.config.render.supersampling,
            points_per_pixel=points_per_pixel,
            whole_sets=self.coded,
            pools=self.pools,
            point_bytes=self.position_bytes + self.attribute_bytes,
            point_budget=self.config.sampling.point_budget,
            own=own,
            margin_px=self._margin_px,
        )

    def _read_layers(self) -> list[Layer]:
        from ..shared.layers.layer_store import open_layer

        settings = self.config.layers
        layers = [open_layer(layer.path) for layer in settings]
        require_gl("layers are drawn with OpenGL")
        if self.config.scene.delivery == "messages":
            raise ConfigError("scene.delivery = 'messages': every rank opens the layers, expected 'files'")
        for name in dict.fromkeys(layer.colormap for layer in settings):
            colormap_words(name, "layers.colormap")
        return layers

    def _open_scene(self) -> Scene:
        if self.config.scene.path:
            return Scene.open(Path(os.path.normpath(self.config.scene.path)), mapped=not self.paged)
        from ..shared.empty_scene import EmptyScene

        corners = [layer.bounds for layer in self.layers]
        return EmptyScene(
            np.min([lower.min(axis=0) for lower, _ in corners], axis=0),
            np.max([upper.max(axis=0) for _, upper in corners], axis=0),
        )

    def layer_nodes(self) -> list[tuple[CullingNode, LayerSamplingNode]]:
        """The culling and the sampling node of each layer of this run."""
        if not self.layers:
            return []
        from ..nodes.layer_sampling import LayerSamplingNode

        return [
            (
                CullingNode(layer.octree, backface=False, margin_px=1.0),
                LayerSamplingNode(layer.octree, detail_px=settings.detail_px),
            )
            for layer, settings in zip(self.layers, self.config.layers, strict=True)
        ]

    def load_points(self, *, verify: bool) -> ResidentPoints:
        """The points of this run, with what it needs of them; coded ones are decoded. Raises StoreError."""
        return load_points(self.scene, self.colouring, self.wanted, verify=verify)

    def load_drawn(self, scene: Scene | None = None, *, verify: bool) -> ResidentPoints | ResidentGroups:
        """The points of this run, or of a share of its scene, in the form it draws them from. Raises StoreError."""
        return load_drawn(scene or self.scene, self.colouring, self.wanted, verify=verify)

    def load_any(self, scene: Scene | None = None, *, verify: bool) -> ResidentPoints | ResidentGroups | PagedPoints:
        """The points of this run, or of a share of its scene, as its rasterizer takes them. Raises StoreError."""
        return self.load_paged(scene) if self.paged else self.load_drawn(scene, verify=verify)

    def load_after(self, before: Job, points: Any, scene: Scene | None = None) -> Any:
        """``load_any`` for a job of other settings, where ``before`` has loaded ``points`` of the same scene or share:
        of those, what is still right is kept, and checksums are not compared again.
        """
        colours, filtered = self.colouring == before.colouring, self.point_filter == before.point_filter
        same_form = replace(self.wanted, point_filter=before.point_filter) == before.wanted
        same_form &= (self.paged, self.config.memory) == (before.paged, before.config.memory)
        if same_form and colours and filtered:
            return points
        scene = scene or self.scene
        kept = same_form and isinstance(points, ResidentPoints) and not self.wanted.pools
        if not kept or (self.wanted.features and not filtered):
            return self.load_any(scene, verify=False)
        points = points if colours else recoloured(points, scene, self.colouring)
        return points if filtered else refiltered(points, scene, self.point_filter)

    def load_paged(self, scene: Scene | None = None) -> PagedPoints:
        """The points of this run, or of a share of its scene, to be read by pages. Raises StoreError."""
        from ..nodes.page_reader import load_paged
        from ..nodes.raster.paged_points import Paging

        memory = self.config.memory
        paging = Paging(memory.budget_bytes, memory.complete)
        return load_paged(scene or self.scene, self.colouring, self.point_filter, paging)

    def make_rasterizer(self, points: ResidentPoints | ResidentGroups | PagedPoints) -> Rasterizer:
        """The rasterizer of this run over ``points``; the caller closes it. Raises DeviceError."""
        render = self.config.render
        return make_rasterizer(
            render.rasterizer,
            points,
            self.views.width,
            self.views.height,
            self.point_size,
            self.threads,
            splats=self.splats,
            compact=self.compact,
        )

    @contextmanager
    def open_render(
        self,
        progress: Callable[[str, int], None],
        scene: Scene | None = None,
        *,
        shown: bool = True,
        screen: Screen | None = None,
        points: ResidentPoints | ResidentGroups | PagedPoints | None = None,
        writes: bool = True,
    ) -> Iterator[RenderStage]:
        """The render node of this run with its points loaded, its kernels compiled and its output open.

        scene : a share of the run's, whose points are drawn.  shown : whether pictures are made of what is drawn, and
        layers drawn over it.  screen : of a wall, where no more is shown.  points : where they are loaded already.
        writes : whether what is shown goes to the outputs.
        """
        if points is None:
            progress("loading points", 0)
            points = self.load_any(scene, verify=self.config.scene.verify)
        output = self.config.output
        with ExitStack() as stack:
            rasterizer = stack.enter_context(self.make_rasterizer(points))
            self.scene.release()
            node = RenderNode(rasterizer)
            if rasterizer.name == "cpu" and not kernels_cached(
                pools=self.wanted.pools, groups=self.coded, paged=self.paged
            ):
                progress("compiling kernels (once; kept for the next run)", 0)
            node.warm_up(self.camera(0))
            layers = None
            if self.layers and shown:
                progress("loading layers", 0)
                layers = stack.enter_context(self._open_layers())
                layers.warm_up(self.camera(0))
            composer = sink = None
            mp4 = output.mp4 and not self.film_afterwards
            if shown and (output.png or output.mp4 or output.depth or output.normals):
                settings = replace(self.picture_settings, screen=screen.window if screen else None)
                composer = stack.enter_context(Composer(settings))
                composer.warm_up([self.camera(view) for view in range(self.views.per_picture)])
            if composer and writes:
                sink = stack.enter_context(
                    FrameSink(self.output, png=output.png, mp4=mp4, fps=output.fps, make_film=self.make_film)
                )
            yield RenderStage(
                node, layers, composer, sink, self.views.per_picture, self._seen(screen), self.frames_ahead
            )

    def _seen(self, screen: Screen | None) -> Callable[[Picture], list[tuple[str, Picture]]]:
        """What is written of a picture: names of screens, and what they show; the name of a whole picture is empty."""
        wall = self.wall
        if wall is None:
            return lambda picture: [("", picture)]
        if screen is not None:
            return lambda picture: [(screen.name, picture)]
        from ..nodes.picture.wall import seen

        return lambda picture: seen(picture, wall)

    @contextmanager
    def _open_layers(self) -> Iterator[LayerRenderNode]:
        from ..nodes.layer_render import LayerRenderNode
        from ..nodes.layers.gl_canvas import GlLayers

        with GlLayers(self.layers, self.config.layers, self.views.width, self.views.height) as canvas:
            yield LayerRenderNode(canvas)

    @property
    def picture_settings(self) -> PictureSettings:
        """What this run makes of its views."""
        camera, render, output = self.config.camera, self.config.render, self.config.output
        return PictureSettings(
            view=camera.view,
            layout=camera.stereo_layout,
            width=self._panel_px[0],
            height=self._panel_px[1],
            supersampling=render.supersampling,
            background=self.background,
            bits=output.png_bits,
            edl_strength=render.edl_strength,
            edl_radius_px=render.edl_radius_px,
            colours=output.png or output.mp4,
            depth=output.depth,
            normals=output.normals,
            threads=self.threads,
        )

    @property
    def composed_share(self) -> float:
        """Pixels of a picture over the pixels drawn for it."""
        panels = 2 if self.config.camera.view == "stereo" else 1
        drawn = self.views.per_picture * self.views.width * self.views.height
        return panels * self._panel_px[0] * self._panel_px[1] / drawn

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of a picture as it is written, or of what a screen shows of it; pixels."""
        if self.wall:
            return self.wall.file_size
        camera = self.config.camera
        across = 2 if camera.view == "stereo" and camera.stereo_layout == "side-by-side" else 1
        down = 2 if camera.view == "stereo" and camera.stereo_layout == "over-under" else 1
        return across * camera.width, down * camera.height

    def picture_names(self, layer: str, number: int) -> list[str]:
        """Names of the files of a layer of a picture."""
        screens = self.wall.screens if self.wall and self.wall.apart else []
        return [layer_name(layer, number, screen.name) for screen in screens] or [layer_name(layer, number)]

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
        for layer in [name for name in ("png", "depth", "normals") if getattr(output, name)]:
            last = self.picture_names(layer, self.n_pictures - 1)[-1]
            first = self.picture_names(layer, 0)[0]
            said.append(str(self.output / first) + (f" … {last}" if last != first else ""))
        if output.mp4:
            said.append(str(self.output / "film.mp4"))
        return [*said, str(self.output / "run.json")]


class RenderStage:
    """Render node, composition and output of one run."""

    def __init__(
        self,
        node: RenderNode,
        layers: LayerRenderNode | None,
        composer: Composer | None,
        sink: FrameSink | None,
        per_picture: int,
        seen: Callable[[Picture], list[tuple[str, Picture]]],
        frames_ahead: int = 0,
    ) -> None:
        self._node = node
        self._layers = layers
        self._composer = composer
        self._sink = sink
        self._per_picture = per_picture
        self.frames_ahead = frames_ahead
        self._seen = seen
        self.description = " + ".join(part.description for part in (node, layers) if part)

    def rasterize(self, camera: Camera, chosen: RenderPoints) -> np.ndarray:
        """(height, width) uint64 framebuffer words of a frame's points; valid until the next call."""
        return self._node.process(camera, chosen)

    def expect(self, chosen: RenderPoints) -> None:
        """Say what a frame that follows will draw; asked for up to ``frames_ahead`` frames, in order."""
        self._node.expect(chosen)

    @property
    def residency(self) -> Residency | None:
        """What the last frame found of paged points; None where points are resident."""
        return self._node.residency

    def compose(self, camera: Camera, words: np.ndarray, of_layers: Sequence[RenderPoints] = ()) -> Picture | None:
        """The picture that a frame completes, its layers drawn over the words of its points; None before its last view
        or where nobody wants it.
        """
        if self._layers is not None:
            words = self._layers.process(camera, of_layers, words)
        if self._composer is None:
            return None
        return self._composer.add(camera.frame % self._per_picture, camera, words)

    def show(self, frame: int, picture: Picture | None) -> None:
        """Hand the picture to the output; waits while that is behind."""
        if self._sink is not None and picture is not None:
            for screen, part in self._seen(picture):
                self._sink.put(frame // self._per_picture, part, screen)

    def times(self) -> dict[str, list[float]]:
        """Seconds of encoding, picture by picture, by kind of output; complete once the output is closed."""
        return self._sink.times if self._sink is not None else {}
