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

import numpy as np

from ...nodes.culling import CullingNode
from ...nodes.picture.compose import Composer
from ...nodes.raster import PointSize, Rasterizer, ResidentPoints
from ...nodes.raster.choose import make_rasterizer
from ...nodes.render import load_points
from ...nodes.sampling import SamplingNode
from ...shared.camera import Camera
from ..job import Job
from ..record import spread_ms
from ..sink import FrameSink
from .needs import CHECKSUMS, COLOUR, LEVEL_OF_DETAIL, NO_NORMALS, PNG, SPLAT_LOOP

_ONE_PIXEL_BY_SIZE = PointSize(1, world=1e-30, maximum=1)
"""One pixel, but only the kernel with sizes finds that out."""

_NEVER_BELOW_PX = 1e-150
"""A threshold that no cell projects to: level of detail is computed and never used."""

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
        kinds = (_back_face_test, _level_of_detail, _splat_loop, _colour_column, _checksums, _png)
        yield [trial for trial in (kind(bench) for kind in kinds) if trial is not None]


class _Bench:
    """What trials share: octree, points, what is drawn of each frame; rasterizers are closed at the end."""

    def __init__(self, job: Job, stack: ExitStack) -> None:
        self.job = job
        self.stack = stack
        self.octree = job.scene.octree()
        self.culling = job.culling_node(self.octree)
        self.sampling = job.sampling_node(self.octree)
        self._entries: dict[int, np.ndarray] = {}

    @cached_property
    def points(self) -> ResidentPoints:
        """The points of the run."""
        return load_points(self.job.scene, self.job.colouring, verify=False)

    def entries(self, camera: Camera) -> np.ndarray:
        """What the run draws of a frame; the second time nothing is computed."""
        if camera.frame not in self._entries:
            self._entries[camera.frame] = self.sampling.process(camera, self.culling.process(camera)).entries
        return self._entries[camera.frame]

    def rasterizer(self, points: ResidentPoints, size: PointSize) -> Rasterizer:
        """The rasterizer of the run over these points."""
        camera, render = self.job.config.camera, self.job.config.render
        maker = make_rasterizer(render.rasterizer, points, camera.width, camera.height, size, render.threads or None)
        return self.stack.enter_context(maker)

    def drawing(self, rasterizer: Rasterizer) -> Callable[[Camera], np.ndarray]:
        """Camera → framebuffer words."""
        return lambda camera: rasterizer.draw(camera, self.entries(camera))

    @cached_property
    def draw(self) -> Callable[[Camera], np.ndarray]:
        """As the run draws."""
        return self.drawing(self.rasterizer(self.points, self.job.point_size))


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
    levelled = SamplingNode(bench.octree, pixel_threshold=_NEVER_BELOW_PX)
    return Trial(
        LEVEL_OF_DETAIL,
        lambda camera: plain.process(camera, culling.process(camera)).entries,
        lambda camera: levelled.process(camera, culling.process(camera)).entries,
    )


def _splat_loop(bench: _Bench) -> Trial | None:
    if bench.job.largest_point_px > 1:
        return None
    return Trial(SPLAT_LOOP, bench.draw, bench.drawing(bench.rasterizer(bench.points, _ONE_PIXEL_BY_SIZE)))


def _colour_column(bench: _Bench) -> Trial | None:
    if bench.job.colouring.mode != "constant":
        return None
    column = np.ascontiguousarray(bench.points.colour)
    with_column = bench.rasterizer(replace(bench.points, colour=column), bench.job.point_size)
    return Trial(COLOUR, bench.draw, bench.drawing(with_column))


def _checksums(bench: _Bench) -> Trial | None:
    def load(verify: bool) -> np.ndarray:
        return load_points(bench.job.scene, bench.job.colouring, verify=verify).x

    return Trial(CHECKSUMS, lambda _: load(False), lambda _: load(True), once=True)


def _png(bench: _Bench) -> Trial | None:
    """Put back frame by frame: one core encodes while nothing else is done."""
    if bench.job.config.output.png:
        return None
    folder = Path(bench.stack.enter_context(TemporaryDirectory()))
    composer = bench.stack.enter_context(Composer(replace(bench.job.picture_settings, colours=True)))

    def encode(camera: Camera) -> np.ndarray:
        words = bench.draw(camera)
        picture = composer.add(camera.frame % bench.job.views.per_picture, camera, words)
        if picture is not None:
            with FrameSink(folder, png=True, mp4=False, fps=1.0) as sink:
                sink.put(camera.frame, picture)
        return words

    return Trial(PNG, bench.draw, encode)
