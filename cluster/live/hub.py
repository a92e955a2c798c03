"""The hub of a live run: a thread that passes the run's pictures to all who look, and what they want to the run.

Ranks reach it by ZeroMQ (``sockets``), viewers by ZeroMQ (``programs``) or from a page (``web``), and to it they are
alike (``viewers``, ``switchboard``). It never waits for any of them: of what one does not take the latest remains, and
who takes nothing is dropped.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import socket
import threading
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ...shared.errors import InputError, MessageError, SplatpipeError
from ..record import package_version
from .asked import Services
from .connection import Connection, RunAddress
from .gathered import Record
from .programs import Programs
from .protocol import PROTOCOL_VERSION, parse_json, to_json
from .sockets import Gone, HubSockets, new_keys
from .switchboard import Switchboard
from .web import Site

__all__ = ["Hub", "Services"]

TICK_S = 0.25
_LAST_WORDS_S = 0.05


class Hub:
    """Context manager: lives from entering to leaving, and nothing of it remains: no thread, socket or file.

    bind : the address on which it listens; another than a loopback one lets others of the network try their keys.
    port, zmq_port : of the page, and of programs; 0: any.
    connection : where the connection file is written.  record : where metrics are written down, JSON lines.
    Entering raises InputError where an address or a file cannot be had; leaving, SplatpipeError where the hub failed.
    """

    run_address: RunAddress
    url: str
    """Of the page, with its token."""

    def __init__(
        self,
        services: Services,
        *,
        bind: str = "127.0.0.1",
        port: int = 0,
        zmq_port: int = 0,
        connection: Path,
        record: Path | None = None,
    ) -> None:
        self._services = services
        self._bind, self._port, self._zmq_port = bind, port, zmq_port
        self.connection = connection
        self._record_path = record
        self._why = "the run is over"
        self._started = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="hub", daemon=True)
        self._ranks: set[bytes] = set()
        self._coordinator: bytes | None = None

    def __enter__(self) -> Self:
        self._thread.start()
        self._started.wait()
        if self._failure is not None:
            self._thread.join()
            raise self._failure
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        if self._failure is not None and error is None:
            raise SplatpipeError(f"hub: {type(self._failure).__name__}: {self._failure}") from self._failure

    def close(self, why: str = "the run is over") -> None:
        """Tell all viewers why, and end; from any thread, any number of times."""
        if self._thread.is_alive():
            self._why = why
            with suppress(RuntimeError):  # the loop has ended meanwhile
                self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join()

    def end_run(self) -> None:
        """Ask the run to end after the frame it is at; from any thread."""
        with suppress(RuntimeError):  # the loop has ended meanwhile
            self._loop.call_soon_threadsafe(self._to_run, {"kind": "quit"})

    def _run(self) -> None:
        try:
            asyncio.run(self._live())
        except BaseException as error:
            self._failure = error
        finally:
            self._started.set()

    async def _live(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        server, run, viewer = new_keys(), new_keys(), new_keys()
        token = secrets.token_urlsafe(32)
        async with AsyncExitStack() as stack:
            record = Record(self._record_path) if self._record_path is not None else None
            if record is not None:
                stack.callback(record.close)
            address = _number_of(self._bind)
            self._sockets = HubSockets(address, self._zmq_port, server, run[0], viewer[0])
            stack.callback(self._sockets.close)
            write = record.write if record is not None else lambda header: None
            version = package_version("splatpipe") or ""
            self._board = board = Switchboard(self._services, self._to_run, write, version, socket.gethostname())
            stack.callback(board.close_worker)
            site = Site(self._bind, address, token, board.connect, board.hear, board.leave)
            await site.start(self._port)
            stack.push_async_callback(site.close)

            host = _name_of(self._bind)
            self.url = f"http://{host}:{site.port}/?token={token}"
            self.run_address = RunAddress(f"tcp://{host}:{self._sockets.run.port}", server[0], *run)
            programs_at = f"tcp://{host}:{self._sockets.viewers.port}"
            connection = Connection(PROTOCOL_VERSION, programs_at, server[0], *viewer, self.url, os.getpid())
            connection.write(self.connection)
            programs = Programs(self._sockets.viewers, board.connect, board.hear, board.leave)
            work = {
                self._sockets.serve(self._from_rank, self._sockets.run),
                self._sockets.serve(programs.take, self._sockets.viewers),
                self._loop.create_task(self._tick(site)),
                self._loop.create_task(self._stop.wait()),
            }
            try:
                self._started.set()
                ended, _ = await asyncio.wait(work, return_when=asyncio.FIRST_COMPLETED)
                for task in ended:
                    task.result()
            finally:
                connection.remove(self.connection)
                for task in work:
                    task.cancel()
                await asyncio.gather(*work, return_exceptions=True)
                board.close(self._why)
                await asyncio.sleep(_LAST_WORDS_S)

    async def _tick(self, site: Site) -> None:
        while True:
            await asyncio.sleep(TICK_S)
            self._board.tick()
            site.tick()

    def _from_rank(self, peer: bytes, frames: list[bytes]) -> None:
        if len(frames) != 2:
            return
        with suppress(MessageError):
            header = parse_json(frames[0])
            if header["kind"] == "hello":
                self._ranks.add(peer)
                if header.get("rank") == 0:
                    self._coordinator = peer
            if peer in self._ranks:
                self._board.from_run(header, frames[1])

    def _to_run(self, header: dict[str, Any]) -> bool:
        if self._coordinator is None:
            return False
        try:
            return self._sockets.run.send(self._coordinator, to_json(header))
        except Gone:
            return False


def _number_of(bind: str) -> str:
    try:
        return str(socket.getaddrinfo(bind, None, type=socket.SOCK_STREAM)[0][4][0])
    except (OSError, UnicodeError):
        raise InputError(f"--bind {bind}: expected an address or a name of this host") from None


def _name_of(bind: str) -> str:
    """How others reach an address that is listened on."""
    name = socket.gethostname() if bind in ("0.0.0.0", "::") else bind
    return f"[{name}]" if ":" in name else name
