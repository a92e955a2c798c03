"""ZeroMQ: the ends of ranks, of programs that look, and of the hub. The only module that imports zmq.

All of it is CURVE: encrypted, and a peer is let in by its public key. Ranks and viewers have different keys, each
admitted at its own socket only, so that no viewer can speak as a rank.
"""

from __future__ import annotations

import asyncio
import os
import select
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ...shared.errors import DeviceError, InputError, MessageError
from .connection import Connection, RunAddress, find_connection
from .protocol import MAX_HEADER_BYTES, MAX_PAYLOAD_BYTES, PROTOCOL_VERSION, LiveMessage, parse_json, to_json

try:
    import zmq
    import zmq.asyncio
    from zmq.utils import z85
except ImportError as error:
    raise DeviceError(f"ZeroMQ: {error}; install splatpipe[live]") from None

__all__ = ["Client", "Gone", "HubSockets", "Router", "RunAddress", "RunLink", "new_keys", "shared_frame"]

_CURVE_BYTES = 64
"""By which CURVE lengthens a frame, and some."""
_RANK_WAITING = 64
_CLIENT_WAITING = 1000
_VIEWER_WAITING = 16
"""Messages that may wait in a socket for one peer."""
_HEARTBEAT_MS = 5_000
_SILENT_MS = 15_000
_HANDSHAKE_MS = 5_000
_RANK_LINGER_MS = 500


def new_keys() -> tuple[str, str]:
    """A public and a secret key, in Z85."""
    if not zmq.has("curve"):
        raise DeviceError("ZeroMQ: built without CURVE; install a pyzmq with libsodium")
    public, secret = zmq.curve_keypair()
    return public.decode(), secret.decode()


class Gone(Exception):
    """There is no such peer any more."""


# --- the end of a rank ---------------------------------------------------------------------------------------------


class RunLink:
    """A rank's end of the link to the hub. Context manager; says hello at once. The hub need not be there yet."""

    def __init__(self, address: RunAddress, rank: int, role: str, host: str) -> None:
        self._context = zmq.Context()
        self._socket = _dealer(self._context, address.address, address, MAX_HEADER_BYTES, _RANK_WAITING)
        self._socket.setsockopt(zmq.LINGER, _RANK_LINGER_MS)
        self._socket.setsockopt(zmq.ROUTING_ID, f"rank{rank}".encode())
        self._lock = threading.Lock()
        self._receiving = threading.Lock()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._closed = False
        self._something = select.poll()
        self._something.register(self._wake, select.POLLIN)
        self._something.register(self._socket.getsockopt(zmq.FD), select.POLLIN)
        self._socket.connect(address.address)
        self.send({"kind": "hello", "protocol": PROTOCOL_VERSION, "rank": rank, "role": role, "host": host})

    def send(self, header: dict[str, Any], payload: bytes | memoryview = b"") -> bool:
        """Send without waiting, from any thread; False: the hub is behind, and the message has been dropped.

        The payload may be changed afterwards.
        """
        frames = [to_json(header), payload]
        with self._lock:
            if self._closed:
                return False
            sent = True
            try:
                self._socket.send_multipart(frames, zmq.NOBLOCK)
            except zmq.Again:
                sent = False
            if self._socket.getsockopt(zmq.EVENTS) & zmq.POLLIN:  # else the receiver would miss what came meanwhile
                os.eventfd_write(self._wake, 1)
        return sent

    def receive(self, timeout_s: float) -> list[LiveMessage]:
        """All messages that wait, for which it waits that long: [] if none came. For one thread."""
        end = time.monotonic() + timeout_s
        with self._receiving:
            while True:
                with self._lock:
                    if self._closed:
                        return []
                    messages = self._take()
                left_s = end - time.monotonic()
                if messages or left_s <= 0:
                    return messages
                self._something.poll(left_s * 1000)
                with suppress(BlockingIOError):
                    os.eventfd_read(self._wake)

    def _take(self) -> list[LiveMessage]:
        messages: list[LiveMessage] = []
        while len(messages) < _RANK_WAITING:
            try:
                frames = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                break
            with suppress(MessageError):
                messages.append(_message(frames))
        return messages

    def close(self) -> None:
        """End it; what has been sent gets a moment to leave."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            os.eventfd_write(self._wake, 1)
        with self._receiving:
            self._socket.close()
            os.close(self._wake)
        self._context.term()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


# --- the end of a program that looks ---------------------------------------------------------------------------------


class Client:
    """A viewer that is a program; for one thread. Context manager.

    connection : the run, its connection file, or None: this user's newest run.
    pictures, metrics : the streams wanted.
    Raises InputError where there is no run.
    """

    def __init__(
        self,
        connection: Connection | Path | None = None,
        *,
        pictures: bool = False,
        metrics: bool = False,
        name: str = "program",
    ) -> None:
        found = connection if isinstance(connection, Connection) else find_connection(connection)
        self.connection = found
        self._context = zmq.Context()
        self._socket = _dealer(self._context, found.address, found, MAX_PAYLOAD_BYTES, _CLIENT_WAITING)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.connect(found.address)
        wanted = {"pictures": pictures, "metrics": metrics}
        self.send({"kind": "hello", "protocol": PROTOCOL_VERSION, "client": name, **wanted})

    def send(self, header: dict[str, Any]) -> bool:
        """Say something; False: too much waits already, and it has been dropped."""
        try:
            self._socket.send_multipart([to_json(header), b""], zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def receive(self, timeout_s: float) -> LiveMessage | None:
        """The next message, None if none came in that time. Raises MessageError for one that is malformed.

        Pictures are to be acknowledged: ``send({"kind": "ack", "frame": …})``.
        """
        if not self._socket.poll(max(0, round(timeout_s * 1000))):
            return None
        return _message(self._socket.recv_multipart())

    def close(self) -> None:
        """Say bye, and end it."""
        if self._socket.closed:
            return
        self.send({"kind": "bye"})
        self._socket.close(linger=100)
        self._context.term()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _dealer(
    context: zmq.Context[Any], address: str, keys: RunAddress | Connection, max_bytes: int, waiting: int
) -> Any:
    socket = context.socket(zmq.DEALER)
    try:
        socket.setsockopt(zmq.CURVE_SERVERKEY, keys.server_key.encode())
        socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.public_key.encode())
        socket.setsockopt(zmq.CURVE_SECRETKEY, keys.secret_key.encode())
    except (zmq.ZMQError, ValueError):
        socket.close(linger=0)
        context.term()
        raise InputError(f"{address}: the keys of this connection are no CURVE keys") from None
    socket.setsockopt(zmq.MAXMSGSIZE, max_bytes + _CURVE_BYTES)
    socket.setsockopt(zmq.SNDHWM, waiting)
    socket.setsockopt(zmq.RCVHWM, _RANK_WAITING)
    socket.setsockopt(zmq.TCP_KEEPALIVE, 1)
    return socket


def _message(frames: list[bytes]) -> LiveMessage:
    if len(frames) != 2:
        raise MessageError(f"message: found {len(frames)} frames, expected a header and a payload")
    return LiveMessage(parse_json(frames[0]), frames[1])


# --- the hub's end -------------------------------------------------------------------------------------------------


def shared_frame(payload: bytes) -> Any:
    """A copy of the payload that can be sent to many without further ones, and without pyzmq's thread for such."""
    return zmq.Frame(payload, copy=True)


class Router:
    """A socket of the hub that knows its peers by name. For the thread of its loop."""

    def __init__(self, socket: zmq.asyncio.Socket) -> None:
        self._socket = socket
        self.port = 0

    async def receive(self) -> tuple[bytes, list[bytes]]:
        """The next message: name of the peer, and its frames."""
        peer, *frames = await self._socket.recv_multipart()
        return peer, frames

    def send(self, peer: bytes, header: bytes, payload: Any = b"") -> bool:
        """Send without waiting; False: too much waits for this peer. Raises Gone.

        payload : bytes, or what ``shared_frame`` made of them.
        """
        future: Any = self._socket.send_multipart([peer, header, payload], zmq.NOBLOCK)
        error = future.exception()
        if error is None:
            return True
        if isinstance(error, zmq.Again):
            return False
        raise Gone from None


class HubSockets:
    """The hub's two sockets, for ranks and for viewers, on a context of their own. For one event loop.

    run_keys, viewer_keys : public keys that are let in.
    Raises InputError where an address cannot be had.
    """

    def __init__(
        self, bind: str, viewer_port: int, server_keys: tuple[str, str], run_key: str, viewer_key: str
    ) -> None:
        self._context: Any = zmq.asyncio.Context()
        self._server_keys = server_keys
        self._admitted = {b"run": run_key.encode(), b"viewers": viewer_key.encode()}
        self._sockets: list[Any] = []
        try:
            self._zap = self._context.socket(zmq.REP)
            self._sockets.append(self._zap)
            self._zap.bind("inproc://zeromq.zap.01")
            self.run = self._bind(b"run", bind, 0, MAX_PAYLOAD_BYTES, _RANK_WAITING)
            self.viewers = self._bind(b"viewers", bind, viewer_port, MAX_HEADER_BYTES, _VIEWER_WAITING)
        except BaseException:
            self.close()
            raise
        self._admitting = asyncio.get_running_loop().create_task(self._admit(), name="zap")

    def _bind(self, domain: bytes, host: str, port: int, max_bytes: int, waiting: int) -> Router:
        socket = self._context.socket(zmq.ROUTER)
        self._sockets.append(socket)
        for option, value in (
            (zmq.CURVE_SERVER, 1),
            (zmq.CURVE_PUBLICKEY, self._server_keys[0].encode()),
            (zmq.CURVE_SECRETKEY, self._server_keys[1].encode()),
            (zmq.ZAP_DOMAIN, domain),
            (zmq.MAXMSGSIZE, max_bytes + _CURVE_BYTES),
            (zmq.SNDHWM, waiting),
            (zmq.RCVHWM, waiting),
            (zmq.LINGER, 0),
            (zmq.ROUTER_MANDATORY, 1),
            (zmq.ROUTER_HANDOVER, int(domain == b"run")),  # a rank that connects again is the same rank
            (zmq.HANDSHAKE_IVL, _HANDSHAKE_MS),
            (zmq.HEARTBEAT_IVL, _HEARTBEAT_MS),
            (zmq.HEARTBEAT_TIMEOUT, _SILENT_MS),
            (zmq.BACKLOG, 256),
            (zmq.IPV6, int(":" in host)),
        ):
            socket.setsockopt(option, value)
        address = f"tcp://{f'[{host}]' if ':' in host else host}:{port or '*'}"
        try:
            socket.bind(address)
        except zmq.ZMQError as error:
            raise InputError(f"{address}: cannot listen there: {error.strerror}") from None
        router = Router(socket)
        router.port = int(socket.getsockopt(zmq.LAST_ENDPOINT).rstrip(b"\0").rpartition(b":")[2])
        return router

    async def _admit(self) -> None:
        """Answer libzmq's questions whom to let in (ZAP, RFC 27): who has proved to hold the secret key that belongs to
        the public key of this socket.
        """
        while True:
            version, request, domain, _, _, mechanism, *credentials = await self._zap.recv_multipart()
            key = z85.encode(credentials[0]) if mechanism == b"CURVE" and len(credentials) == 1 else b""
            admitted = key != b"" and key == self._admitted.get(domain)
            status = (b"200", b"OK", b"viewer") if admitted else (b"400", b"unknown key", b"")
            await self._zap.send_multipart([version, request, *status, b""])

    def serve(self, handle: Callable[[bytes, list[bytes]], None], router: Router) -> asyncio.Task[None]:
        """Hand what comes to ``handle``, letting others have their turn now and then."""
        return asyncio.get_running_loop().create_task(_serve(handle, router))

    def close(self) -> None:
        """End it all; nothing lingers."""
        if hasattr(self, "_admitting"):
            self._admitting.cancel()
        for socket in self._sockets:
            socket.close(linger=0)
        self._context.term()


async def _serve(handle: Callable[[bytes, list[bytes]], None], router: Router) -> None:
    taken = 0
    while True:
        peer, frames = await router.receive()
        handle(peer, frames)
        taken += 1
        if taken % 32 == 0:
            await asyncio.sleep(0)
