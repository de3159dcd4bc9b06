"""The base class of devices at the other end of a wire: sessions, reading and writing in Python."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from typing import Any, Self

import numpy as np

from quell import checks
from quell.kernels.dispatch import call_specialised, compiled, specialised
from quell.realtime import devices, wire
from quell.realtime.devices import read_measurement, write_signals
from quell.realtime.system import SystemClock, system_clock
from quell.realtime.wire import WireHandle
from quell.types import Vector

# A measurement is stale if it answers a command older than this number of samples, or if more than
# this number came at once. Chosen by hand; not tuned further.
_MOST_AGE = 50
# Time between two hellos [s]. Chosen by hand; not tuned further.
_HELLO_EVERY = 0.05
# A device that has not fallen silent sends within so many samples. Chosen by hand.
_SPEAKS_WITHIN = 3

_FAULTS = {
    wire.COMMAND_NOT_SENT: "the command could not be sent",
    wire.TRIPPED: "the device's watchdog has set u to zero; begin a new session",
    wire.SESSION_GONE: "the device has ended the session",
}


@compiled
def _read(handle: WireHandle, clock: SystemClock, until: int) -> tuple[float, int]:
    return read_measurement(handle, clock, until)


@compiled
def _write(handle: WireHandle, u: Vector) -> int:
    return write_signals(handle, u)


class WireDevice:
    """A device at the other end of a wire; a subclass opens the wire and releases it.

    ``paced`` is True: the device has its own clock, and ``read`` waits for the next measurement.

    Parameters
    ----------
    url
        URL of the device.
    dt
        sample time [s]; the device must have the same.
    timeout
        longest time until the device answers [s].
    signals
        numbers of measurements and of control signals, for several axes; ``read`` then returns an
        array and ``write`` takes one.

    Raises
    ------
    ValueError
        for a wrong URL, a wire that can't be opened, or if the device has another sample time or
        other numbers of signals.
    ConnectionError
        if no device answers, or if it has another session.
    """

    paced = True
    _hint = "start one with: quell rig --device {url}"  # advice if no device answers

    def __init__(
        self, url: str, dt: float, timeout: float = 3.0, signals: devices.SignalCounts | None = None
    ) -> None:
        self.url = url
        self.dt = checks.positive("dt", dt, "s")
        self.signal_counts = devices.checked_counts(signals, wire.MOST_SIGNALS)
        outputs, inputs = self.signal_counts or (1, 1)
        own = wire.endpoint(wire.MEASUREMENT, _new_session(), _MOST_AGE, outputs)
        room = 1 if outputs == inputs == 1 else wire.MOST_SIGNALS
        inbox, outbox, watch = wire.buffer(room), wire.buffer(room), system_clock()
        queue = wire.tick_queue(outputs, inputs)
        self.handle = WireHandle(self._connect(), own, inbox, outbox, watch, self.dt, queue)
        # Not the handle's: compiled code takes it that its arguments share no memory.
        self._clock = system_clock()
        self._timeout = timeout
        self._open, self._compiled = True, False
        self._answered = 0  # commands sent before the last reading
        try:
            self._begin_session()
        except BaseException:
            # A device that receives the hello later must not wait for a loop that has gone.
            self.close()
            raise

    def _connect(self) -> Any:
        """Open the wire; return its transport."""
        raise NotImplementedError

    def _release(self) -> None:
        """Release the wire."""
        raise NotImplementedError

    @property
    def counters(self) -> dict[str, int]:
        """Number of frames from the device by result, see ``quell.realtime.wire``."""
        return wire.counts_by_name(self.handle.endpoint.counters)

    @property
    def lost(self) -> bool:
        """Whether the device's watchdog has set u to zero, or the device has ended the session."""
        state = self.handle.endpoint.numbers[wire.STATE]
        return bool(state & (wire.WATCHDOG_TRIPPED | wire.GONE))

    def read(self) -> Any:
        """Return the newest measurement [y-unit]; NaN if none has come for fifty samples.

        A device of several signals returns an array (p,).
        """
        y = self._read_within(_MOST_AGE * self.dt)
        return y if self.signal_counts is None else self.handle.queue.used_y.copy()

    def read_channels(self) -> list[float]:
        """Return the numbers that came with the last measurement, by index.

        NaN for those that have not come for fifty samples.
        """
        return self.handle.queue.shown.tolist()

    def write(self, u: Any) -> None:
        """Send u [u-unit], a number; to a device of several signals as many as it has (m,).

        Raises
        ------
        ValueError
            for another number of control signals.
        ConnectionError
            if u could not be sent, or the device will not apply it: its watchdog has set u to zero,
            or it has ended the session.
        """
        self._check_open()
        if self.signal_counts is None:
            values = np.array([float(u)])
        else:
            values = checks.vector("u", u, self.signal_counts.inputs)
        fault = call_specialised(_write, self.handle, values)
        if fault:
            raise ConnectionError(f"{self.url}: {_FAULTS[fault]}")

    def restart_session(self) -> None:
        """Replace this session by a new one: a device waits only so long for the first command."""
        self._check_open()
        former = self._session
        self._send(wire.GOODBYE, 0.0, former)
        # If a frame replaces the one before it, the device must have time to read the goodbye.
        time.sleep(min(2.0 * self.dt, _HELLO_EVERY))
        wire.start_session(self.handle.endpoint, _new_session())
        self.handle.queue.counts[:] = 0
        self.handle.queue.came[:] = 0  # the values stay until the session has its own
        self._begin_session(former)

    def tick(self, timeout: float = 1.0) -> int:
        """Wait for the next measurement; return the monotonic time of its arrival [ns].

        Raise a ``ConnectionError`` if none has come for ``timeout`` [s].
        """
        counters = self.handle.endpoint.counters
        self._read_within(0.0)
        before = counters[wire.ACCEPTED]
        self._read_within(timeout)
        if counters[wire.ACCEPTED] == before:
            raise ConnectionError(f"{self.url}: no measurement has come for {timeout:g} s")
        return time.monotonic_ns()

    def close(self) -> None:
        """Send a goodbye, after which the device sets u to zero; a second call does nothing."""
        if self._open:
            self._open = False
            self._send(wire.GOODBYE, 0.0, self._session)
            self._release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _signals_word(self) -> int:
        counts = self.signal_counts
        return 0 if counts is None else int(wire.signals_word(*counts))

    @property
    def _session(self) -> int:
        return int(self.handle.endpoint.numbers[wire.SESSION])

    def _begin_session(self, former: int = 0) -> None:
        """Send hellos until a welcome comes.

        If the device is busy, the goodbye of the session ``former`` may have been lost; repeat it.
        """
        refusal = 0
        apart = max(_HELLO_EVERY, 2.0 * self.dt)
        deadline = time.monotonic() + max(self._timeout, 2.0 * apart)
        while time.monotonic() < deadline:
            devices.ask(self.handle)
            for state in self._welcomes(apart):
                if state == 0:
                    return
                refusal = state
                if former:
                    self._send(wire.GOODBYE, 0.0, former)
        if refusal & wire.BUSY:
            raise ConnectionError(
                f"{self.url}: another session is active there; end it first; "
                "a session whose loop was killed ends after a minute"
            )
        if self.signal_counts is not None:  # a device of one y and one u knows no longer hello
            self._send(wire.HELLO, self.dt, self._session)
            for _ in self._welcomes(apart):
                pass
        raise ConnectionError(f"{self.url}: no device answers; {self._hint.format(url=self.url)}")

    def _welcomes(self, seconds: float) -> Iterator[int]:
        """Yield the state flags of each welcome that comes within ``seconds``."""
        handle, end = self.handle, time.monotonic() + seconds
        frame, own = handle.inbox, handle.endpoint
        while (left := end - time.monotonic()) > 0.0:
            wire.wait_for_frame(handle.transport, round(1e9 * left))
            while (size := wire.receive(handle.transport, frame)) >= 0:
                if not wire.is_well_formed(frame, size, own.counters):
                    continue
                if not wire.is_own(own, frame, wire.WELCOME):
                    continue
                state, dt = int(frame.words[8]), float(frame.doubles[3])
                if state >> 8 != self._signals_word >> 8:
                    theirs = devices.SignalCounts(
                        max(state >> 8 & 0xFF, 1), max(state >> 16 & 0xFF, 1)
                    )
                    raise ValueError(devices.other_counts(self.url, theirs, self.signal_counts))
                state &= 0xFF
                if state & wire.OTHER_DT:
                    raise ValueError(
                        f"dt = {self.dt!r} s: the device at {self.url} ticks every {dt!r} s; "
                        "both must be the same"
                    )
                yield state

    def _send(self, kind: int, value: float, session: int) -> None:
        out = self.handle.outbox
        wire.write_frame(out, kind, session, 0, 0, time.monotonic_ns(), value, 0)
        wire.send(self.handle.transport, out)

    def _read_within(self, seconds: float) -> float:
        """Return the newest measurement, or the first that comes within ``seconds``.

        If there was no command since the last reading, the device must be asked for one.
        """
        self._check_open()
        handle, clock = self.handle, self._clock
        if not self._compiled:  # this may take seconds and must not count as waiting
            self._compiled = True
            specialised(_read, handle, clock, 0)
            specialised(_write, handle, np.zeros(handle.queue.used_u.size))
        read = specialised(_read, handle, clock, 0)
        numbers, counters = handle.endpoint.numbers, handle.endpoint.counters
        unanswered, self._answered = self._answered == numbers[wire.SENT], numbers[wire.SENT]
        accepted, begin = counters[wire.ACCEPTED], time.monotonic_ns()
        soon = min(seconds, _SPEAKS_WITHIN * self.dt) if unanswered else seconds
        y = float(read(handle, clock, begin + round(1e9 * soon))[0])
        if counters[wire.ACCEPTED] > accepted or soon == seconds:
            return y
        devices.ask(handle)
        return float(read(handle, clock, begin + round(1e9 * seconds))[0])

    def _check_open(self) -> None:
        if not self._open:
            raise ValueError(f"{self.url}: is closed; make a new device")


def _new_session() -> int:
    return secrets.randbelow((1 << 32) - 1) + 1
