"""Plants, controllers and a frozen learner that the tests of the analysis share."""

from __future__ import annotations

from typing import Any

import numpy as np

import quell as ql
from quell.analysis.linearise import Frozen
from quell.learners.base import NoLearnerMemory

PLANT = ql.plants.LinearPlant([[0.0, 1.0], [-3.0, -0.4]], [0.0, 2.0], [1.0, 0.0])
LEARNED = np.array([-2.5, -0.3, 0.1, 0.05])
TRAINING = ql.Scenario(
    reference=ql.signals.Sinusoid(omega=1.0),
    noise=ql.signals.BandLimitedNoise(power=1e-12, sample_time=0.01),
    duration=10.0,
)


class Held:
    """A learner that has learned and learns no more."""

    def __init__(self, gain: Any, before: float = 0.0, slope: float = 0.0) -> None:
        self.gain, self.before, self.slope = gain, before, slope

    def design(self, observer: ql.ESO, omega_c: float) -> Frozen:
        """Return what was learned."""
        return Frozen(np.append(self.gain[: observer.order], 0.0), self.before, self.slope)

    def memory(self, parameters: Frozen) -> NoLearnerMemory:
        """Return nothing."""
        return NoLearnerMemory(np.zeros(0))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()


def chain(order: int) -> ql.plants.LinearPlant:
    """Return integrators with a little of everything on the last."""
    A = np.diag(np.ones(order - 1), 1)
    A[-1] = [-1.0, -2.0, -1.5, -0.5][:order]
    return ql.plants.LinearPlant(A, 1.3 * np.eye(order)[-1], np.eye(order)[0])


def adrc(
    order: int,
    form: str = "current",
    *,
    model: bool = False,
    learner: Any = None,
    dt: float = 0.01,
    **limits: float,
) -> ql.ADRC:
    """Return a controller for ``chain``."""
    observer = (
        ql.ESO.model_based(chain(order), omega_o=12.0, dt=dt, form=form)
        if model
        else ql.ESO.model_free(order=order, b0=1.0, omega_o=12.0, dt=dt, form=form)
    )
    return ql.ADRC(observer, omega_c=2.0, learner=learner, **limits)
