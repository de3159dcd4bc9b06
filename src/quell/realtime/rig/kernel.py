"""The device's side of a wire: a simulated plant with a clock, a watchdog and sessions.

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

Measurements are sent only as long as the other side asks for them, so that nobody can direct an
endless stream to an address: a hello is worth ``HELLO_WORTH`` measurements, an accepted command
those of the watchdog's time and ``LAST_WORDS`` more, which report that it has tripped. After that
the rig is silent until the next hello or command.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import compiled, is_finite, kernel
from quell.plants.base import advance, measure
from quell.plants.destroyed import is_destroyed
from quell.realtime.system.atomics import load_acquire
from quell.realtime.system.clock import now, wait_until
from quell.realtime.system.histogram import count_duration
from quell.realtime.telemetry.ring import Ring, push
from quell.realtime.wire import frames
from quell.realtime.wire.frames import Buffer, Endpoint
from quell.realtime.wire.transport import (
    MOST_AT_ONCE,
    connect_to_sender,
    is_from_other_side,
    receive,
    reply,
    send,
    wait_for_frame,
)
from quell.types import Vector

IDLE, WAITING, LIVE, TRIPPED = range(4)
STATES = ("idle", "waiting", "live", "tripped")

# Longest wait before ``stop`` is checked again [ns]: 0.1 s, short for a person. Chosen by hand.
_CHECK_STOP_EVERY = 100_000_000

HELLO_WORTH = 2
"""Measurements for a hello. With the welcome it is answered by three times its bytes at most, the
limit of RFC 9000 (QUIC), section 8.1, for an address that has not proved that it receives."""
# Measurements after the watchdog has tripped, if no command comes any more: one of ten arrives even
# over a bad wire. Chosen by hand.
LAST_WORDS = 10

# Entries of ``RigModel.counts``: state, ticks without a fresh command, all ticks, ticks since the
# plant was at rest, sessions, refused hellos, trips of the watchdog, clipped commands, late ticks,
# destroyed states that were put back to rest, measurements that the other side has asked for.
STATE, SILENT, TICKS, SINCE_REST, SESSIONS, REFUSED, TRIPS, CLIPPED, CAUGHT_UP = range(9)
RESTORED, ASKED = 9, 10
COUNTS = 11
# Entries of ``RigModel.signals``: u applied, newest command of this tick, largest |command| so far.
APPLIED, COMMANDED, LARGEST = range(3)

LOG = ("tick", "t", "session", "state", "y", "u", "command")
"""Columns of the log: number of the tick and its time [s], session, state (0 idle … 3 tripped), y,
u as applied, and the command that came in this tick, NaN if none has."""


class RigModel(NamedTuple):
    """Parameters and state of the rig."""

    plant: Any
    transport: Any
    endpoint: Endpoint
    inbox: Buffer
    outbox: Buffer
    dt: float  # time between ticks [s]
    u_max: float  # largest |u| that is applied [u-unit]
    watchdog: int  # ticks without a fresh command before u is set to zero
    patience: int  # ticks that a session has for its first command before another may replace it
    wait: int  # how long a tick waits for the answer to the measurement before it [ns]
    rest: bool  # whether each session starts from ``x0``, and not only after a destroyed state
    x: Vector
    x0: Vector
    scratch: Vector
    w: Vector
    counts: NDArray[np.int64]
    signals: Vector
    row: Vector
    log: Ring
    logged: bool
    lateness: NDArray[np.int64]  # histogram of how late ticks were, see ``system.histogram``
    stop: NDArray[np.int64]  # ``serve`` ends if this is not zero (1,)


@kernel
def tick(rig: RigModel, time: int, fresh: bool) -> None:
    """Perform one tick; the rig's clock shows ``time`` [ns].

    ``fresh`` says whether a fresh command has been received since the last tick already.
    """
    counts, signals = rig.counts, rig.signals
    fresh |= _receive_command(rig, time)
    _update_watchdog(rig, fresh)
    y = measure(rig.plant, rig.x)
    if counts[STATE] != IDLE and counts[ASKED] > 0:
        counts[ASKED] -= 1
        state = frames.WATCHDOG_TRIPPED if counts[STATE] == TRIPPED else 0
        frames.write_next_frame(rig.outbox, rig.endpoint, frames.MEASUREMENT, time, y, state)
        if send(rig.transport, rig.outbox) != 0:
            rig.endpoint.counters[frames.NOT_SENT] += 1
    if rig.logged:
        _log(rig, y)
    signals[COMMANDED] = np.nan
    advance(rig.plant, rig.x, rig.scratch, counts[SINCE_REST] * rig.dt, signals[APPLIED], rig.w)
    counts[SINCE_REST] += 1
    counts[TICKS] += 1


@kernel
def _receive_command(rig: RigModel, time: int) -> bool:
    """Read all frames that have come; return whether a fresh, finite command was among them."""
    own, frame, signals = rig.endpoint, rig.inbox, rig.signals
    u, accepted = 0.0, 0
    for _ in range(MOST_AT_ONCE):
        size = receive(rig.transport, frame)
        if size < 0:
            break
        if not frames.is_well_formed(frame, size, own.counters):
            continue
        kind = frame.bytes[3]
        if kind == frames.HELLO:
            if _answer_hello(rig, time):
                accepted = 0
        elif kind == frames.GOODBYE:
            _end_session(rig)
        elif rig.counts[STATE] == IDLE:
            own.counters[frames.WRONG_SESSION] += 1
        elif _is_foreign(rig):
            own.counters[frames.ADDRESS] += 1
        elif frames.accept(frame, own):
            rig.counts[ASKED] = rig.watchdog + LAST_WORDS
            value = frame.doubles[3]
            if is_finite(value):
                u = value
                accepted += 1
                signals[LARGEST] = max(signals[LARGEST], abs(value))
    if frames.is_backlog(own, accepted) or accepted == 0 or rig.counts[STATE] == IDLE:
        return False
    signals[COMMANDED] = u
    if rig.counts[STATE] != TRIPPED:
        signals[APPLIED] = min(max(u, -rig.u_max), rig.u_max)
        if abs(u) > rig.u_max:
            rig.counts[CLIPPED] += 1
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
        rig.signals[APPLIED] = 0.0


@kernel
def _answer_hello(rig: RigModel, time: int) -> bool:
    """Answer a hello; return whether it begins a session."""
    counts, own = rig.counts, rig.endpoint
    session, dt = int(rig.inbox.words[1]), rig.inbox.doubles[3]
    known = session == own.numbers[frames.SESSION]
    state, begins = 0, False
    if session == 0 or (known and (counts[STATE] == IDLE or counts[STATE] == TRIPPED)):
        own.counters[frames.WRONG_SESSION] += 1  # a session that has ended can't begin again
        return False
    if _is_foreign(rig):
        own.counters[frames.ADDRESS] += 1
        return False
    if not known:
        if not abs(dt - rig.dt) <= 1e-9 * rig.dt:  # a tolerance for rounding; also refuses NaN
            state = frames.OTHER_DT
        elif counts[STATE] == LIVE or (counts[STATE] == WAITING and counts[SILENT] < rig.patience):
            state = frames.BUSY
        else:
            begins = True
    if begins:
        frames.start_session(own, session)
        connect_to_sender(rig.transport)
        counts[STATE] = WAITING
        counts[SILENT] = counts[ASKED] = 0
        counts[SESSIONS] += 1
        rig.signals[APPLIED] = 0.0
        destroyed = is_destroyed(rig.x, rig.x0)
        counts[RESTORED] += 1 if destroyed else 0
        if rig.rest or destroyed:
            counts[SINCE_REST] = 0
            for i in range(rig.x.size):
                rig.x[i] = rig.x0[i]
    elif state != 0:
        counts[REFUSED] += 1
    if state == 0:
        counts[ASKED] = max(counts[ASKED], HELLO_WORTH)
    frames.write_frame(rig.outbox, frames.WELCOME, session, 0, 0, time, rig.dt, state)
    reply(rig.transport, rig.outbox)
    return begins


@kernel
def _end_session(rig: RigModel) -> None:
    """End the session if the goodbye received belongs to it."""
    own = rig.endpoint
    if rig.counts[STATE] == IDLE or int(rig.inbox.words[1]) != own.numbers[frames.SESSION]:
        own.counters[frames.WRONG_SESSION] += 1
    elif _is_foreign(rig):
        own.counters[frames.ADDRESS] += 1
    else:
        rig.counts[STATE] = IDLE


@kernel
def _is_foreign(rig: RigModel) -> bool:
    """Return whether the frame has the session's number but not its address."""
    known = int(rig.inbox.words[1]) == rig.endpoint.numbers[frames.SESSION]
    return known and not is_from_other_side(rig.transport)


@kernel
def _log(rig: RigModel, y: float) -> None:
    """Write the tick's row to the log."""
    counts, row = rig.counts, rig.row
    row[0] = counts[TICKS]
    row[1] = counts[TICKS] * rig.dt
    row[2] = rig.endpoint.numbers[frames.SESSION]
    row[3] = counts[STATE]
    row[4] = y
    row[5] = rig.signals[APPLIED]
    row[6] = rig.signals[COMMANDED]
    push(rig.log, row)


@compiled
def serve(rig: RigModel, clock: Any, most: int, paced: bool) -> None:
    """Tick until ``rig.stop`` is set, or ``most`` times if it is not negative.

    If ``paced``, there is one tick each dt; otherwise they follow each other at once.
    """
    begin = now(clock)
    period = 1e9 * rig.dt
    k = 0
    while k != most and load_acquire(rig.stop, 0) == 0:
        time = begin
        if paced:
            deadline = begin + int(np.rint(k * period))
            time = now(clock)
            while deadline - time > _CHECK_STOP_EVERY and load_acquire(rig.stop, 0) == 0:
                time = wait_until(clock, time + _CHECK_STOP_EVERY)
            if load_acquire(rig.stop, 0) != 0:
                break
            time = wait_until(clock, deadline)
            late = time - deadline
            count_duration(rig.lateness, late)
            if late > period:
                rig.counts[CAUGHT_UP] += 1
        fresh = False
        if rig.wait > 0:
            fresh, waited = _await_answer(rig, clock)
            begin += waited
        tick(rig, time, fresh)
        k += 1


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
        and frames.ahead_of(own.numbers[frames.ANSWERED], own.numbers[frames.SENT]) != 0
        and waited < rig.wait
        and load_acquire(rig.stop, 0) == 0
    ):
        wait_for_frame(rig.transport, min(rig.wait - waited, _CHECK_STOP_EVERY))
        waited = now(clock) - begin
        fresh |= _receive_command(rig, begin + waited)
    return fresh, waited
