"""``splatpipe view``: a run that is looked at and steered, in any topology of one picture at a time."""

from __future__ import annotations

import json
import math
import os
import platform
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...shared.config import RunConfig, load_config
from ...shared.errors import ConfigError, SplatpipeError
from ..job import Job
from ..launch import (
    check_started,
    fail_rank,
    inside_mpi,
    launch,
    mpi_available,
    record,
    say_failed,
    say_refused,
    started_rank,
)
from ..layout import ALONE
from ..topologies import FRAME_PARALLEL, check_world, layout_of, ranks_to_start, role_of

if TYPE_CHECKING:
    from ..transport import Transport
    from .hub import Hub
    from .sockets import RunAddress


@dataclass(frozen=True)
class Listening:
    """Where a hub listens. bind : address; loopback unless somebody says otherwise.

    port, zmq_port : of the page and of programs; 0: any that is free.
    connection : file that tells programs how to connect; None: where ``splatpipe monitor`` looks.
    record : file that the metrics go to, too.
    """

    bind: str = "127.0.0.1"
    port: int = 0
    zmq_port: int = 0
    connection: Path | None = None
    record: Path | None = None


def view_command(config_path: Path, overrides: list[str], listening: Listening) -> int:
    """Show a scene until somebody ends that; the exit status. Called by a person, or on each rank by ``mpiexec``."""
    if inside_mpi():
        return _run_rank(config_path, overrides, listening)
    config = live_config(load_config(config_path, overrides))
    topology = config.pipeline.topology
    if topology not in ("auto", "single") and not mpi_available():
        raise ConfigError(
            f"pipeline.topology = {topology!r}: MPI is missing; install splatpipe[mpi] or choose 'single'"
        )
    alone = topology == "single" or (topology == "auto" and not mpi_available())
    job = Job(config)  # everything that can be wrong with the input is said here, before anything starts
    with _hub(config, listening) as hub, _interrupted(hub):
        if alone:
            _run(job, None, hub.run_address)
            return 0
        overrides = [part for override in overrides for part in ("--set", override)]
        return launch(
            ["view", str(config_path), *overrides],
            ranks_to_start(config.pipeline, topology),
            lambda _: None,
            hub.run_address.to_variables(),
            timeout_s=config.pipeline.timeout_s,
        )


def live_config(config: RunConfig) -> RunConfig:
    """A configuration as a live run has it: pictures of one view, of 8 bits, and no files.

    Raises ConfigError for what cannot be shown live.
    """
    if config.camera.view != "mono":
        raise ConfigError(f"camera.view = {config.camera.view!r}: a live run shows one view, expected 'mono'")
    if config.wall.columns * config.wall.rows > 1:
        raise ConfigError("wall: a live run shows one picture, expected one column and one row")
    if config.scene.delivery == "messages":
        raise ConfigError("scene.delivery = 'messages': in a live run every rank opens the scene, expected 'files'")
    if config.pipeline.topology == FRAME_PARALLEL:
        raise ConfigError(
            f"pipeline.topology = {FRAME_PARALLEL!r}: it draws many pictures at once, "
            "and a live run needs the next one; expected another topology"
        )
    output = {"png": True, "png_bits": 8, "mp4": False, "depth": False, "normals": False, "resume": False}
    return config.model_copy(update={"output": config.output.model_copy(update=output)})


@contextmanager
def _hub(config: RunConfig, listening: Listening) -> Iterator[Hub]:
    """The hub of a run, told to whoever started it."""
    from .connection import new_connection_file
    from .hub import Hub
    from .services import RunServices

    services = RunServices(config)
    services.measure()
    with Hub(
        services,
        bind=listening.bind,
        port=listening.port,
        zmq_port=listening.zmq_port,
        connection=listening.connection or new_connection_file(),
        record=listening.record,
    ) as hub:
        print(f"look at it: {hub.url}", flush=True)
        print(f"programs connect by {hub.connection} (splatpipe monitor); Ctrl-C ends it", flush=True)
        yield hub


@contextmanager
def _interrupted(hub: Hub) -> Iterator[None]:
    """Where Ctrl-C ends the run at its next frame; a second one does at once."""

    def end(number: int, _: Any) -> None:
        signal.signal(number, signal.default_int_handler)
        hub.end_run()

    held = signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, held)


def _run_rank(config_path: Path, overrides: list[str], listening: Listening) -> int:
    """Do this rank's part; the exit status."""
    from ..transport import Transport

    try:
        transport = Transport()
    except SplatpipeError as error:
        if started_rank() == 0:
            say_failed(str(error), error.exit_status)
        return error.exit_status
    role = "starting"
    try:
        status, why = 0, ""
        job = None
        try:
            config = live_config(load_config(config_path, overrides))
            role = role_of(config.pipeline, transport.rank, transport.size)
            record(rank=transport.rank, role=role, pid=os.getpid())
            check_started(transport.size, transport.library)
            check_world(config.pipeline, transport.size)
            transport.timeout_s, transport.patience_s = config.pipeline.timeout_s, math.inf
            job = Job(config)
        except SplatpipeError as error:
            status, why = error.exit_status, str(error)
        statuses = transport.agree(status)
        if job is None or any(statuses):
            return say_refused(transport, statuses, f"rank {transport.rank} ({role})", why)
        with ExitStack() as stack:
            _run(job, transport, _address(job, transport, listening, stack))
            transport.finish()
    except BaseException as error:
        fail_rank(transport, role, error)
    return 0


def _address(job: Job, transport: Transport, listening: Listening, stack: ExitStack) -> RunAddress:
    """Where the hub is: the launcher's, or without one a hub of rank 0's. Collective."""
    from .sockets import RunAddress

    address = RunAddress.from_environment()
    if address is None and transport.rank == 0:
        hub = stack.enter_context(_hub(job.config, listening))
        stack.enter_context(_interrupted(hub))
        address = hub.run_address
    variables = transport.gather(json.dumps(address.to_variables() if address else {}).encode())
    address = RunAddress.from_variables(json.loads(variables[0]))
    assert address
    return address


def _run(job: Job, transport: Transport | None, address: RunAddress) -> None:
    """Draw what is asked for until the run is over."""
    from ..pipeline import FrameLoop
    from .rank import LiveRank
    from .sockets import RunLink

    rank = transport.rank if transport else 0
    layout = layout_of(job.config.pipeline, transport.size) if transport else ALONE
    if transport and len(layout.render) > 1:
        renders_here = transport.count_here(rank in layout.render)
        if not job.config.render.threads:
            job.threads = max(1, job.threads // max(renders_here, 1))
    role = layout.role_of(rank)
    with RunLink(address, rank, role, platform.node()) as link, LiveRank(job, link, rank, role) as live:
        FrameLoop(job, layout, transport, lambda *_: None, live=live).run()
