"""Connections of the studio's server: few at once, and none that never asks for anything.

A program of the same computer can open connections without the token. Each takes a file
descriptor, and a server without free ones accepts no page. So a connection has a few seconds until
its first request is complete; and when there are many, the oldest one that waits is closed for a
new one: a browser sends its request at once, and so it is served. A connection of a page is a
WebSocket, which ``server.py`` counts and limits itself.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import Any

from quell.optional import import_extra

_LOG = logging.getLogger(__name__)

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
