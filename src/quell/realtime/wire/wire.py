"""A device at the other end of a wire: what the loop does with it, whatever carries the frames.

The device has a clock of its own and sends a measurement at each of its ticks. ``fetch`` takes the newest and waits for one where there is
none; ``put`` sends a command that says which measurement it answers.
"""

from __future__ import annotations

import math
import secrets
import time
from typing import Any, NamedTuple

from numba import typeof

from quell import checks
from quell.kernels.dispatch import compiled, for_types, is_finite, kernel
from quell.realtime.devices.base import fetch, put
from quell.realtime.system.clock import SystemClock, now, system_clock
from quell.realtime.wire import frames
from quell.realtime.wire.frames import Buffer, Peer
from quell.realtime.wire.link import await_news, receive, send

# A measurement that answers a command from before the last fifty is stale; so is what waited behind fifty others.
_MOST_AGE = 50
# So many frames are looked at in one go: whoever floods the wire can't keep the loop from its cycle.
MOST_AT_ONCE = 1024
# A hello that was not heard is said again so often [s].
_HELLO_EVERY = 0.05

NOT_SENT, TRIPPED, GONE = 1, 2, 3


class WireLine(NamedTuple):
    """The loop's end of a wire."""

    link: Any
    peer: Peer
    inbox: Buffer
    outbox: Buffer
    watch: SystemClock
    """For how long it waits: a wire takes real time, whatever the loop's clock says."""


@fetch.register(WireLine)
def _fetch(line: WireLine, clock: Any, until: int) -> tuple[float, int]:
    begin = now(clock)
    y, came = _newest(line)
    if came:
        return y, 0
    end = now(line.watch) + until - begin
    left = until - begin
    while not came and left > 0:
        await_news(line.link, left)
        y, came = _newest(line)
        left = end - now(line.watch)
    return y, now(clock) - begin


@kernel
def _newest(line: WireLine) -> tuple[float, bool]:
    """Return the newest measurement of those that have come, and whether one has.

    Where more have come than can be fresh, the queue may have been full, and its end is not the newest: then none of them counts.
    """
    counters, frame = line.peer.counters, line.inbox
    y, news, looked_at = math.nan, 0, 0
    while looked_at < MOST_AT_ONCE:
        size = receive(line.link, frame)
        if size < 0:
            break
        looked_at += 1
        if not frames.well_formed(frame, size, counters):
            continue
        if _is_ours(line, frame, frames.GOODBYE):
            line.peer.numbers[frames.STATE] |= frames.GONE
        elif not _is_ours(line, frame, frames.WELCOME) and frames.is_news(frame, line.peer):
            y = frame.doubles[3]
            news += 1
    if news > 1:
        counters[frames.SKIPPED] += news - 1
    if news > line.peer.most_age:
        counters[frames.STALE] += 1
        return math.nan, False
    return (y if is_finite(y) else math.nan), news > 0


@kernel
def _is_ours(line: WireLine, frame: Buffer, kind: int) -> bool:
    return frame.bytes[3] == kind and int(frame.words[1]) == line.peer.numbers[frames.SESSION]


@put.register(WireLine)
def _put(line: WireLine, u: float) -> int:
    """Send u; 1 where it could not be sent, 2 where the device has set u to zero for good, 3 where it has ended the session."""
    frames.compose(line.outbox, line.peer, frames.COMMAND, now(line.watch), u, 0)
    failed = send(line.link, line.outbox) != 0
    if failed:
        line.peer.counters[frames.NOT_SENT] += 1
    state = line.peer.numbers[frames.STATE]
    if state & frames.GONE:
        return GONE
    if state & frames.WATCHDOG_TRIPPED:
        return TRIPPED
    return NOT_SENT if failed else 0


@compiled
def fetch_one(line: Any, clock: Any, until: int) -> tuple[float, int]:
    """Fetch, called from Python."""
    return fetch(line, clock, until)


@compiled
def put_one(line: Any, u: float) -> int:
    """Put, called from Python."""
    return put(line, u)


class WireDevice:
    """A device at the other end of a wire, which a subclass has laid.

    Its ``paced`` is True: the device has a clock of its own, and ``read`` waits for its next measurement.
    """

    paced = True

    def __init__(self, url: str, link: Any, dt: float, timeout: float, hint: str) -> None:
        """Begin a session, within ``timeout`` seconds; ``hint`` says what may be wrong where nobody answers."""
        self.url = url
        self.dt = checks.positive("dt", dt, "s")
        self.line = WireLine(
            link,
            frames.peer(frames.MEASUREMENT, _new_session(), _MOST_AGE),
            frames.buffer(),
            frames.buffer(),
            system_clock(),
        )
        self._clock = system_clock()
        self._open = True
        self._timeout, self._hint = timeout, hint
        self._compiled = False
        try:
            self._begin_session()
        except BaseException:
            self._open = False
            # A device that hears the hello only later would keep itself free for a loop that has gone.
            self._say(frames.GOODBYE, 0.0, self._session)
            self._free()
            raise

    @property
    def counters(self) -> dict[str, int]:
        """How many frames of the device met which fate, see ``quell.realtime.wire.frames``."""
        return frames.told(self.line.peer.counters)

    @property
    def lost(self) -> bool:
        """Whether the device's watchdog has set u to zero for good, or the device has ended the session."""
        return bool(self.line.peer.numbers[frames.STATE] & (frames.WATCHDOG_TRIPPED | frames.GONE))

    def read(self) -> float:
        """Return the newest measurement [y-unit]; NaN where for fifty samples none has come."""
        self._check_open()
        return self._fetch(_MOST_AGE * self.dt)

    def write(self, u: float) -> None:
        """Send u [u-unit].

        Raises
        ------
        ConnectionError
            where it could not be sent, or will not be applied: the device's watchdog has tripped, or it has ended the session.
        """
        self._check_open()
        fault = self._call(put_one, float(u))
        if fault:
            raise ConnectionError(f"{self.url}: {_FAULTS[fault]}")

    def begin_anew(self) -> None:
        """Begin a new session in place of this one: what the loop does before its first cycle, as the device waits for that only so long.

        Raises
        ------
        ConnectionError
            where no device answers.
        """
        self._check_open()
        former = self._session
        self._say(frames.GOODBYE, 0.0, former)
        # Where a frame replaces the one before, the device has to look before the hello comes.
        time.sleep(min(2.0 * self.dt, _HELLO_EVERY))
        frames.start_session(self.line.peer, _new_session())
        self._begin_session(former)

    def tick(self, timeout: float = 1.0) -> int:
        """Wait for a measurement that comes now, and return the time at which it came: the system's monotonic clock [ns].

        Raises
        ------
        ConnectionError
            where none has come for ``timeout`` seconds.
        """
        self._check_open()
        counters = self.line.peer.counters
        self._fetch(0.0)
        before = counters[frames.ACCEPTED]
        self._fetch(timeout)
        if counters[frames.ACCEPTED] == before:
            raise ConnectionError(f"{self.url}: no measurement has come for {timeout:g} s")
        return time.monotonic_ns()

    def close(self) -> None:
        """Say goodbye, upon which the device sets u to zero; calling it twice does no harm."""
        if self._open:
            self._open = False
            self._say(frames.GOODBYE, 0.0, self._session)
            self._free()

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _free(self) -> None:
        """Give the wire free."""
        raise NotImplementedError

    @property
    def _session(self) -> int:
        return int(self.line.peer.numbers[frames.SESSION])

    def _begin_session(self, former: int = 0) -> None:
        """Say hello until there is a welcome; a goodbye to the ``former`` session may have been lost, and is said again."""
        line, refused = self.line, 0
        apart = max(_HELLO_EVERY, 2.0 * self.dt)
        deadline = time.monotonic() + max(self._timeout, 2.0 * apart)
        while time.monotonic() < deadline:
            self._say(frames.HELLO, self.dt, self._session)
            again = time.monotonic() + apart
            while (left := again - time.monotonic()) > 0.0:
                await_news(line.link, round(1e9 * left))
                while (size := receive(line.link, line.inbox)) >= 0:
                    if not (
                        frames.well_formed(line.inbox, size, line.peer.counters)
                        and _is_ours(line, line.inbox, frames.WELCOME)
                    ):
                        continue
                    refused, dt = int(line.inbox.words[8]), float(line.inbox.doubles[3])
                    if refused & frames.OTHER_DT:
                        raise ValueError(
                            f"dt = {self.dt!r} s: the device at {self.url} ticks every {dt!r} s; both must be the same"
                        )
                    if refused == 0:
                        return
                    if former:
                        self._say(frames.GOODBYE, 0.0, former)
        if refused & frames.BUSY:
            raise ConnectionError(
                f"{self.url}: another session is alive there; end it first; one whose loop was killed ends in a minute"
            )
        raise ConnectionError(f"{self.url}: no device answers; {self._hint}")

    def _say(self, kind: int, value: float, session: int) -> None:
        line = self.line
        frames.write_frame(line.outbox, kind, session, 0, 0, time.monotonic_ns(), value, 0)
        send(line.link, line.outbox)

    def _fetch(self, seconds: float) -> float:
        """Return the newest measurement, or the first that comes within so many seconds."""
        if not self._compiled:  # that may take seconds, and is not to be part of a cycle
            self._compiled = True
            for entry, arguments in ((fetch_one, (self._clock, 0)), (put_one, (0.0,))):
                for_types(entry, self.line).compile(tuple(map(typeof, (self.line, *arguments))))
        y, _ = self._call(fetch_one, self._clock, time.monotonic_ns() + round(1e9 * seconds))
        return float(y)

    def _call(self, entry: Any, *arguments: Any) -> Any:
        return for_types(entry, self.line, *arguments)(self.line, *arguments)

    def _check_open(self) -> None:
        if not self._open:
            raise ValueError(f"{self.url}: is closed; make a new device")


_FAULTS = {
    NOT_SENT: "the command could not be sent",
    TRIPPED: "the device's watchdog has set u to zero; begin a new session",
    GONE: "the device has ended the session",
}


def _new_session() -> int:
    return secrets.randbelow((1 << 32) - 1) + 1
