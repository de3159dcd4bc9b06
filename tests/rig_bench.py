"""A rig that ticks only when a test says so, with devices at the other end of its wire."""

from __future__ import annotations

import fcntl
import math
import struct
import termios
import threading
import zlib
from collections.abc import Callable
from contextlib import ExitStack
from contextvars import copy_context
from typing import Any

import numpy as np
import pytest

import quell as ql
from quell.kernels.dispatch import as_python
from quell.realtime.devices import ask
from quell.realtime.registry import listen
from quell.realtime.rig import APPLIED, Rig
from quell.realtime.transports import SerialDevice, UdpDevice
from quell.realtime.wire import LENGTH, RECEIVED, SENT, wait_for_frame

DT = 0.01
PLANT = ql.plants.two_mass_spring()
DEVICES = {"udp": UdpDevice, "serial": SerialDevice}
WIRES = tuple(DEVICES)
TIME = 123_456_789
"""In every frame that ``packed`` makes [ns]."""


def url_of(wire: str) -> str:
    """Return a URL at which a rig can listen."""
    return {"udp": "udp://127.0.0.1:0", "serial": "serial://pty"}[wire]


def connect(url: str, dt: float = DT, timeout: float = 30.0, signals: Any = None) -> Any:
    """Return the device at a URL."""
    return DEVICES[url.partition(":")[0]](url, dt, timeout, signals)


def law(y: float) -> float:
    """Return some u."""
    return 1.0 - 0.7 * y


def packed(
    kind: int,
    number: int,
    answers: int,
    value: float,
    *,
    session: int = 0x5EED0001,
    version: int = 1,
    state: int = 0,
) -> bytes:
    """Return a frame, made without the package."""
    numbers = number % 2**32, answers % 2**32
    head = struct.pack("<2sBBIIIqdI", b"QL", version, kind, session, *numbers, TIME, value, state)
    return head + struct.pack("<I", zlib.crc32(head))


class PlainRig(Rig):
    """A rig that ticks as plain Python, whether or not its devices are compiled."""

    def prepare(self) -> None:
        """Compile nothing."""

    def tick(self, count: int = 1) -> None:
        """Perform ticks."""
        with as_python():
            super().tick(count)


class Bench:
    """A rig, and the devices that are opened on it."""

    def __init__(
        self,
        stack: ExitStack,
        wire: str = "udp",
        url: str = "",
        kind: type[Rig] = Rig,
        plant: Any = PLANT,
        **settings: Any,
    ) -> None:
        if wire == "serial":
            pytest.importorskip("serial")
        self._stack = stack
        self.rig = stack.enter_context(kind(plant, DT, listen(url or url_of(wire)), **settings))
        self.rig.prepare()
        self.url = self.rig.listener.url

    @property
    def applied(self) -> float:
        """The u that acts on the plant."""
        return float(self.rig.model.signals[APPLIED, 0])

    def open(
        self,
        url: str = "",
        dt: float = DT,
        timeout: float = 30.0,
        meanwhile: Callable[[], Any] = lambda: None,
        signals: Any = None,
    ) -> Any:
        """Return a device; the rig ticks until it is open, or raise what it raised."""
        made: list[Any] = []

        def work() -> None:
            try:
                made.append(connect(url or self.url, dt, timeout, signals))
            except Exception as error:
                made.append(error)

        self.tick_during(work, meanwhile)
        if isinstance(made[0], Exception):
            raise made[0]
        self._stack.callback(made[0].close)
        self.catch_up(made[0])
        ask(made[0].handle)  # the rig may have sent already what the hello was worth
        self.await_frame()
        return made[0]

    def catch_up(self, device: Any) -> float:
        """Read until the rig's newest measurement has come, and return it."""
        y, sent = math.nan, self.rig.model.endpoint.numbers
        while device.handle.endpoint.numbers[RECEIVED] < sent[SENT]:
            y = device.read()
            if np.any(np.isnan(y)):
                self.rig.tick()
        return y

    def tick_during(
        self, work: Callable[[], Any], meanwhile: Callable[[], Any] = lambda: None
    ) -> None:
        """Tick while ``work`` runs on a thread."""
        # Threads begin with an empty context: ``as_python`` holds in this one, too.
        thread = threading.Thread(target=copy_context().run, args=(work,))
        thread.start()
        while thread.is_alive():
            self.rig.tick()
            meanwhile()
            thread.join(0.002)

    def await_frame(self) -> None:
        """Wait until a frame has arrived: a pseudoterminal takes its time."""
        if not self.url.startswith("serial"):
            return
        waiting, port = np.zeros(1, dtype=np.int32), self.rig.model.transport.port.fd
        while waiting[0] < LENGTH + 2:
            wait_for_frame(self.rig.model.transport, 100_000_000)
            fcntl.ioctl(port, termios.FIONREAD, waiting)

    def cycle(self, device: Any, law: Callable[[float], float], count: int = 1) -> list[float]:
        """Let ``count`` ticks pass, each answered; return what was measured."""
        measured = []
        for _ in range(count):
            self.rig.tick()
            measured.append(device.read())
            device.write(law(measured[-1]))
            self.await_frame()
        return measured
