"""Hostile packets and bytes against a rig and a loop that run a session meanwhile.

    python benchmarks/hostile_wire.py                     # 10⁶ attacks: UDP, serial line
    python benchmarks/hostile_wire.py --count 30000 --seed 7
    python benchmarks/hostile_wire.py --seconds 600       # as many as fit into this time

A rig and a loop exchange a frame per tick; between them an attacker sends

* over UDP, from other addresses: random bytes, frames of the session as they are, with changed
  bits, with changed fields and a correct CRC, with absurd values, goodbyes and hellos;
* on a serial line, in both directions: random bytes, broken packets, old frames, frames of other
  sessions.

After each tick it checks that u is within the limits, that the session is that of the loop and that
u is a command of the loop (over UDP: the newest one, and y that of a plant beside it, bit for bit).
At the end it compares resident memory and the number of open files with those after the first
tenth, and the bytes that the rig has sent to strangers with those that it got from them.
"""

from __future__ import annotations

import os
import random
import resource
import socket
import struct
import sys
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
from measured import options_of, parser_of, write

import quell as ql
from quell.kernels import dispatch
from quell.realtime import transports
from quell.realtime import wire as frames
from quell.realtime.devices import TwinDevice, ask
from quell.realtime.registry import listen, open_device
from quell.realtime.rig import APPLIED, Rig

DT, LIMIT, WATCHDOG = 0.01, 5.0, 50
ONE = ql.plants.two_mass_spring()
# Three masses with a spring between neighbours: as many measurements and control signals.
SEVERAL = ql.plants.LinearPlant(
    np.block([[np.zeros((3, 3)), np.eye(3)], [-np.diag([2.0, 3.0, 1.0]) + 0.5, -0.4 * np.eye(3)]]),
    np.vstack([np.zeros((3, 3)), np.eye(3) + 0.2]),
    np.hstack([np.eye(3), np.zeros((3, 3))]),
)
# Attacks per tick: a queue of the system holds some hundred datagrams.
AT_ONCE = 60
# Part of the packets that are new; the others were sent before, to this session or an older one.
NEW = 1 / 3
# Ticks of a session.
SESSION = 400
ABSURD = (float("nan"), float("inf"), -1e300, 1e9, 5e-324, -0.0)


def signed(head: bytes) -> bytes:
    """Return what is before the CRC of a frame, 36 bytes for one number, with it."""
    return head + struct.pack("<I", zlib.crc32(head))


class Session:
    """A rig that ticks when it is told, and a loop; ``tick`` exchanges a frame and checks it."""

    def __init__(
        self, stack: ExitStack, url: str, exact: bool, draw: random.Random, several: bool
    ) -> None:
        self.plant: Any = SEVERAL if several else ONE
        self.rig = stack.enter_context(
            Rig(self.plant, DT, listen(url), u_max=LIMIT, watchdog=WATCHDOG, rest=True)
        )
        self.counts = self.rig.signal_counts
        self.outputs, self.inputs = self.counts or (1, 1)
        stack.callback(self.rig.listener.close)
        self.rig.prepare()
        self.url, self.exact, self.draw = self.rig.listener.url, exact, draw
        self.wrong: list[str] = []
        self.seen: deque[bytes] = deque(maxlen=200)
        self.packets: deque[bytes] = deque(maxlen=300)
        self.loop: Any = None
        self.ended = 0
        self.begin()
        stack.callback(lambda: self.loop.close())

    @property
    def number(self) -> int:
        """Number of the loop's session."""
        return int(self.loop.handle.endpoint.numbers[frames.SESSION])

    def begin(self) -> None:
        """End the loop's session and begin another one."""
        if self.loop is not None:
            self.ended = self.number
            self._while_ticking(self.loop.close)
            self.rig.tick(2)
        opened: list[Any] = []
        self._while_ticking(lambda: opened.append(open_device(self.url, DT, False, self.counts)))
        if not opened:
            raise RuntimeError(f"{self.url}: the loop got no session")
        self.loop = opened[0]
        numbers = self.loop.handle.endpoint.numbers
        while numbers[frames.RECEIVED] < self.rig.model.endpoint.numbers[frames.SENT]:
            self.loop.read()
        ask(self.loop.handle)
        self.u = np.zeros(self.inputs)
        self.commands: deque[np.ndarray] = deque([self.u], maxlen=WATCHDOG)
        self.twin: TwinDevice | None = None

    def _while_ticking(self, work: Callable[[], Any]) -> None:
        thread = threading.Thread(target=work)
        thread.start()
        while thread.is_alive():
            self.rig.tick()
            thread.join(0.002)

    def tick(self) -> None:
        """Let the rig tick, read, answer; the attacks were sent before."""
        self.rig.tick()
        y = self.loop.read() if self.exact else self._read_soon()
        applied = self.rig.model.signals[APPLIED].copy()
        rig_numbers = self.rig.model.endpoint.numbers
        self._check(np.all(np.abs(applied) <= LIMIT), f"u = {applied!r}")
        self._check(rig_numbers[frames.SESSION] == self.number, "a foreign session")
        if self.exact:
            right = np.array_equal(applied, np.clip(self.u, -LIMIT, LIMIT))
            self._check(right, f"u = {applied!r} for {self.u}")
            self._check(self.rig.state in ("live", "waiting"), self.rig.state)
            if self.twin is None:
                late: Any = ql.plants.delayed_inputs if self.counts else ql.plants.delayed
                self.twin = TwinDevice(late(self.plant, DT, DT), DT)
            expected = self.twin.read()
            self._check(np.array_equal(y, expected), f"y = {y!r}, and not {expected!r}")
        else:  # a command acts as a whole, or not at all
            own = any(np.array_equal(applied, np.clip(u, -LIMIT, LIMIT)) for u in self.commands)
            self._check(own or not np.any(applied), f"u = {applied!r} is of nobody")
        self.u = np.array([self.draw.uniform(-1.2 * LIMIT, 1.2 * LIMIT) for _ in self.u])
        if self.twin is not None:
            self.twin.write(self._given(np.clip(self.u, -LIMIT, LIMIT)))
        self.commands.append(self.u)
        with suppress(ConnectionError):  # attacks on the line may trip the watchdog
            self.loop.write(self._given(self.u))
        for box in (self.loop.handle.outbox, self.rig.model.outbox):
            self.seen.append(box.bytes[: box.length[0]].tobytes())

    def _given(self, u: np.ndarray) -> Any:
        """Return control signals as a device takes them."""
        return u if self.counts else float(u[0])

    def _read_soon(self) -> float:
        """Read without waiting for a measurement that an attack has destroyed."""
        return float(self.loop._read_within(0.0))

    def _check(self, right: bool, what: str) -> None:
        if not right:
            self.wrong.append(what)

    def forged(self, session: int) -> bytes:
        """Return a frame of a session, with a correct CRC and fields that were never sent."""
        draw, sent = self.draw, self.rig.model.endpoint.numbers
        kind = draw.choice((1, 2, 2, 2, 3, 4, 5, 5, draw.randrange(256)))
        ahead = draw.choice((1, 2, 100, 2**31 - 1, draw.randrange(2**32)))
        number = (int(sent[frames.RECEIVED]) + ahead) % 2**32
        answers = (int(sent[frames.SENT]) - draw.choice((0, 0, 1, 30, 10**6))) % 2**32
        values = [draw.choice((*ABSURD, DT, draw.uniform(-9.0, 9.0)))]
        version, state = draw.choice((1, 1, 1, 2, 0)), draw.choice((0, 0, 1, 8, draw.randrange(9)))
        if self.counts:  # as many as the session has, fewer, more, or too many for any
            count = draw.choice((*(self.inputs,) * 4, 1, draw.randrange(1, 20)))
            values += [draw.choice((*ABSURD, DT, 1.0)) for _ in range(count - 1)]
            word = frames.signals_word(self.outputs, self.inputs)
            state |= draw.choice((0, word, draw.randrange(2**24)))
        head = struct.pack("<2sBBIIIq", b"QL", version, kind, session, number, answers, 0)
        return signed(head + struct.pack(f"<{len(values)}dI", *values, state))

    def changed(self) -> bytes:
        """Return a frame of the session with some bits changed, sometimes with a correct CRC."""
        draw = self.draw
        data = bytearray(draw.choice(self.seen) if self.seen else bytes(frames.LENGTH))
        for _ in range(draw.randint(1, 4)):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        return bytes(data)


def attack_udp(session: Session, strangers: list[socket.socket]) -> tuple[int, int]:
    """Send packets from other addresses; return the bytes sent, and those that came back."""
    draw = session.draw
    host, _, port = session.url.removeprefix("udp://").partition(":")
    rig, loop = (host, int(port)), session.loop._socket.getsockname()
    sent = returned = 0
    for _ in range(AT_ONCE):
        if draw.random() < NEW or not session.packets:
            session.packets.append(_packet(session))
        data = session.packets[int(draw.random() * len(session.packets))]
        stranger = strangers[int(draw.random() * len(strangers))]
        stranger.sendto(data, loop if draw.random() < 0.1 else rig)
        sent += len(data)
    for stranger in strangers:
        with suppress(BlockingIOError):
            while True:
                returned += len(stranger.recv(4096))
    return sent, returned


def _packet(session: Session) -> bytes:
    """Return a hostile packet."""
    draw = session.draw
    kind = draw.randrange(6)
    if kind == 0:
        return draw.randbytes(draw.randrange(200))
    if kind == 1 and session.seen:
        return draw.choice(session.seen)
    if kind == 2:
        return session.changed()
    if kind == 3:
        return signed(session.changed()[:-4])
    return session.forged(draw.choice((session.number, session.ended, 0, 77)))


def attack_serial(session: Session, ends: tuple[int, int]) -> None:
    """Write bytes to both directions of the line, beside the frames."""
    draw = session.draw
    coded = np.zeros(400, dtype=np.uint8)
    for _ in range(AT_ONCE // 4):
        kind = draw.randrange(5)
        data = draw.randbytes(draw.randrange(60))
        if kind > 1:
            other = session.number ^ draw.randrange(1, 2**32)
            frame = draw.choice(
                (session.changed(), session.forged(other), *list(session.seen)[:-20][-1:])
            )
            raw = np.frombuffer(frame, dtype=np.uint8)
            data = coded[: transports.encode(raw, raw.size, coded)].tobytes()
            data = data[: draw.choice((len(data), len(data), draw.randrange(len(data))))]
        # Mostly with a final zero: otherwise no frame of the session would ever get through.
        data += b"\0" if draw.random() < 0.97 else b""
        with suppress(BlockingIOError):
            os.write(draw.choice(ends), data)


def resources() -> tuple[int, int]:
    """Return resident memory [bytes] and the number of open files."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize(), sum(1 for _ in Path("/proc/self/fd").iterdir())


def attacks(
    wire: str, stack: ExitStack, draw: random.Random, several: bool
) -> Iterator[tuple[int, Session, Any]]:
    """Attack a session over one kind of wire, and yield the number of attacks after each tick."""
    url = {"udp": "udp://127.0.0.1:0", "serial": "serial://pty"}[wire]
    session = Session(stack, url, wire == "udp", draw, several)
    strangers = []
    for i in range(4):
        stranger = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        stranger.setblocking(False)
        stranger.bind((f"127.0.0.{1 + i % 2}", 0))
        strangers.append(stranger)
    balance = [0, 0]
    for number in range(1, sys.maxsize):
        if number % SESSION == 0 or session.loop.lost or session.rig.state == "tripped":
            session.begin()
        if wire == "udp":
            for i, amount in enumerate(attack_udp(session, strangers)):
                balance[i] += amount
        else:
            attack_serial(session, session.rig.listener._port._ends)
        session.tick()
        yield AT_ONCE if wire == "udp" else AT_ONCE // 4, session, tuple(balance)


def trial(
    wire: str, count: int, seconds: float, seed: int, several: bool = False
) -> dict[str, Any]:
    """Attack a wire ``count`` times or for ``seconds``, whichever ends first.

    It has one measurement and one control signal, or ``several``, three of each.
    """
    done, before = 0, (0, 0)
    with ExitStack() as stack:
        attacked = attacks(wire, stack, random.Random(seed), several)
        next(attacked)  # compiles the rig and the loop
        begin = time.monotonic()
        while True:
            many, session, balance = next(attacked)
            done += many
            if before[1] == 0 and (done >= count / 10 or time.monotonic() - begin > seconds / 10):
                before = resources()
            if done >= count or time.monotonic() - begin > seconds:
                break
        after = resources()
        counters = session.rig.counters
    return {
        "wire": wire,
        "attacks": done,
        "seconds": time.monotonic() - begin,
        "wrong": session.wrong,
        "memory": after[0] - before[0],
        "files": after[1] - before[1],
        "sent": balance[0],
        "returned": balance[1],
        "counters": {name: n for name, n in counters.items() if n},
    }


def main() -> None:
    """Run the trials and print a table."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=1_000_000, help="attacks in all")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="time in all")
    parser.add_argument("--seed", type=int, default=1)
    options = options_of(parser, count=1500)
    dispatch.interpret_all = options.quick  # few frames are quicker so than to compile
    figures: dict[str, Any] = {}
    shares = {("udp", 1): 0.6, ("serial", 1): 0.1, ("udp", 3): 0.25, ("serial", 3): 0.05}
    bad = 0
    print(
        f"{'wire':<8} {'signals':>7} {'attacks':>9} {'time':>7} {'wrong':>6} {'memory':>10} "
        f"{'files':>6}  returned"
    )
    for (wire, signals), share in shares.items():
        most = round(share * options.count), share * options.seconds
        found = trial(wire, *most, options.seed, signals > 1)
        part = found["returned"] / found["sent"] if found["sent"] else 0.0
        print(
            f"{wire:<8} {signals:>7} {found['attacks']:>9} {found['seconds']:>5.0f} s "
            f"{len(found['wrong']):>6} "
            f"{found['memory'] / 1024:>6.0f} KiB {found['files']:>6}  {100 * part:.1f} %",
            flush=True,
        )
        print("  ", ", ".join(f"{n} {name}" for name, n in found["counters"].items()))
        for what in found["wrong"][:10]:
            print("   wrong:", what)
        bad += len(found["wrong"]) + abs(found["files"])
        figures[f"{wire}, signals {signals}"] = {
            "attacks": found["attacks"],
            "seconds": found["seconds"],
            "wrong": len(found["wrong"]),
            "memory [KiB]": found["memory"] / 1024,
            "files": found["files"],
            "returned [%]": 100 * part,
            "counters": found["counters"],
        }
    write(options, {"attacks": sum(row["attacks"] for row in figures.values()), **figures})
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
