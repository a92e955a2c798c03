"""What if: one thing changed, everything else as configured.

Any key of a run's configuration, or one of

=================  ==================================================================
``cores``          that the ranks of a host share
``hosts``          that ranks are dealt to, each with cores of its own
``bandwidth``      of messages between ranks of a host, bytes a second
``link``           bandwidth of a host's link to the others, each way, bytes a second
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
from .costs import Costs
from .forecast import Forecast, forecast
from .machine import Machine
from .parts import CountedParts, EvenParts, Parts
from .setting import Setting
from .workload import Workload, count_workload

FIGURES = ("cores", "hosts", "bandwidth", "link", "latency", "speed", "points")


@dataclass(frozen=True)
class Case:
    """What a prediction starts from."""

    run: RunConfig
    costs: Costs
    load: Workload
    machine: Machine
    scene_points: int
    counted: Parts | None = None

    @classmethod
    def of(cls, job: Job, costs: Costs, machine: Machine) -> Case:
        """A job's, its parts counted when they are asked for."""
        load = count_workload(job)
        return cls(job.config, costs, load, machine, job.scene.info.n_points, CountedParts(job, load))

    @property
    def parts(self) -> Parts:
        """What falls to each of several ranks."""
        return self.counted or EvenParts(self.load)

    @property
    def setting(self) -> Setting:
        """The layout that the configuration asks for."""
        return Setting.of(self.run, self.machine.hosts)

    def predict(self) -> Forecast:
        """The forecast as it stands."""
        return forecast(self.costs, self.parts, self.setting, self.machine)


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
        return Case.of(Job(run), case.costs, case.machine)
    if key not in FIGURES:
        raise InputError(f"--what-if {change}: expected a key of the configuration or one of {', '.join(FIGURES)}")
    value = _positive(change, text)
    match key:
        case "cores":
            return replace(case, machine=replace(case.machine, cores=max(int(value), 1)))
        case "hosts":
            return replace(case, machine=replace(case.machine, hosts=max(int(value), 1), shared_cores=False))
        case "link":
            return replace(case, machine=replace(case.machine, link_bytes_per_s=value))
        case "bandwidth":
            return replace(case, machine=replace(case.machine, bandwidth_bytes_per_s=value))
        case "speed":
            return replace(case, machine=replace(case.machine, speed=value))
        case "latency":
            return replace(case, costs=replace(case.costs, message_s=value))
        case _:
            load = case.load.scaled(value / case.scene_points)
            return replace(case, load=load, scene_points=int(value), counted=None)


def _positive(change: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise InputError(f"--what-if {change}: found {text}, expected a number > 0")
    return value
