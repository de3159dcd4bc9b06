"""A relay between a loop and its rig that loses, duplicates, delays and corrupts frames by a plan.

To test a loop of your own, start the rig at one port, the relay in front of it, and connect the
loop to the relay::

    from frame_faults import Fault, Relay

    plan = [Fault("drop", towards="rig", first=500, count=10)]
    with Relay("udp://127.0.0.1:0", "udp://127.0.0.1:5005", plan) as relay:
        ...  # the loop's device is relay.url
        print(relay.done)

Measurements to the loop and commands to the rig are counted separately, so a plan does the same in
each run. Hello, welcome and goodbye pass unchanged.
"""

from __future__ import annotations

import random
import selectors
import socket
import struct
import threading
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Self

from quell import checks
from quell.realtime.transports import UdpListener, resolved
from quell.realtime.wire import COMMAND, LENGTH, MEASUREMENT

DIRECTIONS = ("loop", "rig")


@dataclass(frozen=True)
class Fault:
    """A fault of consecutive frames.

    Parameters
    ----------
    kind
        ``drop``; ``burst``: the frames are held and sent together with the next one; ``duplicate``;
        ``delay``: each is sent ``late`` frames later, after newer ones; ``nan``: the value is NaN
        or infinite, with a correct CRC; ``flip``: a bit is wrong; ``short``, ``long``: bytes are
        missing or added; ``foreign``: another session; ``version``: of the protocol.
    towards
        ``loop`` for measurements, ``rig`` for commands.
    first, count
        number of the first frame, from 0, and number of frames.
    late
        frames, for ``delay``.
    """

    kind: str
    towards: str = "loop"
    first: int = 0
    count: int = 1
    late: int = 3

    def __post_init__(self) -> None:
        checks.one_of("kind", self.kind, KINDS)
        checks.one_of("towards", self.towards, DIRECTIONS)
        checks.whole("first", self.first, 0)
        checks.whole("count", self.count, 1)
        checks.whole("late", self.late, 1)


def random_faults(number: int, frames: int, seed: int = 0, longest: int = 50) -> list[Fault]:
    """Return random faults, 1 to ``longest`` of the first ``frames`` long, in both directions."""
    checks.whole("number", number, 1)
    last = checks.whole("frames", frames, 1) - 1
    most = checks.whole("longest", longest, 1)
    draw = random.Random(checks.whole("seed", seed, 0))
    return [
        Fault(
            draw.choice(KINDS),
            draw.choice(DIRECTIONS),
            draw.randint(0, last),
            round(most ** draw.random()),  # log-uniform: short faults are as frequent as long ones
            draw.randint(1, 10),  # a delay in frames; chosen by hand
        )
        for _ in range(number)
    ]


class FaultInjector:
    """The faults of one direction: ``frames(data)`` returns what is sent in place of ``data``."""

    def __init__(self, faults: Sequence[Fault], towards: str, seed: int = 0) -> None:
        self._faults = [fault for fault in faults if fault.towards == towards]
        self._kind = MEASUREMENT if towards == "loop" else COMMAND
        self._random = random.Random(f"{seed} {towards}")
        self.number = 0
        """Frames so far."""
        self.done: Counter[str] = Counter()
        """Number of frames by kind of fault."""
        self._burst: list[bytes] = []
        self._delayed: list[tuple[int, bytes]] = []

    def frames(self, data: bytes) -> list[bytes]:
        """Return what is sent in place of ``data``, in this order."""
        if len(data) < LENGTH or data[3] != self._kind:
            return [data]
        number, out = self.number, [data]
        self.number += 1
        burst = False
        for fault in self._faults:
            if not fault.first <= number < fault.first + fault.count:
                continue
            self.done[fault.kind] += 1
            if fault.kind == "drop":
                out = []
            elif fault.kind == "duplicate":
                out = out + out
            elif fault.kind == "delay":
                self._delayed += [(number + fault.late, one) for one in out]
                out = []
            elif fault.kind == "burst":
                burst = True
            else:
                out = [_CORRUPTIONS[fault.kind](one, self._random) for one in out]
        out += [one for due, one in self._delayed if due <= number]
        self._delayed = [(due, one) for due, one in self._delayed if due > number]
        if burst:
            self._burst += out
            return []
        out, self._burst = self._burst + out, []
        return out


class Relay:
    """A relay between a loop and a rig, on its own thread.

    Parameters
    ----------
    url
        where the loop connects, for example ``udp://127.0.0.1:0`` for any free port; the attribute
        ``url`` contains the port taken.
    rig
        URL of the rig.
    faults
        the plan.
    seed
        seed of what is random in it, such as which bit is wrong.
    """

    def __init__(self, url: str, rig: str, faults: Sequence[Fault] = (), seed: int = 0) -> None:
        family, address = resolved(rig)
        self._injectors = {towards: FaultInjector(faults, towards, seed) for towards in DIRECTIONS}
        self._front = UdpListener(url)
        self.url = self._front.url
        self._back = socket.socket(family, socket.SOCK_DGRAM)
        self._back.setblocking(False)
        self._back.connect(address)
        self._loop: Any = None
        self._stop_reader, self._stop_writer = socket.socketpair()
        self._thread = threading.Thread(target=self._work, name="quell-relay", daemon=True)
        self._thread.start()

    @property
    def passed(self) -> dict[str, int]:
        """Number of measurements to the loop and of commands to the rig, by direction."""
        return {towards: injector.number for towards, injector in self._injectors.items()}

    @property
    def done(self) -> dict[str, dict[str, int]]:
        """Number of frames by kind of fault, for each direction."""
        return {towards: dict(injector.done) for towards, injector in self._injectors.items()}

    def close(self) -> None:
        """End the thread and release the ports."""
        if self._thread.is_alive():
            self._stop_writer.send(b"x")
            self._thread.join()
        for one in (self._front, self._back, self._stop_reader, self._stop_writer):
            one.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _work(self) -> None:
        front = self._front.socket
        with selectors.DefaultSelector() as selector:
            for one in (front, self._back, self._stop_reader):
                selector.register(one, selectors.EVENT_READ)
            while True:
                ready = [key.fileobj for key, _ in selector.select()]
                if self._stop_reader in ready:
                    return
                if front in ready:
                    self._to_rig(front)
                if self._back in ready:
                    self._to_loop(front)

    def _to_rig(self, front: socket.socket) -> None:
        with suppress(OSError):  # without a rig the frames are lost
            data, self._loop = front.recvfrom(4 * LENGTH)
            for frame in self._injectors["rig"].frames(data):
                self._back.send(frame)

    def _to_loop(self, front: socket.socket) -> None:
        with suppress(OSError):
            data = self._back.recv(4 * LENGTH)
            for frame in self._injectors["loop"].frames(data):
                if self._loop is not None:
                    front.sendto(frame, self._loop)


def _signed(frame: bytes) -> bytes:
    """Return the frame with a correct CRC."""
    return frame[:-4] + struct.pack("<I", zlib.crc32(frame[:-4]))


def _nan(frame: bytes, draw: random.Random) -> bytes:
    value = draw.choice((float("nan"), float("inf"), float("-inf")))
    return _signed(frame[:24] + struct.pack("<d", value) + frame[32:])


def _flip(frame: bytes, draw: random.Random) -> bytes:
    bit = draw.randrange(8 * len(frame))
    return bytes(byte ^ (1 << bit % 8 if i == bit // 8 else 0) for i, byte in enumerate(frame))


def _foreign(frame: bytes, draw: random.Random) -> bytes:
    (session,) = struct.unpack_from("<I", frame, 4)
    return _signed(frame[:4] + struct.pack("<I", session ^ draw.randrange(1, 1 << 32)) + frame[8:])


_CORRUPTIONS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "nan": _nan,
    "flip": _flip,
    "short": lambda frame, draw: frame[: draw.randrange(LENGTH)],
    "long": lambda frame, draw: frame + draw.randbytes(draw.randrange(1, LENGTH)),
    "foreign": _foreign,
    "version": lambda frame, draw: _signed(frame[:2] + bytes([draw.randrange(2, 256)]) + frame[3:]),
}
KINDS = ("drop", "burst", "duplicate", "delay", *_CORRUPTIONS)
