"""The result of a run at a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from quell.realtime.loop.modes import Cause, Ending, Mode
from quell.realtime.loop.state import RESERVED, Rules, SupervisorState
from quell.realtime.system.atomics import load_acquire
from quell.realtime.system.histogram import Timing
from quell.realtime.telemetry.channels import Event
from quell.records.measures import Metrics
from quell.records.trajectory import Trajectory


class ModeChange(NamedTuple):
    """A change of the supervisor's mode."""

    t: float  # time since the loop's first cycle [s]
    mode: Mode
    cause: Cause

    def __str__(self) -> str:
        """Return the change as a sentence."""
        return f"{self.t:9.3f} s  {self.mode.name}: {self.cause.text}"


class Tally(NamedTuple):
    """Numbers of cycles and of events in them."""

    cycles: int
    overruns: int  # cycles that woke, or ended, after the next deadline
    skipped: int  # deadlines that were skipped because of that
    missed: int  # cycles without a good measurement
    clipped: int  # cycles in which the supervisor's limits changed the controller's u
    unsent: int  # commands that could not be sent
    rows_lost: int  # rows that found the telemetry's ring full


@dataclass(frozen=True, eq=False)
class RigRun:
    """The record of one run at a rig."""

    trajectory: Trajectory  #: the samples of the scenario; ``ended`` is zero if it did not begin
    record: Trajectory  #: all cycles, also before the scenario (START) and after it (RAMP, STOPPED)
    timing: Timing  #: histograms of lateness and step time
    changes: tuple[ModeChange, ...]  #: changes of the supervisor's mode and their causes
    tally: Tally  #: numbers of cycles, overruns, missed samples and so on
    counters: dict[str, int]  #: the device's counters, of frames for instance
    notes: tuple[str, ...]  #: remarks, for example on permitted real-time scheduling
    rules: Rules  #: safety rules of the run, with those that were derived; ``rules.text(dt)``

    @property
    def overruns(self) -> int:
        """Cycles that woke, or ended, after the next deadline."""
        return self.tally.overruns

    @property
    def completed(self) -> bool:
        """Whether the scenario was run to its end."""
        return any(change.cause.ending is Ending.COMPLETED for change in self.changes)

    @property
    def verdict(self) -> str:
        """The reason of the end, in a sentence."""
        changes = (change for change in reversed(self.changes) if change.cause is not Cause.RAMPED)
        return str(next(changes, "it never began")).strip()

    def metrics(self, start: float = 0.0, stop: float | None = None, **options: Any) -> Metrics:
        """Return ``Trajectory.metrics``; times count from the scenario's first sample [s].

        If the run was ended early, there are no measures of a step in the window in which it ended,
        and ``missing`` says why, as does the error about a window without samples.
        """
        run, why = self.trajectory, f"the run was ended early: {self.verdict}"
        try:
            found = run.metrics(start, stop, **options)
        except ValueError as error:
            if self.completed:
                raise
            raise ValueError(f"{error}; {why}") from None
        if self.completed or (stop is not None and stop <= run.ended):
            return found
        return found.without_step(why)

    def text(self) -> str:
        """Return changes, counters, timing and notes as lines of text."""
        device = counters_text({name: n for name, n in self.counters.items() if n})
        return "\n".join(
            [
                *map(str, self.changes),
                counters_text(self.tally._asdict()),
                *([f"device: {device}"] if device else []),
                self.timing.text(),
                *self.notes,
            ]
        )


def counters_text(counters: Mapping[str, int]) -> str:
    """Return counters as a line of text."""
    return ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in counters.items())


def tally(state: SupervisorState, rows_lost: int) -> Tally:
    """Return the supervisor's counters, and the number of lost rows."""
    return Tally._make([*state.counters.view(np.int64).tolist(), rows_lost])


def mode_changes(state: SupervisorState, dt: float, first: int = 0) -> tuple[ModeChange, ...]:
    """Return the changes of mode from number ``first`` on; the loop may be running meanwhile."""
    rows = state.changes[first : load_acquire(state.changed, 0)]
    return tuple(ModeChange(k * dt, Mode(mode), Cause(cause)) for k, mode, cause in rows.tolist())


def lost_changes(state: SupervisorState, dt: float) -> tuple[str, ...]:
    """Return a note if there were more changes of mode than are kept."""
    kept, limit = int(state.changed[0]), state.changes.shape[0]
    if kept < limit - RESERVED:
        return ()
    last = state.changes[kept - 1, 0] * dt
    return (f"only the first {kept} changes of mode, until {last:.3f} s, were kept",)


def silence_of(
    record: Trajectory,
    changes: Sequence[ModeChange],
    before: Mapping[str, int],
    after: Mapping[str, int],
) -> tuple[str, ...]:
    """Return a note that says what came from the device when missed samples ended the run.

    Parameters
    ----------
    record
        all cycles.
    changes
        changes of mode.
    before, after
        the device's counters at the begin of the run and at its end.
    """
    end = next((each for each in changes if each.cause in (Cause.LOST, Cause.STALLED)), None)
    if end is None:
        return ()
    missed = np.asarray(record["events"]).astype(np.int64) & (Event.MISSED | Event.GAP) != 0
    at = int(np.searchsorted(record["k"], round(end.t / record.dt)))
    first = last = min(at, missed.size - 1)
    while first > 0 and missed[first - 1]:
        first -= 1
    while last < missed.size and missed[last]:
        last += 1
    count = max(last - first, 1)
    begin = record["k"][first] * record.dt
    span = f"for {count * record.dt:.3g} s ({count} samples) from {begin:.3f} s on"
    if "not_finite" not in after:
        return (f"the device gave no measurement, or none that is a number, {span}",)
    wrong = after["not_finite"] - before.get("not_finite", 0)
    if wrong:
        return (
            f"no good measurement came {span}; {wrong} packets of the run had a value that is not "
            "finite: look at the sensor of the device",
        )
    late = after.get("stale", 0) - before.get("stale", 0)
    return (
        f"no packet of the device came in time {span}, and no value was wrong: the device, the "
        f"network or this computer was busy, or the device has stopped ({late} packets were too "
        "old); the safety rule hold, or hold_time, says how long u may be held",
    )


def scenario_part(record: Trajectory, state: SupervisorState, samples: int) -> Trajectory:
    """Return the samples of a record that belong to the scenario."""
    k, began = record["k"], state.memory[0].began
    inside = (k >= began) & (k < began + samples) & (began >= 0)
    log = np.ascontiguousarray(record.log[inside])
    return replace(record, log=log, ended=max(log.shape[0] - 1, 0) * record.dt)
