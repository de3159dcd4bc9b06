"""Server for viewers of a running loop, as a process of its own, in the Foxglove protocol.

``LiveSink`` starts this file as a script, with a socket on standard input and a listening socket
whose descriptor is the argument. Nothing that viewers do, or fail to do, reaches the process of the
loop: its descriptors, memory, threads and output are its own. The first frame on the socket has the
settings as JSON, each further frame a row; the server ends when the socket is closed.

The protocol is that of foxglove-sdk (``foxglove.sdk.v1``, before that ``foxglove.websocket.v1``)
with one channel: the server sends *serverInfo* and *advertise* as JSON, the viewer *subscribe* and
*unsubscribe*; a row is 1 (one byte), the subscription (4 bytes), the log time (8 bytes) and the
message, little endian. A web page of another computer is refused by its Origin header (RFC 6455,
section 10.2), because a browser would let any page connect.

The script imports the standard library and websockets only, so that it starts at once.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import socket
import struct
import sys
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

PROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
LENGTH = struct.Struct("<I")  # in front of each frame: its number of bytes
TIME = struct.Struct("<Q")  # in front of a row: its log time [ns since 1970]
_MESSAGE = struct.Struct("<BI")  # in front of a message: its kind, the subscription
_ROW = 1  # kind of a message with a row

# Most viewers at once; further ones are refused. Chosen by hand: a person opens a few.
_MOST_VIEWERS = 32
# A client that has not finished its request by then is disconnected [s]; chosen by hand: a browser
# on this computer needs milliseconds.
_HANDSHAKE = 3.0
# Rows that wait for a slow viewer, after which it loses the oldest; chosen by hand: some seconds at
# the default rate.
_BACKLOG = 256
# Largest message from a viewer [bytes]; chosen by hand: a subscription takes a hundred.
_LARGEST = 16_384
# A viewer that does not answer a ping for so long is disconnected [s]: the library's default.
_PING = 20.0
# Time at the end in which viewers get their last rows, and then for their goodbyes [s]. Chosen by
# hand, so that both fit into the second for which ``LiveSink.close`` waits.
_LAST_ROWS, _GOODBYE = 0.25, 0.25


def settings(name: str, session: str, channel: Mapping[str, Any], origins: Sequence[str]) -> bytes:
    """Return the first frame: name of the server and the run, its channel, further origins."""
    info = {"op": "serverInfo", "name": name, "capabilities": [], "sessionId": session}
    return json.dumps({"info": info, "channel": channel, "origins": list(origins)}).encode()


def is_local(origin: str | None) -> bool:
    """Return whether an Origin header is that of a program or a page of this computer.

    Programs send none, or ``file://``. The origin ``null`` is refused, because any web page can get
    it with a sandboxed frame.
    """
    if origin is None or origin == "file://":
        return True
    try:
        parts = urlsplit(origin)
        host = parts.hostname
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and host in ("localhost", "127.0.0.1", "::1")


class Viewers:
    """The viewers of one channel."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._info, self._channel = json.dumps(settings["info"]), settings["channel"]
        self._origins = frozenset[str](settings["origins"])
        self._all: set[Viewer] = set()

    def refuse(self, connection: Any, request: Any) -> Any:
        """Return the answer to a request that is refused, None for the others."""
        origins = request.headers.get_all("Origin")
        if len(origins) > 1 or not all(each in self._origins or is_local(each) for each in origins):
            reason = f"The origin {', '.join(origins)} may not watch.\n"
            return connection.respond(HTTPStatus.FORBIDDEN, reason)
        if len(self._all) >= _MOST_VIEWERS:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "Too many viewers.\n")
        return None

    async def serve(self, connection: Any) -> None:
        """Serve a viewer until it leaves."""
        from websockets.exceptions import ConnectionClosed

        viewer = Viewer(connection)
        self._all.add(viewer)
        sending = None
        try:
            await connection.send(self._info)
            await connection.send(json.dumps({"op": "advertise", "channels": [self._channel]}))
            sending = asyncio.create_task(viewer.send_rows())
            async for message in connection:
                viewer.answer(message, self._channel["id"])
        except ConnectionClosed:
            pass
        finally:
            self._all.discard(viewer)
            if sending is not None:
                sending.cancel()

    def offer(self, row: bytes) -> None:
        """Pass a row with its log time to all who subscribed."""
        for viewer in self._all:
            viewer.offer(row)

    async def last_rows(self) -> None:
        """Wait until all viewers have got their rows."""
        while any(viewer.waiting for viewer in self._all):
            await asyncio.sleep(0.01)


class Viewer:
    """A connection, its subscription, and the rows that wait for it."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._subscription: int | None = None
        self._rows = deque[bytes](maxlen=_BACKLOG)
        self._some = asyncio.Event()

    @property
    def waiting(self) -> bool:
        """Whether rows wait."""
        return bool(self._rows)

    def answer(self, message: str | bytes, channel: int) -> None:
        """Take a message; whatever is not a subscription is ignored."""
        with suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError):
            asked = json.loads(message)
            if asked["op"] == "subscribe":
                for each in asked["subscriptions"]:
                    if each["channelId"] == channel and 0 <= each["id"] < 2**32:
                        self._subscription = int(each["id"])
            elif asked["op"] == "unsubscribe" and self._subscription in asked["subscriptionIds"]:
                self._subscription = None

    def offer(self, row: bytes) -> None:
        """Let a row wait; the oldest is lost if there are too many."""
        if self._subscription is not None:
            self._rows.append(_MESSAGE.pack(_ROW, self._subscription) + row)
            self._some.set()

    async def send_rows(self) -> None:
        """Send rows as the viewer takes them."""
        from websockets.exceptions import ConnectionClosed

        with suppress(ConnectionClosed):
            while await self._some.wait():
                self._some.clear()
                while self._rows:
                    await self._connection.send(self._rows.popleft())


async def run(rows: socket.socket, listening: Iterable[socket.socket]) -> None:
    """Serve viewers until ``rows`` is closed."""
    from websockets.asyncio.server import serve

    reader, writer = await asyncio.open_connection(sock=rows)
    viewers = Viewers(json.loads(await _frame(reader)))
    options: dict[str, Any] = {
        "process_request": viewers.refuse,
        "subprotocols": PROTOCOLS,
        "compression": None,
        "open_timeout": _HANDSHAKE,
        "ping_interval": _PING,
        "ping_timeout": _PING,
        "close_timeout": _GOODBYE,
        "max_size": _LARGEST,
        "server_header": None,
    }
    servers = [await serve(viewers.serve, sock=each, **options) for each in listening]
    with suppress(OSError):
        os.nice(5)  # the loop's process comes first
    with suppress(asyncio.IncompleteReadError, ConnectionError):
        while True:
            viewers.offer(await _frame(reader))
    with suppress(TimeoutError):
        await asyncio.wait_for(viewers.last_rows(), _LAST_ROWS)
    for server in servers:
        server.close()
    with suppress(TimeoutError):
        await asyncio.wait_for(asyncio.gather(*(s.wait_closed() for s in servers)), _GOODBYE)
    writer.close()


async def _frame(reader: asyncio.StreamReader) -> bytes:
    """Return the next frame."""
    (length,) = LENGTH.unpack(await reader.readexactly(LENGTH.size))
    return await reader.readexactly(length)


def main() -> None:
    """Serve until the loop's process closes the socket; write nothing to its terminal."""
    logging.disable()
    rows = socket.socket(fileno=os.dup(0))
    asyncio.run(run(rows, [socket.socket(fileno=int(number)) for number in sys.argv[1:]]))
    os._exit(0)  # a connection that does not end must not keep the process


if __name__ == "__main__":
    main()
