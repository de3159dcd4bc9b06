"""The server of the studio: static files and one WebSocket, for this computer only.

The address contains a random token as its first part, without which nothing is answered. Requests
for another host, which a page of the web could make by rebinding its name (DNS rebinding), and
WebSockets of pages from elsewhere (their Origin header, RFC 6455 section 10.2) are refused. A page
can reach no file: the few files of the page itself are in memory.
"""

from __future__ import annotations

import asyncio
import hmac
import secrets
import socket
from collections.abc import Callable, Mapping
from contextlib import closing
from importlib.resources import files
from pathlib import PurePath
from typing import Any

from quell import checks
from quell.optional import import_extra
from quell.parallel import one_blas_thread
from quell.studio.connections import BACKLOG, Door
from quell.studio.forms import forms
from quell.studio.frames import frame
from quell.studio.messages import MOST_BYTES, Granted, files_of
from quell.studio.pages import Page, Workers

HOST = "127.0.0.1"
PORT = 8770
"""The usual port. A page that is opened again at the same port finds what it last had."""

# Most pages at once; chosen by hand: a person opens a few.
_MOST_PAGES = 32
# Messages of one page that wait in the server before its connection is no longer read.
_QUEUE = 8
# Connections that wait in the operating system until they are accepted.
_QUEUED = 1024
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
}
# The page loads nothing from elsewhere, and connects to this computer only: to this server, and, to
# watch a rig, to the port of its telemetry.
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self' ws://127.0.0.1:*; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
# Policy violation, and try again later (RFC 6455, section 7.4.1).
_REFUSED, _TOO_MANY = 1008, 1013


def page_files() -> dict[str, tuple[str, bytes]]:
    """Return type and content of each file of the page by its path."""
    found: dict[str, tuple[str, bytes]] = {}

    def collect(folder: Any, before: str) -> None:
        for entry in folder.iterdir():
            name = before + entry.name
            if entry.is_dir():
                collect(entry, f"{name}/")
            else:
                kind = _TYPES.get(PurePath(entry.name).suffix, "text/plain; charset=utf-8")
                found[name] = kind, entry.read_bytes()

    collect(files("quell.studio") / "page", "")
    return found


class Studio:
    """The application: who may connect, what the page gets, and the threads that work for it.

    Parameters
    ----------
    port
        the port at which it is served: part of the host that requests must name.
    setup
        tables of the setup that the page starts with; its own by default.
    token
        the first part of the path of the address; random by default.
    trust
        whether the Python file of a plant in ``setup`` may be run.
    """

    def __init__(
        self,
        port: int = PORT,
        setup: Mapping[str, Any] | None = None,
        token: str | None = None,
        trust: bool = False,
    ) -> None:
        self.token = secrets.token_urlsafe(24) if token is None else token
        self.host = f"{HOST}:{port}"
        self._setup, self._files, self._workers = setup, page_files(), Workers()
        self._granted = Granted(files_of(setup), trust)
        self.door = Door()
        self._pages = 0

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://{self.host}/{self.token}/"

    def app(self) -> Any:
        """Return the application for a server (ASGI)."""
        applications = import_extra("starlette.applications", "studio", "the studio")
        routing = import_extra("starlette.routing", "studio", "the studio")
        routes = [
            routing.Route("/{token}/{path:path}", self._file, methods=["GET"]),
            routing.WebSocketRoute("/{token}/socket", self._socket),
        ]
        return applications.Starlette(routes=routes)

    def close(self) -> None:
        """End the threads."""
        self._workers.close()

    def _is_welcome(self, request: Any, origin_needed: bool) -> bool:
        """Return whether host, origin and token of a request are those of the studio's page."""
        headers = request.headers
        origins = headers.getlist("origin")
        own = f"http://{self.host}"
        if headers.getlist("host") != [self.host] or any(each != own for each in origins):
            return False
        if origin_needed and len(origins) != 1:
            return False
        given = str(request.path_params["token"]).encode("utf-8", "replace")
        return hmac.compare_digest(given, self.token.encode())

    async def _file(self, request: Any) -> Any:
        from starlette.responses import Response

        if not self._is_welcome(request, origin_needed=False):
            return Response("Not for you.\n", 403, _HEADERS, "text/plain")
        found = self._files.get(request.path_params["path"] or "index.html")
        if found is None:
            return Response("No such file.\n", 404, _HEADERS, "text/plain")
        kind, content = found
        return Response(content, 200, _HEADERS | {"Content-Type": kind})

    async def _socket(self, websocket: Any) -> None:
        if not self._is_welcome(websocket, origin_needed=True):
            await websocket.close(_REFUSED)
            return
        if self._pages >= _MOST_PAGES:
            await websocket.close(_TOO_MANY)
            return
        self._pages += 1
        try:
            await websocket.accept()
            hello = {"kind": "hello", "forms": forms(self._granted)}
            await websocket.send_bytes(frame({**hello, "setup": self._setup}))
            await Page(websocket, self._workers, self._granted).serve()
        finally:
            self._pages -= 1


def listen(
    setup: Mapping[str, Any] | None = None,
    port: int = PORT,
    token: str | None = None,
    trust: bool = False,
) -> tuple[Any, Studio, Any]:
    """Return a listening socket, the application for it, and the configuration of its server.

    Parameters
    ----------
    setup
        tables of the setup that the page starts with.
    port
        TCP port; 0 takes any free one.
    token
        first part of the path of the address; random by default.
    trust
        whether the Python file of a plant in ``setup`` may be run.

    Raises
    ------
    ValueError
        for a port out of range, or one at which another program listens.
    ImportError
        without the packages of the extra ``studio``.
    """
    checks.whole("port", port, 0, 65535)
    uvicorn = import_extra("uvicorn", "studio", "the studio")
    import_extra("websockets", "studio", "the studio")
    try:
        listener = socket.create_server((HOST, port), backlog=_QUEUED)
    except OSError as error:
        raise ValueError(
            f"port = {port}: can't listen there ({error.strerror or error}); choose another port, "
            "or 0 for a free one"
        ) from None
    try:
        # Else the second frame of an answer waits until the first one is acknowledged, which
        # receivers put off by up to 40 ms (Nagle's algorithm, RFC 896, and delayed
        # acknowledgements, RFC 1122). Connections have the option from their listener.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        studio = Studio(listener.getsockname()[1], setup, token, trust)
        config = uvicorn.Config(
            studio.app(),
            http=studio.door.protocol(),
            backlog=BACKLOG,
            ws="websockets-sansio",
            ws_max_size=MOST_BYTES,
            ws_max_queue=_QUEUE,
            ws_per_message_deflate=False,
            lifespan="off",
            access_log=False,
            log_level="error",
            server_header=False,
            timeout_graceful_shutdown=1,
        )
    except BaseException:
        listener.close()
        raise
    return listener, studio, config


def serve(
    setup: Mapping[str, Any] | None = None,
    port: int = PORT,
    ready: Callable[[str], None] | None = None,
    trust: bool = False,
) -> None:
    """Serve the studio until it is interrupted; arguments and errors as those of ``listen``.

    ``ready`` is called with the address when the server listens.
    """
    listener, studio, config = listen(setup, port, trust=trust)
    server = import_extra("uvicorn", "studio", "the studio").Server(config)
    with listener, closing(studio), one_blas_thread():
        if ready is not None:
            ready(studio.url)

        async def work() -> None:
            asyncio.get_running_loop().set_exception_handler(studio.door.exceptions)
            serving = asyncio.create_task(server.serve(sockets=[listener]))
            while not (server.started or serving.done()):
                await asyncio.sleep(0.01)
            if not serving.done():
                # Uvicorn has set it to ``BACKLOG``: a page would wait a second when it is full.
                listener.listen(_QUEUED)
            await serving

        asyncio.run(work())
