"""A known input delay: the observer is fed the control signal that reaches the plant.

For a plant ``y^(n)(t) = b0 u(t − τ) + f(t)`` with ``τ = d dt``, an ESO that is fed u(t) takes the
missing response for a disturbance and counteracts it. An ESO that is fed ``u(t − τ)`` compares
signals of the same time (Zhao & Gao, *ISA Transactions* 53, 2014). The control law does not change:
it acts on present estimates, and the delay remains in the loop.

A part of a sample is not represented: the observer is given the nearest whole number of samples and
takes the effect of the rest, at most half a sample, for a disturbance. The plant, analysis and
tuning have the whole delay.

The running state is that of the inner observer, followed by the last d values of u, newest first.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from quell import checks
from quell.kernels.sized import Size
from quell.observers.base import acting_control, begin, expected_measurement, observe
from quell.types import Vector

# The longest delay. All stored values of u are shifted in each sample, so the cost grows with it.
# Chosen by hand; not tuned further. Its main use is to detect a delay that is not in seconds.
_MOST_SAMPLES = 10_000
_PART = "; give the observer the nearer one, the rest of a delay counts as a disturbance"


class DelayedModel(NamedTuple):
    """Parameters of an observer with a delay of u."""

    inner: Any  # parameters of the observer without delay
    size: Size  # length of the running state of ``inner``
    samples: int  # d, at least 1

    @property
    def states(self) -> int:
        """Length of the running state."""
        return self.size + self.samples


@observe.register(DelayedModel)
def _observe(
    model: DelayedModel, z: Vector, estimate: Vector, y: float, u: float, f_learned: float
) -> None:
    last = z.size - 1
    arriving = z[last]
    for i in range(last, model.size, -1):
        z[i] = z[i - 1]
    z[model.size] = u
    observe(model.inner, z[: model.size], estimate, y, arriving, f_learned)


@expected_measurement.register(DelayedModel)
def _expected(model: DelayedModel, z: Vector, u: float, f_learned: float) -> float:
    return expected_measurement(model.inner, z, z[z.size - 1], f_learned)


@begin.register(DelayedModel)
def _begin(model: DelayedModel, z: Vector, estimate: Vector, y: float) -> None:
    for i in range(model.size, z.size):
        z[i] = 0.0
    begin(model.inner, z[: model.size], estimate, y)


@acting_control.register(DelayedModel)
def _acting_control(model: DelayedModel, z: Vector, u: float) -> float:
    return z[z.size - 1]


def delayed_model(model: Any, delay: float, dt: float) -> Any:
    """Return ``model`` with a delay [s] of u; ``model`` itself if the delay is zero."""
    samples = checks.samples("delay", delay, dt, _PART)
    if samples > _MOST_SAMPLES:
        raise ValueError(
            f"delay = {delay!r} s with dt = {dt!r} s: must be at most {_MOST_SAMPLES} samples"
        )
    return model if samples == 0 else DelayedModel(model, model.states, samples)


def without_delay(model: Any) -> Any:
    """Return an observer's model without its delay of u, which affects neither y nor f_L."""
    return model.inner if isinstance(model, DelayedModel) else model
