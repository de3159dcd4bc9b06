"""A scenario: signals, duration and initial state of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quell import checks
from quell.signals import Constant, Signal, as_signal, seeded_apart


@dataclass(frozen=True)
class Scenario:
    """Signals, duration and initial state of a run.

    Parameters
    ----------
    reference
        signal or number that y has to follow [y-unit].
    disturbances
        one signal or number for each disturbance input of the plant, in its order; missing ones are
        zero.
    noise
        signal added to y before the controller sees it; none by default.
    duration
        length of the run [s]; the record has the samples from 0 to ``duration``, both included.
    x0
        the plant's state at the start; zero by default.
    rest_at
        times [s] at which the plant is put back to ``x0`` and the controller starts from rest; it
        keeps what it has learned.
    seed
        seed of all random signals; the same seed gives the same bits.

    Raises
    ------
    ValueError
        if the duration is not positive, the seed is negative, a signal is none, or the times in
        ``rest_at`` do not increase within the duration.
    """

    reference: Signal | float = 0.0
    duration: float = 10.0
    disturbances: Sequence[Signal | float] = ()
    noise: Signal | float = 0.0
    x0: ArrayLike | None = None
    rest_at: Sequence[float] = field(default=())
    seed: int = 0

    def __post_init__(self) -> None:
        checks.positive("duration", self.duration, "s")
        checks.whole("seed", self.seed, 0)
        as_signal(self.reference, "reference")
        as_signal(self.noise, "noise")
        if not checks.is_sequence(self.disturbances):
            raise ValueError(
                f"disturbances = {self.disturbances!r}: must be a sequence of signals or numbers"
            )
        for i, disturbance in enumerate(self.disturbances):
            as_signal(disturbance, f"disturbances[{i}]")
        times = np.array([0.0, *checks.vector("rest_at", self.rest_at), self.duration])
        if np.any(np.diff(times) <= 0.0):
            rule = f"must increase and lie within (0, duration = {self.duration!r})"
            raise ValueError(f"rest_at = {self.rest_at!r}: {rule}")

    def seeded_signals(self, inputs: int) -> tuple[Signal, tuple[Signal, ...], Signal]:
        """Return the reference, ``inputs`` disturbances and the noise, seeded."""
        if len(self.disturbances) > inputs:
            plant = f"the plant has {inputs} disturbance inputs"
            raise ValueError(f"disturbances has {len(self.disturbances)} signals: {plant}")
        given = (as_signal(self.reference), *map(as_signal, self.disturbances))
        noise = as_signal(self.noise).seeded(self.seed)
        # The noise has the seed itself: its bits must not depend on the number of disturbances.
        reference, *disturbances = seeded_apart(given, self.seed)
        return reference, (*disturbances, *[Constant(0.0)] * (inputs - len(disturbances))), noise


def check_scenario(value: Any, name: str = "scenario") -> None:
    """Raise a ``ValueError`` if ``value``, the argument ``name``, is not a scenario."""
    if isinstance(value, type) or not hasattr(value, "seeded_signals"):
        raise ValueError(f"{name} = {value!r}: must be a quell.Scenario")
