"""Ablation: the same frames with and without a part that the run leaves out.

A trial does the same work without the part, as the run does, and with it, as a program would that cannot leave it out.
Both are held against each other first (leaving out must not change a bit) and then timed in turn, so that a change of
the machine's speed meets both.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from ...nodes.culling import CullingNode
from ...nodes.picture.compose import Composer, Picture
from ...nodes.point_filter import ClipBox, PointFilter
from ...nodes.raster import PointSize, Rasterizer, ResidentPoints
from ...nodes.raster.choose import make_rasterizer
from ...nodes.render import load_drawn
from ...nodes.sampling import SamplingNode
from ...shared.camera import Camera
from ..job import Job
from ..record import spread_ms
from ..sink import FrameSink
from .part import (
    ADAPTIVE,
    BOXES,
    CHECKSUMS,
    CLASSES,
    COLOUR,
    DEPTHS,
    LEVEL_OF_DETAIL,
    LIGHTING,
    NO_NORMALS,
    NORMALS,
    PNG,
    SPLAT_LOOP,
)

if TYPE_CHECKING:
    from ...nodes.raster.group_raster import ResidentGroups

_ONE_PIXEL_BY_SIZE = PointSize(1, world=1e-30, maximum=1)
"""One pixel, but only the kernel with sizes finds that out."""

_ONE_PIXEL_BY_SPACING = PointSize(1, maximum=1, adaptive=True)

_NO_LIGHTING = 1e-30
"""A strength of eye-dome lighting that changes no colour."""

_ALL_CLASSES = PointFilter(classes=tuple(range(256)))
_WHOLE_WORLD = PointFilter(boxes=(ClipBox((-1e300, -1e300, -1e300), (1e300, 1e300, 1e300)),))

_NEVER_BELOW_PX = 1e-150
"""A threshold that no cell projects to: level of detail is computed and never used."""

_MORE_THAN_ANY = 1e200
"""Points for a pixel, of which no leaf has enough: it is drawn whole."""

_LEAST_S = 0.3
_LEAST_REPEATS = 5


@dataclass(frozen=True)
class Trial:
    """One part's work, without and with it. Both give what must be the same, valid until the next call.

    part : its name in ``needs``.  once : it is done once a run and not once a frame.
    """

    part: str
    without: Callable[[Camera], np.ndarray]
    with_part: Callable[[Camera], np.ndarray]
    once: bool = False


@dataclass(frozen=True)
class Ablation:
    """What a trial measured.

    without_ms, with_ms : median, min, p95 and max of a frame (of a run, where ``once``).
    saved_ms : median of the differences of neighbours.
    identical : whether all frames have the same bits.  repeats : timed pairs.
    """

    part: str
    once: bool
    without_ms: dict[str, float]
    with_ms: dict[str, float]
    saved_ms: float
    identical: bool
    repeats: int


def ablate(job: Job, n_frames: int = 8) -> list[Ablation]:
    """Measure every part that ``job`` leaves out and that can be put back, on ``n_frames`` frames of its path."""
    frames = np.unique(np.linspace(0, job.n_frames - 1, n_frames).astype(int))
    cameras = [job.camera(int(frame)) for frame in frames]
    with trials(job) as found:
        return [measure(trial, cameras[:1] if trial.once else cameras) for trial in found]


def measure(trial: Trial, cameras: list[Camera]) -> Ablation:
    """Hold both sides against each other on all cameras, which also warms up, then time them in turn."""
    identical = all(same(trial, camera) for camera in cameras)
    seconds: list[tuple[float, float]] = []
    started = time.perf_counter()
    while len(seconds) < _LEAST_REPEATS * len(cameras) or time.perf_counter() - started < _LEAST_S:
        camera = cameras[len(seconds) % len(cameras)]
        begin = time.perf_counter()
        trial.without(camera)
        between = time.perf_counter()
        trial.with_part(camera)
        seconds.append((between - begin, time.perf_counter() - between))
    without, with_part = np.array(seconds).T
    return Ablation(
        part=trial.part,
        once=trial.once,
        without_ms=spread_ms(without.tolist()),
        with_ms=spread_ms(with_part.tolist()),
        saved_ms=float(np.median(with_part - without)) * 1e3,
        identical=identical,
        repeats=len(seconds),
    )


def same(trial: Trial, camera: Camera) -> bool:
    """Whether a frame has the same bits with and without the part."""
    without = trial.without(camera).copy()
    with_part = trial.with_part(camera)
    return (without.dtype, without.shape) == (with_part.dtype, with_part.shape) and bool((without == with_part).all())


@contextmanager
def trials(job: Job) -> Iterator[list[Trial]]:
    """The trials that apply to a run, with its scene and rasterizers open."""
    with ExitStack() as stack:
        bench = _Bench(job, stack)
        kinds = (
            _back_face_test,
            _level_of_detail,
            _class_filter,
            _clip_boxes,
            _splat_loop,
            _adaptive_size,
            _colour_column,
            _checksums,
            _lighting,
            _png,
            _depths,
            _normals,
        )
        yield [trial for trial in (kind(bench) for kind in kinds) if trial is not None]


class _Bench:
    """What trials share: octree, points, what is drawn of each frame; rasterizers are closed at the end."""

    def __init__(self, job: Job, stack: ExitStack) -> None:
        self.job = job
        self.stack = stack
        self.octree = job.load_octree()
        self.culling = job.culling_node(self.octree)
        self.sampling = job.sampling_node(self.octree)
        self._entries: dict[int, np.ndarray] = {}

    @cached_property
    def points(self) -> ResidentPoints | ResidentGroups:
        """The points of the run."""
        return self.job.load_drawn(verify=False)

    def load(self, **wanted: Any) -> ResidentPoints | ResidentGroups:
        """The points of the run with more wanted of them."""
        job = self.job
        return load_drawn(job.scene, job.colouring, replace(job.wanted, **wanted), verify=False)

    def entries(self, camera: Camera) -> np.ndarray:
        """What the run draws of a frame; the second time nothing is computed."""
        if camera.frame not in self._entries:
            self._entries[camera.frame] = self.sampling.process(camera, self.culling.process(camera)).entries
        return self._entries[camera.frame]

    def rasterizer(self, points: ResidentPoints | ResidentGroups, size: PointSize) -> Rasterizer:
        """The rasterizer of the run over these points."""
        job, render = self.job, self.job.config.render
        width, height, threads = job.views.width, job.views.height, render.threads or None
        maker = make_rasterizer(
            render.rasterizer, points, width, height, size, threads, splats=job.splats, compact=job.compact
        )
        return self.stack.enter_context(maker)

    def drawing(self, rasterizer: Rasterizer) -> Callable[[Camera], np.ndarray]:
        """Camera → framebuffer words."""
        return lambda camera: rasterizer.draw(camera, self.entries(camera))

    @cached_property
    def draw(self) -> Callable[[Camera], np.ndarray]:
        """As the run draws."""
        return self.drawing(self.rasterizer(self.points, self.job.point_size))

    def composing(self, **settings: Any) -> Callable[[Camera], tuple[np.ndarray, Picture | None]]:
        """Camera → words as the run draws them, and the picture that they complete."""
        composer = self.stack.enter_context(Composer(replace(self.job.picture_settings, **settings)))

        def compose(camera: Camera) -> tuple[np.ndarray, Picture | None]:
            words = self.draw(camera)
            return words, composer.add(camera.frame % self.job.views.per_picture, camera, words)

        return compose


def _back_face_test(bench: _Bench) -> Trial | None:
    """Put back by cones that hold every direction: what cells without normals would have."""
    if "normal" in bench.job.scene.info.attributes:
        return None  # tested against real normals, a picture may change
    cone = np.tile(np.array([0, 0, 1, -1], np.float32), (len(bench.octree), 1))
    tested = CullingNode(replace(bench.octree, cone=cone), backface=True, margin_px=bench.culling.margin_px)
    return Trial(
        NO_NORMALS, lambda camera: bench.culling.process(camera).bits, lambda camera: tested.process(camera).bits
    )


def _level_of_detail(bench: _Bench) -> Trial | None:
    if bench.job.pixel_threshold > 0:
        return None
    culling, plain = bench.culling, bench.sampling
    levelled = SamplingNode(
        bench.octree,
        pixel_threshold=_NEVER_BELOW_PX,
        points_per_pixel=_MORE_THAN_ANY,
        whole_sets=plain.whole_sets,
    )
    return Trial(
        LEVEL_OF_DETAIL,
        lambda camera: plain.process(camera, culling.process(camera)).entries,
        lambda camera: levelled.process(camera, culling.process(camera)).entries,
    )


def _splat_loop(bench: _Bench) -> Trial | None:
    if bench.job.largest_point_px > 1 or bench.job.splats:
        return None
    return Trial(SPLAT_LOOP, bench.draw, bench.drawing(bench.rasterizer(bench.points, _ONE_PIXEL_BY_SIZE)))


def _adaptive_size(bench: _Bench) -> Trial | None:
    """Put back by a spacing of each cell that a largest side of one pixel undoes."""
    if bench.job.largest_point_px > 1 or bench.job.splats:
        return None
    points = bench.load(cells=True, spacing=True)
    return Trial(ADAPTIVE, bench.draw, bench.drawing(bench.rasterizer(points, _ONE_PIXEL_BY_SPACING)))


def _class_filter(bench: _Bench) -> Trial | None:
    """Put back by a filter that keeps every class, of a scene that has them."""
    if bench.job.coded or bench.job.point_filter.classes or "classification" not in bench.job.scene.info.attributes:
        return None
    return _loading(bench, CLASSES, _ALL_CLASSES)


def _clip_boxes(bench: _Bench) -> Trial | None:
    """Put back by a box that holds everything."""
    return None if bench.job.coded or bench.job.point_filter.boxes else _loading(bench, BOXES, _WHOLE_WORLD)


def _loading(bench: _Bench, part: str, keeps_all: PointFilter) -> Trial:
    given = bench.job.point_filter
    both = PointFilter(given.classes or keeps_all.classes, given.boxes or keeps_all.boxes)
    return Trial(part, lambda _: _bits(bench.load()), lambda _: _bits(bench.load(point_filter=both)), once=True)


def _bits(points: ResidentPoints | ResidentGroups) -> np.ndarray:
    """A column of positions, as bits, so that what is filtered out equals itself."""
    return points.x.view(np.uint32) if isinstance(points, ResidentPoints) else points.cells.x


def _colour_column(bench: _Bench) -> Trial | None:
    if bench.job.colouring.mode != "constant":
        return None
    points = bench.points
    if isinstance(points, ResidentPoints):
        points = replace(points, colour=np.ascontiguousarray(points.colour))
    else:
        kept, inner = map(np.ascontiguousarray, (points.cells.kept_colour, points.cells.inner_colour))
        points = replace(points, cells=points.cells._replace(kept_colour=kept, inner_colour=inner))
    return Trial(COLOUR, bench.draw, bench.drawing(bench.rasterizer(points, bench.job.point_size)))


def _checksums(bench: _Bench) -> Trial | None:
    def load(verify: bool) -> np.ndarray:
        return _bits(bench.job.load_drawn(verify=verify))

    return Trial(CHECKSUMS, lambda _: load(False), lambda _: load(True), once=True)


def _lighting(bench: _Bench) -> Trial | None:
    """Put back with a strength that darkens nothing."""
    if bench.job.config.render.edl_strength:
        return None

    def colours(edl_strength: float) -> Callable[[Camera], np.ndarray]:
        compose = bench.composing(colours=True, edl_strength=edl_strength)

        def draw(camera: Camera) -> np.ndarray:
            words, picture = compose(camera)
            return words if picture is None or picture.rgba is None else picture.rgba

        return draw

    return Trial(LIGHTING, colours(0.0), colours(_NO_LIGHTING))


def _png(bench: _Bench) -> Trial | None:
    return None if bench.job.config.output.png else _output(bench, PNG, "colours")


def _depths(bench: _Bench) -> Trial | None:
    return None if bench.job.config.output.depth else _output(bench, DEPTHS, "depth")


def _normals(bench: _Bench) -> Trial | None:
    return None if bench.job.config.output.normals else _output(bench, NORMALS, "normals")


def _output(bench: _Bench, part: str, layer: str) -> Trial:
    """Put back frame by frame: one core encodes while nothing else is done."""
    folder = Path(bench.stack.enter_context(TemporaryDirectory()))
    compose = bench.composing(**{"colours": False, "depth": False, "normals": False, layer: True})

    def encode(camera: Camera) -> np.ndarray:
        words, picture = compose(camera)
        if picture is not None:
            with FrameSink(folder, png=True, mp4=False, fps=1.0) as sink:
                sink.put(camera.frame, picture)
        return words

    return Trial(part, bench.draw, encode)
