"""``splatpipe model``: parameters measured or read, then the conditions of thesis 3.3.1 evaluated for each rank."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from ...shared.config import load_config, refuse_layers
from ...shared.errors import InputError
from ...shared.views import VIEWS_PER_PICTURE
from ..launch import inside_mpi
from ..progress import FrameProgress
from .application import instrumented_run, measured_application
from .inequalities import Condition, conditions
from .measure import measure_ranks, measured_system
from .parameters import Application, System, is_frame_rate
from .system_file import read_system_file, write_system_file


@dataclasses.dataclass(frozen=True)
class Model:
    """Parameters, the conditions they meet or miss, and the samples behind those that were measured.

    origin : where the parameters come from, for people.
    run : of the ``run.json`` of the instrumented run: what it reached and sent.
    samples : what ``measure_ranks`` found.  Both are empty where nothing was measured.
    """

    origin: str
    run: dict[str, Any]
    system: System
    application: Application
    conditions: list[Condition]
    samples: dict[str, Any]


def make_model(
    config: Path | None,
    overrides: list[str],
    system_path: Path | None,
    save_path: Path | None,
    frames_per_s: float | None,
) -> Model:
    """Measure what is asked for and evaluate it.

    config : what to run; None takes the application from the system file as well.
    system_path : a system file in place of this cluster.  save_path : where to write the parameters.
    frames_per_s : the rate to hold the conditions against, views counted one by one; None for that of the configuration
        (``output.fps``) or file.
    Raises InputError for bad input before anything is measured.
    """
    if inside_mpi():
        raise InputError("mpiexec: found, expected splatpipe model to be started without: it starts its own ranks")
    if frames_per_s is not None and not is_frame_rate(frames_per_s):
        raise InputError(f"--fps {frames_per_s}: expected a finite number > 0")
    filed, application = read_system_file(system_path) if system_path else (None, None)
    run: dict[str, Any] = {}
    samples: dict[str, Any] = {}
    if config is not None:
        settings = load_config(config, overrides)
        refuse_layers(settings, "the model counts points alone")
        wanted = frames_per_s or settings.output.fps * VIEWS_PER_PICTURE[settings.camera.view]
        run, samples, system, application = _measure(config, overrides, filed, system_path, wanted)
    elif filed is None:
        raise InputError("found neither CONFIG nor --system FILE, expected one of them or both")
    elif application is None:
        raise InputError(f"{system_path}: application: found nothing, expected a table, or a CONFIG to measure it with")
    else:
        system = filed
    if frames_per_s is not None:
        application = dataclasses.replace(application, frames_per_s=frames_per_s)
    origin = ", ".join(
        [f"system: {system_path or 'measured'}", f"application: {f'measured on {config}' if config else system_path}"]
    )
    if save_path is not None:
        write_system_file(save_path, origin, system, application)
    told = ("topology", "rasterizer", "frames", "frames_per_s", "latency_ms", "messages")
    run = {key: run[key] for key in told if key in run}
    return Model(origin, run, system, application, conditions(system, application), samples)


def _measure(
    config: Path, overrides: list[str], filed: System | None, system_path: Path | None, frames_per_s: float
) -> tuple[dict[str, Any], dict[str, Any], System, Application]:
    """The run, the samples, the system (that of the file if there is one) and the application."""
    with FrameProgress(3) as progress:
        progress.show("running the pipeline", 0)
        run, overrides = instrumented_run(config, overrides)
        roles = [rank["role"] for rank in run["ranks"]]
        if filed is not None and len(filed.ranks) != len(roles):
            raise InputError(
                f"{system_path}: system.rank: found {len(filed.ranks)}, expected {len(roles)} as in the run"
            )
        progress.show("measuring the ranks", 1)
        samples = measure_ranks(config, overrides, roles, run["rasterizer"].split()[0])
        progress.show("counting", 2)
        application = measured_application(config, overrides, run, samples, frames_per_s)
        return run, samples, filed or measured_system(samples, roles), application
