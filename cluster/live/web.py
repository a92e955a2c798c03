"""The web site of a live run: the page's files, and its WebSocket. The only module that imports aiohttp.

A request must name this site as its host, which keeps off pages of others whose name has been made to point here (DNS
rebinding); a WebSocket must come from this site's own page and have the token. The files are a table made when the site
starts: no request names a path.
"""

from __future__ import annotations

import asyncio
import fcntl
import hmac
import ipaddress
import logging
import socket
import sys
import termios
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import resources
from pathlib import PurePath
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from ...shared.errors import DeviceError, InputError, MessageError
from .protocol import MAX_HEADER_BYTES, parse_json
from .viewers import Parcel, Viewer

try:
    from aiohttp import WSMsgType, web
except ImportError as error:
    raise DeviceError(f"the page: {error}; install splatpipe[live]") from None

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; font-src 'self';"
        " connect-src 'self'; worker-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".mjs": "text/javascript",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".ico": "image/x-icon",
    ".json": "application/json",
    ".webmanifest": "application/manifest+json",
    ".woff2": "font/woff2",
    ".wasm": "application/wasm",
}
MAX_CONNECTIONS = 512
REQUEST_S = 20.0
"""How long a connection may last that is no WebSocket."""
_LAST_WORDS_S = 1.0
_HEARTBEAT_S = 20.0

_silent = logging.Logger("splatpipe.live.web", logging.CRITICAL + 1)  # what strangers send is nobody's concern


class _File(NamedTuple):
    content: bytes
    type: str


def page_files() -> dict[str, _File]:
    """Address → file, of the files with known suffixes in the package's own directory ``page``."""
    files: dict[str, _File] = {}
    directory = resources.files("splatpipe.cluster.live").joinpath("page")
    for file in directory.iterdir() if directory.is_dir() else ():
        kind = TYPES.get(PurePath(file.name).suffix)
        if kind is not None and file.is_file():
            files[f"/{file.name}"] = _File(file.read_bytes(), kind)
    if "/index.html" in files:
        files["/"] = files["/index.html"]
    return files


class _PageOutlet:
    """A viewer's end over a WebSocket."""

    probed = False

    def __init__(self, link: web.WebSocketResponse, transport: asyncio.Transport) -> None:
        self._link, self._transport = link, transport
        self.closing: asyncio.Task[None] | None = None

    async def send(self, parcel: Parcel) -> None:
        if parcel.payload:
            await self._link.send_frame(parcel.binary, WSMsgType.BINARY)
        else:
            await self._link.send_frame(parcel.text, WSMsgType.TEXT)

    def waiting_bytes(self) -> int:
        """Also what the kernel has, since that takes more only when a good part of it has gone."""
        waiting = self._transport.get_write_buffer_size()
        with suppress(OSError, ValueError):  # closed meanwhile
            unsent = fcntl.ioctl(self._transport.get_extra_info("socket").fileno(), termios.TIOCOUTQ, bytes(4))
            waiting += int.from_bytes(unsent, sys.byteorder)
        return waiting

    def end(self, last: Parcel | None) -> None:
        if self.closing is None:
            self.closing = asyncio.get_running_loop().create_task(self._close(last))

    async def _close(self, last: Parcel | None) -> None:
        try:
            async with asyncio.timeout(_LAST_WORDS_S):
                with suppress(ConnectionError, RuntimeError):
                    if last is not None:
                        await self._link.send_frame(last.text, WSMsgType.TEXT)
                    await self._link.close()
        except TimeoutError:
            pass
        finally:
            self._transport.abort()


class Site:
    """Serves the page and takes its WebSockets.

    bind : as it was asked for, a name by which requests may call this host.  address : what that is in numbers.
    token : what a WebSocket must have in its address.
    connect : a new viewer, or None where there are too many.  said : what one says; raises MessageError for what nobody
    may say.  left : it has gone, or is to go for a reason.
    Raises InputError where the address cannot be had.
    """

    def __init__(
        self,
        bind: str,
        address: str,
        token: str,
        connect: Callable[[_PageOutlet], Viewer | None],
        said: Callable[[Viewer, dict[str, Any]], None],
        left: Callable[[Viewer, str], None],
    ) -> None:
        self._address, self._token = address, token
        self._connect, self._said, self._left = connect, said, left
        self._files = page_files()
        self._names = _names_of(bind)
        self._since: dict[Any, float] = {}  # connection → when it was accepted, the oldest first
        self._pages: set[Any] = set()  # connections that are WebSockets
        self.port = 0

    async def start(self, port: int) -> None:
        """Listen; port 0: any."""
        app = web.Application(middlewares=[self._guard], client_max_size=1024, logger=_silent)
        app.router.add_get("/live", self._live)
        app.router.add_get("/{name:[^/]*}", self._file)
        self._runner = web.AppRunner(
            app,
            access_log=None,
            logger=_silent,
            handle_signals=False,
            shutdown_timeout=2 * _LAST_WORDS_S,
            keepalive_timeout=REQUEST_S,
        )
        await self._runner.setup()
        try:
            loop = asyncio.get_running_loop()
            self._listener = await loop.create_server(
                self._accept, self._address, port, backlog=256, reuse_address=True
            )
        except OSError as error:
            await self._runner.cleanup()
            raise InputError(f"{self._address}:{port}: cannot listen there: {error.strerror or error}") from None
        self.port = self._listener.sockets[0].getsockname()[1]

    def _accept(self) -> asyncio.BaseProtocol:
        if len(self._since) >= MAX_CONNECTIONS:
            self._forget()
            others = [protocol for protocol in self._since if protocol not in self._pages]  # the oldest first
            if len(self._since) >= MAX_CONNECTIONS and not (others and self._abort(others[0])):
                return _Refused()
        server: Any = self._runner.server
        protocol = server()
        self._since[protocol] = time.monotonic()
        return protocol

    def tick(self) -> None:
        """To be called now and then: ends connections that ask for nothing or take nothing."""
        self._forget()
        now = time.monotonic()
        for protocol, since in list(self._since.items()):
            if protocol not in self._pages and now - since > REQUEST_S:
                self._abort(protocol)

    def _forget(self) -> None:
        """Forget connections that have ended. One that has just been accepted has no transport either."""
        now = time.monotonic()
        for protocol, since in list(self._since.items()):
            if protocol.transport is None and now - since > 1:
                del self._since[protocol]

    def _abort(self, protocol: Any) -> bool:
        if protocol.transport is None:
            return False
        protocol.transport.abort()
        del self._since[protocol]
        return True

    async def close(self) -> None:
        """Stop listening, and end what is left."""
        self._listener.close()
        await self._runner.cleanup()
        await self._listener.wait_closed()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        if not self._is_here(request.headers.getall("Host", [])):
            return web.Response(status=421, text="not a name of this host", headers=HEADERS)
        try:
            response = await handler(request)
        except web.HTTPException as error:
            response = web.Response(status=error.status, text=error.reason)
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    def _is_here(self, hosts: list[str]) -> bool:
        try:
            name = urlsplit(f"//{hosts[0]}").hostname if len(hosts) == 1 else None
        except ValueError:
            return False
        if name is None:
            return False
        if name in self._names:
            return True
        try:  # an address, not a name: nobody can make it point elsewhere
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True

    async def _file(self, request: web.Request) -> web.Response:
        file = self._files.get(request.path)
        if file is None:
            return web.Response(status=404, text="nothing there")
        text = file.type.startswith("text/")
        return web.Response(body=file.content, content_type=file.type, charset="utf-8" if text else None)

    async def _live(self, request: web.Request) -> web.StreamResponse:
        if request.headers.getall("Origin", []) != [f"http://{request.host}"]:
            return web.Response(status=403, text="of another origin")
        token = request.query.get("token", "").encode(errors="replace")
        if not hmac.compare_digest(token, self._token.encode()):
            return web.Response(status=403, text="wrong token")
        link = web.WebSocketResponse(compress=False, max_msg_size=MAX_HEADER_BYTES, heartbeat=_HEARTBEAT_S)
        transport: Any = request.transport
        if not link.can_prepare(request) or transport is None:
            return web.Response(status=400, text="expected a WebSocket")
        outlet = _PageOutlet(link, transport)
        viewer = self._connect(outlet)
        if viewer is None:
            return web.Response(status=503, text="too many viewers")
        self._pages.add(request.protocol)
        why = ""
        try:
            await link.prepare(request)
            async for message in link:
                if message.type is not WSMsgType.TEXT:
                    why = "message: expected text"
                    break
                self._said(viewer, parse_json(message.data))
        except MessageError as error:
            why = str(error)
        except ConnectionError:
            pass
        finally:
            self._left(viewer, why)
            if outlet.closing is not None:
                await asyncio.shield(outlet.closing)
            self._pages.discard(request.protocol)
        return link


class _Refused(asyncio.Protocol):
    """A connection that is one too many."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.abort()


def _names_of(bind: str) -> set[str]:
    """The names by which a request may call this host."""
    names = {bind.lower(), "localhost"}
    if bind in ("0.0.0.0", "::"):
        names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    return names
