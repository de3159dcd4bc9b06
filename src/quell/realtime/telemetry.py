"""Telemetry: a ring buffer, the thread that empties it, delivery to slow sinks.

The telemetry writer: a thread that takes the loop's rows out of a ring and passes them to sinks.

The loop puts a row into the ring each cycle and never waits. The writer empties the ring some
twenty times a second. Each sink has a thread of its own (``delivery``): one that fails (disk full,
no permission) is closed and reported, one that hangs costs its own rows; the loop and the other
sinks go on.

An interpreted loop shares Python's interpreter with these threads. Therefore they work in bursts of
0.1 ms and sleep in between. On a busy machine a thread of ordinary priority may be suspended for
milliseconds in the middle of a burst, while it holds the interpreter: for such a loop the threads
take the lowest real-time priority (``urgent``).

A ring buffer between the threads of loop and telemetry writer; neither of them waits.

One producer, one consumer, no lock (Lamport, "Specifying Concurrent Program Modules", ACM TOPLAS
5(2), 1983). ``HEAD`` counts the rows written, ``TAIL`` those read; each has one writer. The
producer writes a row and then, as a *release*, the new head; the consumer reads the head as an
*acquire* and finds the row complete. The tail keeps the producer off rows that are still being read
in the same way. If the ring is full, the newest row is dropped and counted.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from threading import Thread
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.kernels.dispatch import call_specialised, compiled, kernel
from quell.kernels.sized import Buffer
from quell.realtime.recordings import Header, Sink
from quell.realtime.system import load_acquire, set_low_priority, store_release
from quell.types import Matrix, Vector

# ---- Delivery of rows to a sink, on a thread of its own, so that a slow sink delays no other ----

_LOG = logging.getLogger(__name__)

# Values per burst: they take CSV about 0.1 ms (benchmarks/telemetry.py), after which the thread
# sleeps as long [s].
_BURST = 100
_PAUSE = 1e-4


class Delivery:
    """The thread of a sink, and the rows that wait for it.

    A sink that fails (disk full, no permission) is closed and reported. One that blocks loses the
    newest rows as soon as ``capacity`` rows wait.

    Parameters
    ----------
    sink
        an open sink.
    capacity
        most rows that wait.
    urgent
        whether the thread takes real-time priority, see ``TelemetryWriter``.
    report
        takes a sentence on what went wrong.
    """

    def __init__(
        self, sink: Sink, capacity: int, urgent: bool, report: Callable[[str], None]
    ) -> None:
        self.sink, self.rows = sink, 0
        self._capacity, self._urgent, self._report = capacity, urgent, report
        self._queue = SimpleQueue[Matrix | None]()
        # Rows put into the queue, and lost: one thread writes them, as another one does ``rows``.
        self._put, self._lost = 0, 0
        self._failed = False
        self._thread = Thread(target=self._run, name=f"quell-{sink.name}", daemon=True)
        self._thread.start()

    @property
    def stored(self) -> int:
        """Number of rows that the sink has, as far as it knows."""
        return int(getattr(self.sink, "stored", self.rows))

    def put(self, rows: Matrix) -> None:
        """Take rows, which may be none, for the next round; never wait."""
        if self._failed or (not rows.size and not self._queue.empty()):
            return
        room = self._capacity - (self._put - self.rows)
        taken = rows[: max(room, 0)]
        self._lost += rows.shape[0] - taken.shape[0]
        self._put += taken.shape[0]
        self._queue.put(taken)

    def end(self) -> None:
        """Begin to end: what was put is still delivered, then the sink is closed."""
        self._queue.put(None)

    def join(self, deadline: float, timeout: float) -> None:
        """Wait for the end until ``deadline`` (``time.monotonic``), ``timeout`` after it began."""
        self._thread.join(max(deadline - time.monotonic(), 0.0))
        if self._thread.is_alive():
            self._report(
                f"{self.sink.name}: writing did not end within {timeout:g} s; the last rows may be "
                "missing"
            )
        elif self._lost:
            self._report(f"{self.sink.name}: {self._lost} rows are missing: it was too slow")

    def _run(self) -> None:
        set_low_priority(real_time=self._urgent)
        while (rows := self._queue.get()) is not None:
            burst = max(_BURST // rows.shape[1], 1)
            for first in range(0, rows.shape[0], burst):
                part = rows[first : first + burst]
                if not self._succeeds(self.sink.write, part):
                    return
                self.rows += part.shape[0]
                time.sleep(_PAUSE)
            if not self._succeeds(self.sink.flush):
                return
        self._succeeds(self.sink.close)

    def _succeeds(self, action: Callable[..., None], *arguments: Matrix) -> bool:
        """Call a method of the sink; close the sink if that fails."""
        try:
            action(*arguments)
        except BaseException as error:  # a panic of a library in Rust is not an Exception
            self._failed = True
            why = error.strerror if isinstance(error, OSError) and error.strerror else error
            try:
                self.sink.close()
            except BaseException as again:
                _LOG.debug("%s: closing failed as well: %s", self.sink.name, again)
            self._report(f"{self.sink.name}: {why}; closed after {self.stored} rows")
            return False
        return True


# ---- A ring buffer between the threads of loop and telemetry writer ----

# Indices of ``Ring.ends``, 16 words = 128 bytes apart: processors fetch cache lines of 64 bytes,
# some of them in pairs.
HEAD, TAIL, DROPPED = 0, 16, 32
_WORDS = 48


class Ring(NamedTuple):
    """Rows on their way from one thread to another."""

    rows: Buffer  #: (capacity, width); row number k is stored at k modulo capacity
    ends: NDArray[np.int64]  #: rows written (at ``HEAD``), read (``TAIL``), dropped (``DROPPED``)


def ring(capacity: int, width: int) -> Ring:
    """Return an empty ring for ``capacity`` rows of ``width`` values.

    All its memory is written once, so that no page is missing when the loop first uses it.
    """
    size = checks.whole("capacity", capacity, 1), checks.whole("width", width, 1)
    return Ring(np.full(size, np.nan), np.zeros(_WORDS, dtype=np.int64))


@kernel
def push(ring: Ring, row: Vector) -> bool:
    """Write a row, on the producer's thread, without waiting; return whether there was room."""
    rows, ends = ring.rows, ring.ends
    head = ends[HEAD]  # only this thread writes it
    if head - load_acquire(ends, TAIL) >= rows.shape[0]:
        store_release(ends, DROPPED, ends[DROPPED] + 1)
        return False
    index = head % rows.shape[0]
    for i in range(rows.shape[1]):
        rows[index, i] = row[i]
    store_release(ends, HEAD, head + 1)
    return True


def drain(ring: Ring) -> Matrix:
    """Remove all rows, on the consumer's thread, and return a copy (rows, width), oldest first."""
    out = np.empty((waiting(ring), ring.rows.shape[1]))
    call_specialised(_read_rows, ring, out)
    return out


def waiting(ring: Ring) -> int:
    """Return the number of rows in the ring; the producer may add more meanwhile."""
    return int(ring.ends[HEAD] - ring.ends[TAIL])


def dropped(ring: Ring) -> int:
    """Return how many rows were dropped because the ring was full."""
    return int(ring.ends[DROPPED])


@compiled
def _read_rows(ring: Ring, out: Matrix) -> None:
    """Move the oldest rows of the ring to ``out``."""
    rows, ends = ring.rows, ring.ends
    tail = ends[TAIL]
    count = min(out.shape[0], load_acquire(ends, HEAD) - tail)
    for k in range(count):
        index = (tail + k) % rows.shape[0]
        for i in range(rows.shape[1]):
            out[k, i] = rows[index, i]
    store_release(ends, TAIL, tail + count)


# ---- The telemetry writer ----

# The ring holds the rows of so many seconds, and at least so many rows, in case the writer's thread
# gets no processor. A sink has as many seconds to end. Chosen by hand.
_CAPACITY = 10.0
_LEAST_ROWS = 256
# Rows may wait for a sink that is slow up to this size, or that of the ring if it is larger
# [bytes]; chosen by hand: at 1 kHz and 20 values a row a disk may stall for 7 minutes.
_MOST_WAITING = 1 << 26


class TelemetryWriter:
    """A ring for a loop's rows, and the threads that write them to sinks.

    As a context manager it starts and stops itself.

    Parameters
    ----------
    header
        header of the recording.
    sinks
        receivers of the rows.
    period
        time between two rounds of emptying the ring [s], at most 0.25: a killed process must lose
        less than one second.
    urgent
        True if the loop is interpreted and has a real-time priority above 1: the threads then take
        priority 1 if permitted, otherwise an ordinary one.

    Attributes
    ----------
    ring : Ring
        where the loop pushes its rows.
    rows : int
        number of rows taken out so far.
    problems : list of str
        which sinks failed, when and why.
    """

    def __init__(
        self,
        header: Header,
        sinks: Sequence[Sink] = (),
        *,
        period: float = 0.05,  # chosen by hand: short for a viewer, long for the interpreter
        urgent: bool = False,
    ) -> None:
        self.header, self.period = header, checks.positive("period", period, "s")
        # Half a second of an MCAP chunk and a quarter here leave a margin of a quarter.
        if period > 0.25:
            raise ValueError(
                f"period = {period!r} s: must be at most 0.25 s, or a killed process may lose 1 s"
            )
        capacity = max(_LEAST_ROWS, math.ceil(_CAPACITY / header.dt))
        self.ring: Ring = ring(capacity, header.width)
        self._most_waiting = max(capacity, _MOST_WAITING // self.ring.rows[0].nbytes)
        self.urgent = urgent
        self.rows = 0
        self.problems: list[str] = []
        self._sinks, self._deliveries = tuple(sinks), list[Delivery]()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="quell-telemetry", daemon=True)

    @property
    def dropped(self) -> int:
        """Number of rows that were lost because the ring was full."""
        return dropped(self.ring)

    @property
    def lost(self) -> int:
        """Number of rows that are missing in the sink that has the fewest, once all have ended."""
        return self.dropped + max((self.rows - each.stored for each in self._deliveries), default=0)

    def start(self) -> None:
        """Open all sinks and start writing.

        Call it before the loop's thread takes a real-time priority or a processor of its own:
        threads inherit both.

        Raises
        ------
        ValueError
            if a sink can't be opened; none is open then.
        ImportError
            if a sink needs a package that is missing.
        """
        opened = []
        try:
            for sink in self._sinks:
                sink.open(self.header)
                opened.append(sink)
        except BaseException as error:
            for sink in opened:
                sink.close()
            if isinstance(error, OSError):  # a full disk, for instance
                path = self._sinks[len(opened)].name
                why = error.strerror or error
                raise ValueError(f"telemetry = {path!r}: can't be written ({why})") from None
            raise
        drain(self.ring)  # compiles it, or loads it from disk
        self._deliveries = [
            Delivery(sink, self._most_waiting, self.urgent, self._report) for sink in opened
        ]
        self._thread.start()

    def stop(self, timeout: float = _CAPACITY) -> None:
        """Write the rest of the ring and close all sinks; each has ``timeout`` [s], all at once."""
        deadline = time.monotonic() + timeout
        self._stopped.set()
        self._thread.join()  # it waits for no sink
        for delivery in self._deliveries:
            delivery.join(deadline, timeout)

    def __enter__(self) -> TelemetryWriter:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _run(self) -> None:
        set_low_priority(real_time=self.urgent)
        while not self._stopped.wait(self.period):
            self._pass_on()
        self._pass_on()
        for delivery in self._deliveries:
            delivery.end()

    def _pass_on(self) -> None:
        """Empty the ring for the sinks."""
        rows = drain(self.ring)
        for delivery in self._deliveries:
            delivery.put(rows)
        self.rows += rows.shape[0]

    def _report(self, problem: str) -> None:
        self.problems.append(problem)
        _LOG.warning("telemetry: %s", problem)
