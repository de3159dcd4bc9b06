"""A loop ready to run: all that ``run_cycles`` needs, made and compiled beforehand."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.kernels.dispatch import dispatcher_for, interpreted
from quell.kernels.user_types import explain_compile_errors
from quell.realtime.devices.base import PythonHandle, handle_of
from quell.realtime.loop.compiled_controller import bound, warm
from quell.realtime.loop.cycle import Books, Pace, Setpoints, pace, run_cycles
from quell.realtime.loop.modes import Mode
from quell.realtime.loop.supervisor import (
    FLUSH,
    MODE,
    SAMPLES,
    Rules,
    SupervisorState,
    initial_state,
)
from quell.realtime.system.histogram import Histogram, Timing, empty_counts
from quell.realtime.telemetry.channels import row_channels
from quell.realtime.telemetry.ring import Ring
from quell.records.channels import columns_of
from quell.records.sample_times import in_steps
from quell.signals import Signal, as_signal
from quell.simulation.scenario import Scenario
from quell.types import Matrix

# With twenty channels a record of them is 1.6 GB.
_MOST_SAMPLES = 10_000_000
# s(τ) of the least jerk from 0 to 1, at rest at both ends (Flash & Hogan, J. Neuroscience 5, 1985, eq. (3)).
_LEAST_JERK = np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])


def scenario_of(value: Any, duration: float | None) -> Scenario:
    """Return a scenario, or make one of a reference that takes ``duration`` [s].

    Raises
    ------
    ValueError
        for a reference without duration, a scenario with another one, and one that puts the plant back to rest.
    """
    if not isinstance(value, Scenario):
        if duration is None:
            raise ValueError(
                "duration = None: give the duration [s] with a reference, or a quell.Scenario, which has one"
            )
        return Scenario(as_signal(value, "scenario"), duration)
    if value.rest_at:
        raise ValueError(
            f"rest_at = {value.rest_at!r}: a plant of metal can't be put back to rest; leave it out"
        )
    if duration is None:
        return value
    return Scenario(value.reference, duration, seed=value.seed)


def setpoints(scenario: Scenario, dt: float, derivatives: int, approach: float) -> Setpoints:
    """Return the reference and its derivatives for every sample, and how the loop gets there within ``approach`` seconds.

    Raises
    ------
    ValueError
        for a run of more than ten million samples, and a reference that is not finite or has no derivatives.
    """
    if scenario.duration / dt > _MOST_SAMPLES:
        raise ValueError(
            f"duration = {scenario.duration!r} s with dt = {dt!r} s: must be at most {_MOST_SAMPLES:.0e} samples"
        )
    t = np.arange(math.floor(in_steps(scenario.duration, dt)) + 1) * dt
    reference: Signal = scenario.seeded_signals(len(scenario.disturbances))[0]
    signals = [reference]
    for _ in range(derivatives):
        signals.append(signals[-1].derivative())
    columns = np.column_stack([signal(t) for signal in signals])
    if not np.all(np.isfinite(columns)):
        first = int(np.argmin(np.isfinite(columns).all(axis=1)))
        raise ValueError(
            f"reference: it, or a derivative of it, is no number at {t[first]:.6g} s; it must be finite throughout"
        )
    slide = sliding(dt, checks.non_negative("approach", approach, "s"), derivatives)
    return Setpoints(columns[:, 0].copy(), columns[:, 1:].copy(), slide, np.zeros(derivatives))


def sliding(dt: float, time: float, derivatives: int) -> Matrix:
    """Return ``1 − s(t / time)`` and its derivatives at the samples before ``time`` [s], (·, 1 + derivatives)."""
    tau = np.arange(math.ceil(in_steps(time, dt)) if time else 0) * dt / (time or 1.0)
    rest = 1.0 - _LEAST_JERK
    return np.column_stack(
        [(rest.deriv(i) if i else rest)(tau) / (time or 1.0) ** i for i in range(derivatives + 1)]
    )


@dataclass(frozen=True, eq=False)
class ControlLoop:
    """A loop that is compiled and has not begun."""

    handle: Any
    clock: Any
    design: Any
    state: Any
    rules: Rules
    supervisor: SupervisorState
    setpoints: Setpoints
    pace: Pace
    books: Books
    interpreted: bool
    """Whether the loop is Python."""

    @classmethod
    def of(
        cls,
        device: Any,
        controller: Any,
        setpoints: Setpoints,
        rules: Rules,
        clock: Any,
        ring: Ring,
        *,
        interpret: bool = False,
    ) -> ControlLoop:
        """Put together a device, a controller that begins with nothing learned, and what it has to follow; compile it.

        The loop is interpreted where the device needs it, but the controller is compiled all the same; unless ``interpret`` wants both as
        plain Python, to debug.
        """
        handle = handle_of(device)
        design, state = controller.parameters, controller.initial_state()
        channels = row_channels(controller.channels)
        row = np.zeros(sum(width for _, width in channels))
        if isinstance(handle, PythonHandle) and not interpret:
            design = bound(design)
            warm(
                design,
                controller.initial_state(),
                setpoints.now.copy(),
                row[len(row) - _reported(controller) :].copy(),
            )
        known = {name for name, width in channels if width}
        f_learned, f_residual = (
            columns_of(channels, name).start if {"f_learned", "f_residual"} <= known else -1
            for name in ("f_learned", "f_residual")
        )
        books = Books(
            ring,
            row,
            f_learned,
            f_residual,
            empty_counts(),
            empty_counts(),
            np.zeros(1, dtype=np.int64),
        )
        due = pace(controller.dt, getattr(device, "paced", False))
        as_python = interpret or isinstance(handle, PythonHandle)
        prepared = cls(
            handle, clock, design, state, rules, initial_state(), setpoints, due, books, as_python
        )
        prepared._compile()
        return prepared

    @property
    def requests(self) -> NDArray[np.int64]:
        """What the loop is asked to do (1,), see ``supervisor``."""
        return self.books.requests

    def run(self) -> None:
        """Run all cycles."""
        entry = (
            interpreted(run_cycles)
            if self.interpreted
            else dispatcher_for(run_cycles, self.handle, self.clock, self.design)
        )
        with (
            np.errstate(over="ignore", invalid="ignore"),
            explain_compile_errors(self.handle, self.design),
        ):
            entry(
                *(
                    self.handle,
                    self.clock,
                    self.design,
                    self.state,
                    self.rules,
                    self.supervisor,
                    self.setpoints,
                    self.pace,
                    self.books,
                )
            )

    def _compile(self) -> None:
        """Compile by a run that is over before it begins."""
        over = copy.deepcopy(self.supervisor)
        over.counts[MODE], over.counts[SAMPLES] = Mode.STOPPED, FLUSH + 1
        ControlLoop(**{**vars(self), "supervisor": over}).run()

    @property
    def timing(self) -> Timing:
        """How punctual it was so far."""
        return Timing(Histogram.of(self.books.lateness), Histogram.of(self.books.step))


def _reported(controller: Any) -> int:
    return sum(width for _, width in controller.channels)
