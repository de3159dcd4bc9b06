"""The inner loop: a plant and a controller, sample by sample, in segments of a scenario.

Verdict on finished runs: whether their integration is poor, or why a run diverged.

A loop that diverges for its own reasons often becomes too fast for its sub-steps at last. So a run
that diverged is repeated with enough sub-steps: only if it does not diverge then, the integration
was the cause. A run whose state is suddenly no number has met a function of the user that is not
defined there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell.controllers.base import reset_loop, set_reference_derivatives, status_flags, write_row
from quell.controllers.several import control_all, references_of
from quell.kernels.dispatch import (
    compiled_loop,
    explain_compile_errors,
    interpreted,
    is_available,
    kernel,
    specialised,
)
from quell.plants.base import advance, as_input, begin_run, check_run, inputs_of, measure_all
from quell.plants.base import outputs_of as outputs_of_plant
from quell.records.metrics import runs_away
from quell.records.record import columns_of
from quell.simulation.integration import LARGEST_ERROR, IntegrationCheck, Samples, with_substeps
from quell.simulation.scenario import Segment, segment_bounds, segments
from quell.types import Channels, Matrix, Status, Vector, called_by_quell, warn

# ---- The inner loop ----

SIGNALS = ("r", "y", "y_measured", "u")  # the first channels of a log


class Sample(NamedTuple):
    """The signals of one sample; as fields their sizes are constants in compiled code."""

    r: Vector  # references (n,)
    y: Vector  # outputs (p,)
    measured: Vector  # the same with noise (p,)
    u: Vector  # control signals (m,)


def sample_of(plant: Any, controller: Any) -> Sample:
    """Return room for the signals of a sample of a loop."""
    outputs = outputs_of_plant(plant)
    widths = (references_of(controller), outputs, outputs, inputs_of(plant))
    return Sample(*map(np.zeros, widths))


@compiled_loop("plant", "design", "r", "derivatives", "w", "noise")
def run_block(
    plant: Any,
    x: Vector,
    scratch: Vector,
    design: Any,
    state: Any,
    sample: Sample,
    t0: float,
    dt: float,
    r: Matrix,
    derivatives: Matrix,
    w: Matrix,
    noise: Matrix,
    log: Matrix,
    row: int,
    every: int,
    until_next: int,
    limit: float,
) -> tuple[int, int, int, int]:
    """Run ``r.shape[0]`` samples from the time ``t0``; log every ``every``-th from ``row`` on.

    ``sample`` is work space. A log with as many columns as ``SIGNALS`` have gets only these.
    Returns the number of samples that were run (fewer if the loop diverged: ``|y|`` beyond
    ``limit``, or not finite), the next row, the number of samples until it is written, and all
    status flags.
    """
    y, u = sample.y, sample.u
    references, outputs, inputs = sample.r.size, y.size, w.shape[1]
    first_u = references + 2 * outputs
    first_w = first_u + u.size
    first_x = first_w + inputs
    status = 0
    for k in range(r.shape[0]):
        measure_all(plant, x, y)
        for i in range(outputs):
            if not abs(y[i]) <= limit:
                return k, row, until_next, status
            sample.measured[i] = y[i] + noise[k, i]
        for i in range(references):
            sample.r[i] = r[k, i]
        if derivatives.shape[1] > 0:
            set_reference_derivatives(design, state, derivatives[k])
        control_all(design, state, sample.r, sample.measured, u)
        status |= status_flags(design, state)
        if until_next == 0:
            for i in range(references):
                log[row, i] = sample.r[i]
            for i in range(outputs):
                log[row, references + i] = y[i]
                log[row, references + outputs + i] = sample.measured[i]
            for i in range(u.size):
                log[row, first_u + i] = u[i]
            if log.shape[1] > first_w:
                for j in range(inputs):
                    log[row, first_w + j] = w[k, j]
                for j in range(x.size):
                    log[row, first_x + j] = x[j]
                write_row(design, state, log[row, first_x + x.size :])
            row += 1
            until_next = every
        until_next -= 1
        advance(plant, x, scratch, t0 + k * dt, as_input(plant, u), w[k])
    return r.shape[0], row, until_next, status


run_samples = kernel(interpreted(run_block))
"""``run_block`` for compiled loops over several loops, which call it for each of them."""


class Loop:
    """A plant and a controller during a run; ``run`` takes them through a segment.

    ``like`` is a loop with the same controller and a model of the same layout, which runs the same
    code.
    """

    block: Any = staticmethod(run_block)

    def __init__(
        self,
        plant: Any,
        model: Any,
        controller: Any,
        scenario: Any,
        interpret: bool,
        like: Loop | None = None,
    ) -> None:
        self.plant, self.controller, self.interpret = plant, controller, interpret
        self.model, self.design = model, controller.parameters
        self.state = controller.initial_state()
        self.x0, self.limit = scenario.x0, scenario.limit
        self.x, self.scratch = scenario.x0.copy(), np.zeros(6 * plant.order)
        self._sample = sample_of(plant, controller)
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
        with np.errstate(all="ignore"), explain_compile_errors(self.model, self.design):
            if from_rest:
                self.x[:] = self.x0
                begin_run(self.model, self.x, self.scratch)
                reset_loop(self.design, self.state)  # it is short: to compile it takes longer
            arguments = self._arguments(segment, log, row, every)
            if self._run_block is None:
                other = None if self._like is None else self._like._run_block
                self._run_block = other or self._entry(self.block, *arguments)
            samples, row, self.until_next, flags = self._run_block(*arguments)
        check_run(self.model, self.scratch)
        self.done = first + samples
        if samples < len(segment.r) and row > 0:
            self.last_row = log[row - 1].copy()
        self.status |= flags if samples == len(segment.r) else flags | Status.DIVERGED
        if self.integration.needed:
            self._check_integration(log[from_row:row], from_sample, every, dt)
        return int(row)

    def run_through(self, every: int, progress: Callable[[float], None] | None) -> Matrix:
        """Run the whole scenario, judge the integration, and return the log of a single run."""
        samples = self.scenario.samples
        log, row = np.empty(((samples - 1) // every + 1, self.width)), 0
        for segment in segments(self.scenario):
            row = self.run(segment, log, row, every)
            if self.diverged:
                break
            if progress is not None:
                progress(self.done / samples)
        judge_integration(self.plant.name, [self])
        return log[:row]

    def is_compiled(self, segment: Segment) -> bool:
        """Return whether its code is in this process, or in the disk cache."""
        log = np.empty((1, self.width))
        return self._as_python or is_available(self.block, *self._arguments(segment, log, 0, 1))

    def _arguments(self, segment: Segment, log: Matrix, row: int, every: int) -> tuple[Any, ...]:
        """Return the arguments of ``run_block``."""
        first, dt, _, *signals = segment
        loop = (self.model, self.x, self.scratch, self.design, self.state, self._sample)
        times = first * dt, dt
        return (*loop, *times, *signals, log, row, every, self.until_next, self.limit)

    def _check_integration(self, log: Matrix, first: int, every: int, dt: float) -> None:
        """Check the plant's integration at rows of the log, ``every`` samples apart.

        Of a run that diverged only the rows before it left its usual range count: far outside, a
        loop that diverges for another reason may be too fast for its sub-steps, too.
        """
        if self.diverged:
            usual = [self.is_usual(row) for row in log]
            log = log[: int(np.argmin(np.append(usual, False)))]
        t = (first + every * np.arange(log.shape[0], dtype=np.float64)) * dt
        first_state = self.first_state
        w = log[:, first_state - self.plant.disturbances : first_state]
        x = log[:, first_state : first_state + self.x.size]
        self.integration.add(Samples(t, self.controls(log), w, x), all_of_them=self.diverged)

    @property
    def first_state(self) -> int:
        """The first column of a log that has the plant's state."""
        return width_of_signals(self.plant, self.controller) + int(self.plant.disturbances)

    def controls(self, log: Matrix) -> Matrix:
        """Return the control signals of rows of a log (rows, m)."""
        last = width_of_signals(self.plant, self.controller)
        return log[:, last - inputs_of(self.plant) : last]

    def is_usual(self, row: Vector) -> bool:
        """Return whether all outputs of a row of a log are in their usual range."""
        first = references_of(self.controller)
        y = row[first : first + outputs_of_plant(self.plant)]
        return bool(np.all(np.abs(y) <= self.scenario.range))

    def measured(self) -> Vector:
        """Return the outputs now (p,)."""
        y = np.zeros(outputs_of_plant(self.plant))
        measure_all(self.model, self.x, y)
        return y


def width_of_signals(plant: Any, controller: Any) -> int:
    """Return the number of columns of ``SIGNALS`` in a log."""
    return sum(part.size for part in sample_of(plant, controller))


def logged_channels(plant: Any, controller: Any) -> Channels:
    """Return name and width of the columns that ``run_block`` logs, in order."""
    widths = (part.size for part in sample_of(plant, controller))
    signals = tuple(zip(SIGNALS, widths, strict=True))
    return (*signals, ("w", plant.disturbances), ("x", plant.order), *controller.channels)


# ---- Verdict on finished runs ----


def judged(log: Any, channels: Channels, loops: Sequence[Loop]) -> NDArray[np.int64]:
    """Return all flags of finished runs, with ``RAN_AWAY`` where y of an axis left r (runs,).

    ``log`` (runs, samples, columns) has the channels ``r`` and ``y``, or nothing more is known. A
    run that diverged has its own flag.
    """
    status = np.array([int(loop.result_status) for loop in loops], dtype=np.int64)
    names = [name for name, _ in channels]
    if "r" not in names or "y" not in names:
        return status
    r, y = (log[..., columns_of(channels, name)] for name in "ry")
    u = log[..., columns_of(channels, "u")] if "u" in names else log[..., :0]
    # Of a loop with another number of outputs than references nothing says which belong together.
    axes = r.shape[-1] if r.shape[-1] == y.shape[-1] else 0
    ended = np.array([loop.diverged for loop in loops])
    for i in range(axes):
        status[runs_away(r[..., i], y[..., i], u) & ~ended] |= int(Status.RAN_AWAY)
    return status


def warn_of_lost(runs: Any) -> None:
    """Warn a user who called ``simulate`` of runs that diverged, or whose y ran away.

    ``simulate`` calls this, for a run or a batch.
    """
    if np.any(runs.lost) and not called_by_quell(2):
        warn(f"{runs.plant}: {runs.message}")


def judge_integration(plant: str, loops: Sequence[Loop]) -> None:
    """Find the cause of divergence, and warn of runs whose integration is poor.

    Afterwards ``Loop.result_status`` has ``POORLY_INTEGRATED`` only where that stands. ``plant`` is
    the plants' name.
    """
    for loop in loops:
        _warn_of_undefined_functions(plant, loop)
        if loop.integration.poor and loop.diverged and _diverges_anyway(loop):
            loop.integration.acquit()
    poor = [loop.integration for loop in loops if loop.integration.poor]
    if not poor:
        return
    worst = max(poor, key=lambda check: check.error)
    runs = f" in {len(poor)} of {len(loops)} runs" if len(loops) > 1 else ""
    remedy = (
        f"give at least substeps = {max(check.enough for check in poor)}, or a lower dt"
        if all(check.enough for check in poor)
        else "it is stiff, or f jumps: make f smoother, or give many more substeps"
    )
    warn(
        f"{plant}: with {worst.model.substeps} sub-steps in a sample a state has an error of "
        f"{100.0 * worst.error:.2g} % of its range in one sample{runs}, more than "
        f"{100.0 * LARGEST_ERROR:g} %: {remedy}"
    )


def _warn_of_undefined_functions(plant: str, loop: Loop) -> None:
    """Warn if a function of the user returned NaN or infinity while y was in its usual range."""
    if not (loop.diverged and loop.integration.needed):
        return
    row, first = loop.last_row, loop.first_state
    before = loop.x0 if row is None else row[first : first + loop.x.size]
    usual = loop.ended == 0 if row is None else loop.is_usual(row)
    with np.errstate(all="ignore"):
        defined = bool(np.all(np.isfinite([*loop.x, *loop.measured()])))
    if defined or not usual:
        return
    warn(
        f"{plant}: f or output returns a number that is not finite; the run ended at t = "
        f"{loop.ended * loop.scenario.dt:.9g} s. The last recorded state was "
        f"{[float(f'{value:.4g}') for value in before]}: both must be defined wherever the "
        "plant goes"
    )


def _diverges_anyway(loop: Loop) -> bool:
    """Return whether a run that diverged leaves its usual range with enough sub-steps, too."""
    if not loop.integration.enough:
        return True
    scenario = replace(loop.scenario, limit=loop.scenario.range)
    model = with_substeps(loop.model, loop.integration.enough)
    again = type(loop)(loop.plant, model, loop.controller, scenario, loop.interpret)
    again.integration.needed = False
    samples = loop.ended + 1
    log, every = np.empty((1, loop.width)), samples
    for first, last in segment_bounds(samples, (k for k in scenario.rest_samples if k < samples)):
        again.run(scenario.segment(first, last), log, 0, every)
        if again.diverged:
            return True
    return False
