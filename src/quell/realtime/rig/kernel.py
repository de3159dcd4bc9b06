"""The device's side of the wire: a simulated plant with a clock of its own, a watchdog and one session at a time.

At each tick k the rig

1. takes what has come since the last tick: the newest valid command is the u from now on;
2. samples y_k and sends it;
3. applies u over ``[t_k, t_k + dt]``.

So a u that answers y_k acts from the tick k + 1 on: one sample late, as ``quell.plants.delayed(plant, dt, dt)`` has it. Ticks that the rig
slept over are caught up, none is skipped: where the plant goes depends on nothing but which command was there at which tick.

=========  ===========================================================================================================================
state      what it means
=========  ===========================================================================================================================
idle       no session: u = 0, nothing is sent
waiting    a hello was answered: measurements are sent, u = 0 until the first command
live       u is the last command
tripped    for ``watchdog`` ticks in a row no fresh, finite command has come: u = 0 until a new session, whatever comes
=========  ===========================================================================================================================

A hello begins a session, where none is live, nor has been waiting for less than ``patience`` ticks; a goodbye ends it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.kernels.dispatch import compiled, is_finite, kernel
from quell.plants.base import advance, measure
from quell.realtime.system.atomics import load_acquire
from quell.realtime.system.clock import now, wait_until
from quell.realtime.system.histogram import count_duration
from quell.realtime.telemetry.ring import Ring, push
from quell.realtime.wire import frames
from quell.realtime.wire.frames import Buffer, Endpoint
from quell.realtime.wire.transport import connect_to_sender, receive, reply, send
from quell.realtime.wire.wire import MOST_AT_ONCE
from quell.types import Vector

IDLE, WAITING, LIVE, TRIPPED = range(4)
STATES = ("idle", "waiting", "live", "tripped")

# In long ticks it looks so often whether it is to end [ns].
_LOOK = 100_000_000

# Entries of ``RigModel.counts``: state, ticks without a fresh command, ticks in all, ticks since the plant was at rest, and how often what.
STATE, SILENT, TICKS, SINCE_REST, SESSIONS, REFUSED, TRIPS, CLIPPED, CAUGHT_UP = range(9)
# Entries of ``RigModel.signals``: u applied, the newest command of this tick, the largest |command| of all.
APPLIED, COMMANDED, LARGEST = range(3)

LOG = ("tick", "t", "session", "state", "y", "u", "command")
"""What a row of the log has: number of the tick and its time [s], session, state (0 idle … 3 tripped), y, u as applied, and the command
that came in this tick, NaN where none has."""


class RigModel(NamedTuple):
    """All that a tick needs."""

    plant: Any
    transport: Any
    endpoint: Endpoint
    inbox: Buffer
    outbox: Buffer
    dt: float
    """[s]."""
    u_max: float
    """Largest |u| that is applied [u-unit]."""
    watchdog: int
    """Ticks."""
    patience: int
    """Ticks that a session has for its first command before another may take its place."""
    rest: bool
    """Whether each session starts from ``x0``."""
    x: Vector
    x0: Vector
    scratch: Vector
    w: Vector
    counts: NDArray[np.int64]
    signals: Vector
    row: Vector
    log: Ring
    logged: bool
    lateness: NDArray[np.int64]
    """A ``tally``: how late ticks were."""
    stop: NDArray[np.int64]
    """Not zero: ``serve`` is to end (1,)."""


@kernel
def tick(rig: RigModel, time: int) -> None:
    """Let one tick pass; the rig's clock shows ``time`` [ns]."""
    counts, signals = rig.counts, rig.signals
    signals[COMMANDED] = np.nan
    fresh = _hear(rig, time)
    _watch(rig, fresh)
    y = measure(rig.plant, rig.x)
    if counts[STATE] != IDLE:
        state = frames.WATCHDOG_TRIPPED if counts[STATE] == TRIPPED else 0
        frames.write_next_frame(rig.outbox, rig.endpoint, frames.MEASUREMENT, time, y, state)
        if send(rig.transport, rig.outbox) != 0:
            rig.endpoint.counters[frames.NOT_SENT] += 1
    if rig.logged:
        _note(rig, y)
    advance(rig.plant, rig.x, rig.scratch, counts[SINCE_REST] * rig.dt, signals[APPLIED], rig.w)
    counts[SINCE_REST] += 1
    counts[TICKS] += 1


@kernel
def _hear(rig: RigModel, time: int) -> bool:
    """Take what has come; tell whether a fresh, finite command was in it."""
    counters, frame = rig.endpoint.counters, rig.inbox
    u, news = 0.0, 0
    for _ in range(MOST_AT_ONCE):
        size = receive(rig.transport, frame)
        if size < 0:
            break
        if not frames.is_well_formed(frame, size, counters):
            continue
        kind = frame.bytes[3]
        if kind == frames.HELLO:
            if _greet(rig, time):
                news = 0
        elif kind == frames.GOODBYE:
            _part(rig)
        elif rig.counts[STATE] == IDLE:
            counters[frames.WRONG_SESSION] += 1
        elif frames.accept_well_formed(frame, rig.endpoint):
            value = frame.doubles[3]
            if is_finite(value):
                u = value
                news += 1
                rig.signals[LARGEST] = max(rig.signals[LARGEST], abs(value))
    if news > 1:
        counters[frames.SKIPPED] += news - 1
    if (
        news > rig.endpoint.most_age
    ):  # they may have waited in a queue that was full: the newest of them need not be new
        counters[frames.STALE] += 1
        return False
    if news == 0 or rig.counts[STATE] == IDLE:
        return False
    rig.signals[COMMANDED] = u
    if rig.counts[STATE] != TRIPPED:
        rig.signals[APPLIED] = min(max(u, -rig.u_max), rig.u_max)
        if abs(u) > rig.u_max:
            rig.counts[CLIPPED] += 1
    return True


@kernel
def _watch(rig: RigModel, fresh: bool) -> None:
    """Let the watchdog look at this tick."""
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
def _greet(rig: RigModel, time: int) -> bool:
    """Answer a hello; tell whether a session begins with it."""
    counts, own = rig.counts, rig.endpoint
    session, dt = int(rig.inbox.words[1]), rig.inbox.doubles[3]
    known = session == own.numbers[frames.SESSION]
    state, begins = 0, False
    if session == 0 or (known and (counts[STATE] == IDLE or counts[STATE] == TRIPPED)):
        own.counters[frames.WRONG_SESSION] += 1  # a session that is over does not come back
        return False
    if not known:
        if not abs(dt - rig.dt) <= 1e-9 * rig.dt:
            state = frames.OTHER_DT
        elif counts[STATE] == LIVE or (counts[STATE] == WAITING and counts[SILENT] < rig.patience):
            state = frames.BUSY
        else:
            begins = True
    if begins:
        frames.start_session(own, session)
        connect_to_sender(rig.transport)
        counts[STATE] = WAITING
        counts[SILENT] = 0
        counts[SESSIONS] += 1
        rig.signals[APPLIED] = 0.0
        if rig.rest:
            counts[SINCE_REST] = 0
            for i in range(rig.x.size):
                rig.x[i] = rig.x0[i]
    elif state != 0:
        counts[REFUSED] += 1
    frames.write_frame(rig.outbox, frames.WELCOME, session, 0, 0, time, rig.dt, state)
    reply(rig.transport, rig.outbox)
    return begins


@kernel
def _part(rig: RigModel) -> None:
    """Hear a goodbye."""
    if (
        rig.counts[STATE] != IDLE
        and int(rig.inbox.words[1]) == rig.endpoint.numbers[frames.SESSION]
    ):
        rig.counts[STATE] = IDLE
    else:
        rig.endpoint.counters[frames.WRONG_SESSION] += 1


@kernel
def _note(rig: RigModel, y: float) -> None:
    """Write the tick's row into the log."""
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
    """Let a tick pass every dt until ``rig.stop`` says so, or ``most`` have (all, where it is below zero); where not ``paced``, at once."""
    begin = now(clock)
    period = 1e9 * rig.dt
    k = 0
    while k != most and load_acquire(rig.stop, 0) == 0:
        time = begin
        if paced:
            deadline = begin + int(np.rint(k * period))
            time = now(clock)
            while deadline - time > _LOOK and load_acquire(rig.stop, 0) == 0:
                time = wait_until(clock, time + _LOOK)
            if load_acquire(rig.stop, 0) != 0:
                break
            time = wait_until(clock, deadline)
            late = time - deadline
            count_duration(rig.lateness, late)
            if late > period:
                rig.counts[CAUGHT_UP] += 1
        tick(rig, time)
        k += 1
