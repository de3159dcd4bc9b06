"""The inner loop: a plant and a controller, sample by sample, through stretches of a scenario."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.base import (
    Controller,
    control,
    reset_loop,
    set_reference_derivatives,
    status_flags,
    write_row,
)
from quell.kernels.dispatch import compiled, dispatcher_for, interpreted
from quell.kernels.user_types import explain_compile_errors
from quell.plants.base import Plant, advance, measure
from quell.records.sample_times import first_sample_at, in_steps
from quell.signals import Signal
from quell.types import Matrix, Status, Vector

# Signals are evaluated so many samples at a time: enough to make Python's share small, few enough
# to stay in cache.
_BLOCK = 8192
# Time in steps of dt is exact to a part in a thousand of a step up to here.
_MOST_SAMPLES = 10**12
# What each part of a loop is known by, and what to give.
_PARTS = {
    "plant": (
        "sampled",
        "a plant, for example quell.plants.two_mass_spring() or quell.plants.LinearPlant.of(model)",
    ),
    "controller": ("initial_state", "a controller, for example quell.ADRC(...)"),
    "scenario": ("seeded_signals", "a quell.Scenario"),
}


@compiled
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
    """Run ``r.size`` samples from the time ``t0``; write every ``every``-th into ``log`` from ``row`` on.

    Returns how many samples were run (fewer than asked where the loop diverged: ``|y|`` beyond
    ``limit``, or not finite), the next row, how many samples are left until it is written, and all
    status flags that were seen.
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


@compiled
def start_from_rest(design: Any, state: Any) -> None:
    """Start the controller from rest, with what it has learned."""
    reset_loop(design, state)


class Stretch(NamedTuple):
    """Some samples of a course, evaluated."""

    first: int
    dt: float
    from_rest: bool
    """Whether the loop starts from rest at its first sample."""
    r: Vector
    derivatives: Matrix
    w: Matrix
    noise: Vector


@dataclass(frozen=True, eq=False)
class Course:
    """A scenario as the samples of a loop."""

    signals: tuple[Signal, tuple[Signal, ...], Signal]
    derivatives: tuple[Signal, ...]
    """Of the reference, those that the controller heeds."""
    samples: int
    dt: float
    x0: Vector
    limit: float
    rests: frozenset[int]

    @classmethod
    def of(cls, scenario: Any, plant: Any, controller: Controller, limit: float | None) -> Course:
        """Return the course of a scenario for a plant of this order and a controller; ``limit`` as ``simulate`` takes it."""
        dt = controller.dt
        if scenario.duration / dt > _MOST_SAMPLES:
            raise ValueError(
                f"duration = {scenario.duration!r} s with dt = {dt!r} s: must be at most {_MOST_SAMPLES:.0e} samples"
            )
        samples = math.floor(in_steps(scenario.duration, dt)) + 1
        x0 = (
            np.zeros(plant.order)
            if scenario.x0 is None
            else checks.vector("x0", scenario.x0, plant.order)
        )
        signals = scenario.seeded_signals(plant.disturbances)
        limit = (
            _default_limit(signals[0], x0, samples, dt)
            if limit is None
            else checks.positive("limit", limit)
        )
        rests = frozenset(first_sample_at(time, dt, samples) for time in scenario.rest_at)
        derivatives = _derivatives(signals[0], getattr(controller, "derivatives", 0))
        return cls(signals, derivatives, samples, dt, x0, limit, rests)

    def stretch(self, first: int, last: int) -> Stretch:
        """Return the samples from ``first`` to before ``last``."""
        reference, disturbances, noise = self.signals
        t = np.arange(first, last) * self.dt
        w = np.empty((t.size, len(disturbances)))
        for j, disturbance in enumerate(disturbances):
            w[:, j] = disturbance(t)
        rates = (
            np.array([rate(t) for rate in self.derivatives])
            .reshape(len(self.derivatives), t.size)
            .T.copy()
        )
        r, added = np.ascontiguousarray(reference(t)), np.ascontiguousarray(noise(t))
        return Stretch(first, self.dt, first in self.rests, r, rates, w, added)


def pieces(samples: int, rests: Iterable[int]) -> list[tuple[int, int]]:
    """Return where stretches begin and end: none is long, none has a start from rest but at its beginning."""
    return list(pairwise(sorted({*range(0, samples, _BLOCK), *rests, samples})))


class Loop:
    """A plant and a controller under way; ``run`` takes them through stretches one after the other."""

    def __init__(
        self, plant: Plant, model: Any, controller: Controller, course: Course, interpret: bool
    ) -> None:
        self.model, self.design, self.state = (
            model,
            controller.parameters,
            controller.initial_state(),
        )
        self.x0, self.limit = course.x0, course.limit
        self.x, self.scratch = course.x0.copy(), np.zeros(6 * plant.order)
        self.done = self.status = self.until_next = 0
        as_python = interpret or not plant.compiled
        self._block, self._to_rest = (
            interpreted(f) if as_python else dispatcher_for(f, model, self.design)
            for f in (run_block, start_from_rest)
        )

    @property
    def diverged(self) -> bool:
        """Whether it has ended early."""
        return bool(self.status & Status.DIVERGED)

    def run(self, stretch: Stretch, log: Matrix, row: int, every: int) -> int:
        """Run a stretch, write every ``every``-th sample into ``log`` from ``row`` on, and return the next row."""
        first, dt, from_rest, r, derivatives, w, noise = stretch
        # An interpreted loop that diverges would warn of every overflow; the status says it once.
        with (
            np.errstate(over="ignore", invalid="ignore"),
            explain_compile_errors(self.model, self.design),
        ):
            if from_rest:
                self.x[:] = self.x0
                self._to_rest(self.design, self.state)
            ran, row, self.until_next, seen = self._block(
                *(
                    self.model,
                    self.x,
                    self.scratch,
                    self.design,
                    self.state,
                    first * dt,
                    dt,
                    r,
                    derivatives,
                    w,
                    noise,
                ),
                *(log, row, every, self.until_next, self.limit),
            )
        self.done = first + ran
        self.status |= seen if ran == r.size else seen | Status.DIVERGED
        return int(row)

    @property
    def ended(self) -> int:
        """The sample at which it ended."""
        return self.done if self.diverged else self.done - 1


def check_part(kind: str, value: Any, name: str = "") -> None:
    """Check that ``value``, the argument ``name``, is of a ``kind``: plant, controller or scenario."""
    has, wanted = _PARTS[kind]
    if isinstance(value, type) or not hasattr(value, has):
        raise ValueError(f"{name or kind} = {value!r}: must be {wanted}")


def channels_of(plant: Any, controller: Controller) -> tuple[tuple[str, int], ...]:
    """Return name and width of what ``run_block`` logs, in order."""
    return (
        *(
            ("r", 1),
            ("y", 1),
            ("y_measured", 1),
            ("u", 1),
            ("w", plant.disturbances),
            ("x", plant.order),
        ),
        *controller.channels,
    )


def _default_limit(reference: Signal, x0: Vector, samples: int, dt: float) -> float:
    """Return a million times what is asked of the loop: a loop in encoder counts is not one that diverges."""
    early = reference(np.arange(min(samples, _BLOCK)) * dt)
    sizes = np.abs([1.0, *x0, *early[np.isfinite(early)]])
    return 1e6 * float(np.max(sizes))


def _derivatives(reference: Signal, count: int) -> tuple[Signal, ...]:
    """Return the first ``count`` derivatives of the reference."""
    found: list[Signal] = []
    for _ in range(count):
        found.append((found[-1] if found else reference).derivative())
    return tuple(found)
