"""Rows over a Foxglove WebSocket, for Foxglove and for PlotJuggler's Foxglove bridge.

Only a limited number of rows per second is sent, and a slow viewer loses the oldest. A row that is
sent has the events of all rows since the one before, so that none is lost.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quell import checks
from quell.optional import import_extra
from quell.realtime.telemetry.channels import EVENTS, K
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.ros_message import log_rows, open_topic
from quell.types import Matrix

PORT = 8765  # default port of Foxglove's viewers


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

    Attributes
    ----------
    url : str
        address for viewers, once the sink is open.

    Raises
    ------
    ValueError
        for a port out of range or a rate that is not positive.
    """

    def __init__(self, port: int = PORT, host: str = "127.0.0.1", rate: float = 100.0) -> None:
        self.port, self.host = checks.whole("port", port, 0, 65535), host
        self.rate = checks.positive("rate", rate, "1/s")
        self.name = self.url = f"ws://{host}:{port}"
        self._server: Any = None

    def open(self, header: Header) -> None:
        """Start to listen."""
        foxglove = import_extra("foxglove", "telemetry", "watching live")
        self._header = header
        self._context = foxglove.Context()  # kept: a topic is closed with it
        self._every = max(math.ceil(1.0 / (self.rate * header.dt) - 1e-9), 1)
        self._next, self._events = -math.inf, 0
        try:
            self._server = foxglove.start_server(
                name=header.device or "quell", host=self.host, port=self.port, context=self._context
            )
        except RuntimeError as error:
            reason = str(error).removeprefix("FoxgloveError: ")
            raise ValueError(
                f"host = {self.host!r}, port = {self.port}: can't listen there ({reason}); choose "
                "another port"
            ) from None
        self.name = self.url = f"ws://{self.host}:{self._server.port}"
        self._topic = open_topic(foxglove, header, self._context)

    def write(self, rows: Matrix) -> None:
        """Send those of the rows that are due."""
        events = np.nan_to_num(rows[:, EVENTS]).astype(np.int64).tolist()
        for i, k in enumerate(rows[:, K].tolist()):
            self._events |= events[i]
            if k >= self._next:
                row = rows[i : i + 1].copy()
                row[0, EVENTS], self._events = self._events, 0
                log_rows(self._topic, self._header, row)
                self._next = k + self._every

    def flush(self) -> None:
        """Do nothing: rows are sent at once."""

    def close(self) -> None:
        """Stop listening."""
        if self._server is not None:
            server, self._server = self._server, None
            self._topic.close()
            server.stop()
