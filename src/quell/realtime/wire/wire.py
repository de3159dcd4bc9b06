"""A device at the other end of a wire: what the loop does with it, whatever carries the frames.

The device has a clock of its own and sends a measurement at each of its ticks. ``read_measurement`` takes the newest and waits for one where there is
none; ``write_command`` sends a command that says which measurement it answers.
"""

from __future__ import annotations

import math
import secrets
import time
from typing import Any, NamedTuple

from numba import typeof

from quell import checks
from quell.kernels.dispatch import compiled, dispatcher_for, is_finite, kernel
from quell.realtime.devices.base import read_measurement, write_command
from quell.realtime.system.clock import SystemClock, now, system_clock
from quell.realtime.wire import frames
from quell.realtime.wire.frames import Buffer, Endpoint
from quell.realtime.wire.transport import receive, send, wait_for_frame

# A measurement that answers a command from before the last fifty is stale; so is what waited behind fifty others.
_MOST_AGE = 50
# So many frames are looked at in one go: whoever floods the wire can't keep the loop from its cycle.
MOST_AT_ONCE = 1024
# A hello that was not heard is said again so often [s].
_HELLO_EVERY = 0.05

NOT_SENT, TRIPPED, GONE = 1, 2, 3


class WireHandle(NamedTuple):
    """The loop's end of a wire."""

    transport: Any
    endpoint: Endpoint
    inbox: Buffer
    outbox: Buffer
    watch: SystemClock
    """For how long it waits: a wire takes real time, whatever the loop's clock says."""


@read_measurement.register(WireHandle)
def _read_measurement(handle: WireHandle, clock: Any, until: int) -> tuple[float, int]:
    begin = now(clock)
    y, came = _newest(handle)
    if came:
        return y, 0
    end = now(handle.watch) + until - begin
    left = until - begin
    while not came and left > 0:
        wait_for_frame(handle.transport, left)
        y, came = _newest(handle)
        left = end - now(handle.watch)
    return y, now(clock) - begin


@kernel
def _newest(handle: WireHandle) -> tuple[float, bool]:
    """Return the newest measurement of those that have come, and whether one has.

    Where more have come than can be fresh, the queue may have been full, and its end is not the newest: then none of them counts.
    """
    counters, frame = handle.endpoint.counters, handle.inbox
    y, news, looked_at = math.nan, 0, 0
    while looked_at < MOST_AT_ONCE:
        size = receive(handle.transport, frame)
        if size < 0:
            break
        looked_at += 1
        if not frames.is_well_formed(frame, size, counters):
            continue
        if _is_ours(handle, frame, frames.GOODBYE):
            handle.endpoint.numbers[frames.STATE] |= frames.GONE
        elif not _is_ours(handle, frame, frames.WELCOME) and frames.accept_well_formed(
            frame, handle.endpoint
        ):
            y = frame.doubles[3]
            news += 1
    if news > 1:
        counters[frames.SKIPPED] += news - 1
    if news > handle.endpoint.most_age:
        counters[frames.STALE] += 1
        return math.nan, False
    return (y if is_finite(y) else math.nan), news > 0


@kernel
def _is_ours(handle: WireHandle, frame: Buffer, kind: int) -> bool:
    return frame.bytes[3] == kind and int(frame.words[1]) == handle.endpoint.numbers[frames.SESSION]


@write_command.register(WireHandle)
def _write_command(handle: WireHandle, u: float) -> int:
    """Send u; 1 where it could not be sent, 2 where the device has set u to zero for good, 3 where it has ended the session."""
    frames.write_next_frame(handle.outbox, handle.endpoint, frames.COMMAND, now(handle.watch), u, 0)
    failed = send(handle.transport, handle.outbox) != 0
    if failed:
        handle.endpoint.counters[frames.NOT_SENT] += 1
    state = handle.endpoint.numbers[frames.STATE]
    if state & frames.GONE:
        return GONE
    if state & frames.WATCHDOG_TRIPPED:
        return TRIPPED
    return NOT_SENT if failed else 0


@compiled
def fetch_one(handle: Any, clock: Any, until: int) -> tuple[float, int]:
    """Fetch, called from Python."""
    return read_measurement(handle, clock, until)


@compiled
def put_one(handle: Any, u: float) -> int:
    """Put, called from Python."""
    return write_command(handle, u)


class WireDevice:
    """A device at the other end of a wire, which a subclass has laid.

    Its ``paced`` is True: the device has a clock of its own, and ``read`` waits for its next measurement.
    """

    paced = True

    def __init__(self, url: str, transport: Any, dt: float, timeout: float, hint: str) -> None:
        """Begin a session, within ``timeout`` seconds; ``hint`` says what may be wrong where nobody answers."""
        self.url = url
        self.dt = checks.positive("dt", dt, "s")
        self.handle = WireHandle(
            transport,
            frames.endpoint(frames.MEASUREMENT, _new_session(), _MOST_AGE),
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
        return frames.counts_by_name(self.handle.endpoint.counters)

    @property
    def lost(self) -> bool:
        """Whether the device's watchdog has set u to zero for good, or the device has ended the session."""
        return bool(
            self.handle.endpoint.numbers[frames.STATE] & (frames.WATCHDOG_TRIPPED | frames.GONE)
        )

    def read(self) -> float:
        """Return the newest measurement [y-unit]; NaN where for fifty samples none has come."""
        self._check_open()
        return self._read_measurement(_MOST_AGE * self.dt)

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

    def restart_session(self) -> None:
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
        frames.start_session(self.handle.endpoint, _new_session())
        self._begin_session(former)

    def tick(self, timeout: float = 1.0) -> int:
        """Wait for a measurement that comes now, and return the time at which it came: the system's monotonic clock [ns].

        Raises
        ------
        ConnectionError
            where none has come for ``timeout`` seconds.
        """
        self._check_open()
        counters = self.handle.endpoint.counters
        self._read_measurement(0.0)
        before = counters[frames.ACCEPTED]
        self._read_measurement(timeout)
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
        return int(self.handle.endpoint.numbers[frames.SESSION])

    def _begin_session(self, former: int = 0) -> None:
        """Say hello until there is a welcome; a goodbye to the ``former`` session may have been lost, and is said again."""
        handle, refused = self.handle, 0
        apart = max(_HELLO_EVERY, 2.0 * self.dt)
        deadline = time.monotonic() + max(self._timeout, 2.0 * apart)
        while time.monotonic() < deadline:
            self._say(frames.HELLO, self.dt, self._session)
            again = time.monotonic() + apart
            while (left := again - time.monotonic()) > 0.0:
                wait_for_frame(handle.transport, round(1e9 * left))
                while (size := receive(handle.transport, handle.inbox)) >= 0:
                    if not (
                        frames.is_well_formed(handle.inbox, size, handle.endpoint.counters)
                        and _is_ours(handle, handle.inbox, frames.WELCOME)
                    ):
                        continue
                    refused, dt = int(handle.inbox.words[8]), float(handle.inbox.doubles[3])
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
        handle = self.handle
        frames.write_frame(handle.outbox, kind, session, 0, 0, time.monotonic_ns(), value, 0)
        send(handle.transport, handle.outbox)

    def _read_measurement(self, seconds: float) -> float:
        """Return the newest measurement, or the first that comes within so many seconds."""
        if not self._compiled:  # that may take seconds, and is not to be part of a cycle
            self._compiled = True
            for entry, arguments in ((fetch_one, (self._clock, 0)), (put_one, (0.0,))):
                dispatcher_for(entry, self.handle).compile(
                    tuple(map(typeof, (self.handle, *arguments)))
                )
        y, _ = self._call(fetch_one, self._clock, time.monotonic_ns() + round(1e9 * seconds))
        return float(y)

    def _call(self, entry: Any, *arguments: Any) -> Any:
        return dispatcher_for(entry, self.handle, *arguments)(self.handle, *arguments)

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
