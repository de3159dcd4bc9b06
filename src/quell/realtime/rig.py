"""The rig: a simulated plant at the other end of a wire.

The device's side of a wire: a simulated plant with a clock, a watchdog and sessions.

At each tick k the rig

1. reads what has come since the last tick: the newest valid command is u from now on;
2. samples y_k and sends it;
3. applies u over ``[t_k, t_k + dt]``.

So a u that answers y_k acts from the tick k + 1 on: one sample late, as in
``quell.plants.delayed(plant, dt, dt)``. If the rig is late, it makes up for the missed ticks and
skips none: the motion of the plant depends only on the command at each tick.

=======  ========================================================================================
state    meaning
=======  ========================================================================================
idle     no session: u = 0, nothing is sent
waiting  a hello was answered: measurements are sent, u = 0 until the first command
live     u is the last command
tripped  no fresh, finite command for ``watchdog`` ticks in a row: u = 0 until a new session
=======  ========================================================================================

A simulated plant need not move on while the loop is late: with ``wait`` a tick waits for the
command that answers the measurement before it, and the rig's clock stands still meanwhile.

A hello begins a session, unless one is live or waits for less than ``patience`` ticks. A goodbye
ends it. A session begins at ``x0`` if ``rest``, or if the last one destroyed the plant's state: no
motion can go on from there.

Commands, goodbyes and repeated hellos of a session are accepted only from the address that
opened it.

A plant of several signals sends all its measurements in one frame, and takes all control signals of
one: if one of them is not finite, none is applied. A hello for another number of signals is
refused.

Measurements are sent only as long as the other side asks for them, so that nobody can direct an
endless stream to an address: a hello is worth ``HELLO_WORTH`` measurements, an accepted command
those of the watchdog's time and ``LAST_WORDS`` more, which report that it has tripped. After that
the rig is silent until the next hello or command.

The rig: it listens at a wire, ticks on its own thread, writes its log and counts events.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quell import checks
from quell.files import GrowingFile, check_writable
from quell.kernels.dispatch import call_specialised, compiled, generic_with_default, kernel
from quell.plants.base import Plant, advance, as_input, check_plant, is_destroyed, measure_all
from quell.realtime import system, wire
from quell.realtime.devices import Listener, counts_of
from quell.realtime.system import count_duration, load_acquire, now, wait_until
from quell.realtime.telemetry import Ring, drain, dropped, push, ring
from quell.realtime.wire import (
    MOST_AT_ONCE,
    Buffer,
    Endpoint,
    connect_to_sender,
    is_from_other_side,
    receive,
    reply,
    send,
    wait_for_frame,
)
from quell.types import Matrix, Vector

# ---- The device's side of a wire ----

IDLE, WAITING, LIVE, TRIPPED = range(4)
STATES = ("idle", "waiting", "live", "tripped")

# Longest wait before ``stop`` is checked again [ns]: 0.1 s, short for a person. Chosen by hand.
_CHECK_STOP_EVERY = 100_000_000

WATCHDOG = 20
"""Ticks without a command after which u is zero, by default."""
HELLO_WORTH = 2
"""Measurements for a hello. With the welcome it is answered by three times its bytes at most, the
limit of RFC 9000 (QUIC), section 8.1, for an address that has not proved that it receives."""
# Measurements after the watchdog has tripped, if no command comes any more: one of ten arrives even
# over a bad wire. Chosen by hand.
LAST_WORDS = 10

# Entries of ``RigModel.counts``: state, ticks without a fresh command, all ticks, ticks since the
# plant was at rest, sessions, refused hellos, trips of the watchdog, clipped commands, late ticks,
# destroyed states that were put back to rest, measurements that the other side has asked for, the
# next channel in turn, and 0, or for a tick that is late by more than one 1, or 2 if the one before
# was less late.
STATE, SILENT, TICKS, SINCE_REST, SESSIONS, REFUSED, TRIPS, CLIPPED, CAUGHT_UP = range(9)
RESTORED, ASKED, TURN, BEHIND = 9, 10, 11, 12
COUNTS = 13
# Rows of ``RigModel.signals``: u applied, newest command of this tick, largest |command| so far.
APPLIED, COMMANDED, LARGEST = range(3)

LOG = ("tick", "t", "session", "state", "y", "u", "command")
"""Columns of the log: number of the tick and its time [s], session, state (0 idle … 3 tripped), y,
u as applied, and the command that came in this tick, NaN if none has. A plant of several signals
has ``y[0]``, ``y[1]`` and so on."""


def log_columns(outputs: int, inputs: int) -> tuple[str, ...]:
    """Return the columns of the log of a plant with so many signals."""
    if outputs == inputs == 1:
        return LOG
    counts = {"y": outputs, "u": inputs, "command": inputs}
    return (*LOG[:4], *(f"{name}[{i}]" for name, count in counts.items() for i in range(count)))


@generic_with_default
def measure_channels(plant: Any, x: Vector, values: Vector) -> None:
    """Write what a plant gives beside y into ``values``; by default they stay as they are."""


@generic_with_default
def has_ended(plant: Any) -> bool:
    """Return whether a plant that is a machine is at rest for good; the rig then ends."""
    return False


@generic_with_default
def may_end(plant: Any, stop: int) -> bool:
    """Return whether the rig may end; a machine is brought to rest first, and ends the rig then.

    ``stop`` says how often ``Rig.stop`` was called.
    """
    return True


@generic_with_default
def tell_host(plant: Any, counts: NDArray[np.int64], session: int) -> None:
    """Tell a plant that is a machine the state of its host's session (``RigModel.counts``)."""


@generic_with_default
def fill_log(plant: Any, row: Vector) -> None:
    """Write what a plant adds to a row of the log: the columns that it has as ``log_columns``."""


class RigModel(NamedTuple):
    """Parameters and state of the rig."""

    plant: Any
    transport: Any
    endpoint: Endpoint
    inbox: Buffer
    outbox: Buffer
    dt: float  # time between ticks [s]
    u_max: Vector  # largest |u| that is applied [u-unit] (m,)
    watchdog: int  # ticks without a fresh command before u is set to zero
    patience: int  # ticks that a session has for its first command before another may replace it
    wait: int  # how long a tick waits for the answer to the measurement before it [ns]
    rest: bool  # whether each session starts from ``x0``, and not only after a destroyed state
    x: Vector
    x0: Vector
    scratch: Vector
    w: Vector
    counts: NDArray[np.int64]
    y: Vector  # of this tick (p,)
    received: Vector  # work array: a command (m,)
    signals: Matrix  # (3, m)
    channels: Vector  # what is sent beside y (c,)
    row: Vector
    log: Ring
    logged: bool
    lateness: NDArray[np.int64]  # histogram of how late ticks were, see ``system.histogram``
    stop: NDArray[np.int64]  # how often ``Rig.stop`` was called, which ends ``serve`` (1,)


@kernel
def tick(rig: RigModel, time: int, fresh: bool) -> None:
    """Perform one tick; the rig's clock shows ``time`` [ns].

    ``fresh`` says whether a fresh command has been received since the last tick already.
    """
    counts, signals = rig.counts, rig.signals
    fresh |= _receive_command(rig, time)
    _update_watchdog(rig, fresh)
    tell_host(rig.plant, counts, rig.endpoint.numbers[wire.SESSION])
    measure_all(rig.plant, rig.x, rig.y)
    measure_channels(rig.plant, rig.x, rig.channels)
    if counts[STATE] != IDLE and counts[ASKED] > 0:
        counts[ASKED] -= 1
        _send_channels(rig, time)
        state = wire.WATCHDOG_TRIPPED if counts[STATE] == TRIPPED else 0
        wire.write_next_numbers(rig.outbox, rig.endpoint, wire.MEASUREMENT, time, rig.y, state)
        if send(rig.transport, rig.outbox) != 0:
            rig.endpoint.counters[wire.NOT_SENT] += 1
    t, u = counts[SINCE_REST] * rig.dt, signals[APPLIED]
    advance(rig.plant, rig.x, rig.scratch, t, as_input(rig.plant, u), rig.w)
    if rig.logged:
        _log(rig)
    for k in range(signals.shape[1]):
        signals[COMMANDED, k] = np.nan
    counts[SINCE_REST] += 1
    counts[TICKS] += 1


@kernel
def _send_channels(rig: RigModel, time: int) -> None:
    """Send the channels of this tick before its measurement.

    Before the first command the next one in turn takes the place of a measurement: an address that
    has not proved that it receives gets no more frames than without channels.
    """
    counts, own = rig.counts, rig.endpoint
    first, last = 0, rig.channels.size
    if counts[STATE] == WAITING and last > 0:
        if counts[ASKED] == 0:
            return
        counts[ASKED] -= 1
        first = counts[TURN] % last
        last = first + 1
        counts[TURN] += 1
    for i in range(first, last):
        session, number = own.numbers[wire.SESSION], own.numbers[wire.SENT] + 1
        answers, value = own.numbers[wire.RECEIVED], rig.channels[i]
        wire.write_frame(rig.outbox, wire.TELEMETRY, session, number, answers, time, value, i)
        if send(rig.transport, rig.outbox) != 0:
            own.counters[wire.NOT_SENT] += 1


@kernel
def _receive_command(rig: RigModel, time: int) -> bool:
    """Read all frames that have come; return whether a fresh, finite command was among them."""
    own, frame, signals, u = rig.endpoint, rig.inbox, rig.signals, rig.received
    accepted = 0
    for _ in range(MOST_AT_ONCE):
        size = receive(rig.transport, frame)
        if size < 0:
            break
        if not wire.is_well_formed(frame, size, own.counters):
            continue
        kind = frame.bytes[3]
        if kind == wire.HELLO:
            if _answer_hello(rig, time, size):
                accepted = 0
        elif kind == wire.GOODBYE:
            _end_session(rig)
        elif rig.counts[STATE] == IDLE:
            own.counters[wire.WRONG_SESSION] += 1
        elif _is_foreign(rig):
            own.counters[wire.ADDRESS] += 1
        elif wire.accept(frame, own):
            rig.counts[ASKED] = rig.watchdog + LAST_WORDS
            if wire.are_finite(frame, own.signals):
                accepted += 1
                for k in range(own.signals):
                    u[k] = frame.doubles[3 + k]
                    signals[LARGEST, k] = max(signals[LARGEST, k], abs(u[k]))
    if wire.is_backlog(own, accepted) or accepted == 0 or rig.counts[STATE] == IDLE:
        return False
    clipped = False
    for k in range(own.signals):
        signals[COMMANDED, k] = u[k]
        if rig.counts[STATE] != TRIPPED:
            signals[APPLIED, k] = min(max(u[k], -rig.u_max[k]), rig.u_max[k])
            clipped |= abs(u[k]) > rig.u_max[k]
    rig.counts[CLIPPED] += 1 if clipped else 0
    return True


@kernel
def _update_watchdog(rig: RigModel, fresh: bool) -> None:
    counts = rig.counts
    if counts[STATE] == WAITING and fresh:
        counts[STATE] = LIVE
    counts[SILENT] = 0 if fresh else counts[SILENT] + 1
    if counts[STATE] == LIVE and counts[SILENT] >= rig.watchdog:
        counts[STATE] = TRIPPED
        counts[TRIPS] += 1
    if counts[STATE] != LIVE:
        _apply_zero(rig)


@kernel
def _apply_zero(rig: RigModel) -> None:
    for k in range(rig.signals.shape[1]):
        rig.signals[APPLIED, k] = 0.0


@kernel
def _answer_hello(rig: RigModel, time: int, size: int) -> bool:
    """Answer a hello of so many bytes; return whether it begins a session."""
    counts, own = rig.counts, rig.endpoint
    outputs = rig.y.size
    word = wire.signals_word(outputs, own.signals)
    fits = size == wire.LENGTH + 8 * (outputs - 1) and int(rig.inbox.words[size // 4 - 2]) == word
    session, dt = int(rig.inbox.words[1]), rig.inbox.doubles[3]
    known = session == own.numbers[wire.SESSION]
    state, begins = 0, False
    if session == 0 or (known and (counts[STATE] == IDLE or counts[STATE] == TRIPPED)):
        own.counters[wire.WRONG_SESSION] += 1  # a session that has ended can't begin again
        return False
    if _is_foreign(rig):
        own.counters[wire.ADDRESS] += 1
        return False
    if not known:
        if not fits:
            state = wire.OTHER_SIGNALS
        elif not abs(dt - rig.dt) <= 1e-9 * rig.dt:  # a tolerance for rounding; also refuses NaN
            state = wire.OTHER_DT
        elif counts[STATE] == LIVE or (counts[STATE] == WAITING and counts[SILENT] < rig.patience):
            state = wire.BUSY
        else:
            begins = True
    if begins:
        wire.start_session(own, session)
        connect_to_sender(rig.transport)
        counts[STATE] = WAITING
        counts[SILENT] = counts[ASKED] = 0
        counts[SESSIONS] += 1
        _apply_zero(rig)
        destroyed = is_destroyed(rig.x, rig.x0)
        counts[RESTORED] += 1 if destroyed else 0
        if rig.rest or destroyed:
            counts[SINCE_REST] = 0
            for i in range(rig.x.size):
                rig.x[i] = rig.x0[i]
    elif state != 0:
        counts[REFUSED] += 1
    if state == 0 and fits:
        counts[ASKED] = max(counts[ASKED], HELLO_WORTH)
    wire.write_frame(rig.outbox, wire.WELCOME, session, 0, 0, time, rig.dt, state | word)
    reply(rig.transport, rig.outbox)
    return begins


@kernel
def _end_session(rig: RigModel) -> None:
    """End the session if the goodbye received belongs to it."""
    own = rig.endpoint
    if rig.counts[STATE] == IDLE or int(rig.inbox.words[1]) != own.numbers[wire.SESSION]:
        own.counters[wire.WRONG_SESSION] += 1
    elif _is_foreign(rig):
        own.counters[wire.ADDRESS] += 1
    else:
        rig.counts[STATE] = IDLE


@kernel
def _is_foreign(rig: RigModel) -> bool:
    """Return whether the frame has the session's number but not its address."""
    known = int(rig.inbox.words[1]) == rig.endpoint.numbers[wire.SESSION]
    return known and not is_from_other_side(rig.transport)


@kernel
def _log(rig: RigModel) -> None:
    """Write the tick's row to the log."""
    counts, row, signals = rig.counts, rig.row, rig.signals
    outputs, inputs = rig.y.size, signals.shape[1]
    row[0] = counts[TICKS]
    row[1] = counts[TICKS] * rig.dt
    row[2] = rig.endpoint.numbers[wire.SESSION]
    row[3] = counts[STATE]
    for i in range(outputs):
        row[4 + i] = rig.y[i]
    for k in range(inputs):
        row[4 + outputs + k] = signals[APPLIED, k]
        row[4 + outputs + inputs + k] = signals[COMMANDED, k]
    fill_log(rig.plant, row[4 + outputs + 2 * inputs :])
    push(rig.log, row)


@compiled
def serve(rig: RigModel, clock: Any, most: int, paced: bool) -> bool:
    """Tick until ``rig.stop`` is set, or ``most`` times if it is not negative.

    Return whether the plant has ended; then there is no further tick. If ``paced``, there is one
    tick each dt; otherwise they follow each other at once.
    """
    begin = now(clock)
    period = 1e9 * rig.dt
    k = before = 0
    while True:
        over = (most >= 0 and k >= most) or load_acquire(rig.stop, 0) != 0
        if over and (not paced or may_end(rig.plant, load_acquire(rig.stop, 0))):
            break
        time = begin
        if paced:
            deadline = begin + int(np.rint(k * period))
            time = now(clock)
            while deadline - time > _CHECK_STOP_EVERY and (over or load_acquire(rig.stop, 0) == 0):
                time = wait_until(clock, time + _CHECK_STOP_EVERY)
            if not over and load_acquire(rig.stop, 0) != 0:
                continue
            time = wait_until(clock, deadline)
            late = time - deadline
            count_duration(rig.lateness, late)
            rig.counts[BEHIND] = 0
            if late > period:
                rig.counts[BEHIND] = 2 if late > before else 1
                rig.counts[CAUGHT_UP] += 1
            before = late
        fresh = False
        if rig.wait > 0:
            fresh, waited = _await_answer(rig, clock)
            begin += waited
        tick(rig, time, fresh)
        k += 1
        if has_ended(rig.plant):
            return True
    return False


@kernel
def _await_answer(rig: RigModel, clock: Any) -> tuple[bool, int]:
    """Wait for the command that answers the last measurement, for ``rig.wait`` [ns] at most.

    Return whether a fresh command has come, and how long it took [ns].
    """
    own = rig.endpoint
    begin = now(clock)
    fresh = _receive_command(rig, begin)
    waited = 0
    while (
        rig.counts[STATE] == LIVE
        and wire.ahead_of(own.numbers[wire.ANSWERED], own.numbers[wire.SENT]) != 0
        and waited < rig.wait
        and load_acquire(rig.stop, 0) == 0
    ):
        wait_for_frame(rig.transport, min(rig.wait - waited, _CHECK_STOP_EVERY))
        waited = now(clock) - begin
        fresh |= _receive_command(rig, begin + waited)
    return fresh, waited


# ---- The rig ----

# Time between two writes to the log [s]; time that its buffer holds [s], and least rows. By hand.
_WRITE_EVERY = 0.05
_BUFFERED, _LEAST_ROWS = 5.0, 100
# Time that a new session is protected while its first command is missing [s]: its loop may have to
# be compiled first. Chosen by hand; not tuned further.
_PATIENCE = 60.0
# Range of dt [s] and largest watchdog [ticks]: far beyond any use; they catch typing errors.
_SHORTEST, _LONGEST = 1e-6, 100.0
_MOST_TICKS = 1_000_000
# Longest run [s]: thirty years, so that the number of ticks fits into an integer.
_LONGEST_RUN = 1e9


class Rig:
    """A simulated plant at the end of a wire.

    Parameters
    ----------
    plant
        any compiled plant, of one or of several signals.
    dt
        time between ticks [s].
    listener
        its end of the wire; ``close`` closes it.
    watchdog
        ticks in a row without a fresh, finite command after which u is zero until a new session; 20
        by default, or what a ``CompensatedDrive`` allows its host.
    u_max
        larger commands are cut to it [u-unit]; one for all control signals, or one for each.
    rest
        whether each session starts from ``x0``, or from where the last one left the plant. If that
        state is not finite, or beyond 10⁹, the session starts from ``x0`` in any case.
    wait
        how long a tick waits for the command that answers the measurement before it [s]; the later
        ticks are shifted by that time. A loop that is late then has no effect on the motion.
    x0
        the plant's state at the start (n,); zero by default.
    channels
        numbers that are sent beside y, at most 8, for the loop's schedule for example; the
        attribute ``channels`` is an array whose values may be changed while it runs.
    log
        CSV file for y, u, command and state of each tick (``quell.realtime.rig.LOG``).
    overwrite
        whether a log that exists is replaced; it is refused otherwise.

    Raises
    ------
    ValueError
        for a plant that is not compiled, numbers out of range, or a log that can't be written.
    """

    def __init__(
        self,
        plant: Plant,
        dt: float,
        listener: Listener,
        *,
        watchdog: int | None = None,
        u_max: ArrayLike = np.inf,
        rest: bool = True,
        wait: float = 0.0,
        x0: ArrayLike | None = None,
        channels: ArrayLike = (),
        log: str | Path | None = None,
        overwrite: bool = False,
    ) -> None:
        check_plant(plant)
        dt = checks.positive("dt", dt, "s")
        if not _SHORTEST <= dt <= _LONGEST:
            raise ValueError(f"dt = {dt!r} s: must be from {_SHORTEST:g} to {_LONGEST:g} s")
        if not plant.compiled:
            raise ValueError(
                f"plant = {plant!r}: must be a compiled plant; this one runs only as Python"
            )
        several = counts_of(plant)
        outputs, inputs = several or (1, 1)
        if max(outputs, inputs) > wire.MOST_SIGNALS:
            rule = f"must have at most {wire.MOST_SIGNALS} of each, for a frame of the wire"
            raise ValueError(f"plant: {outputs} outputs and {inputs} control signals; {rule}")
        largest = _checked_limits(u_max, inputs)
        if watchdog is None:
            watchdog = getattr(plant, "watchdog", WATCHDOG)
        watchdog = checks.whole("watchdog", watchdog, 1, _MOST_TICKS)
        start = np.zeros(plant.order) if x0 is None else checks.vector("x0", x0, plant.order)
        rows = max(round(_BUFFERED / dt), _LEAST_ROWS)
        self.channels = _checked_channels(plant, channels)
        self._columns = (*log_columns(outputs, inputs), *getattr(plant, "log_columns", ()))
        model = plant.sampled(dt)
        room = 1 if outputs == inputs == 1 else wire.MOST_SIGNALS
        self.listener = listener
        self.dt, self.signal_counts = dt, several
        if checks.non_negative("wait", wait, "s") > _LONGEST:
            raise ValueError(f"wait = {wait!r} s: must be at most {_LONGEST:g} s")
        self.model = RigModel(
            plant=model,
            transport=listener.transport,
            endpoint=wire.endpoint(wire.COMMAND, 0, watchdog, inputs),
            inbox=wire.buffer(room),
            outbox=wire.buffer(room),
            dt=dt,
            u_max=largest,
            watchdog=watchdog,
            patience=max(round(_PATIENCE / dt), 1),
            wait=round(1e9 * wait),
            rest=checks.flag("rest", rest),
            x=start.copy(),
            x0=start,
            scratch=np.zeros(6 * plant.order),
            w=np.zeros(plant.disturbances),
            counts=np.zeros(COUNTS, dtype=np.int64),
            y=np.zeros(outputs),
            received=np.zeros(inputs),
            signals=np.repeat([[0.0], [np.nan], [0.0]], inputs, axis=1),
            channels=self.channels,
            row=np.zeros(len(self._columns)),
            log=ring(1 if log is None else rows, len(self._columns)),
            logged=log is not None,
            lateness=system.empty_counts(),
            stop=np.zeros(1, dtype=np.int64),
        )
        self._file = None if log is None else _opened(log, overwrite, self._columns)
        self._log_failure, self._lost = "", 0
        self._clock = system.system_clock()
        self._open = True

    @property
    def x(self) -> Vector:
        """The plant's state, as a copy (n,)."""
        return self.model.x.copy()

    @property
    def state(self) -> str:
        """One of idle, waiting, live, tripped."""
        return STATES[self.model.counts[STATE]]

    @property
    def counters(self) -> dict[str, int]:
        """Number of frames by result, see ``quell.realtime.wire``, and of other events."""
        more = {
            "sessions": SESSIONS,
            "refused": REFUSED,
            "watchdog": TRIPS,
            "clipped": CLIPPED,
            "ticks": TICKS,
            "caught_up": CAUGHT_UP,
            "restored": RESTORED,
        }
        return wire.counts_by_name(self.model.endpoint.counters) | {
            name: int(self.model.counts[index]) for name, index in more.items()
        }

    @property
    def largest(self) -> float:
        """Largest ``|command|`` received [u-unit], applied or not, of all control signals."""
        return float(np.max(self.model.signals[LARGEST]))

    @property
    def lateness(self) -> system.Histogram:
        """Lateness of the ticks in ``run`` [s]."""
        return system.Histogram.of(self.model.lateness)

    @property
    def unlogged(self) -> int:
        """Ticks that are missing in the log, which could not be written, or not fast enough."""
        return dropped(self.model.log) + self._lost if self.model.logged else 0

    def tick(self, count: int = 1) -> None:
        """Perform ``count`` ticks at once, without a clock: for tests that go step by step."""
        self._serve(count, False)
        self._write_log()

    def prepare(self) -> None:
        """Compile what ``run`` needs, or load it from the disk."""
        self._serve(0, False)

    def run(
        self,
        seconds: float | None = None,
        *,
        priority: int = 0,
        cpu: int | None = None,
        watch: Callable[[], Any] | None = None,
    ) -> list[str]:
        """Tick in real time for ``seconds``, or until a signal or another thread calls ``stop``.

        Where the plant is a ``CompensatedDrive``, it is brought to rest first, and its end is that
        of the run and of the session. The ticks run on their own thread, which needs no Python; the
        calling thread writes the log. Return sentences about which requests the system has granted.

        Parameters
        ----------
        seconds
            duration [s]; by default until ``stop``.
        priority
            SCHED_FIFO priority of the ticks, 1 to 99, together with locked memory; 0 for neither.
        cpu
            number of the processor for the ticks; any by default.
        watch
            called about twenty times a second, and at the end, in this thread.

        Raises
        ------
        ValueError
            for arguments out of range.
        """
        most = -1
        if seconds is not None:
            most = max(round(checked_seconds("seconds", seconds) / self.dt), 1)
        priority, cpu = system.checked_priority(priority), system.checked_cpu(cpu)
        self.prepare()
        raised: list[BaseException] = []
        with system.real_time_process(priority, False) as notes:

            def work() -> None:
                try:
                    system.enter_real_time(priority, cpu, notes)
                    self._serve(most, True)
                    self._end_session()  # at once: the loop holds u while it waits for measurements
                except BaseException as error:
                    raised.append(error)

            thread = threading.Thread(target=work, name="quell-rig")
            thread.start()
            try:
                while thread.is_alive():
                    thread.join(_WRITE_EVERY)
                    self._write_log()
                    if watch is not None:
                        watch()
            finally:
                self.stop()
                thread.join()
                self._write_log()
        if raised:
            raise raised[0]
        if self._log_failure:
            notes.append(self._log_failure)
        return notes

    def stop(self) -> None:
        """End ``run`` at its next tick; a second call does not wait for a ramp of u."""
        system.store_release(self.model.stop, 0, int(self.model.stop[0]) + 1)

    def close(self) -> None:
        """End the session, if there is one, and release the wire; a second call does nothing."""
        if not self._open:
            return
        self._open = False
        self._end_session()
        self.listener.close()
        if self._file is not None:
            self._write_log()
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _end_session(self) -> None:
        """Send a goodbye if there is a session."""
        model = self.model
        if model.counts[STATE] == IDLE:
            return
        session, now = int(model.endpoint.numbers[wire.SESSION]), time.monotonic_ns()
        wire.write_frame(model.outbox, wire.GOODBYE, session, 0, 0, now, 0.0, wire.GONE)
        send(model.transport, model.outbox)
        model.counts[STATE] = IDLE

    def _serve(self, most: int, paced: bool) -> None:
        if call_specialised(serve, self.model, self._clock, most, paced):
            self._end_session()

    def _write_log(self) -> None:
        if self._file is None:
            return
        rows = drain(self.model.log).tolist()
        lines = self._file.lines
        if not self._file.closed:
            try:
                self._file.add("".join(map(_line, rows)))
            except OSError as error:  # a full disk must not end the loop
                self._log_failure = f"the log was given up: {error.strerror}"
                self._file.close()
        self._lost += len(rows) - (self._file.lines - lines)


def _line(row: list[float]) -> str:
    """Return a row of the log as a line."""
    k, t, session, state, *values = row
    cells = f"{int(k)},{t:.9g},{int(session)},{int(state)}"
    return ",".join((cells, *map(repr, values))) + "\n"


def _checked_channels(plant: Any, channels: ArrayLike) -> Vector:
    """Return the first values of the channels: those given, or as many as the plant has."""
    own = len(getattr(plant, "channels", ()))
    try:
        values = np.full(own, np.nan) if own else np.array(channels, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.zeros((0, 0))
    if values.ndim != 1 or values.size > wire.MOST_CHANNELS:
        rule = f"must be at most {wire.MOST_CHANNELS} numbers"
        raise ValueError(f"channels = {channels!r:.60}: {rule}")
    return values


def _checked_limits(u_max: ArrayLike, inputs: int) -> Vector:
    """Return the largest |u| of each control signal; infinite for no limit."""
    given: Any = u_max
    if isinstance(given, float | int) and given == np.inf:
        return np.full(inputs, np.inf)
    limits = checks.positive_vector("u_max", given)
    if limits.size not in (1, inputs):
        raise ValueError(f"u_max = {given!r:.60}: must be one number, or {inputs}, one for each u")
    return np.full(inputs, limits[0]) if limits.size == 1 else limits


def checked_seconds(name: str, seconds: float) -> float:
    """Return the duration of a run [s], at most thirty years."""
    if checks.positive(name, seconds, "s") > _LONGEST_RUN:
        raise ValueError(f"{name} = {seconds!r}: must be at most {_LONGEST_RUN:g} s, or left out")
    return seconds


def _opened(path: str | Path, overwrite: bool, columns: tuple[str, ...]) -> GrowingFile:
    """Return the open log, with its header written; a device like /dev/null may be one, too."""
    target = Path(path)
    if target.is_file():
        check_writable(target, overwrite)
    try:
        if target.is_file():
            target.unlink()
        new = not target.exists()
        file = GrowingFile(target)
        try:
            file.add(",".join(columns) + "\n")
        except OSError:
            file.close()
            if new:
                target.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise ValueError(f"log = {str(path)!r}: can't be written ({error.strerror})") from None
    return file
