"""The server of the studio: files, connections, and one WebSocket for each page.

The server of the studio: static files and one WebSocket, for this computer only.

The address contains a random token as its first part, without which nothing is answered. Requests
for another host, which a page of the web could make by rebinding its name (DNS rebinding), and
WebSockets of pages from elsewhere (their Origin header, RFC 6455 section 10.2) are refused. A page
can reach no file: the few files of the page itself are in memory.

The connection of one page: messages in, frames out.

Messages of one page that wait for a thread: of those of one kind the newest wins.

Connections of the studio's server: few at once, and none that never asks for anything.

A program of the same computer can open connections without the token. Each takes a file
descriptor, and a server without free ones accepts no page. So a connection has a few seconds until
its first request is complete; and when there are many, the oldest one that waits is closed for a
new one: a browser sends its request at once, and so it is served. A connection of a page is a
WebSocket, which the server counts and limits itself.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import secrets
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from functools import partial
from importlib.resources import files
from pathlib import PurePath
from typing import Any

from quell import checks
from quell.checks import import_extra
from quell.kernels.cache import compile_time
from quell.parallel import one_blas_thread
from quell.studio import messages
from quell.studio.messages import MOST_BYTES, Granted, files_of, forms, frame
from quell.studio.records import PageRecord
from quell.studio.runs import Maker, StoppedError
from quell.studio.separate import frames_apart, is_large
from quell.studio.tasks import LONG, frames_for

# ---- Messages of one page that wait for a thread ----

# A run that a newer message replaces is finished all the same if it takes no longer than this [s]:
# otherwise nothing would be drawn while a slider moves. Chosen by hand.
_PATIENCE = 0.3


class Lane:
    """The newest message of each kind, and the one that is worked on."""

    def __init__(self) -> None:
        self._waiting: dict[str, dict[str, Any]] = {}
        self._some = asyncio.Event()
        self._began = 0.0
        self._closed = self._stopped = False

    def put(self, message: dict[str, Any]) -> None:
        """Take a message in place of an older one of its kind."""
        self._waiting.pop(message["do"], None)
        self._waiting[message["do"]] = message
        self._some.set()

    async def next(self) -> dict[str, Any]:
        """Return the message that waits longest."""
        while not self._waiting:
            self._some.clear()
            await self._some.wait()
        self._began, self._stopped = time.monotonic(), False
        return self._waiting.pop(next(iter(self._waiting)))

    def stop(self) -> None:
        """End what is worked on, and forget what waits."""
        self._waiting.clear()
        self._stopped = True

    def close(self) -> None:
        """End for good: the page is gone."""
        self._closed = True
        self.stop()

    def stale(self) -> bool:
        """Return whether what is worked on should end; called from its thread."""
        if self._closed or self._stopped:
            return True
        return bool(self._waiting) and time.monotonic() - self._began > _PATIENCE


# ---- The connection of one page ----

_LOG = logging.getLogger(__name__)

# A page hears that code is compiled, or that others are served first, after this time [s]; a person
# notices a pause from about 0.4 s on.
_NOTICED = 0.4
# Shortest time between two reports of progress [s]: ten a second are smooth.
_REPORTS = 0.1
# Processes for large setups at once.
_APART = 2


class Workers:
    """The threads of all pages: one for runs, one for long tasks, some that wait for processes."""

    def __init__(self) -> None:
        self.runs = ThreadPoolExecutor(1, thread_name_prefix="quell-studio-run")
        self.long = ThreadPoolExecutor(1, thread_name_prefix="quell-studio-long")
        self.apart = ThreadPoolExecutor(_APART, thread_name_prefix="quell-studio-apart")

    def close(self) -> None:
        """Let the threads end; what waits is dropped."""
        for pool in (self.runs, self.long, self.apart):
            pool.shutdown(wait=False, cancel_futures=True)


class Page:
    """A page, from its connection until it leaves.

    Parameters
    ----------
    websocket
        an accepted connection of Starlette.
    workers
        the threads.
    granted
        the files that it may name.
    """

    def __init__(self, websocket: Any, workers: Workers, granted: messages.Granted) -> None:
        self._websocket, self._workers = websocket, workers
        self._lanes = {"short": Lane(), "long": Lane()}
        self._granted, self._record = granted, PageRecord()
        self._makers = {name: Maker(trust=granted.trust) for name in self._lanes}
        self._sending = asyncio.Lock()

    async def serve(self) -> None:
        """Answer messages until the page leaves."""
        working = [asyncio.create_task(self._work(name)) for name in self._lanes]
        try:
            while True:
                received = await self._websocket.receive()
                if received["type"] != "websocket.receive":
                    return
                await self._take(received.get("text") or received.get("bytes") or "")
        finally:
            for lane in self._lanes.values():
                lane.close()
            for task in working:
                task.cancel()
            await asyncio.gather(*working, return_exceptions=True)

    async def _take(self, text: str | bytes) -> None:
        """Put a message where a thread takes it; answer a malformed one with its error."""
        try:
            message = messages.parsed(text)
            if message["do"] == "part":
                self._record.take_part(message)
                return
            if message["do"] == "record":
                message["content"] = self._record.content(message.get("size"))
        except ValueError as error:
            await self._send(_problem(error, messages.identity(text)))
            return
        if message["do"] == "cancel":
            self._lanes["long"].stop()
            return
        self._lanes["long" if message["do"] in LONG else "short"].put(message)

    async def _work(self, name: str) -> None:
        """Answer the messages of a lane, one after the other."""
        lane = self._lanes[name]
        while True:
            message = await lane.next()
            report = self._reporter(message["id"])
            make = self._makers[name]
            about = self._granted, self._record, lane.stale, report
            try:
                if is_large(message):
                    found, pool = frames_apart(message, *about), self._workers.apart
                else:
                    found = frames_for(message, make, *about)
                    pool = self._workers.long if name == "long" else self._workers.runs
                await self._send_all(found, pool, name, message["id"])
            except StoppedError:
                await self._send(frame({"kind": "stopped", "id": message["id"]}))
            except (ValueError, ArithmeticError, ImportError, OSError, MemoryError) as error:
                await self._send(_problem(error, message["id"]))
            except Exception as error:
                # A message must not end the page, whatever it makes a library do.
                _LOG.exception("studio: a message failed")
                await self._send(_problem(error, message["id"]))

    async def _send_all(
        self, frames: Iterator[bytes], pool: ThreadPoolExecutor, name: str, number: int
    ) -> None:
        """Send frames as a thread makes them."""
        loop = asyncio.get_running_loop()
        while True:
            making = loop.run_in_executor(pool, partial(next, frames, None))
            done, _ = await asyncio.wait([making], timeout=_NOTICED)
            if not done and name == "short":
                await self._send(frame({"kind": "wait", "id": number, "compiles": _compiles()}))
            made = await making
            if made is None:
                return
            await self._send(made)

    async def _send(self, data: bytes) -> None:
        async with self._sending:
            with suppress(RuntimeError):  # the page has left
                await self._websocket.send_bytes(data)

    def _reporter(self, number: int) -> Any:
        """Return a function that sends progress from a thread."""
        loop, last = asyncio.get_running_loop(), [0.0]

        def report(part: str, share: float) -> None:
            if time.monotonic() - last[0] >= _REPORTS:
                last[0] = time.monotonic()
                header = {"kind": "progress", "id": number, "part": part, "share": share}
                asyncio.run_coroutine_threadsafe(self._send(frame(header)), loop)

        return report


def _compiles() -> bool:
    """Return whether a thread compiles now."""
    return compile_time.running > 0


def _problem(error: BaseException, number: int | None) -> bytes:
    """Return a frame with the message of an error."""
    text = str(error) or type(error).__name__
    if not isinstance(error, ValueError):
        text = f"{type(error).__name__}: {text}"
    lines = [" ".join(line.split())[:1000] for line in text.splitlines() if line.strip()]
    return frame({"kind": "error", "id": number, "text": lines[:20]})


# ---- Connections of the studio's server ----

FIRST_REQUEST = 3.0
"""Time until the first request of a connection is complete [s], as at the live port."""
MOST_CONNECTIONS = 200
"""Most connections that are no pages; chosen by hand: a browser opens six."""
BACKLOG = 64
"""Connections that are accepted in one go: fewer than may wait, so that the newest are read."""
# Shortest time between two lines in the log [s].
_QUIET = 60.0


class Door:
    """The connections that are no pages, and what the log says of those that were closed."""

    def __init__(self) -> None:
        self.waiting: dict[Any, None] = {}  # in the order in which they came
        self._closed, self._said = 0, -_QUIET

    def protocol(self) -> type[asyncio.Protocol]:
        """Return the protocol of HTTP for uvicorn, with these limits."""
        base: Any = import_extra("uvicorn.protocols.http.auto", "studio", "the studio")
        door = self

        class Limited(base.AutoHTTPProtocol):
            """HTTP of uvicorn with a time limit for the first request."""

            def connection_made(self, transport: Any) -> None:
                super().connection_made(transport)
                door.enter(self)
                loop = asyncio.get_running_loop()
                self.too_late = loop.call_later(FIRST_REQUEST, self.end_if_silent)

            def connection_lost(self, exc: Exception | None) -> None:
                self.too_late.cancel()
                door.waiting.pop(self, None)
                super().connection_lost(exc)

            def end_if_silent(self) -> None:
                """Close the connection if no request is complete, and it has not become a page."""
                if self.transport.get_protocol() is not self:
                    door.waiting.pop(self, None)
                elif self.cycle is None:
                    door.close(self)

        return Limited

    def enter(self, connection: Any) -> None:
        """Take a new connection; close the oldest one that waits if there are too many."""
        self.waiting[connection] = None
        if len(self.waiting) <= MOST_CONNECTIONS:
            return
        for each in list(self.waiting):
            if each.transport.get_protocol() is not each:  # it is a page now
                del self.waiting[each]
            elif each.cycle is None or each.cycle.response_complete:
                self.close(each)
            if len(self.waiting) <= MOST_CONNECTIONS:
                return
        self.close(connection)

    def close(self, connection: Any) -> None:
        """Close a connection; the log has one line in a minute at most."""
        self.waiting.pop(connection, None)
        connection.transport.abort()
        self.note()

    def note(self) -> None:
        """Count a connection that was closed or not accepted, and say so now and then."""
        self._closed += 1
        if time.monotonic() - self._said >= _QUIET:
            self._said = time.monotonic()
            _LOG.warning(
                "studio: connections were closed (%d until now): they sent no request within %g s, "
                "or there were more than %d; pages go on",
                *(self._closed, FIRST_REQUEST, MOST_CONNECTIONS),
            )

    def exceptions(self, loop: Any, context: dict[str, Any]) -> None:
        """Take errors of the event loop: those of connections that it can't accept are counted."""
        if isinstance(context.get("exception"), OSError):
            self.note()
        else:
            loop.default_exception_handler(context)


# ---- The server of the studio ----

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
