"""Going on without a rank that has died, where MPI lets the others: Open MPI 5 started with ``--with-ft ulfm``.

A rank that notices revokes the communicator, so that all do, whatever they wait for. They shrink it to those that are
left, who are numbered anew in the same order, and begin again in the same processes: the layout is made for as many
ranks as there are now, and the pictures that are not on disk are drawn. What a run has written stays, so that a death
costs the pictures under way and loading. Ranks end together: nobody leaves before ``run.json`` is written.

Not survived: the death of a rank before all have started, of ``mpiexec``, and any with ``scene.delivery = "messages"``,
as the scene may lie where the dead rank was. A run that cannot go on ends, and is resumed by ``--resume``.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import numpy as np

from ..shared.config import RunConfig
from .launch import record
from .topologies import role_of
from .transport import Transport

_HOST_BYTES = 64


class Survival:
    """What a rank knows of those that have died; it begins the run again with the others.

    lost : a record of each: rank and role it had, host, pid, when it was missed (ISO 8601, UTC).
    pictures : numbers of the pictures that the run was to draw when it began, before any rank died.
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._there: list[dict[str, Any]] = []
        self._config: RunConfig | None = None
        self.lost: list[dict[str, Any]] = []
        self.pictures: list[int] | None = None

    def run(self, attempt: Callable[[], int]) -> int:
        """Do this rank's part of the run, again for as long as ranks die in it; the exit status. Collective."""
        transport = self._transport
        while transport.survives:
            failed: BaseException | None = None
            status = 0
            try:
                self._there = self._there or self._introduced()
                status = attempt()
            except BaseException as error:
                if not transport.lost_a_rank(error):
                    raise
                failed = error
            if transport.unanimous(failed is None):
                record(done=status)
                return status
            lost = transport.go_on()
            if failed and not lost:
                raise failed
            self._miss(lost)
        return attempt()

    def settled(self, config: RunConfig) -> RunConfig:
        """The configuration for the ranks that are left: as it is, until one has died."""
        self._config = config
        if not self.lost:
            return config
        output = config.output
        resume = output.png or not output.mp4  # a film alone leaves no picture to go on from
        pipeline: dict[str, Any] = dict.fromkeys(("ranks", "culling_ranks", "sampling_ranks", "render_ranks"), 0)
        self._config = config.model_copy(
            update={
                "pipeline": config.pipeline.model_copy(update=pipeline),
                "output": output.model_copy(update={"resume": resume}),
            }
        )
        return self._config

    def _introduced(self) -> list[dict[str, Any]]:
        host = platform.node().encode()[:_HOST_BYTES].ljust(_HOST_BYTES)
        hosts = self._transport.join(np.frombuffer(host, np.uint8)).astype(np.uint8).reshape(-1, _HOST_BYTES)
        pids = self._transport.agree(os.getpid())
        return [
            {"rank": rank, "host": host.tobytes().decode(errors="replace").strip(), "pid": pid}
            for rank, (host, pid) in enumerate(zip(hosts, pids, strict=True))
        ]

    def _miss(self, numbers: list[int]) -> None:
        size = len(self._there)
        when = datetime.now(UTC).isoformat(timespec="milliseconds")
        for number in numbers:
            role = role_of(self._config.pipeline, number, size) if self._config else "starting"
            self.lost.append(self._there[number] | {"role": role, "when": when})
        self._there = [there for number, there in enumerate(self._there) if number not in numbers]
