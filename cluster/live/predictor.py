"""Tells a hub, beside what ranks measure, what the performance model expects of frames with such counts.

It listens to the metrics as any client does, and speaks to the hub as a rank that draws nothing:

    costs = measure_costs(job)                 # before the ranks start; None where there is no model
    with hub, Predictor(hub.connection, hub.run_address, costs, setting_of(job.config, n_ranks)):
        …

The costs are those of the configuration: other sizes of points, set while the run goes on, are not in them.
"""

from __future__ import annotations

import platform
import threading
import time
from pathlib import Path
from typing import Self

from ...shared.errors import MessageError
from ..predict.setting import Setting
from .board import Board
from .connection import RunAddress
from .expected import LiveCosts, expected

_SHARE = 0.05
"""Of a core that predicting may take."""
_LISTEN_S = 0.25


class Predictor:
    """A thread that hears metrics and sends predictions; context manager, to be left before the hub.

    connection : file of the hub.  address : as of its ranks.  costs : None: nothing is predicted.
    Cost: some ms for each message with metrics, of many ranks at most ``_SHARE`` of a core.
    """

    def __init__(self, connection: Path, address: RunAddress, costs: LiveCosts | None, setting: Setting) -> None:
        self._connection, self._address, self._costs, self._setting = connection, address, costs, setting
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        if self._costs is not None:
            self._thread = threading.Thread(target=self._run, args=(self._costs,), name="predictor", daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, costs: LiveCosts) -> None:
        from .sockets import Client, RunLink

        board, told, due = Board(), {}, 0.0
        name = "model"
        with (
            Client(self._connection, metrics=True, name=name) as client,
            RunLink(self._address, self._setting.size, name, platform.node()) as link,
        ):
            while not self._over.is_set():
                try:
                    message = client.receive(_LISTEN_S)
                    if message is None or message.kind != "metrics" or not board.hear(message.header):
                        continue
                except MessageError:
                    continue
                counts = counts_of(board)
                if time.monotonic() < due or counts == told:
                    continue
                begun = time.monotonic()
                ranks = expected(costs, self._setting, counts)
                now = time.monotonic()
                due = now + (now - begun) / _SHARE
                if ranks and link.send({"kind": "prediction", "ranks": ranks}):
                    told = counts


def counts_of(board: Board) -> dict[str, float]:
    """What ``expected`` is to be told of a frame, of what all ranks have measured; what none has is missing."""
    found = {name: board.total(name) for name in ("cells", "entries", "points")}
    pixels = [of.values["pixels"] for of in board.in_order() if "pixels" in of.values]
    found |= {"pixels": max(pixels, default=None), "frames_per_s": board.frames_per_s or None}
    return {name: value for name, value in found.items() if value is not None}
