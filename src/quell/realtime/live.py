"""Rows over a Foxglove WebSocket, for Foxglove and for PlotJuggler's Foxglove bridge.

Only a limited number of rows per second is sent, and a slow viewer loses the oldest. A row that is
sent has the events of all rows since the one before, so that none is lost. Viewers connect to a
process of its own (``viewers``), which the loop's process never waits for.
"""

from __future__ import annotations

import math
import socket
import subprocess
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from quell import checks
from quell.checks import import_extra
from quell.realtime import viewers
from quell.realtime.recordings import EVENTS, Header, K, advertised, message, row_time
from quell.types import Matrix

PORT = 8765  # default port of Foxglove's viewers

# Bytes that may wait for the server, after which rows are left out; chosen by hand: a second of
# wide rows.
_MOST_WAITING = 1 << 20
# Time for the server to end, after which it is killed [s]; it needs half of it for viewers that do
# not answer.
_END = 1.0


class LiveSink:
    """Send rows to connected viewers.

    Parameters
    ----------
    port
        TCP port; 0 takes any free one.
    host
        address to listen at; only this machine can connect by default. There is no password:
        whoever can connect can watch, but not act.
    rate
        largest number of rows per second [1/s]; a browser displays a hundred without delay.
    origins
        web pages that may watch, such as ``https://app.foxglove.dev``, besides programs and pages
        of this computer. Browsers let any page connect and name it in the request; others are
        refused.

    Attributes
    ----------
    url : str
        address for viewers, once the sink is open.

    Raises
    ------
    ValueError
        for a port out of range, a rate that is not positive, an origin that is not one.
    """

    def __init__(
        self,
        port: int = PORT,
        host: str = "127.0.0.1",
        rate: float = 100.0,
        origins: Sequence[str] = (),
    ) -> None:
        self.port, self.host = checks.whole("port", port, 0, 65535), host
        self.rate = checks.positive("rate", rate, "1/s")
        self.origins = _checked_origins(origins)
        self.name = self.url = _url(host, port)
        self._process: subprocess.Popen[bytes] | None = None

    def open(self, header: Header) -> None:
        """Start to listen."""
        import_extra("websockets", "telemetry", "watching live")
        self._header = header
        self._every = max(math.ceil(1.0 / (self.rate * header.dt) - 1e-9), 1)
        self._next, self._events = -math.inf, 0
        listener = self._listener()
        self._rows, theirs = socket.socketpair()
        with listener, theirs:
            self._process = subprocess.Popen(
                # -P: modules are not looked up in the folder of the script
                [sys.executable, "-P", viewers.__file__, str(listener.fileno())],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[listener.fileno()],
                start_new_session=True,  # Ctrl-C is for the loop, which still has rows to show
            )
            self.name = self.url = _url(self.host, listener.getsockname()[1])
        self._rows.setblocking(False)
        self._waiting = bytearray()
        name, session = header.device or "quell", str(header.started)
        self._send(viewers.settings(name, session, advertised(header), self.origins))

    def write(self, rows: Matrix) -> None:
        """Send those of the rows that are due."""
        events = np.nan_to_num(rows[:, EVENTS]).astype(np.int64).tolist()
        for i, k in enumerate(rows[:, K].tolist()):
            self._events |= events[i]
            if k >= self._next and len(self._waiting) < _MOST_WAITING:
                row = rows[i].copy()
                row[EVENTS], self._events = self._events, 0
                time = row_time(self._header, k) % 2**64
                self._send(viewers.TIME.pack(time) + message(row))
                self._next = k + self._every

    def flush(self) -> None:
        """Send what the server had no room for."""
        with suppress(BlockingIOError):
            while self._waiting:
                del self._waiting[: self._rows.send(self._waiting)]

    def close(self) -> None:
        """Stop listening; the server has a second to say goodbye to its viewers."""
        if self._process is None:
            return
        process, self._process = self._process, None
        with suppress(OSError):
            self.flush()
        self._rows.close()
        try:
            process.wait(_END)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _send(self, frame: bytes) -> None:
        """Send a frame, or keep what the server has no room for."""
        self._waiting += viewers.LENGTH.pack(len(frame)) + frame
        self.flush()

    def _listener(self) -> socket.socket:
        """Return a socket that listens; a ``ValueError`` says why there is none."""
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        try:
            return socket.create_server((self.host, self.port), family=family, backlog=128)
        except OSError as error:
            raise ValueError(
                f"host = {self.host!r}, port = {self.port}: can't listen there "
                f"({error.strerror or error}); choose another port"
            ) from None


def _url(host: str, port: int) -> str:
    return f"ws://[{host}]:{port}" if ":" in host else f"ws://{host}:{port}"


def _checked_origins(origins: Any) -> tuple[str, ...]:
    """Return origins; each must be a scheme and a host, as browsers send them."""
    if isinstance(origins, str) or not isinstance(origins, Iterable):
        raise ValueError(f"origins = {origins!r}: must be a list of origins")
    for i, origin in enumerate(origins):
        scheme, mark, host = str(origin).partition("://")
        if not (scheme and mark and host) or set(host) & set("/*? "):
            raise ValueError(
                f"origins[{i}] = {origin!r}: must be the scheme and host of a web page, without a "
                "path, such as 'https://app.foxglove.dev'"
            )
    return tuple(origins)
