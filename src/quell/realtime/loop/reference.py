"""The reference of a run: its samples, and the approach to it from the first y."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.kernels.sized import Buffer
from quell.records.sample_times import in_steps
from quell.signals import Signal, as_signal
from quell.signals.samples import check_derivative
from quell.simulation.scenario import Scenario
from quell.types import Matrix, Vector

# A record of so many samples with twenty channels takes 1.6 GB.
_MOST_SAMPLES = 10_000_000
# s(τ) of the least jerk from rest at 0 to rest at 1 (Flash & Hogan, J. Neuroscience 5, 1985, (3)).
_LEAST_JERK = np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])


class ReferenceSamples(NamedTuple):
    """The reference for all samples of a run: code is not compiled for each duration."""

    r: Buffer  # (samples,) [y-unit]
    derivatives: Buffer  # (samples, d): r', r'', …, as many as the controller uses
    approach: Buffer  # (·, 1 + d): ``approach_curve`` and its derivatives for a distance of 1
    current: Vector  # work array: derivatives of one sample (d,)


def as_scenario(value: Scenario | Signal | float, duration: float | None) -> Scenario:
    """Return a scenario, or make one of a reference that takes ``duration`` [s]."""
    if not isinstance(value, Scenario):
        if duration is None:
            raise ValueError("duration = None: give the duration [s], or a quell.Scenario")
        return Scenario(as_signal(value, "scenario"), duration)
    if value.rest_at:
        raise ValueError(
            f"rest_at = {value.rest_at!r}: a real plant can't be put back to rest; leave it out"
        )
    return value if duration is None else Scenario(value.reference, duration, seed=value.seed)


def reference_samples(
    scenario: Scenario, dt: float, derivatives: int, approach: float
) -> ReferenceSamples:
    """Return the reference for every sample, and its approach within ``approach`` [s]."""
    if scenario.duration / dt > _MOST_SAMPLES:
        times = f"duration = {scenario.duration!r} s with dt = {dt!r} s"
        raise ValueError(f"{times}: must be at most {_MOST_SAMPLES:.0e} samples")
    t = np.arange(math.floor(in_steps(scenario.duration, dt)) + 1) * dt
    signals = [scenario.seeded_signals(len(scenario.disturbances))[0]]
    for _ in range(derivatives):
        check_derivative(signals[-1])
        signals.append(signals[-1].derivative())
    columns = np.column_stack([signal(t) for signal in signals])
    finite = np.isfinite(columns).all(axis=1)
    if not finite.all():
        raise ValueError(
            f"reference: it or one of its derivatives is not finite at {t[np.argmin(finite)]:.6g} s"
        )
    curve = approach_curve(dt, checks.non_negative("approach", approach, "s"), derivatives)
    return ReferenceSamples(
        columns[:, 0].copy(), columns[:, 1:].copy(), curve, np.zeros(derivatives)
    )


def approach_curve(dt: float, time: float, derivatives: int) -> Matrix:
    """Return ``1 − s(t / time)`` and its derivatives before ``time`` [s], (·, 1 + derivatives)."""
    scale = time or 1.0
    tau = np.arange(math.ceil(in_steps(time, dt)) if time else 0) * dt / scale
    rest = 1.0 - _LEAST_JERK
    return np.column_stack(
        [(rest.deriv(i) if i else rest)(tau) / scale**i for i in range(derivatives + 1)]
    )
