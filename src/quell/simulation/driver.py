"""The inner loop: a plant and a controller, sample by sample, in segments of a scenario."""

from __future__ import annotations

from typing import Any

import numpy as np

from quell.controllers.base import (
    Controller,
    control,
    reset_loop,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.kernels.dispatch import compiled_loop, interpreted, is_available, specialised
from quell.kernels.user_types import explain_compile_errors
from quell.plants.base import Plant, advance, begin_run, check_run, measure
from quell.simulation.integration import IntegrationCheck, Samples
from quell.simulation.sampled_scenario import SampledScenario, Segment
from quell.types import Channels, Matrix, Status, Vector

SIGNALS = ("r", "y", "y_measured", "u")  # the first columns of a log


@compiled_loop("plant", "design", "r", "derivatives", "w", "noise")
def run_block(
    plant: Any,
    x: Vector,
    scratch: Vector,
    design: Any,
    state: Any,
    t0: float,
    dt: float,
    r: Vector,
    derivatives: Matrix,
    w: Matrix,
    noise: Vector,
    log: Matrix,
    row: int,
    every: int,
    until_next: int,
    limit: float,
) -> tuple[int, int, int, int]:
    """Run ``r.size`` samples from the time ``t0``; log every ``every``-th from ``row`` on.

    A log with as many columns as ``SIGNALS`` gets only these. Returns the number of samples that
    were run (fewer if the loop diverged: ``|y|`` beyond ``limit``, or not finite), the next row,
    the number of samples until it is written, and all status flags.
    """
    inputs = w.shape[1]
    status = 0
    for k in range(r.size):
        y = measure(plant, x)
        measured = y + noise[k]
        if not abs(y) <= limit:
            return k, row, until_next, status
        if derivatives.shape[1] > 0:
            set_reference_derivatives(design, state, derivatives[k])
        u = control(design, state, r[k], measured)
        status |= status_flags(design, state)
        if until_next == 0:
            log[row, 0] = r[k]
            log[row, 1] = y
            log[row, 2] = measured
            log[row, 3] = u
            if log.shape[1] > len(SIGNALS):
                for j in range(inputs):
                    log[row, 4 + j] = w[k, j]
                for j in range(x.size):
                    log[row, 4 + inputs + j] = x[j]
                write_row(design, state, log[row, 4 + inputs + x.size :])
            row += 1
            until_next = every
        until_next -= 1
        advance(plant, x, scratch, t0 + k * dt, u, w[k])
    return r.size, row, until_next, status


class Loop:
    """A plant and a controller during a run; ``run`` takes them through a segment.

    ``like`` is a loop with the same controller and a model of the same layout, which runs the same
    code.
    """

    def __init__(
        self,
        plant: Plant,
        model: Any,
        controller: Controller,
        scenario: SampledScenario,
        interpret: bool,
        like: Loop | None = None,
    ) -> None:
        self.plant, self.controller, self.interpret = plant, controller, interpret
        self.model, self.design = model, controller.parameters
        self.state = controller.initial_state()
        self.x0, self.limit = scenario.x0, scenario.limit
        self.x, self.scratch = scenario.x0.copy(), np.zeros(6 * plant.order)
        begin_run(model, self.x, self.scratch)
        self.done = self.status = self.until_next = 0
        as_python = interpret or not plant.compiled
        self.integration = IntegrationCheck(model, as_python)
        self.scenario = scenario
        self._as_python = as_python
        self._like = like
        self.last_row: Vector | None = None  # of the log, if the run diverged after it
        self._run_block: Any = None  # the compiled function, from the first segment on

    def _entry(self, function: Any, *arguments: Any) -> Any:
        """Return a function to call with arguments like these."""
        return interpreted(function) if self._as_python else specialised(function, *arguments)

    @property
    def diverged(self) -> bool:
        """True if it has ended early."""
        return bool(self.status & Status.DIVERGED)

    @property
    def width(self) -> int:
        """Number of columns of its log."""
        return sum(width for _, width in logged_channels(self.plant, self.controller))

    @property
    def result_status(self) -> Status:
        """All flags of the run, with that of its integration."""
        poor = Status.POORLY_INTEGRATED if self.integration.poor else Status.OK
        return Status(self.status) | poor

    @property
    def ended(self) -> int:
        """The sample at which it ended."""
        return self.done if self.diverged else self.done - 1

    def run(self, segment: Segment, log: Matrix, row: int, every: int) -> int:
        """Run a segment, log every ``every``-th sample from ``row`` on, and return the next row."""
        first, dt, from_rest = segment[:3]
        from_row, from_sample = row, first + self.until_next
        # An interpreted loop that diverges would warn of every overflow; the status reports it
        # once.
        with (
            np.errstate(all="ignore"),
            explain_compile_errors(self.model, self.design),
        ):
            if from_rest:
                self.x[:] = self.x0
                begin_run(self.model, self.x, self.scratch)
                reset_loop(self.design, self.state)  # it is short: to compile it takes longer
            arguments = self._arguments(segment, log, row, every)
            if self._run_block is None:
                other = None if self._like is None else self._like._run_block
                self._run_block = other or self._entry(run_block, *arguments)
            samples, row, self.until_next, flags = self._run_block(*arguments)
        check_run(self.model, self.scratch)
        self.done = first + samples
        if samples < segment.r.size and row > 0:
            self.last_row = log[row - 1].copy()
        self.status |= flags if samples == segment.r.size else flags | Status.DIVERGED
        if self.integration.needed:
            self._check_integration(log[from_row:row], from_sample, every, dt)
        return int(row)

    def is_compiled(self, segment: Segment) -> bool:
        """Return whether its code is in this process, or in the disk cache."""
        log = np.empty((1, self.width))
        return self._as_python or is_available(run_block, *self._arguments(segment, log, 0, 1))

    def _arguments(self, segment: Segment, log: Matrix, row: int, every: int) -> tuple[Any, ...]:
        """Return the arguments of ``run_block``."""
        first, dt, _, *signals = segment
        loop = (self.model, self.x, self.scratch, self.design, self.state, first * dt, dt)
        return (*loop, *signals, log, row, every, self.until_next, self.limit)

    def _check_integration(self, log: Matrix, first: int, every: int, dt: float) -> None:
        """Check the plant's integration at rows of the log, ``every`` samples apart.

        Of a run that diverged only the rows before it left its usual range count: far outside, a
        loop that diverges for another reason may be too fast for its sub-steps, too.
        """
        if self.diverged:
            log = log[: int(np.argmin(np.append(np.abs(log[:, 1]) <= self.scenario.range, False)))]
        t = (first + every * np.arange(log.shape[0], dtype=np.float64)) * dt
        first_state = 4 + self.plant.disturbances
        w, x = log[:, 4:first_state], log[:, first_state : first_state + self.x.size]
        self.integration.add(Samples(t, log[:, 3], w, x), all_of_them=self.diverged)


def logged_channels(plant: Plant, controller: Controller) -> Channels:
    """Return name and width of the columns that ``run_block`` logs, in order."""
    scalars = tuple((name, 1) for name in SIGNALS)
    return (*scalars, ("w", plant.disturbances), ("x", plant.order), *controller.channels)
