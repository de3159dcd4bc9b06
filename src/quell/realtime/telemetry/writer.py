"""The telemetry writer: a thread that takes the loop's rows out of a ring and passes them to sinks.

The loop puts a row into the ring each cycle and never waits. The writer empties the ring some
twenty times a second. A sink that fails (disk full, no permission) is closed and reported; the loop
and the other sinks go on.

An interpreted loop shares Python's interpreter with the writer. Therefore the writer works in
bursts of 0.1 ms and sleeps in between. On a busy machine a thread of ordinary priority may be
suspended for milliseconds in the middle of a burst, while it holds the interpreter: for such a loop
the writer takes the lowest real-time priority (``urgent``).
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from threading import Event, Thread

from quell import checks
from quell.realtime.system.scheduling import set_low_priority
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.ring import Ring, drain, dropped, ring
from quell.realtime.telemetry.sinks import Sink
from quell.types import Matrix

_LOG = logging.getLogger(__name__)

# Values per burst: they take CSV about 0.1 ms (benchmarks/telemetry.py), after which the writer
# sleeps as long [s].
_BURST = 100
_PAUSE = 1e-4
# The ring holds the rows of so many seconds, so that a disk may stall as long, and at least so many
# rows; chosen by hand.
_CAPACITY = 10.0
_LEAST_ROWS = 256


class TelemetryWriter:
    """A ring for a loop's rows, and the thread that writes them to sinks.

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
        True if the loop is interpreted and has a real-time priority above 1: the writer then takes
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
        self.ring: Ring = ring(max(_LEAST_ROWS, math.ceil(_CAPACITY / header.dt)), header.width)
        self.urgent = urgent
        self.rows = 0
        self.problems: list[str] = []
        self._sinks, self._given = list[Sink](), tuple(sinks)
        self._burst = max(_BURST // header.width, 1)
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
        try:
            for sink in self._given:
                sink.open(self.header)
                self._sinks.append(sink)
        except BaseException:
            for sink in self._sinks:
                sink.close()
            self._sinks.clear()
            raise
        drain(self.ring)  # compiles it, or loads it from disk
        self._thread.start()

    def stop(self, timeout: float = _CAPACITY) -> None:
        """Write the rest of the ring and close all sinks; give up after ``timeout`` [s]."""
        self._stopped.set()
        self._thread.join(timeout)
        if self._thread.is_alive():
            self._report(f"writing did not end within {timeout:g} s; the last rows may be missing")

    def __enter__(self) -> TelemetryWriter:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _run(self) -> None:
        set_low_priority(real_time=self.urgent)
        while not self._stopped.wait(self.period):
            self._write_rows()
        self._write_rows()
        for sink in tuple(self._sinks):
            self._attempt(sink, sink.close)

    def _write_rows(self) -> None:
        """Empty the ring into the sinks, in bursts."""
        rows = drain(self.ring)
        for first in range(0, rows.shape[0], self._burst):
            burst = rows[first : first + self._burst]
            for sink in tuple(self._sinks):
                self._attempt(sink, sink.write, burst)
                time.sleep(_PAUSE)
            self.rows += burst.shape[0]
        for sink in tuple(self._sinks):
            self._attempt(sink, sink.flush)

    def _attempt(self, sink: Sink, action: Callable[..., None], *arguments: Matrix) -> None:
        """Call a method of a sink; close the sink if that fails."""
        try:
            action(*arguments)
        except BaseException as error:  # a panic of a library in Rust is not an Exception
            self._sinks.remove(sink)
            why = error.strerror if isinstance(error, OSError) and error.strerror else error
            self._report(f"{sink.name}: {why}; closed after {self.rows} rows")
            try:
                sink.close()
            except BaseException as again:
                _LOG.debug("%s: closing failed as well: %s", sink.name, again)

    def _report(self, problem: str) -> None:
        self.problems.append(problem)
        _LOG.warning("telemetry: %s", problem)
