"""The rig as an object: it listens, ticks on a thread of its own, writes its log, and says at the end how it went."""

from __future__ import annotations

import csv
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from quell import checks
from quell.kernels.dispatch import dispatcher_for
from quell.plants.base import check_plant
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

# The log is written so often [s], and has room for so many seconds.
_WRITE_EVERY = 0.05
_ROOM = 5.0
# A session whose first command does not come keeps others out for so long [s]: its loop may have to be compiled.
_PATIENCE = 60.0
# Sample times that a wire and a clock can make sense of [s], and silence that still counts by the frames' own numbers.
_SHORTEST, _LONGEST = 1e-6, 100.0
_MOST_TICKS = 1_000_000
# Thirty years [s].
_EVER = 1e9


class Listener(Protocol):
    """The device's end of a wire; ``quell.realtime.devices.registry.listen`` makes it of a URL."""

    url: str
    transport: Any
    """For whose type the functions of ``quell.realtime.wire.transport`` are registered."""

    def close(self) -> None:
        """Give it free."""


class Rig:
    """A simulated plant at the end of a wire.

    Parameters
    ----------
    plant
        any plant that is compiled.
    dt
        its tick [s].
    listener
        its end of the wire; ``close`` closes it.
    watchdog
        after so many ticks in a row without a fresh, finite command u is set to zero until a new session.
    u_max
        larger commands are cut to it [u-unit].
    rest
        whether each session starts from ``x0``, or from where the last one left the plant.
    x0
        the plant's state at the start; zero by default.
    log
        a CSV file for each tick's y, u, command and state (``quell.realtime.rig.kernel.LOG``); what was there is overwritten.

    Raises
    ------
    ValueError
        for a plant that is not compiled, numbers out of range, or a log that can't be written.
    """

    def __init__(
        self,
        plant: Any,
        dt: float,
        listener: Listener,
        *,
        watchdog: int = 20,
        u_max: float = np.inf,
        rest: bool = True,
        x0: Any = None,
        log: str | Path | None = None,
    ) -> None:
        check_plant(plant)
        dt = checks.positive("dt", dt, "s")
        if not _SHORTEST <= dt <= _LONGEST:
            raise ValueError(f"dt = {dt!r} s: must be from {_SHORTEST:g} to {_LONGEST:g} s")
        if not plant.compiled:
            raise ValueError(
                f"plant = {plant!r}: must be one that is compiled; this one runs as Python only"
            )
        u_max = u_max if u_max == np.inf else checks.positive("u_max", u_max)
        watchdog = checks.whole("watchdog", watchdog, 1, _MOST_TICKS)
        start = np.zeros(plant.order) if x0 is None else checks.vector("x0", x0, plant.order)
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
            rest=checks.flag("rest", rest),
            x=start.copy(),
            x0=start,
            scratch=np.zeros(6 * plant.order),
            w=np.zeros(plant.disturbances),
            counts=np.zeros(9, dtype=np.int64),
            signals=np.zeros(3),
            row=np.zeros(len(kernels.LOG)),
            log=ring(max(round(_ROOM / dt), 100) if log is not None else 1, len(kernels.LOG)),
            logged=log is not None,
            lateness=empty_counts(),
            stop=np.zeros(1, dtype=np.int64),
        )
        self._file = None if log is None else _opened(log)
        self._writer = None if self._file is None else csv.writer(self._file, lineterminator="\n")
        if self._writer is not None:
            self._writer.writerow(kernels.LOG)
        self._log_failed = ""
        self._clock = system_clock()
        self._open = True

    @property
    def x(self) -> Any:
        """The plant's state, as a copy (n,)."""
        return self.model.x.copy()

    @property
    def state(self) -> str:
        """One of idle, waiting, live, tripped."""
        return kernels.STATES[self.model.counts[kernels.STATE]]

    @property
    def counters(self) -> dict[str, int]:
        """How many frames of loops met which fate, see ``quell.realtime.wire.frames``; and what else happened how often."""
        counts = self.model.counts
        more = {
            "sessions": kernels.SESSIONS,
            "refused": kernels.REFUSED,
            "watchdog": kernels.TRIPS,
            "clipped": kernels.CLIPPED,
            "ticks": kernels.TICKS,
            "caught_up": kernels.CAUGHT_UP,
        }
        return frames.counts_by_name(self.model.endpoint.counters) | {
            name: int(counts[index]) for name, index in more.items()
        }

    @property
    def largest(self) -> float:
        """Largest ``|command|`` that came [u-unit], whether it was applied or not."""
        return float(self.model.signals[kernels.LARGEST])

    @property
    def lateness(self) -> Histogram:
        """How late ticks were [s], for all that ``run`` timed."""
        return Histogram.of(self.model.lateness)

    def tick(self, count: int = 1) -> None:
        """Let ``count`` ticks pass at once, without a clock: for tests that go step by step."""
        self._serve(count, False)
        self._write()

    def prepare(self) -> None:
        """Compile what ``run`` needs, or load it from the disk."""
        self._serve(0, False)

    def run(
        self, seconds: float | None = None, *, priority: int = 0, cpu: int | None = None
    ) -> list[str]:
        """Tick in real time until ``stop`` is called, from a signal or another thread, or for so long [s].

        The ticks are on a thread of their own, which needs no Python; the calling one writes the log.

        Parameters
        ----------
        seconds
            for how long; until ``stop`` by default.
        priority
            SCHED_FIFO priority of the ticks, 1 to 99, together with locked memory; 0 leaves all that alone.
        cpu
            number of the processor that the ticks are to have; any by default.

        Returns
        -------
        list of str
            what was permitted of that, and what was not, in sentences.

        Raises
        ------
        ValueError
            for arguments out of range.
        """
        most = (
            -1 if seconds is None else max(round(checked_seconds("seconds", seconds) / self.dt), 1)
        )
        priority, cpu = checked_priority(priority), checked_cpu(cpu)
        self.prepare()
        raised: list[BaseException] = []
        with real_time_process(priority, False) as notes:

            def work() -> None:
                try:
                    enter_real_time(priority, cpu, notes)
                    self._serve(most, True)
                    self._part()  # at once: each sample that the loop waits in vain it holds u
                except BaseException as error:
                    raised.append(error)

            thread = threading.Thread(target=work, name="quell-rig")
            thread.start()
            try:
                while thread.is_alive():
                    thread.join(_WRITE_EVERY)
                    self._write()
            finally:
                self.stop()
                thread.join()
                self._write()
        if raised:
            raise raised[0]
        if self._log_failed:
            notes.append(self._log_failed)
        return notes

    def stop(self) -> None:
        """End ``run`` at its next tick."""
        store_release(self.model.stop, 0, 1)

    def close(self) -> None:
        """End the session, if there is one, and give the wire free; calling it twice does no harm."""
        if not self._open:
            return
        self._open = False
        self._part()
        self.listener.close()
        if self._file is not None:
            self._write()
            self._file.close()

    def _part(self) -> None:
        """Say goodbye, if there is a session."""
        model = self.model
        if model.counts[kernels.STATE] != kernels.IDLE:
            session = int(model.endpoint.numbers[frames.SESSION])
            frames.write_frame(
                model.outbox, frames.GOODBYE, session, 0, 0, time.monotonic_ns(), 0.0, frames.GONE
            )
            send(model.transport, model.outbox)
            model.counts[kernels.STATE] = kernels.IDLE

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def unlogged(self) -> int:
        """Ticks that are missing in the log, because it could not be written quickly enough."""
        return dropped(self.model.log) if self.model.logged else 0

    def _serve(self, most: int, paced: bool) -> None:
        dispatcher_for(serve, self.model, self._clock)(self.model, self._clock, most, paced)

    def _write(self) -> None:
        if self._writer is None or self._file is None or self._file.closed:
            return
        try:
            for row in drain(self.model.log):
                k, t, session, state, *values = row.tolist()
                self._writer.writerow(
                    [int(k), f"{t:.9g}", int(session), int(state), *map(repr, values)]
                )
            self._file.flush()
        except OSError as error:  # a full disk is no reason to leave the loop alone
            self._log_failed = f"the log was given up: {error.strerror}"
            with suppress(OSError):
                self._file.close()


def checked_seconds(name: str, seconds: float) -> float:
    """Return for how long a rig is to run [s]."""
    if checks.positive(name, seconds, "s") > _EVER:
        raise ValueError(
            f"{name} = {seconds!r}: must be at most {_EVER:g} s; leave it out to run until interrupted"
        )
    return seconds


def _opened(path: str | Path) -> Any:
    try:
        return Path(path).open("w", encoding="utf-8", newline="")
    except OSError as error:
        raise ValueError(f"log = {str(path)!r}: can't be written ({error.strerror})") from None
