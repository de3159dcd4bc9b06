"""A signal that repeats another one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from quell import checks
from quell.signals.base import EDGE_TOLERANCE, Signal, as_signal
from quell.types import Vector

# Largest number of repetitions: times are then still exact to a nanosecond within a period of 10 s.
_MOST = 10**6


@dataclass(frozen=True)
class Repeated(Signal):
    """A cycle that is repeated: ``cycle(t − start − k period)`` in repetition k.

    Before ``start`` it is the cycle at negative times, and after the last repetition the cycle goes
    on past its period. Noise in a cycle is repeated as well. A cycle should end where it begins,
    else the signal jumps.

    Parameters
    ----------
    cycle
        signal of time since the beginning of the repetition [s]; used from 0 to ``period``.
    period
        time from one repetition to the next [s].
    count
        number of repetitions; by default it never ends.
    start
        time of the first repetition [s].

    Raises
    ------
    ValueError
        for a cycle that is no signal or number, a period that is not positive, or a count below 1.

    Examples
    --------
    >>> there_and_back = Trapezoid(1.0, 1.0) - Trapezoid(1.0, 1.0, start=2.0)
    >>> moves = Repeated(there_and_back, period=4.0, count=50)
    >>> square_wave = Repeated(Constant(1.0).until(0.5, then=-1.0), period=1.0)
    """

    cycle: Signal | float
    period: float
    count: int | None = None
    start: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "cycle", as_signal(self.cycle, "cycle"))
        checks.positive("period", self.period, "s")
        checks.optional(checks.whole, "count", self.count, 1, _MOST)
        checks.finite("start", self.start)

    @property
    def _cycle(self) -> Signal:
        return as_signal(self.cycle)

    def evaluate(self, t: Vector) -> Vector:
        """Return the values of the cycle."""
        since = t - self.start
        repetition = np.maximum(np.floor((since + EDGE_TOLERANCE) / self.period), 0.0)
        if self.count is not None:
            repetition = np.minimum(repetition, self.count - 1.0)
        return self._cycle(since - repetition * self.period)

    def derivative(self) -> Signal:
        """Return the repeated derivative of the cycle."""
        return replace(self, cycle=self._cycle.derivative())

    def seeded(self, seed: int) -> Signal:
        """Return the signal with seeded noise, the same in all repetitions."""
        return replace(self, cycle=self._cycle.seeded(seed))
