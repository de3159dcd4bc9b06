"""Random loops of orders 1 to 4: plants, references, loads; each with MF-ESO, its margin stated.

The unit of time is 1/omega_c, that of y a move of the reference: quell's controllers, learners and
guard do not depend on either. omega_o is 5 to 20, omega_o dt 0.01 to 0.1, b0 wrong by a factor of
0.6 to 1.6. Amplitudes of loads are 0.1 to 3 times omega_c^n, which is what a step of 1 asks of b0 u
at first, on a constant level of up to 30 in half of the loops. A run lasts 250 lags of the
observer, N/omega_o each, and 40/omega_c at least; the load begins to vary after 30 to 60 lags.

``FAMILIES`` names the plants. Poles of linear parts have sizes of 0.05 to 2 omega_c; friction and
gravity have the sizes of loads. "two masses" are those of ``random_loops``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quell.controllers import ADRC
from quell.experiments.stress.general.loads import LOADS, Table, load_table
from quell.experiments.stress.general.margin import modulus_margin
from quell.experiments.stress.general.plant import GeneralPlant
from quell.experiments.stress.general.program import Program, Watched
from quell.experiments.stress.general.references import REFERENCES, reference_table
from quell.guard import Guard
from quell.learners import Learner
from quell.observers import ESO
from quell.plants import LinearPlant, two_mass_spring
from quell.simulation.scenario import Scenario
from quell.types import Vector

Rng = np.random.Generator

FAMILIES = (
    "stable",
    "unstable",
    "lagged",
    "delayed",
    "saturated",
    "quantised",
    "friction",
    "gravity",
    "two masses",
)
# Lags of the observer in a run, and least length in 1/omega_c: METHOD's guard needs 30 lags to
# trust, a step response 12/omega_c.
RUN_LAGS, _LEAST_DURATION = 250.0, 40.0
# Loops below this modulus margin are not drawn: they are hardly stable themselves.
LEAST_MARGIN = 0.2
_MOST_TRIES = 1000


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
    u_limit: float  #: limit of |u| that the controller knows
    plant: GeneralPlant
    margin: float  #: modulus margin of the linear part; the least over its operating points
    noise: float  #: standard deviation of the measurement noise
    level: float  #: constant part of the load
    amplitude: float  #: varying part of the load
    omega: float  #: frequency of the load
    seed: int

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
        return r, w, self.noise * rng.standard_normal(t.size)

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
    omega_o = _log_uniform(rng, 5.0, 20.0)
    dt = _log_uniform(rng, 0.01, 0.1) / omega_o
    b, gain_error = _log_uniform(rng, 0.1, 10.0), rng.uniform(0.6, 1.6)
    level = (
        float(rng.choice([-1.0, 1.0])) * _log_uniform(rng, 0.3, 30.0) * float(rng.random() < 0.5)
    )
    amplitude = _log_uniform(rng, 0.1, 3.0)
    linear, per_load = _linear_part(family, n, b, omega_o, rng)
    if family == "two masses":
        b = linear_gain(linear, n)
    parts: dict[str, float] = {}
    slopes = [0.0]
    u_limit = math.inf
    if family == "delayed":
        parts["delay"] = max(round(_log_uniform(rng, 0.02, 0.5) / omega_o / dt), 1)
    elif family == "quantised":
        parts["quantum"] = _log_uniform(rng, 1e-4, 1e-2) * 0.2 ** (n - 1)
    elif family == "friction":
        parts |= {"velocity": max(n - 1, 0), "friction": _log_uniform(rng, 0.05, 1.0)}
    elif family == "gravity":
        strength, rate = _log_uniform(rng, 0.1, 2.0), _log_uniform(rng, 0.3, 3.0)
        parts |= {"velocity": n - 1, "strength": strength, "rate": rate}
        slopes = [-strength * rate, 0.0, strength * rate]
    elif family == "saturated":
        needed = (abs(level) + amplitude + rng.uniform(0.5, 3.0)) / (gain_error * b)
        if rng.random() < 0.7:
            u_limit = needed
        else:
            parts["limit"] = needed
    loop = GeneralLoop(
        family=family,
        order=n,
        load=str(rng.choice(list(LOADS))),
        reference=str(rng.choice(list(REFERENCES))),
        omega_o=omega_o,
        dt=dt,
        gain_error=gain_error,
        b0=gain_error * b,
        u_limit=u_limit,
        plant=GeneralPlant(linear, **parts),  # type: ignore[arg-type]
        margin=0.0,
        # Times omega_o^n it is the noise of the estimated f, of which loads are 0.1 to 3.
        noise=_log_uniform(rng, 1e-4, 3e-2) / omega_o**n,
        level=level * per_load,
        amplitude=amplitude * per_load,
        omega=_log_uniform(rng, 0.1, 0.2 * omega_o),
        seed=int(rng.integers(2**31)),
    )
    delay = int(parts.get("delay", 0))
    where = parts.get("velocity", 0)
    margins = []
    for slope in slopes:
        A = linear.A.copy()
        A[int(where)] += slope * linear.C[0]
        plant = LinearPlant(A, linear.B, linear.C, linear.E)
        margins.append(modulus_margin(plant, loop.controller(), delay))
    return replace(loop, margin=min(margins))


def linear_gain(plant: LinearPlant, order: int) -> float:
    """Return the gain from u to the derivative of y of that order, ``C A^(n−1) B``."""
    return float((plant.C @ np.linalg.matrix_power(plant.A, order - 1) @ plant.B)[0, 0])


def _linear_part(
    family: str, n: int, b: float, omega_o: float, rng: Rng
) -> tuple[LinearPlant, float]:
    """Return a linear plant of order n, and the load that acts on it as a change of 1 in f does."""
    if family == "two masses":
        m1, m2, k = rng.uniform(0.5, 2.0), rng.uniform(0.5, 2.0), rng.uniform(0.3, 3.0)
        plant = two_mass_spring(m1, m2, k)
        return LinearPlant(plant.A, plant.B, plant.C, plant.E[:, 1:]), 1.0
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -_coefficients(n, family == "unstable", rng)
    B, E, C = b * np.eye(n)[-1:].T, np.eye(n)[-1:].T, np.eye(n)[:1]
    if family == "lagged":
        tau = _log_uniform(rng, 0.03, 1.0) / omega_o
        A = np.block([[A, B], [np.zeros((1, n)), np.full((1, 1), -1.0 / tau)]])
        B = np.eye(n + 1)[-1:].T / tau
        E, C = np.append(E, [[0.0]], axis=0), np.eye(n + 1)[:1]
    return LinearPlant(A, B, C, E), 1.0


def _coefficients(n: int, unstable: bool, rng: Rng) -> Vector:
    """Return ``a_0 … a_{n−1}`` of ``s^n + a_{n−1} s^(n−1) + … + a_0`` with random poles."""
    poles: list[complex] = []
    while len(poles) < n:
        size = _log_uniform(rng, 0.05, 2.0)
        if n - len(poles) >= 2 and rng.random() < 0.5:
            damping = rng.uniform(0.02, 1.0)
            pole = size * complex(-damping, math.sqrt(1.0 - damping**2))
            poles += [pole, pole.conjugate()]
        else:
            poles.append(-size if rng.random() < 0.7 else 0.0)
    if unstable:
        last = poles[-1]
        if isinstance(last, complex) and last.imag != 0.0:
            poles[-2:] = [-p.conjugate() for p in poles[-2:]]
        else:
            poles[-1] = _log_uniform(rng, 0.05, 1.0)
    return np.asarray(np.real(np.poly(poles))[:0:-1])


def _log_uniform(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
