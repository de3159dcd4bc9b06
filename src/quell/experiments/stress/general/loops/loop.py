"""Random loops of orders 1 to 4: plants, references, loads; each with MF-ESO, its margin stated.

The unit of time is 1/omega_c, that of y a move of the reference: quell's controllers, learners and
guard do not depend on either. omega_o is 5 to 20, omega_o dt 0.01 to 0.1, b0 wrong by a factor of
0.6 to 1.6. Amplitudes of loads are 0.1 to 3 times omega_c^n, which is what a step of 1 asks of b0 u
at first, on a constant level of up to 30 in half of the loops. A run lasts 250 lags of the
observer, N/omega_o each, and 40/omega_c at least; the load begins to vary after 30 to 60 lags.

The plants are those of ``random_plants``. Poles of linear parts have sizes of 0.05 to 2 omega_c;
friction and gravity have the sizes of loads; "two masses" are those of the two-mass trial.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quell.controllers import ADRC
from quell.experiments.stress.adversaries import log_uniform
from quell.experiments.stress.general.loops.loads import LOADS, Table, load_table
from quell.experiments.stress.general.loops.margin import modulus_margin
from quell.experiments.stress.general.loops.plant import GeneralPlant
from quell.experiments.stress.general.loops.random_plants import FAMILIES, draw_plant
from quell.experiments.stress.general.loops.references import REFERENCES, reference_table
from quell.experiments.stress.general.program import Program, Watched
from quell.guard import Guard
from quell.learners import Learner
from quell.observers import ESO
from quell.simulation.scenario import Scenario
from quell.types import Vector

Rng = np.random.Generator

# Lags of the observer in a run, and least length in 1/omega_c: the guard needs 30 lags to
# trust, a step response 12/omega_c.
RUN_LAGS, _LEAST_DURATION = 250.0, 40.0
# Loops below this modulus margin are not drawn: they are hardly stable themselves.
LEAST_MARGIN = 0.2
_MOST_TRIES = 1000
# Share of the limits of u that the controller knows.
_KNOWN_LIMITS = 0.7


@dataclass(frozen=True, eq=False)
class GeneralLoop:
    """A plant, its controller without learner, and what acts on it."""

    family: str
    order: int  #: order n of the controller
    load: str  #: kind of the load
    reference: str  #: kind of the reference
    omega_o: float
    dt: float
    gain_error: float  #: b0 / b
    b0: float
    u_limit: float  #: limit of ``|u|`` that the controller knows
    plant: GeneralPlant
    margin: float  #: modulus margin of the linear part; the least over its operating points
    noise: float  #: standard deviation of the measurement noise
    level: float  #: constant part of the load
    amplitude: float  #: varying part of the load
    omega: float  #: frequency of the load
    seed: int
    draw: int = 0  #: which draw of the measurement noise; all else is the same

    @property
    def lag(self) -> float:
        """Lag N/omega_o of the observer [s]."""
        return (self.order + 1) / self.omega_o

    @property
    def samples(self) -> int:
        """Number of samples of a run."""
        return round(max(RUN_LAGS * self.lag, _LEAST_DURATION) / self.dt) + 1

    @cached_property
    def tables(self) -> tuple[Vector, Vector, Vector]:
        """Reference, load and noise, a value for each sample."""
        rng = np.random.default_rng(self.seed)
        t: Vector = self.dt * np.arange(self.samples, dtype=np.float64)
        start = rng.uniform(30.0, 60.0) * self.lag
        r = reference_table(self.reference, t, rng)
        w = load_table(
            self.load,
            t,
            rng,
            omega=self.omega,
            amplitude=self.amplitude,
            level=self.level,
            start=start,
            lag=self.lag,
        )
        return r, w, self.noise * rng.standard_normal((self.draw + 1, t.size))[-1]

    @property
    def scenario(self) -> Scenario:
        """Reference, load and noise for ``simulate``."""
        r, w, noise = (Table(values, self.dt) for values in self.tables)
        return Scenario(r, (self.samples - 1) * self.dt, (w,), noise)

    def controller(self, learner: Learner | None = None, guard: Guard | None = None) -> ADRC:
        """Return the controller, with a learner and a guard."""
        observer = ESO.model_free(self.order, self.b0, self.omega_o, self.dt)
        limit, kind = self.u_limit, Watched if isinstance(learner, Program) else ADRC
        return kind(observer, 1.0, learner=learner, guard=guard, u_min=-limit, u_max=limit)

    def describe(self) -> str:
        """Return what a table shows of it."""
        return (
            f"order {self.order}, {self.family}, {self.load} on {self.level:.3g}, "
            f"{self.reference}, margin {self.margin:.2f}, seed {self.seed}"
        )


def draw_loop(rng: Rng, family: str | None = None, order: int | None = None) -> GeneralLoop:
    """Return a random loop, of a family and an order if they are given."""
    for _ in range(_MOST_TRIES):
        loop = _draw(rng, family, order)
        if loop.margin >= LEAST_MARGIN:
            return loop
    raise ValueError(f"family = {family!r}, order = {order!r}: no loop with a margin was found")


def _draw(rng: Rng, family: str | None, order: int | None) -> GeneralLoop:
    family = family or str(rng.choice(FAMILIES if order in (None, 4) else FAMILIES[:-1]))
    n = 4 if family == "two masses" else order or int(rng.integers(1, 5))
    omega_o = log_uniform(rng, 5.0, 20.0)
    dt = log_uniform(rng, 0.01, 0.1) / omega_o
    gain_error, amplitude = rng.uniform(0.6, 1.6), log_uniform(rng, 0.1, 3.0)
    level = float(rng.choice([-1.0, 1.0])) * log_uniform(rng, 0.3, 30.0)
    level = level if rng.random() < 0.5 else 0.0
    drawn = draw_plant(family, n, omega_o, dt, rng)
    plant, u_limit = drawn.plant, math.inf
    if family == "saturated":
        hold = abs(level) + amplitude + abs(plant.linear.A[n - 1, 0])  # of y = 1 under the load
        needed = (hold + rng.uniform(0.5, 3.0)) / (gain_error * abs(drawn.b))
        if rng.random() < _KNOWN_LIMITS:
            u_limit = needed
        else:
            plant = replace(plant, limit=needed)
    loop = GeneralLoop(
        family=family,
        order=n,
        load=str(rng.choice(list(LOADS))),
        reference=str(rng.choice(list(REFERENCES))),
        omega_o=omega_o,
        dt=dt,
        gain_error=gain_error,
        b0=gain_error * drawn.b,
        u_limit=u_limit,
        plant=plant,
        margin=0.0,
        # Times omega_o^n it is the noise of the estimated f, of which loads are 0.1 to 3.
        noise=log_uniform(rng, 1e-4, 3e-2) / omega_o**n,
        level=level * drawn.load,
        amplitude=amplitude * drawn.load,
        omega=log_uniform(rng, 0.1, 0.2 * omega_o),
        seed=int(rng.integers(2**31)),
    )
    controller = loop.controller()
    margins = (modulus_margin(p, controller, plant.delay) for p in drawn.operating_points)
    return replace(loop, margin=min(margins))
