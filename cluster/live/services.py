"""What is answered beside a live run, from the scene's files: picks, recorded paths, and what the run leaves out.

No rank is asked. A scene is opened at the first question that needs it.
"""

from __future__ import annotations

import json
import threading
from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING, Any

from ...shared.config import RunConfig
from ...shared.errors import SplatpipeError
from .protocol import PathKey, View
from .settings import configured
from .views import camera_of

if TYPE_CHECKING:
    from ..job import Job
    from ..selected import Selected
    from .expected import LiveCosts


class RunServices:
    """The hub's ``Services`` of a run, from any thread, one call after the other.

    config : as the run was started with; settings that hold at the moment come with each call.
    """

    def __init__(self, config: RunConfig) -> None:
        self._config = config
        self._lock = threading.Lock()
        self._selected: tuple[str, Selected] | None = None
        self._left_out: list[dict[str, Any]] | None = None

    def pick(self, view: View, width: int, height: int, x: float, y: float, settings: dict[str, Any]) -> dict[str, Any]:
        """What a picture of ``width`` × ``height`` pixels shows at (x, y), in shares of these; as ``Selected.pick``.

        Candidates are the points that the run draws: those that its culling and sampling choose for the view. Objects
        of layers are not picked.  Raises InputError for a view or settings that the run cannot have.
        """
        if not self._config.scene.path:
            return {"found": False}
        camera = camera_of(view, width, height, 0, self._near)
        with self._lock:
            return self._selected_by(settings).pick(camera, x * width, y * height)

    def path(self, keys: list[PathKey], fps: float, settings: dict[str, Any]) -> str:
        """A recorded path as the text of a configuration, with the settings of the moment (``recorded_config``)."""
        from .recorded import recorded_config

        up = self._job.views.path.up
        return recorded_config(configured(self._config, settings), keys, fps, up)

    def left_out(self) -> list[dict[str, Any]]:
        """What the run leaves out, as ``splatpipe plan`` lists it: what, why, and what that saves.

        Cost: at the first call, that of culling and sampling some frames.
        """
        from ..launch import mpi_available
        from ..plan.needs import left_out
        from ..plan.topology import Decision, decide
        from ..plan.workload import Workload

        with self._lock:
            if self._left_out is None:
                job, chain = self._job, "a live run takes three ranks where there is MPI"
                is_chain = self._config.pipeline.topology == "auto" and mpi_available()
                decision = Decision("pipelined", chain) if is_chain else decide(job)
                parts = left_out(job, Workload.of_look(job), decision)
                self._left_out = [
                    {"what": part["what"], "why": part["why"], "saves": _saves(part["gain"], part["unit"])}
                    for part in parts
                ]
            return self._left_out

    def measure(self) -> None:
        """Measure what the model needs; to be called before the ranks have the cores. Without kernels that have been
        compiled it is left to the first question, and what is wrong with the scene to the ranks.  Cost: 1.5 s.
        """
        from ...nodes.raster.cpu import kernels_cached

        job = self._job
        if job.rasterizer == "cpu" and kernels_cached(pools=job.wanted.pools, groups=job.coded, paged=job.paged):
            with suppress(SplatpipeError):
                _ = self._costs

    def expected(self, ranks: int, counts: dict[str, float]) -> list[dict[str, Any]]:
        """What the performance model expects of a frame with these counts (``expected``).

        Cost: some ms; where ``measure`` was not called, some seconds at the first call.
        """
        from .expected import expected, setting_of

        costs = self._costs
        return expected(costs, setting_of(self._job.config, ranks), counts) if costs else []

    @cached_property
    def _costs(self) -> LiveCosts | None:
        from .expected import measure_costs

        return measure_costs(self._job)

    @cached_property
    def _job(self) -> Job:
        from ..job import Job

        return Job(self._config)

    @cached_property
    def _near(self) -> float:
        return self._job.camera(0).near

    def _selected_by(self, settings: dict[str, Any]) -> Selected:
        """Selection with these settings; the last ones are kept."""
        from ..selected import Selected

        key = json.dumps(settings, sort_keys=True)
        if self._selected is None or self._selected[0] != key:
            job = self._job.with_config(configured(self._config, settings))
            held = self._selected and self._selected[1]
            octree = held.octree if held and held.suits(job) else job.load_octree()
            self._selected = key, Selected(job, octree)
        return self._selected[1]


def _saves(gain: float | None, unit: str) -> str:
    return "" if gain is None else f"{gain:.3g} {unit}"
