"""The telemetry writer: a thread that takes the loop's rows out of a ring and passes them to sinks.

The loop puts a row into the ring each cycle and never waits. The writer empties the ring some
twenty times a second. Each sink has a thread of its own (``delivery``): one that fails (disk full,
no permission) is closed and reported, one that hangs costs its own rows; the loop and the other
sinks go on.

An interpreted loop shares Python's interpreter with these threads. Therefore they work in bursts of
0.1 ms and sleep in between. On a busy machine a thread of ordinary priority may be suspended for
milliseconds in the middle of a burst, while it holds the interpreter: for such a loop the threads
take the lowest real-time priority (``urgent``).
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from threading import Event, Thread

from quell import checks
from quell.realtime.system.scheduling import set_low_priority
from quell.realtime.telemetry.delivery import Delivery
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.ring import Ring, drain, dropped, ring
from quell.realtime.telemetry.sinks import Sink

_LOG = logging.getLogger(__name__)

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
        self._stopped = Event()
        self._thread = Thread(target=self._run, name="quell-telemetry", daemon=True)

    @property
    def dropped(self) -> int:
        """Number of rows that were lost because the ring was full."""
        return dropped(self.ring)

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
