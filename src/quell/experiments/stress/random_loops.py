"""Random loops: two-mass-spring plants, all controlled by one design without tuning.

Masses in [0.5, 2] kg, stiffness in [0.3, 3] N/m, b0 wrong by a factor in [0.6, 1.6], sample times
of 1, 2 and 5 ms, a load on m2 of 0.1 to 1.5 rad/s and 0.1 to 2 N; omega_c = 1 and omega_o = 10
rad/s for all. From rest the output follows sin t for 60 s, then a unit step; the load acts from 90
s on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quell.controllers import ADRC
from quell.guard import Guard
from quell.learners import Learner
from quell.observers import ESO
from quell.plants import LinearPlant, two_mass_spring
from quell.signals import BandLimitedNoise, Sinusoid, Step
from quell.simulation.scenario import Scenario

STEP_AT, LOAD_AT, END = 60.0, 90.0, 150.0
"""Start of the step and of the load, end of a run [s]: chosen by hand."""
REFERENCE = Sinusoid().until(STEP_AT, then=Step(at=STEP_AT))


@dataclass(frozen=True)
class Loop:
    """One plant with its sample time, its load and the error of the design's b0."""

    m1: float
    m2: float
    k: float
    gain_error: float  #: b0 / b
    dt: float
    omega: float  #: frequency of the load [rad/s]
    amplitude: float  #: amplitude of the load [N]
    seed: int  #: seed of the noise

    @property
    def plant(self) -> LinearPlant:
        """The plant."""
        return two_mass_spring(self.m1, self.m2, self.k)

    @property
    def scenario(self) -> Scenario:
        """Reference, load and noise."""
        return Scenario(
            reference=REFERENCE,
            disturbances=(0.0, Sinusoid(self.amplitude, self.omega, start=LOAD_AT)),
            noise=BandLimitedNoise(power=1e-12, sample_time=0.01),
            duration=END,
            seed=self.seed,
        )

    def controller(self, learner: Learner | None = None, guard: Guard | None = None) -> ADRC:
        """Return the design that all loops share, with a learner and a guard."""
        b0 = self.gain_error * self.k / (self.m1 * self.m2)
        observer = ESO.model_free(order=4, b0=b0, omega_o=10.0, dt=self.dt)
        return ADRC(observer, omega_c=1.0, learner=learner, guard=guard)


def draw_loops(count: int, rng: np.random.Generator) -> list[Loop]:
    """Return ``count`` random loops."""
    return [
        Loop(
            m1=rng.uniform(0.5, 2.0),
            m2=rng.uniform(0.5, 2.0),
            k=rng.uniform(0.3, 3.0),
            gain_error=rng.uniform(0.6, 1.6),
            dt=float(rng.choice([1e-3, 2e-3, 5e-3])),
            omega=rng.uniform(0.1, 1.5),
            amplitude=rng.uniform(0.1, 2.0),
            seed=int(rng.integers(2**31)),
        )
        for _ in range(count)
    ]
