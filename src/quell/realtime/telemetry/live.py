"""Rows live over a Foxglove WebSocket, for Foxglove and for PlotJuggler's Foxglove bridge.

Who watches is not a recorder: of a quick loop only so many rows a second are sent, and a slow viewer loses the oldest. So that nothing
passes unseen between two rows that are sent, the later one has the events of all of them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quell import checks
from quell.optional import import_extra
from quell.realtime.telemetry.channels import EVENTS, K
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.ros_message import SCHEMA, TOPIC, definition, log_time, messages
from quell.types import Matrix

PORT = 8765
"""Where viewers look first."""


class LiveSink:
    """Send rows to whoever connects.

    Parameters
    ----------
    port
        TCP port; 0 takes any that is free.
    host
        address to listen at; only this machine can connect by default. There is no password: whoever can connect can watch, though not
        act.
    rate
        how many rows a second are sent at most [1/s]; a browser follows a hundred well.

    Attributes
    ----------
    url : str
        what to connect to, once it is open.

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
        """Begin to listen."""
        foxglove = import_extra("foxglove", "telemetry", "watching live")
        self._header = header
        self._context = context = foxglove.Context()  # a channel is closed with it
        self._apart, self._next, self._events = (
            max(math.ceil(1.0 / (self.rate * header.dt) - 1e-9), 1),
            -math.inf,
            0,
        )
        try:
            self._server = foxglove.start_server(
                name=header.device or "quell", host=self.host, port=self.port, context=context
            )
        except RuntimeError as error:
            reason = str(error).removeprefix("FoxgloveError: ")
            raise ValueError(
                f"host = {self.host!r}, port = {self.port}: can't listen there ({reason}); choose another port"
            ) from None
        self.name = self.url = f"ws://{self.host}:{self._server.port}"
        schema = foxglove.Schema(name=SCHEMA, encoding="ros2msg", data=definition(header).encode())
        self._channel = foxglove.Channel(
            TOPIC, schema=schema, message_encoding="cdr", context=context
        )

    def write(self, rows: Matrix) -> None:
        """Send those of the rows that are due."""
        events = np.nan_to_num(rows[:, EVENTS]).astype(np.int64).tolist()
        for i, k in enumerate(rows[:, K].tolist()):
            self._events |= events[i]
            if k >= self._next:
                row = rows[i : i + 1].copy()
                row[0, EVENTS], self._events = self._events, 0
                self._channel.log(messages(row)[0], log_time=log_time(self._header, k))
                self._next = k + self._apart

    def flush(self) -> None:
        """Do nothing: what is sent is sent."""

    def close(self) -> None:
        """Stop listening."""
        if self._server is not None:
            server, self._server = self._server, None
            self._channel.close()
            server.stop()
