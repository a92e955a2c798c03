"""What viewers ask that the run itself need not answer: one worker thread, and a bounded number of requests."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

from ...shared.errors import InputError, SplatpipeError
from .protocol import MAX_HEADER_BYTES, PathKey, PathWanted, PickWanted, PlanWanted, View, to_json
from .viewers import Parcel, Viewer

MAX_WAITING = 8
"""Requests that the thread has or that wait for it; of them ``MAX_WAITING_EACH`` of one viewer."""
MAX_WAITING_EACH = 2

Asked = PickWanted | PathWanted | PlanWanted


class Services(Protocol):
    """What is answered beside the run, in a worker thread of the hub's. A SplatpipeError is told to who asked."""

    def pick(self, view: View, width: int, height: int, x: float, y: float, settings: dict[str, Any]) -> dict[str, Any]:
        """{"found": bool, "position": [x, y, z], "attributes": {name: value}} at a place of a picture, in shares."""
        ...

    def path(self, keys: list[PathKey], fps: float, settings: dict[str, Any]) -> str:
        """A recorded path as TOML."""
        ...

    def left_out(self) -> list[dict[str, Any]]:
        """[{"what", "why", "saves"}]."""
        ...

    def expected(self, ranks: int, counts: dict[str, float]) -> list[dict[str, Any]]:
        """``ranks`` of a ``prediction`` for a frame with these counts; nothing where there is no model of the run."""
        ...


class Worker:
    """Asks the services. answer : called in the loop with the viewer and the answer or refusal."""

    def __init__(self, services: Services, answer: Callable[[Viewer, Parcel], None]) -> None:
        self._services, self._answer = services, answer
        self._thread = ThreadPoolExecutor(1, "hub services")
        self._tasks: set[asyncio.Task[None]] = set()

    def ask(self, viewer: Viewer, wanted: Asked, frame: dict[str, Any], settings: dict[str, Any]) -> None:
        """Have a request answered. frame : what is known of the picture that it is about. Raises InputError where too
        many wait.
        """
        if viewer.services >= MAX_WAITING_EACH or len(self._tasks) >= MAX_WAITING:
            raise InputError("too many requests are waiting")
        viewer.services += 1
        task = asyncio.get_running_loop().create_task(self._work(viewer, wanted, frame, settings))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def expected(self, ranks: int, counts: dict[str, float]) -> list[dict[str, Any]]:
        """What the services expect of a frame; nothing where they fail."""
        try:
            call = asyncio.get_running_loop().run_in_executor(self._thread, self._services.expected, ranks, counts)
            return await call
        except Exception:  # a model that does not suit is no reason to do without metrics
            return []

    async def _work(self, viewer: Viewer, wanted: Asked, frame: dict[str, Any], settings: dict[str, Any]) -> None:
        answer: dict[str, Any]
        try:
            call = asyncio.get_running_loop().run_in_executor(self._thread, self._call, wanted, frame, settings)
            answer = {"kind": wanted.kind, **await call}
            n_bytes = len(to_json(answer))
            if n_bytes > MAX_HEADER_BYTES - 64:
                raise InputError(f"the answer has {n_bytes} bytes, at most {MAX_HEADER_BYTES} can be sent")
        except SplatpipeError as error:
            answer = {"kind": "refused", "why": " ".join(str(error).split())[:400]}
        except Exception as error:  # a service that fails ends neither the hub nor the run
            answer = {"kind": "refused", "why": f"{wanted.kind} failed: {type(error).__name__}"}
        finally:
            viewer.services -= 1
        self._answer(viewer, Parcel({**answer, "request": wanted.request}))

    def _call(self, wanted: Asked, frame: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
        if isinstance(wanted, PickWanted):
            view = View.model_validate_json(to_json(frame["view"]))
            return self._services.pick(view, frame["width"], frame["height"], wanted.x, wanted.y, settings)
        if isinstance(wanted, PathWanted):
            return {"toml": self._services.path(wanted.keys, wanted.fps, settings)}
        return {"left_out": self._services.left_out()}

    def close(self) -> None:
        """Wait for the request that is being worked on, and drop the others."""
        for task in self._tasks:
            task.cancel()
        self._thread.shutdown(wait=True, cancel_futures=True)
