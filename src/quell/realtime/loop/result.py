"""What a run at the rig returns."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell.realtime.loop.modes import Cause, Ending, Mode
from quell.realtime.loop.supervisor import (
    BEGAN,
    CHANGES,
    CLIPPED,
    CYCLES,
    MISSES,
    OVERRUNS,
    SKIPPED,
    UNSENT,
    SupervisorState,
)
from quell.realtime.system.atomics import load_acquire
from quell.realtime.system.histogram import Timing
from quell.records.trajectory import Trajectory


class ModeChange(NamedTuple):
    """The supervisor went over to another mode."""

    t: float
    """When [s], counted from the loop's first cycle."""
    mode: Mode
    cause: Cause

    def __str__(self) -> str:
        """Say it in a sentence."""
        return f"{self.t:9.3f} s  {self.mode.name}: {self.cause.text}"


class Tally(NamedTuple):
    """How many cycles there were, and with how many something was the matter."""

    cycles: int
    overruns: int
    """Cycles that woke, or ended, after the next deadline."""
    skipped: int
    """Deadlines that were left out for that."""
    missed: int
    """Cycles without a good measurement."""
    clipped: int
    """Cycles in which the supervisor's limits changed the controller's u."""
    unsent: int
    """Commands that did not get out."""
    rows_lost: int
    """Rows that found the telemetry's ring full."""


@dataclass(frozen=True, eq=False)
class RigRun:
    """The record of one run at a rig.

    Attributes
    ----------
    trajectory : Trajectory
        from the scenario's first sample to its last, or as far as it came; ``ended`` is zero where it did not begin.
    record : Trajectory
        all cycles: also those before, in which the controller watches, and after, in which u goes to zero.
    timing : Timing
        histograms of lateness and step time.
    changes : tuple of ModeChange
        what the supervisor did, and why.
    tally : Tally
        how many cycles, overruns, missed samples and so on.
    counters : dict
        what the device counted: of frames, for instance.
    notes : tuple of str
        what real-time scheduling was to be had and what was not, and whatever else is to be told.
    """

    trajectory: Trajectory
    record: Trajectory
    timing: Timing
    changes: tuple[ModeChange, ...]
    tally: Tally
    counters: dict[str, int]
    notes: tuple[str, ...]

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
        """Why it ended, in a sentence."""
        last = next(
            (change for change in reversed(self.changes) if change.cause is not Cause.RAMPED), None
        )
        return str(last).strip() if last else "it never began"

    def metrics(
        self, start: float = 0.0, stop: float | None = None, **options: Any
    ) -> dict[str, float]:
        """Judge the response as ``Trajectory.metrics`` does; times count from the scenario's first sample [s]."""
        return self.trajectory.metrics(start, stop, **options)

    def text(self) -> str:
        """Return what happened and how punctual it was, as lines of text."""
        counted = ", ".join(
            f"{value} {name.replace('_', ' ')}" for name, value in self.tally._asdict().items()
        )
        device = ", ".join(
            f"{value} {name.replace('_', ' ')}" for name, value in self.counters.items() if value
        )
        return "\n".join(
            [
                *map(str, self.changes),
                counted,
                *([f"device: {device}"] if device else []),
                self.timing.text(),
                *self.notes,
            ]
        )


def tally_of(state: SupervisorState, rows_lost: int) -> Tally:
    """Return what the supervisor counted."""
    cycles, overruns, skipped, missed, clipped, unsent = (
        int(state.counts[place]) for place in (CYCLES, OVERRUNS, SKIPPED, MISSES, CLIPPED, UNSENT)
    )
    return Tally(cycles, overruns, skipped, missed, clipped, unsent, rows_lost)


def mode_changes(state: SupervisorState, dt: float, first: int = 0) -> tuple[ModeChange, ...]:
    """Return the changes of mode from number ``first`` on; the loop may be running meanwhile."""
    rows = state.changes[first : load_acquire(state.counts, CHANGES)]
    return tuple(ModeChange(k * dt, Mode(mode), Cause(cause)) for k, mode, cause in rows.tolist())


def unkept(state: SupervisorState, dt: float) -> tuple[str, ...]:
    """Say where there were more changes of mode than are kept."""
    kept = int(state.counts[CHANGES])
    limit = state.changes.shape[0]
    return (
        ()
        if kept < limit - 4
        else (
            f"only the first {kept} changes of mode, until {state.changes[kept - 1, 0] * dt:.3f} s, were kept",
        )
    )


def scenario_part(record: Trajectory, state: SupervisorState, samples: int) -> Trajectory:
    """Return those samples of a record that are the scenario's."""
    k, began = record["k"], int(state.counts[BEGAN])
    mine = (
        np.flatnonzero((k >= began) & (k < began + samples))
        if began >= 0
        else np.zeros(0, dtype=int)
    )
    log = np.ascontiguousarray(record.log[mine])
    return dataclasses.replace(record, log=log, ended=max(log.shape[0] - 1, 0) * record.dt)
