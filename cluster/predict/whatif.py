"""What if: one thing changed, everything else as configured.

Any key of a run's configuration, or one of

=================  ==================================================================
``cores``          that the ranks share
``bandwidth``      of messages between ranks, bytes a second
``latency``        software latency of a message, seconds
``speed``          of a core, 1 being this one
``points``         of the scene; cells, entries and points drawn grow alike
=================  ==================================================================
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ...shared.config import RunConfig, load_config
from ...shared.errors import InputError
from ..job import Job
from ..launch import mpi_available
from .costs import Costs
from .forecast import Forecast, Machine, Setting, forecast
from .workload import Workload, count_workload, threads_of

FIGURES = ("cores", "bandwidth", "latency", "speed", "points")


@dataclass(frozen=True)
class Case:
    """What a prediction starts from."""

    run: RunConfig
    costs: Costs
    load: Workload
    machine: Machine
    scene_points: int

    @property
    def setting(self) -> Setting:
        """The layout that the configuration asks for."""
        topology = self.run.pipeline.topology
        if topology == "auto":
            topology = "pipelined" if mpi_available() else "single"
        return Setting(topology, threads_of(self.run.render.threads), self.run.pipeline.frames_in_flight)

    def predict(self) -> Forecast:
        """The forecast as it stands."""
        return forecast(self.costs, self.load, self.setting, self.machine)


def changed(case: Case, config: str, overrides: list[str], change: str) -> Case:
    """The case with ``key=value`` changed. Raises InputError or ConfigError naming the key.

    config, overrides : what ``case`` was loaded from.
    """
    key, equals, text = change.partition("=")
    if not equals:
        raise InputError(f"--what-if {change}: expected key=value")
    if "." in key:
        run = load_config(config, [*overrides, change])
        if run.render.rasterizer != case.run.render.rasterizer:
            raise InputError(f"--what-if {change}: the costs are of rasterizer {case.run.render.rasterizer}")
        job = Job(run)
        return replace(case, run=run, load=count_workload(job), scene_points=job.scene.info.n_points)
    if key not in FIGURES:
        raise InputError(f"--what-if {change}: expected a key of the configuration or one of {', '.join(FIGURES)}")
    value = _positive(change, text)
    match key:
        case "cores":
            return replace(case, machine=replace(case.machine, cores=max(int(value), 1)))
        case "bandwidth":
            return replace(case, machine=replace(case.machine, bandwidth_bytes_per_s=value))
        case "speed":
            return replace(case, machine=replace(case.machine, speed=value))
        case "latency":
            return replace(case, costs=replace(case.costs, message_s=value))
        case _:
            return replace(case, load=case.load.scaled(value / case.scene_points), scene_points=int(value))


def _positive(change: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise InputError(f"--what-if {change}: found {text}, expected a number > 0")
    return value
