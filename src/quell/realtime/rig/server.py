"""The rig: it listens at a wire, ticks on its own thread, writes its log and counts events."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Self, TextIO

import numpy as np
from numpy.typing import ArrayLike

from quell import checks
from quell.files import check_writable
from quell.kernels.dispatch import call_specialised
from quell.plants.base import Plant, check_plant
from quell.realtime.devices.base import Listener
from quell.realtime.rig import kernel as kernels
from quell.realtime.rig.kernel import RigModel, serve
from quell.realtime.system.atomics import store_release
from quell.realtime.system.clock import system_clock
from quell.realtime.system.histogram import Histogram, empty_counts
from quell.realtime.system.scheduling import (
    checked_cpu,
    checked_priority,
    enter_real_time,
    real_time_process,
)
from quell.realtime.telemetry.ring import drain, dropped, ring
from quell.realtime.wire import frames
from quell.realtime.wire.transport import send
from quell.types import Vector

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
        any compiled plant.
    dt
        time between ticks [s].
    listener
        its end of the wire; ``close`` closes it.
    watchdog
        ticks in a row without a fresh, finite command after which u is zero until a new session.
    u_max
        larger commands are cut to it [u-unit].
    rest
        whether each session starts from ``x0``, or from where the last one left the plant. If that
        state is not finite, or beyond 10⁹, the session starts from ``x0`` in any case.
    wait
        how long a tick waits for the command that answers the measurement before it [s]; the later
        ticks are shifted by that time. A loop that is late then has no effect on the motion.
    x0
        the plant's state at the start (n,); zero by default.
    log
        CSV file for y, u, command and state of each tick (``quell.realtime.rig.kernel.LOG``).
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
        watchdog: int = 20,
        u_max: float = np.inf,
        rest: bool = True,
        wait: float = 0.0,
        x0: ArrayLike | None = None,
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
        u_max = u_max if u_max == np.inf else checks.positive("u_max", u_max)
        watchdog = checks.whole("watchdog", watchdog, 1, _MOST_TICKS)
        start = np.zeros(plant.order) if x0 is None else checks.vector("x0", x0, plant.order)
        rows = max(round(_BUFFERED / dt), _LEAST_ROWS)
        self.listener = listener
        self.dt = dt
        self.model = RigModel(
            plant=plant.sampled(dt),
            transport=listener.transport,
            endpoint=frames.endpoint(frames.COMMAND, 0, watchdog),
            inbox=frames.buffer(),
            outbox=frames.buffer(),
            dt=dt,
            u_max=u_max,
            watchdog=watchdog,
            patience=max(round(_PATIENCE / dt), 1),
            wait=round(1e9 * _checked_wait(wait)),
            rest=checks.flag("rest", rest),
            x=start.copy(),
            x0=start,
            scratch=np.zeros(6 * plant.order),
            w=np.zeros(plant.disturbances),
            counts=np.zeros(kernels.COUNTS, dtype=np.int64),
            signals=np.array([0.0, np.nan, 0.0]),
            row=np.zeros(len(kernels.LOG)),
            log=ring(1 if log is None else rows, len(kernels.LOG)),
            logged=log is not None,
            lateness=empty_counts(),
            stop=np.zeros(1, dtype=np.int64),
        )
        self._file = None if log is None else _opened(log, overwrite)
        self._log_failure = ""
        self._clock = system_clock()
        self._open = True

    @property
    def x(self) -> Vector:
        """The plant's state, as a copy (n,)."""
        return self.model.x.copy()

    @property
    def state(self) -> str:
        """One of idle, waiting, live, tripped."""
        return kernels.STATES[self.model.counts[kernels.STATE]]

    @property
    def counters(self) -> dict[str, int]:
        """Number of frames by result, see ``quell.realtime.wire.frames``, and of other events."""
        more = {
            "sessions": kernels.SESSIONS,
            "refused": kernels.REFUSED,
            "watchdog": kernels.TRIPS,
            "clipped": kernels.CLIPPED,
            "ticks": kernels.TICKS,
            "caught_up": kernels.CAUGHT_UP,
            "restored": kernels.RESTORED,
        }
        return frames.counts_by_name(self.model.endpoint.counters) | {
            name: int(self.model.counts[index]) for name, index in more.items()
        }

    @property
    def largest(self) -> float:
        """Largest ``|command|`` received [u-unit], applied or not."""
        return float(self.model.signals[kernels.LARGEST])

    @property
    def lateness(self) -> Histogram:
        """Lateness of the ticks in ``run`` [s]."""
        return Histogram.of(self.model.lateness)

    @property
    def unlogged(self) -> int:
        """Ticks that are missing in the log because it could not be written fast enough."""
        return dropped(self.model.log) if self.model.logged else 0

    def tick(self, count: int = 1) -> None:
        """Perform ``count`` ticks at once, without a clock: for tests that go step by step."""
        self._serve(count, False)
        self._write_log()

    def prepare(self) -> None:
        """Compile what ``run`` needs, or load it from the disk."""
        self._serve(0, False)

    def run(
        self, seconds: float | None = None, *, priority: int = 0, cpu: int | None = None
    ) -> list[str]:
        """Tick in real time for ``seconds``, or until a signal or another thread calls ``stop``.

        The ticks run on their own thread, which needs no Python; the calling thread writes the log.
        Return sentences about which requests the system has granted.

        Parameters
        ----------
        seconds
            duration [s]; by default until ``stop``.
        priority
            SCHED_FIFO priority of the ticks, 1 to 99, together with locked memory; 0 for neither.
        cpu
            number of the processor for the ticks; any by default.

        Raises
        ------
        ValueError
            for arguments out of range.
        """
        most = -1
        if seconds is not None:
            most = max(round(checked_seconds("seconds", seconds) / self.dt), 1)
        priority, cpu = checked_priority(priority), checked_cpu(cpu)
        self.prepare()
        raised: list[BaseException] = []
        with real_time_process(priority, False) as notes:

            def work() -> None:
                try:
                    enter_real_time(priority, cpu, notes)
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
        """End ``run`` at its next tick."""
        store_release(self.model.stop, 0, 1)

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
        if model.counts[kernels.STATE] == kernels.IDLE:
            return
        session, now = int(model.endpoint.numbers[frames.SESSION]), time.monotonic_ns()
        frames.write_frame(model.outbox, frames.GOODBYE, session, 0, 0, now, 0.0, frames.GONE)
        send(model.transport, model.outbox)
        model.counts[kernels.STATE] = kernels.IDLE

    def _serve(self, most: int, paced: bool) -> None:
        call_specialised(serve, self.model, self._clock, most, paced)

    def _write_log(self) -> None:
        if self._file is None or self._file.closed:
            return
        try:
            for row in drain(self.model.log):
                k, t, session, state, *values = row.tolist()
                cells = f"{int(k)},{t:.9g},{int(session)},{int(state)}"
                self._file.write(",".join((cells, *map(repr, values))) + "\n")
            self._file.flush()
        except OSError as error:  # a full disk must not end the loop
            self._log_failure = f"the log was given up: {error.strerror}"
            with suppress(OSError):
                self._file.close()


def _checked_wait(wait: float) -> float:
    if checks.non_negative("wait", wait, "s") > _LONGEST:
        raise ValueError(f"wait = {wait!r} s: must be at most {_LONGEST:g} s")
    return wait


def checked_seconds(name: str, seconds: float) -> float:
    """Return the duration of a run [s], at most thirty years."""
    if checks.positive(name, seconds, "s") > _LONGEST_RUN:
        raise ValueError(f"{name} = {seconds!r}: must be at most {_LONGEST_RUN:g} s, or left out")
    return seconds


def _opened(path: str | Path, overwrite: bool) -> TextIO:
    """Return the open log, with its header written; a device like /dev/null may be one, too."""
    target = Path(path)
    if target.is_file():
        check_writable(target, overwrite)
    try:
        if target.is_file():
            target.unlink()
        file = target.open("w" if target.exists() else "x", encoding="utf-8", newline="")
    except OSError as error:
        raise ValueError(f"log = {str(path)!r}: can't be written ({error.strerror})") from None
    file.write(",".join(kernels.LOG) + "\n")
    return file
