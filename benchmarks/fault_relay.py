"""A relay that injects faults between a loop and a rig, over any wire; for ``faults.py``.

Over UDP it is ``Relay`` of ``frame_faults.py``. Over a serial line (two
pseudoterminals) and shared memory it takes the frames from one wire, changes them by the same plan,
and puts them on the other. Shared memory carries frames of 40 bytes only: shorter ones are filled
with zeros, longer ones cut. On the serial line the changed frame is framed again, so that its
length changes. The threads of a relay have real-time priority if the system permits.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Self

import numpy as np
from frame_faults import Fault, FaultInjector, Relay

from quell.kernels.dispatch import compiled, specialised
from quell.realtime import transports
from quell.realtime import wire as frames
from quell.realtime.registry import listen
from quell.realtime.transports import SerialDevice
from quell.realtime.wire import receive, wait_for_frame

PRIORITY = 40  # below that of the loop and the rig
WIRES = ("udp", "serial")


def rig_url(wire: str) -> str:
    """Return a URL at which a rig can listen."""
    return {"udp": "udp://127.0.0.1:0", "serial": "serial://pty"}[wire]


def relay(url: str, faults: Sequence[Fault], seed: int) -> Any:
    """Return a relay to the rig at ``url``, open."""
    wire = url.partition(":")[0]
    with real_time():
        if wire == "udp":
            return Relay(rig_url(wire), url, faults, seed)
        return SerialRelay(url, faults, seed)


@contextlib.contextmanager
def real_time() -> Iterator[None]:
    """Give threads that start meanwhile a real-time priority."""
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@compiled
def _take(transport: Any, frame: frames.Buffer, nanoseconds: int) -> int:
    """Return the length of the next packet, -1 if none has come in this time."""
    size = receive(transport, frame)
    if size < 0:
        wait_for_frame(transport, nanoseconds)
        size = receive(transport, frame)
    return size


@compiled
def _encode(coded: Any, values: Any) -> int:
    return transports.encode(values, values.size, coded)


class _SerialEnd(SerialDevice):
    """The loop's end of a serial line, without a session."""

    def _begin_session(self, former: int = 0) -> None:
        """Do nothing: the loop's own hello goes through."""


class SerialRelay:
    """A relay over a serial line, with a thread for each direction."""

    def __init__(self, rig: str, faults: Sequence[Fault], seed: int) -> None:
        self._back: Any = _SerialEnd(rig, 1e-3)
        self._front: Any = listen(rig_url(rig.partition(":")[0]))
        self.url = self._front.url
        self._injectors = {
            towards: FaultInjector(faults, towards, seed) for towards in ("loop", "rig")
        }
        self._stop = False
        front, back = self._front.transport, self._back.handle.transport
        ends = {"rig": (front, back), "loop": (back, front)}
        # Compiled here: the trial forks, and a lock that a compiling thread holds stays closed.
        self._threads = [
            threading.Thread(target=self._carrier(towards, *ends[towards]), daemon=True)
            for towards in ends
        ]
        for thread in self._threads:
            thread.start()

    @property
    def passed(self) -> dict[str, int]:
        """Number of measurements to the loop and of commands to the rig, by direction."""
        return {towards: injector.number for towards, injector in self._injectors.items()}

    def _carrier(self, towards: str, source: Any, target: Any) -> Callable[[], None]:
        """Return a function that carries frames in one direction, until the relay is closed."""
        inbox = frames.buffer()
        coded = np.zeros(256, dtype=np.uint8)
        take, encode = specialised(_take, source, inbox, 0), specialised(_encode, coded, coded)

        def carry() -> None:
            while not self._stop:
                while (size := take(source, inbox, 20_000_000)) >= 0:
                    data = bytes(inbox.bytes[: max(size, 0)])
                    for frame in self._injectors[towards].frames(data):
                        values = np.frombuffer(frame, dtype=np.uint8)
                        length = encode(coded, values.copy())
                        with contextlib.suppress(OSError):  # the other end is gone
                            os.write(target.port.fd, coded[:length].tobytes())

        return carry

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop = True
        for thread in self._threads:
            thread.join()
        self._front.close()
        self._back._open = False  # no goodbye of its own
        self._back._release()
