"""A known input delay: the observer is fed the control signal that reaches the plant, not the one that was sent.

For a plant ``y^(n)(t) = b0 u(t − τ) + f(t)`` with ``τ = d dt``, an ESO that is fed u(t) takes the missing answer for a disturbance and
works against it; one that is fed ``u(t − τ)`` compares what belongs together (Zhao & Gao, *ISA Transactions* 53, 2014). The law is left
alone: it acts on estimates of now, and the delay stays in the loop.

The running state is the inner observer's, followed by the last d values of u, the newest first.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from quell import checks
from quell.observers.base import acting_control, begin, expected_measurement, observe
from quell.types import Vector

# All of them are moved on each sample.
_MOST_SAMPLES = 10_000


class DelayedModel(NamedTuple):
    """An observer behind a delay of u."""

    inner: Any
    """The observer's model."""
    size: int
    """Length of its running state."""
    samples: int
    """d, at least 1."""

    @property
    def states(self) -> int:
        """Length of the running state."""
        return self.size + self.samples


@observe.register(DelayedModel)
def _observe(
    model: DelayedModel, z: Vector, seen: Vector, y: float, u: float, f_learned: float
) -> None:
    last = z.size - 1
    arriving = z[last]
    for i in range(last, model.size, -1):
        z[i] = z[i - 1]
    z[model.size] = u
    observe(model.inner, z[: model.size], seen, y, arriving, f_learned)


@expected_measurement.register(DelayedModel)
def _expected(model: DelayedModel, z: Vector, u: float, f_learned: float) -> float:
    return expected_measurement(model.inner, z, z[z.size - 1], f_learned)


@begin.register(DelayedModel)
def _begin(model: DelayedModel, z: Vector, seen: Vector, y: float) -> None:
    for i in range(model.size, z.size):
        z[i] = 0.0
    begin(model.inner, z[: model.size], seen, y)


@acting_control.register(DelayedModel)
def _acting(model: DelayedModel, z: Vector, u: float) -> float:
    return z[z.size - 1]


def delayed_model(model: Any, delay: float, dt: float) -> Any:
    """Return ``model`` behind a delay [s] of u; ``model`` itself where there is none.

    Raises
    ------
    ValueError
        where the delay is negative, no whole number of samples, or longer than 10 000 of them.
    """
    samples = checks.samples("delay", delay, dt)
    if samples > _MOST_SAMPLES:
        raise ValueError(
            f"delay = {delay!r} s with dt = {dt!r} s: must be at most {_MOST_SAMPLES} samples; is it in seconds?"
        )
    return model if samples == 0 else DelayedModel(model, model.states, samples)


def without_delay(model: Any) -> Any:
    """Return an observer's model as it is without a delay of u, to which neither y nor f_L is subject."""
    return model.inner if isinstance(model, DelayedModel) else model
