"""What goes wrong on a wire, on purpose: a relay between a loop and its rig that loses, doubles, delays and spoils frames by a plan.

For trials of a loop of one's own: start the rig at one port, the relay in front of it, and the loop at the relay::

    from quell.realtime.faults import Fault, Relay

    with Relay("udp://127.0.0.1:0", "udp://127.0.0.1:5005", [Fault("drop", towards="rig", first=500, count=10)]) as relay:
        ...  # the loop's device is relay.url
        print(relay.done)

Frames are counted in each direction, measurements towards the loop and commands towards the rig, so that a plan does the same in each run.
Hello, welcome and goodbye pass.
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
from dataclasses import dataclass
from typing import Any

from quell import checks
from quell.realtime.wire.frames import COMMAND, LENGTH, MEASUREMENT
from quell.realtime.wire.udp import UdpListener, resolved

DIRECTIONS = ("loop", "rig")


@dataclass(frozen=True)
class Fault:
    """What befalls some frames in a row.

    Parameters
    ----------
    kind
        ``drop``; ``burst``: they are kept back, and come all at once with the next; ``duplicate``: each comes twice; ``delay``: each comes
        ``late`` frames later, behind newer ones; ``nan``: the value is none, with a CRC that fits; ``flip``: a bit is wrong; ``short``,
        ``long``: bytes are missing, or too many; ``foreign``: of another session; ``version``: of another version of the protocol.
    towards
        ``loop`` for measurements, ``rig`` for commands.
    first, count
        the first frame, counted from 0, and how many.
    late
        frames, for ``delay``.

    Raises
    ------
    ValueError
        for a kind or direction that is not known, or numbers out of range.
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
    """Return ``number`` faults of all kinds, either way, of 1 to ``longest`` frames, among the first ``frames``.

    Raises
    ------
    ValueError
        for numbers below one.
    """
    checks.whole("number", number, 1)
    last = checks.whole("frames", frames, 1) - 1
    most = checks.whole("longest", longest, 1)
    draw = random.Random(checks.whole("seed", seed, 0))
    # Short ones as often as long ones.
    return [
        Fault(
            draw.choice(KINDS),
            draw.choice(DIRECTIONS),
            draw.randint(0, last),
            round(most ** draw.random()),
            draw.randint(1, 10),
        )
        for _ in range(number)
    ]


class FaultInjector:
    """One direction of the wire: ``frames(data)`` says what comes out where ``data`` goes in."""

    def __init__(self, faults: Sequence[Fault], towards: str, seed: int = 0) -> None:
        self._faults = [fault for fault in faults if fault.towards == towards]
        self._kind = MEASUREMENT if towards == "loop" else COMMAND
        self._random = random.Random(f"{seed} {towards}")
        self.number = 0
        self._kept: list[bytes] = []
        self._late: list[tuple[int, bytes]] = []
        self.done: Counter[str] = Counter()

    def frames(self, data: bytes) -> list[bytes]:
        """Return what is sent in the place of ``data``, in this order."""
        if len(data) != LENGTH or data[3] != self._kind:
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
                self._late += [(number + fault.late, one) for one in out]
                out = []
            elif fault.kind == "burst":
                burst = True
            else:
                out = [_SPOILED[fault.kind](one, self._random) for one in out]
        out += [one for due, one in self._late if due <= number]
        self._late = [(due, one) for due, one in self._late if due > number]
        if burst:
            self._kept += out
            return []
        out, self._kept = self._kept + out, []
        return out


class Relay:
    """A relay between a loop and a rig, on a thread of its own.

    Parameters
    ----------
    url
        where the loop finds it, as ``udp://127.0.0.1:0`` for any port that is free; ``relay.url`` has the one it got.
    rig
        URL of the rig.
    faults
        what is to go wrong.
    seed
        of what is random about it: which bit is wrong.

    Raises
    ------
    ValueError
        for a URL that is not ``udp://HOST:PORT``, or a port that is taken.
    """

    def __init__(self, url: str, rig: str, faults: Sequence[Fault] = (), seed: int = 0) -> None:
        family, address = resolved(rig)
        self._ways = {towards: FaultInjector(faults, towards, seed) for towards in DIRECTIONS}
        self._front = UdpListener(url)
        self.url = self._front.url
        self._back = socket.socket(family, socket.SOCK_DGRAM)
        self._back.setblocking(False)
        self._back.connect(address)
        self._loop: Any = None
        self._bell, self._ring = socket.socketpair()
        self._thread = threading.Thread(target=self._work, name="quell-relay", daemon=True)
        self._thread.start()

    @property
    def passed(self) -> dict[str, int]:
        """How many measurements and commands have come by, towards the loop and towards the rig."""
        return {towards: way.number for towards, way in self._ways.items()}

    @property
    def done(self) -> dict[str, dict[str, int]]:
        """How many frames met which fault, for each direction."""
        return {towards: dict(way.done) for towards, way in self._ways.items()}

    def close(self) -> None:
        """End it."""
        if self._thread.is_alive():
            self._ring.send(b"x")
            self._thread.join()
        for one in (self._front, self._back, self._bell, self._ring):
            one.close()

    def __enter__(self) -> Relay:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _work(self) -> None:
        front = self._front.socket
        with selectors.DefaultSelector() as selector:
            for one in (front, self._back, self._bell):
                selector.register(one, selectors.EVENT_READ)
            while True:
                ready = [key.fileobj for key, _ in selector.select()]
                if self._bell in ready:
                    return
                if front in ready:
                    self._towards_rig(front)
                if self._back in ready:
                    self._towards_loop(front)

    def _towards_rig(self, front: socket.socket) -> None:
        try:
            data, self._loop = front.recvfrom(4 * LENGTH)
            for frame in self._ways["rig"].frames(data):
                self._back.send(frame)
        except OSError:  # the rig is not there: what is sent is lost
            pass

    def _towards_loop(self, front: socket.socket) -> None:
        try:
            data = self._back.recv(4 * LENGTH)
            for frame in self._ways["loop"].frames(data):
                if self._loop is not None:
                    front.sendto(frame, self._loop)
        except OSError:
            pass


def _signed(frame: bytes) -> bytes:
    """Return a frame with the CRC that fits."""
    return frame[:-4] + struct.pack("<I", zlib.crc32(frame[:-4]))


def _nan(frame: bytes, draw: random.Random) -> bytes:
    return _signed(
        frame[:24]
        + struct.pack("<d", draw.choice((float("nan"), float("inf"), float("-inf"))))
        + frame[32:]
    )


def _flip(frame: bytes, draw: random.Random) -> bytes:
    bit = draw.randrange(8 * len(frame))
    return bytes(byte ^ (1 << bit % 8 if i == bit // 8 else 0) for i, byte in enumerate(frame))


def _foreign(frame: bytes, draw: random.Random) -> bytes:
    (session,) = struct.unpack_from("<I", frame, 4)
    return _signed(frame[:4] + struct.pack("<I", session ^ draw.randrange(1, 1 << 32)) + frame[8:])


_SPOILED: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "nan": _nan,
    "flip": _flip,
    "short": lambda frame, draw: frame[: draw.randrange(LENGTH)],
    "long": lambda frame, draw: frame + draw.randbytes(draw.randrange(1, LENGTH)),
    "foreign": _foreign,
    "version": lambda frame, draw: _signed(frame[:2] + bytes([draw.randrange(2, 256)]) + frame[3:]),
}
KINDS = ("drop", "burst", "duplicate", "delay", *_SPOILED)
