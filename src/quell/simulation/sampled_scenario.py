"""A scenario as the samples of a loop, evaluated in segments."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, fields, is_dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.controllers.base import Controller
from quell.plants.base import Plant
from quell.records.sample_times import first_sample_at, in_steps
from quell.signals import BandLimitedNoise, Constant, Signal
from quell.signals.samples import check_derivative
from quell.simulation.scenario import Scenario
from quell.types import Matrix, Vector
from quell.warn import warn

# Samples for which signals are evaluated at once: enough that Python's share of the time is small,
# few enough to stay in the processor's cache. Chosen by hand.
_SEGMENT = 8192
# Times the largest of 1, |x0| and the reference: |y| beyond it has diverged. Chosen by hand, far
# above the overshoot of any loop.
_DIVERGED = 1e6
# Times the same: |y| beyond it is outside of the usual range. Chosen by hand.
_UNUSUAL = 10.0
_NOTHING = Constant(0.0)  # what inputs without a signal get
# Noise with a shorter sample time, in units of dt, was not meant so. Chosen by hand: a sensor that
# is sampled twice as quickly as the loop is usual.
_QUICKEST_NOISE = 0.1
# Up to here time in steps of dt is exact to a thousandth of a step (2e-16 · 1e12).
_MOST_SAMPLES = 10**12


class Segment(NamedTuple):
    """The signals at some consecutive samples."""

    first: int
    dt: float
    from_rest: bool  # true if the loop starts from rest at the first of them
    r: Vector
    derivatives: Matrix
    w: Matrix
    noise: Vector


@dataclass(frozen=True, eq=False)
class SampledScenario:
    """A scenario for a plant and a controller."""

    signals: tuple[Signal, tuple[Signal, ...], Signal]
    derivatives: tuple[Signal, ...]  # those of the reference that the controller uses
    samples: int
    dt: float
    x0: Vector
    limit: float
    range: float  # |y| beyond it is unusual, though the run may not have diverged [y-unit]
    rest_samples: frozenset[int]

    @classmethod
    def of(
        cls, scenario: Scenario, plant: Plant, controller: Controller, limit: float | None
    ) -> SampledScenario:
        """Sample a scenario for a plant and a controller; ``limit`` as in ``simulate``."""
        dt, duration = controller.dt, scenario.duration
        if duration / dt > _MOST_SAMPLES:
            raise ValueError(
                f"duration = {duration!r} s with dt = {dt!r} s: must be at most "
                f"{_MOST_SAMPLES:.0e} samples"
            )
        samples = math.floor(in_steps(duration, dt)) + 1
        _warn_of_times(scenario, dt, samples)
        given = scenario.x0
        x0 = np.zeros(plant.order) if given is None else checks.vector("x0", given, plant.order)
        signals = scenario.seeded_signals(plant.disturbances)
        size = _size(signals[0], x0, samples, dt)
        limit = _DIVERGED * size if limit is None else checks.positive("limit", limit)
        rests = frozenset(first_sample_at(time, dt, samples) for time in scenario.rest_at)
        derivative, derivatives = signals[0], []
        for _ in range(getattr(controller, "derivatives", 0)):
            check_derivative(derivative)
            derivative = derivative.derivative()
            derivatives.append(derivative)
        usual = _UNUSUAL * size
        return cls(signals, tuple(derivatives), samples, dt, x0, limit, usual, rests)

    def segment(self, first: int, last: int) -> Segment:
        """Return the samples from ``first`` to before ``last``."""
        reference, disturbances, noise = self.signals
        t = np.arange(first, last, dtype=np.float64)
        t *= self.dt
        derivatives, w = _columns(self.derivatives, t), _columns(disturbances, t)
        r, added = (np.ascontiguousarray(s(t), np.float64) for s in (reference, noise))
        return Segment(first, self.dt, first in self.rest_samples, r, derivatives, w, added)


def segments(scenario: SampledScenario) -> Iterator[Segment]:
    """Return an iterator over all segments, which evaluates the next one in another thread.

    The compiled loop releases the interpreter lock, so the signals then cost no time.
    """
    bounds = deque(segment_bounds(scenario.samples, scenario.rest_samples))
    if len(bounds) == 1:
        yield scenario.segment(*bounds[0])
        return
    context = copy_context()  # with the caller's np.errstate

    def evaluate(samples: tuple[int, int]) -> Segment:
        return context.run(scenario.segment, *samples)

    with ThreadPoolExecutor(1) as thread:
        coming = thread.submit(evaluate, bounds.popleft())
        while bounds:
            segment = coming.result()
            coming = thread.submit(evaluate, bounds.popleft())
            yield segment
        yield coming.result()


def segment_bounds(samples: int, rest_samples: Iterable[int]) -> list[tuple[int, int]]:
    """Return begin and end of segments; starts from rest are only at the beginning of one."""
    return list(pairwise(sorted({*range(0, samples, _SEGMENT), *rest_samples, samples})))


def _warn_of_times(scenario: Scenario, dt: float, samples: int) -> None:
    """Warn of a duration between two samples, and of noise that is far quicker than the samples."""
    last = (samples - 1) * dt
    if in_steps(scenario.duration, dt) != samples - 1:
        warn(
            f"duration = {scenario.duration!r} s with dt = {dt!r} s: is no whole number of "
            f"samples, so the run ends at {last:.9g} s; {last + dt:.9g} s is the next one"
        )
    for name, value in (("noise", scenario.noise), ("disturbances", scenario.disturbances)):
        for noise in _noises(value):
            if noise.power > 0.0 and noise.sample_time < _QUICKEST_NOISE * dt:
                warn(
                    f"{name}: sample_time = {noise.sample_time!r} s is far below dt = {dt!r} s: "
                    "each sample sees one draw, whose variance power/sample_time = "
                    f"{noise.power / noise.sample_time:.3g} is that of a much wider band; "
                    "give sample_time = dt, or the power for it"
                )


def _noises(value: Any) -> Iterator[BandLimitedNoise]:
    """Return an iterator over all noises in a signal, or in a sequence of signals."""
    if isinstance(value, BandLimitedNoise):
        yield value
    elif isinstance(value, Signal) and is_dataclass(value):
        for field in fields(value):
            yield from _noises(getattr(value, field.name))
    elif checks.is_sequence(value):
        for part in value:
            yield from _noises(part)


def _columns(signals: tuple[Signal, ...], t: Vector) -> Matrix:
    """Return signals at the times ``t`` as the columns of a matrix."""
    columns = np.zeros((t.size, len(signals)))
    for j, signal in enumerate(signals):
        if signal != _NOTHING:
            columns[:, j] = signal(t)
    return columns


def _size(reference: Signal, x0: Vector, samples: int, dt: float) -> float:
    """Return the largest of 1, ``|x0|`` and the reference in the first samples.

    The limit depends on these because a loop in encoder counts has large values and is stable.
    """
    early = reference(np.arange(min(samples, _SEGMENT)) * dt)
    largest = np.max(np.abs(early), initial=1.0, where=np.isfinite(early))
    return float(np.max(np.abs(x0), initial=largest))
