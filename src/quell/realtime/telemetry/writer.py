"""TelemetryWriter: rows leave the loop through a ring, and another thread writes them down.

The loop puts a row into the ring each cycle and never waits. The writer's thread empties the ring some twenty times a second and hands the
rows to its sinks: files, or whoever watches. A sink that fails (disk full, no permission) is closed and reported; the loop, and the other
sinks, go on.

A loop that is Python itself shares the interpreter with the writer. So the writer works in bursts of a tenth of a millisecond and sleeps
in between. That is not enough on a busy machine, where a thread of ordinary priority may be set aside for milliseconds in the middle of a
burst, and the interpreter with it: for such a loop the writer takes the lowest real-time priority (``urgent``).
"""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from threading import Event, Thread
from types import TracebackType
from typing import Protocol

from quell import checks
from quell.realtime.telemetry.header import Header
from quell.realtime.telemetry.ring import Ring, drain, dropped, ring
from quell.types import Matrix

_LOG = logging.getLogger(__name__)

# So many numbers are written in one go, which takes about 0.1 ms, and so long the interpreter is left alone then [s].
_BURST = 100
_PAUSE = 1e-4
# The ring holds what comes in so many seconds: a disk may be away as long.
_PATIENCE = 10.0
_LEAST_ROWS = 256


class Sink(Protocol):
    """Where rows go; all of it is called on the writer's thread but ``open``."""

    name: str
    """What it is called in messages."""

    def open(self, header: Header) -> None:
        """Begin a recording; a ``ValueError`` says why that can't be."""

    def write(self, rows: Matrix) -> None:
        """Take some rows (rows, width), the next ones in order."""

    def flush(self) -> None:
        """Bring what was taken to where it outlives this process; called after each round of ``write``."""

    def close(self) -> None:
        """End the recording."""


class TelemetryWriter:
    """A ring for a loop's rows, and the thread that takes them out.

    Used as a context manager it starts and stops itself.

    Parameters
    ----------
    header
        what is recorded.
    sinks
        where it goes; see ``quell.realtime.telemetry.sinks``.
    period
        how often the ring is emptied [s].
    urgent
        whether the loop is Python and has a real-time priority above 1: then the writer takes that of 1, where it is permitted. Else it has
        none, even where it inherits one.

    Attributes
    ----------
    ring : Ring
        what the loop pushes its rows into.
    rows : int
        how many rows were taken out so far.
    problems : list of str
        which sinks failed, when and why.

    Raises
    ------
    ValueError
        for a period that is not positive or beyond a quarter of a second: a killed process must lose less than one second.
    """

    def __init__(
        self,
        header: Header,
        sinks: Sequence[Sink] = (),
        *,
        period: float = 0.05,
        urgent: bool = False,
    ) -> None:
        self.header, self.period = header, checks.positive("period", period, "s")
        if period > 0.25:
            raise ValueError(
                f"period = {period!r} s: must be at most 0.25 s, or a killed process may lose more than a second"
            )
        self.ring: Ring = ring(max(_LEAST_ROWS, math.ceil(_PATIENCE / header.dt)), header.width)
        self.urgent = urgent
        self.rows = 0
        self.problems: list[str] = []
        self._sinks, self._given = list[Sink](), tuple(sinks)
        self._piece = max(_BURST // header.width, 1)
        self._stopped, self._thread = (
            Event(),
            Thread(target=self._run, name="quell-telemetry", daemon=True),
        )

    @property
    def dropped(self) -> int:
        """How many rows found the ring full and are lost."""
        return dropped(self.ring)

    def start(self) -> None:
        """Open all sinks and start writing.

        To be called before the loop's thread takes a real-time priority or a processor of its own: threads inherit both.

        Raises
        ------
        ValueError
            where a sink can't be opened; none is open then.
        ImportError
            where a sink needs a package that is missing.
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
        drain(self.ring)  # compiles, or loads
        self._thread.start()

    def stop(self, timeout: float = 10.0) -> None:
        """Write what is in the ring and close all sinks; a disk that hangs is waited for so long [s]."""
        self._stopped.set()
        self._thread.join(timeout)
        if self._thread.is_alive():
            self._report(f"writing did not end within {timeout:g} s; the last rows may be missing")

    def __enter__(self) -> TelemetryWriter:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def _run(self) -> None:
        _schedule(self.urgent)
        while not self._stopped.wait(self.period):
            self._pass_on()
        self._pass_on()
        for sink in tuple(self._sinks):
            self._attempt(sink, sink.close)

    def _pass_on(self) -> None:
        """Empty the ring into the sinks, a burst at a time."""
        rows = drain(self.ring)
        for first in range(0, rows.shape[0], self._piece):
            piece = rows[first : first + self._piece]
            for sink in tuple(self._sinks):
                self._attempt(sink, sink.write, piece)
                time.sleep(_PAUSE)
            self.rows += piece.shape[0]
        for sink in tuple(self._sinks):
            self._attempt(sink, sink.flush)

    def _attempt(self, sink: Sink, action: object, *arguments: Matrix) -> None:
        """Call a method of a sink; close the sink where that fails."""
        try:
            action(*arguments)  # type: ignore[operator]
        except BaseException as error:  # a panic of a library in Rust is no Exception
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


def _schedule(urgent: bool) -> None:
    """Take the lowest real-time priority, or give up one that was inherited."""
    if not hasattr(os, "sched_setscheduler"):
        return
    if urgent:
        with suppress(OSError):
            os.sched_setscheduler(
                0, os.SCHED_FIFO, os.sched_param(os.sched_get_priority_min(os.SCHED_FIFO))
            )
            return
    if os.sched_getscheduler(0) != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
