"""Delivery of rows to a sink, on a thread of its own, so that a slow sink delays no other."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from queue import SimpleQueue
from threading import Thread

from quell.realtime.system.scheduling import set_low_priority
from quell.realtime.telemetry.sinks import Sink
from quell.types import Matrix

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
            self._report(f"{self.sink.name}: {why}; closed after {self.rows} rows")
            try:
                self.sink.close()
            except BaseException as again:
                _LOG.debug("%s: closing failed as well: %s", self.sink.name, again)
            return False
        return True
