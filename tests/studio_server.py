"""A studio on a free port in a thread of the tests, and a client of its WebSocket."""

from __future__ import annotations

import base64
import json
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import pytest

from quell.studio.messages import parsed_frame
from quell.types import Vector

TABLES = {
    "title": "A loop",
    "dt": 0.005,
    "plant": {"kind": "linear", "num": [50.0], "den": [1.0, 4.0, 0.0]},
    "observer": {"kind": "model-free", "order": 2, "b0": 50.0, "omega_o": 40.0},
    "controller": {"kind": "adrc", "omega_c": 8.0, "u_min": -10.0, "u_max": 10.0},
    "scenario": {
        "duration": 2.0,
        "reference": {"kind": "step", "height": 1.0, "at": 0.1},
        "disturbances": [{"kind": "step", "height": 0.5, "at": 1.0}],
    },
}
"""A setup whose loop compiles quickly."""

_AXIS = {
    "observer": {"kind": "model-free", "order": 1, "omega_o": 40.0},
    "controller": {"omega_c": 8.0},
}
AXES = {
    "title": "Two tanks",
    "dt": 0.005,
    "plant": {
        "kind": "multivariable-linear",
        "A": [[-1.0, 0.2], [0.1, -2.0]],
        "B": [[4.0, 1.0], [0.5, 3.0]],
        "C": [[1.0, 0.0], [0.0, 1.0]],
    },
    "axes": {"B0": "plant", "u_min": -5.0, "u_max": [5.0, 4.0]},
    "axis": [
        {"name": "left", "reference": {"kind": "step", "at": 0.1}, **_AXIS},
        {"name": "right", **_AXIS},
    ],
    "scenario": {"duration": 1.0},
}
"""A setup of two axes whose loop compiles quickly."""


@contextmanager
def running(tables: Any = None, port: int = 0, token: str | None = None) -> Iterator[str]:
    """Serve a studio in a thread, and yield its address."""
    uvicorn = pytest.importorskip("uvicorn")
    pytest.importorskip("starlette")
    from quell.studio.server import listen

    listener, studio, config = listen(tables, port, token)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    try:
        while not server.started and thread.is_alive():
            time.sleep(0.01)
        yield studio.url
    finally:
        server.should_exit = True
        thread.join(20.0)
        listener.close()
        studio.close()


def step_test(samples: int = 400, noise: float = 0.005) -> bytes:
    """Return a CSV file of a heater's step test: a lag of 2 s, a gain of 1.5, dt = 0.1 s."""
    random = np.random.default_rng(0)
    u = np.where(np.arange(samples) % 150 < 30, 0.0, 1.0)
    y = np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = np.exp(-0.05) * y[k] + 1.5 * (1.0 - np.exp(-0.05)) * u[k]
    y += noise * random.standard_normal(samples)
    rows = [f"{0.1 * k:.1f},{u[k]:g},{y[k]:.5f}" for k in range(samples)]
    return "\n".join(["t,u,y", *rows]).encode()


class Client:
    """A page without a browser."""

    def __init__(self, url: str, **headers: Any) -> None:
        from websockets.sync.client import connect

        host = "/".join(url.split("/")[:3])
        options = {"origin": host, "max_size": None, "compression": None} | headers
        self._stack = ExitStack()
        address = f"ws{url.removeprefix('http')}socket"
        self.socket = self._stack.enter_context(connect(address, **options))
        self.hello = self.next()[0]
        self.count = 0

    def next(self) -> tuple[dict[str, Any], dict[str, Vector], bytes]:
        """Return the next frame."""
        data = self.socket.recv(timeout=120.0)
        assert isinstance(data, bytes)
        return parsed_frame(data)

    def send(self, **message: Any) -> int:
        """Send a message with the next id, and return the id."""
        self.count += 1
        self.socket.send(json.dumps({"id": self.count, **message}))
        return self.count

    def ask(self, last: str, **message: Any) -> dict[str, Any]:
        """Send a message; return its frames by kind, up to the one of the kind ``last``."""
        return self.answer(last, self.send(**message))

    def answer(self, last: str, number: int) -> dict[str, Any]:
        """Return the frames that answer a message by kind, up to the one of the kind ``last``."""
        found: dict[str, Any] = {}
        while last not in found and "error" not in found:
            header, arrays, content = self.next()
            if header.get("id") == number:
                found[header["kind"]] = header, arrays, content
        return found

    def send_record(self, content: bytes, **message: Any) -> int:
        """Send the file of a record in two parts, and the message about it; return its id."""
        half = len(content) // 2
        for at, part in ((0, content[:half]), (half, content[half:])):
            self.send(do="part", at=at, data=base64.b64encode(part).decode())
        return self.send(do="record", **{"name": "step.csv", "size": len(content), **message})

    def close(self) -> None:
        """Leave."""
        self._stack.close()
