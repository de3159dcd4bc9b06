"""``simulate`` for plants with several signals: one run of several axes through a scenario.

The driver is that of one signal (``driver.py``) with vectors in the place of r, y and u.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.base import set_reference_derivatives, status_flags, write_row
from quell.controllers.several import control_all
from quell.kernels.dispatch import compiled_loop
from quell.plants.base import advance
from quell.plants.multivariable import is_several, measure_all, named
from quell.records.axes import AxesTrajectory
from quell.signals import Constant, Signal, as_signal, seeded_apart
from quell.signals.shapes import check_derivative
from quell.simulation.driver import (
    DIVERGED,
    UNUSUAL,
    Loop,
    Scenario,
    columns_at,
    judged,
    rest_samples,
    samples_and_start,
    size_of,
)
from quell.types import Channels, Matrix, Status, Vector


class SegmentOfAxes(NamedTuple):
    """The signals at some consecutive samples, a column for each axis or output."""

    first: int
    dt: float
    from_rest: bool
    r: Matrix
    derivatives: Matrix
    w: Matrix
    noise: Matrix


@dataclass(frozen=True, eq=False)
class SampledAxes:
    """A scenario for a plant with several signals and its controller."""

    reference: tuple[Signal, ...]
    derivatives: tuple[Signal, ...]  # those that the first axis uses, then those of the second …
    disturbances: tuple[Signal, ...]
    noise: tuple[Signal, ...]
    samples: int
    dt: float
    x0: Vector
    limit: float
    range: float  # |y| beyond it is unusual, though the run may not have diverged [y-unit]
    rest_samples: frozenset[int]

    @classmethod
    def of(
        cls, scenario: Scenario, plant: Any, controller: Any, limit: float | None
    ) -> SampledAxes:
        """Sample a scenario for a plant and a controller; ``limit`` as in ``simulate``."""
        dt = controller.dt
        samples, x0 = samples_and_start(scenario, plant, dt)
        axes, inputs = references_of(controller), plant.disturbances
        reference = _one_for_each("reference", scenario.reference, axes)
        noise = _one_for_each("noise", scenario.noise, controller.outputs)
        given = tuple(map(as_signal, scenario.disturbances))
        if len(given) > inputs:
            have = checks.counted(len(given), "signal")
            most = checks.counted(inputs, "disturbance input")
            raise ValueError(f"disturbances has {have}: the plant has {most}{named(plant, 'w')}")
        if scenario.schedule:
            raise ValueError("scenario.schedule: axes have no schedule; leave it out")
        # Signals are seeded apart, so the noise of each output has numbers of its own.
        every = tuple(seeded_apart((*reference, *given, *noise), scenario.seed))
        reference, rest = every[:axes], every[axes:]
        disturbances, noise = rest[: len(given)], rest[len(given) :]
        disturbances += (Constant(0.0),) * (inputs - len(given))
        size = max(size_of(signal, x0, samples, dt) for signal in reference)
        return cls(
            reference,
            tuple(_derivatives(reference, controller.derivatives)),
            disturbances,
            noise,
            samples,
            dt,
            x0,
            DIVERGED * size if limit is None else checks.positive("limit", limit),
            UNUSUAL * size,
            rest_samples(scenario, dt, samples),
        )

    def segment(self, first: int, last: int) -> SegmentOfAxes:
        """Return the samples from ``first`` to before ``last``."""
        t = np.arange(first, last, dtype=np.float64) * self.dt
        every = (self.reference, self.derivatives, self.disturbances, self.noise)
        columns = [columns_at(signals, t) for signals in every]
        return SegmentOfAxes(first, self.dt, first in self.rest_samples, *columns)


def references_of(controller: Any) -> int:
    """Return the number of references of a controller of several signals."""
    return int(getattr(controller, "references", controller.outputs))


def references_in(
    scenario: Scenario, controller: Any
) -> tuple[tuple[Signal, ...], tuple[Signal, ...]]:
    """Return the references of a scenario for a controller, seeded, and their derivatives."""
    given = _one_for_each("reference", scenario.reference, references_of(controller))
    reference = tuple(seeded_apart(given, scenario.seed))
    return reference, tuple(_derivatives(reference, controller.derivatives))


def _one_for_each(name: str, given: Any, axes: int) -> tuple[Signal, ...]:
    """Return a signal for each axis, from one for all or one for each."""
    if not checks.is_sequence(given):
        return (as_signal(given, name),) * axes
    if len(given) != axes:
        what = "axes" if name == "reference" else "outputs"
        have = checks.counted(len(given), "signal")
        raise ValueError(f"{name} has {have}: there are {axes} {what}, give one each")
    return tuple(as_signal(each, f"{name}[{i}]") for i, each in enumerate(given))


def _derivatives(reference: tuple[Signal, ...], counts: tuple[int, ...]) -> list[Signal]:
    found: list[Signal] = []
    for signal, count in zip(reference, counts, strict=True):
        derivative = signal
        for _ in range(count):
            check_derivative(derivative)
            derivative = derivative.derivative()
            found.append(derivative)
    return found


@compiled_loop("plant", "design", "r", "derivatives", "w", "noise")
def run_axes(
    plant: Any,
    x: Vector,
    scratch: Vector,
    design: Any,
    state: Any,
    t0: float,
    dt: float,
    r: Matrix,
    derivatives: Matrix,
    w: Matrix,
    noise: Matrix,
    outputs_now: Matrix,
    u: Vector,
    log: Matrix,
    row: int,
    every: int,
    until_next: int,
    limit: float,
) -> tuple[int, int, int, int]:
    """Run ``r.shape[0]`` samples from the time ``t0``; see ``driver.run_block``.

    ``outputs_now`` (2, p) and ``u`` (m,) have room for y, the measured y, and the control signals.
    """
    axes, outputs, inputs = r.shape[1], noise.shape[1], w.shape[1]
    status = 0
    y, measured = outputs_now[0], outputs_now[1]
    for k in range(r.shape[0]):
        measure_all(plant, x, y)
        for i in range(outputs):
            if not abs(y[i]) <= limit:
                return k, row, until_next, status
            measured[i] = y[i] + noise[k, i]
        if derivatives.shape[1] > 0:
            set_reference_derivatives(design, state, derivatives[k])
        control_all(design, state, r[k], measured, u)
        status |= status_flags(design, state)
        if until_next == 0:
            at = 0
            for i in range(axes):
                log[row, at + i] = r[k, i]
            at += axes
            for i in range(outputs):
                log[row, at + i] = y[i]
                log[row, at + outputs + i] = measured[i]
            at += 2 * outputs
            for i in range(u.size):
                log[row, at + i] = u[i]
            at += u.size
            for i in range(inputs):
                log[row, at + i] = w[k, i]
            at += inputs
            for i in range(x.size):
                log[row, at + i] = x[i]
            write_row(design, state, log[row, at + x.size :])
            row += 1
            until_next = every
        until_next -= 1
        advance(plant, x, scratch, t0 + k * dt, u, w[k])
    return r.shape[0], row, until_next, status


class LoopOfAxes(Loop):
    """A plant with several signals and its controller during a run."""

    block = staticmethod(run_axes)

    def _arguments(self, segment: Any, log: Matrix, row: int, every: int) -> tuple[Any, ...]:
        first, dt, _, *signals = segment
        room = (np.zeros((2, self.plant.outputs)), np.zeros(self.plant.inputs))
        loop = (self.model, self.x, self.scratch, self.design, self.state, first * dt, dt)
        return (*loop, *signals, *room, log, row, every, self.until_next, self.limit)

    @property
    def width(self) -> int:
        """Number of columns of its log."""
        return sum(width for _, width in logged_channels(self.plant, self.controller))

    @property
    def first_state(self) -> int:
        """The first column of a log that has the plant's state."""
        before = references_of(self.controller) + 2 * self.plant.outputs + self.plant.inputs
        return int(before + self.plant.disturbances)

    def controls(self, log: Matrix) -> Any:
        """Return the control signals of rows of a log."""
        last = self.first_state - self.plant.disturbances
        return log[:, last - self.plant.inputs : last]

    def is_usual(self, row: Vector) -> bool:
        """Return whether all outputs of a row of a log are in their usual range."""
        first = references_of(self.controller)
        y = row[first : first + self.plant.outputs]
        return bool(np.all(np.abs(y) <= self.scenario.range))

    def measured(self) -> Vector:
        """Return the outputs now."""
        y = np.zeros(self.plant.outputs)
        measure_all(self.model, self.x, y)
        return y


def logged_channels(plant: Any, controller: Any) -> Channels:
    """Return name and width of the columns that ``run_axes`` logs, in order."""
    widths = (references_of(controller), plant.outputs, plant.outputs, plant.inputs)
    signals = tuple(zip(("r", "y", "y_measured", "u"), widths, strict=True))
    return (*signals, ("w", plant.disturbances), ("x", plant.order), *controller.channels)


def names_of_axes(controller: Any) -> dict[str, Any]:
    """Return the names of the axes, and of the features of each, for a record."""
    features = tuple(axis.features for axis in controller.axes)
    return {"axis_names": controller.names, "axis_features": features}


def check_fit(plant: Any, controller: Any) -> None:
    """Raise a ``ValueError`` unless a plant has the signals of a controller of several axes."""
    name = getattr(plant, "name", plant)
    if not is_several(plant):
        raise ValueError(
            f"plant = {name!r} has one control signal and one output, the controller "
            f"{controller.inputs} and {controller.outputs}: must be a plant with as many, for "
            "example quell.plants.arm()"
        )
    for what, channel, own, of_plant in (
        ("control signals", "u", controller.inputs, plant.inputs),
        ("outputs", "y", controller.outputs, plant.outputs),
    ):
        if own != of_plant:
            raise ValueError(
                f"plant = {name!r} has {of_plant} {what}{named(plant, channel)}, the controller "
                f"{own}: must be the same"
            )


def simulate_axes(
    plant: Any,
    controller: Any,
    scenario: Scenario,
    record_every: int = 1,
    limit: float | None = None,
    interpret: bool = False,
    progress: Callable[[float], None] | None = None,
) -> AxesTrajectory:
    """Run a controller of several axes; see ``quell.simulate``."""
    check_fit(plant, controller)
    every = checks.whole("record_every", record_every, 1)
    sampled = SampledAxes.of(scenario, plant, controller, limit)
    dt = sampled.dt
    loop = LoopOfAxes(plant, plant.sampled(dt, interpret), controller, sampled, interpret)
    log = loop.run_through(every, progress)
    channels = logged_channels(plant, controller)
    return AxesTrajectory(
        log=log,
        channels=channels,
        dt=dt,
        every=every,
        status=Status(int(judged(log[None], channels, [loop])[0])),
        ended=loop.ended * dt,
        limit=sampled.limit,
        plant=plant.name,
        **names_of_axes(controller),
        final_state=loop.state,
    )
