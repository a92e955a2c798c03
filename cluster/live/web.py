"""The web site of a live run: the page's files, and its WebSocket. The only module that imports aiohttp.

A request must name this site as its host, which keeps off pages of others whose name has been made to point here (DNS
rebinding); a WebSocket must come from this site's own page and have the token. The files are a table made when the site
starts: no request names a path.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import mimetypes
import socket
from collections.abc import Callable
from contextlib import suppress
from importlib import resources
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
_LAST_WORDS_S = 2.0
_HEARTBEAT_S = 20.0


class _File(NamedTuple):
    content: bytes
    type: str


def page_files() -> dict[str, _File]:
    """Address → file of the page, of the package's own directory ``page``."""
    files: dict[str, _File] = {}
    directory = resources.files(__package__).joinpath("page")
    for file in directory.iterdir() if directory.is_dir() else ():
        if file.is_file() and not file.name.startswith((".", "__")):
            kind = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
            files[f"/{file.name}"] = _File(file.read_bytes(), kind)
    if "/index.html" in files:
        files["/"] = files["/index.html"]
    return files


class _PageOutlet:
    """A viewer's end over a WebSocket."""

    def __init__(self, link: web.WebSocketResponse, transport: asyncio.Transport) -> None:
        self._link, self._transport = link, transport
        self._closing: asyncio.Task[None] | None = None

    async def send(self, parcel: Parcel) -> None:
        if parcel.payload:
            await self._link.send_frame(parcel.binary, WSMsgType.BINARY)
        else:
            await self._link.send_frame(parcel.text, WSMsgType.TEXT)

    def waiting_bytes(self) -> int:
        return self._transport.get_write_buffer_size()

    def end(self, last: Parcel | None) -> None:
        if self._closing is None:
            self._closing = asyncio.get_running_loop().create_task(self._close(last))

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

    bind, port : where; port 0: any.  token : what a WebSocket must have in its address.
    connect : a new viewer, or None where there are too many.  said : what one says; raises MessageError for what nobody
    may say.  left : it has gone, or is to go for a reason.
    Raises InputError where the address cannot be had.
    """

    def __init__(
        self,
        bind: str,
        token: str,
        connect: Callable[[_PageOutlet], Viewer | None],
        said: Callable[[Viewer, dict[str, Any]], None],
        left: Callable[[Viewer, str], None],
    ) -> None:
        self._bind, self._token = bind, token
        self._connect, self._said, self._left = connect, said, left
        self._files = page_files()
        self._names = _names_of(bind)
        self.port = 0

    async def start(self, port: int) -> None:
        """Listen."""
        app = web.Application(middlewares=[self._guard], client_max_size=1024)
        app.router.add_get("/live", self._live)
        app.router.add_get("/{name:[^/]*}", self._file)
        self._runner = web.AppRunner(
            app, access_log=None, handle_signals=False, shutdown_timeout=_LAST_WORDS_S + 1, keepalive_timeout=10.0
        )
        await self._runner.setup()
        try:
            await web.TCPSite(self._runner, self._bind, port, backlog=256).start()
        except OSError as error:
            await self._runner.cleanup()
            raise InputError(f"{self._bind}:{port}: cannot listen there: {error.strerror or error}") from None
        self.port = self._runner.addresses[0][1]

    async def close(self) -> None:
        """Stop listening, and end what is left."""
        await self._runner.cleanup()

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
        return web.Response(body=file.content, content_type=file.type)

    async def _live(self, request: web.Request) -> web.StreamResponse:
        if request.headers.getall("Origin", []) != [f"http://{request.host}"]:
            return web.Response(status=403, text="of another origin")
        if not hmac.compare_digest(request.query.get("token", "").encode(), self._token.encode()):
            return web.Response(status=403, text="wrong token")
        link = web.WebSocketResponse(compress=False, max_msg_size=MAX_HEADER_BYTES, heartbeat=_HEARTBEAT_S)
        if not link.can_prepare(request) or request.transport is None:
            return web.Response(status=400, text="expected a WebSocket")
        transport: Any = request.transport
        outlet = _PageOutlet(link, transport)
        viewer = self._connect(outlet)
        if viewer is None:
            return web.Response(status=503, text="too many viewers")
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
        finally:
            self._left(viewer, why)
            if outlet._closing is not None:
                await asyncio.shield(outlet._closing)
        return link


def _names_of(bind: str) -> set[str]:
    """The names by which a request may call this host."""
    names = {bind.lower(), "localhost"}
    if bind in ("0.0.0.0", "::"):
        names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    return names
