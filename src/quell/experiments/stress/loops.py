"""Random loops of the trial: plants, references, loads, margins.

Loads of the trial, each a table of one value for each sample.

Random loops of orders 1 to 4: plants, references, loads; each with MF-ESO, its margin stated.

The unit of time is 1/omega_c, that of y a move of the reference: quell's controllers, learners and
guard do not depend on either. omega_o is 5 to 20, omega_o dt 0.01 to 0.1, b0 wrong by a factor of
0.6 to 1.6. Amplitudes of loads are 0.1 to 3 times omega_c^n, which is what a step of 1 asks of b0 u
at first, on a constant level of up to 30 in half of the loops. A run lasts 250 lags of the
observer, N/omega_o each, and 40/omega_c at least; the load begins to vary after 30 to 60 lags.

The plants are those of ``random_plants``. Poles of linear parts have sizes of 0.05 to 2 omega_c;
friction and gravity have the sizes of loads; "two masses" are those of the two-mass trial.

One type of plant for all loops of the trial, so that each order of controller compiles once.

A linear plant, padded with zeros to ``STATES`` states, with a dead time, a limit that the
controller does not know, friction, gravity and a quantised output, each of which may be absent::

    x' = A x + B sat(u(t − τ)) + E w + D (p + h),   y = C x, rounded to multiples of the quantum
    p  = −strength sin(rate C x)                      gravity, at the place where friction acts
    h  = −friction sign(v), |h| ≤ friction at v = 0   v a state, D its force input

The linear part is exact for forces that are held over a sample. Gravity is taken in the middle of
the sample. Friction is what brings v to zero within the sample, or ``±friction`` if that is too
little (Moreau's time stepping: Acary & Brogliato, *Numerical Methods for Nonsmooth Dynamical
Systems*, 2008, section 10.1), so a plant at rest stays there, to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from quell.analysis import analyse
from quell.controllers import ADRC
from quell.experiments.stress.adversaries import Program, Watched, log_uniform
from quell.guard import Guard
from quell.learners import Learner
from quell.lti.models import zero_order_hold
from quell.observers import ESO
from quell.plants import LinearPlant, two_mass_spring
from quell.plants.base import advance, measure
from quell.signals import Signal
from quell.simulation.scenario import Scenario
from quell.types import Matrix, Vector

# ---- Loads of the trial, each a table of one value for each sample ----

Rng = np.random.Generator

# From rest to a constant level in so many lags of the observer. The level is there before the load
# varies, and slow enough not to decide the RMS error of the run. Chosen by hand.
_LEVEL_LAGS = 30.0


@dataclass(frozen=True, eq=False)
class Table(Signal):
    """A value for each sample of ``dt`` [s]; the last one holds."""

    values: Vector
    dt: float

    def evaluate(self, t: Vector) -> Vector:
        """Return the values of the samples at ``t``."""
        at = np.rint(t / self.dt).astype(np.int64)
        return np.asarray(self.values[np.clip(at, 0, self.values.size - 1)])


def _sine(t: Vector, rng: Rng, omega: float) -> Vector:
    return np.sin(omega * t)


def _constant(t: Vector, rng: Rng, omega: float) -> Vector:
    return np.ones_like(t)


def _ramp(t: Vector, rng: Rng, omega: float) -> Vector:
    """Return ramps up and, after a hold, down again."""
    end = t[-1] if t.size else 1.0
    corners = np.sort(rng.uniform(0.0, end, 4))
    return np.interp(t, [0.0, *corners, end], [0.0, 0.0, 3.0, 3.0, -1.0, -1.0])


def _steps(t: Vector, rng: Rng, omega: float) -> Vector:
    """Return steps at random times to random heights, about one in two periods."""
    end = t[-1] if t.size else 1.0
    count = max(int(end * omega / (4.0 * np.pi)), 1)
    at = np.sort(rng.uniform(0.0, end, count))
    heights = np.append(1.0, rng.uniform(-1.0, 1.0, count))
    return heights[np.searchsorted(at, t, side="right")]


def _coloured(t: Vector, rng: Rng, omega: float) -> Vector:
    """Return white noise through a lag of bandwidth ω; its standard deviation is 1/√2."""
    from scipy.signal import lfilter

    pole = np.exp(-omega * (t[1] - t[0]))
    drive = np.sqrt(0.5 * (1.0 - pole**2)) * rng.standard_normal(t.size)
    return np.asarray(lfilter([1.0], [1.0, -pole], drive))


def _triangle(t: Vector, rng: Rng, omega: float) -> Vector:
    return 2.0 / np.pi * np.arcsin(np.sin(omega * t))


def _square(t: Vector, rng: Rng, omega: float) -> Vector:
    return np.where(np.sin(omega * t) >= 0.0, 1.0, -1.0)


def _modulated(t: Vector, rng: Rng, omega: float) -> Vector:
    slow = omega * rng.uniform(0.03, 0.3)
    return 0.5 * (1.0 + np.sin(slow * t)) * np.sin(omega * t)


def _chirp(t: Vector, rng: Rng, omega: float) -> Vector:
    """Return a sinusoid that moves by two octaves, up or down, over the whole time."""
    share = t / t[-1]
    exponent = rng.choice([-1.0, 1.0]) * (2.0 * share - 1.0)
    step = t[1] - t[0]
    return np.sin(np.cumsum(omega * 2.0**exponent) * step)


def _jumps(t: Vector, rng: Rng, omega: float) -> Vector:
    """Return a sinusoid with jumps in frequency; its phase has none."""
    count = int(rng.integers(1, 5))
    at = np.sort(rng.uniform(0.0, t[-1], count))
    omegas = omega * 2.0 ** rng.uniform(-1.0, 1.0, count + 1)
    step = t[1] - t[0]
    return np.sin(np.cumsum(omegas[np.searchsorted(at, t)]) * step)


LOADS: dict[str, Callable[[Vector, Rng, float], Vector]] = {
    "constant": _constant,
    "ramp": _ramp,
    "steps": _steps,
    "coloured": _coloured,
    "sine": _sine,
    "triangle": _triangle,
    "square": _square,
    "amplitude-modulated": _modulated,
    "chirp": _chirp,
    "frequency jumps": _jumps,
}
"""A load of amplitude 1 by its kind: functions of the time since its start, and of a frequency."""


def load_table(
    kind: str,
    t: Vector,
    rng: Rng,
    *,
    omega: float,
    amplitude: float,
    level: float,
    start: float,
    lag: float,
) -> Vector:
    """Return a load at the times ``t``: a level that is there first, and what varies from start.

    ``lag`` is that of the observer [s].
    """
    rise = np.clip(t / (_LEVEL_LAGS * lag), 0.0, 1.0)
    table = level * 0.5 * (1.0 - np.cos(np.pi * rise))
    later = t >= start
    table[later] += amplitude * LOADS[kind](t[later] - start, rng, omega)
    return table


# ---- The modulus margin of a loop with MF-ESO ----

# Frequencies of the grid, from a thousandth of omega_c to half the sampling rate: neighbours are
# 4 % apart, and min |1 + L| of a loop without sharp resonances is then right within 1 %.
_POINTS_PER_DECADE = 60
_LOWEST = 1e-3


def modulus_margin(plant: LinearPlant, controller: ADRC, delay: int = 0) -> float:
    """Return ``min |1 + L|`` on a grid of frequencies; zero for an unstable loop.

    ``delay`` is that of the plant's input in samples.
    """
    found = analyse(plant, controller, delay=delay * controller.dt)
    if not found.stable:
        return 0.0
    low, high = _LOWEST * controller.omega_c, np.pi / controller.dt
    omega = np.geomspace(low, high, int(_POINTS_PER_DECADE * np.log10(high / low)) + 1)
    return float(np.min(np.abs(1.0 + found.response("L", omega))))


# ---- One type of plant for all loops of the trial ----

STATES = 5
"""States of each plant without its dead time: order 4 and an actuator's lag."""


class GeneralModel(NamedTuple):
    """The plant, sampled."""

    transition: Matrix  # Φ (STATES, STATES)
    input: Vector  # Γ (STATES,)
    disturbance: Vector  # Γ_w (STATES,)
    force: Vector  # Γ_D (STATES,)
    output: Vector  # C (STATES,)
    velocity: int  # index of the state v
    friction: float
    strength: float
    rate: float  # [1/y-unit]
    dt: float
    limit: float  # of |u|
    quantum: float  # [y-unit]; zero for none


@measure.register(GeneralModel)
def _measure(plant: GeneralModel, x: Vector) -> float:
    y = 0.0
    for i in range(plant.output.size):
        y += plant.output[i] * x[i]
    if plant.quantum > 0.0:
        y = plant.quantum * np.floor(y / plant.quantum + 0.5)
    return y


@advance.register(GeneralModel)
def _advance(
    plant: GeneralModel, x: Vector, scratch: Vector, t: float, u: float, w: Vector
) -> None:
    size, last = plant.output.size, x.size - 1
    if last >= size:
        arriving = x[last]
        for i in range(last, size, -1):
            x[i] = x[i - 1]
        x[size] = u
        u = arriving
    u = min(max(u, -plant.limit), plant.limit)
    p = 0.0
    if plant.strength != 0.0:
        y, rate = 0.0, 0.0
        for i in range(size):
            y += plant.output[i] * x[i]
        rate = x[plant.velocity] if plant.velocity > 0 else 0.0
        p = -plant.strength * math.sin(plant.rate * (y + 0.5 * plant.dt * rate))
    for i in range(size):
        total = plant.input[i] * u + plant.disturbance[i] * w[0] + plant.force[i] * p
        for j in range(size):
            total += plant.transition[i, j] * x[j]
        scratch[i] = total
    if plant.friction > 0.0:
        v = plant.velocity
        h = -scratch[v] / plant.force[v]
        h = min(max(h, -plant.friction), plant.friction)
        for i in range(size):
            scratch[i] += plant.force[i] * h
    for i in range(size):
        x[i] = scratch[i]


@dataclass(frozen=True, eq=False)
class GeneralPlant:
    """A linear plant of up to ``STATES`` states with what real plants have besides.

    Parameters
    ----------
    linear
        its linear part, with one disturbance input.
    delay
        dead time in samples.
    limit
        of ``|u|`` [u-unit], which the controller does not know.
    quantum
        of y [y-unit]; zero for none.
    velocity
        index of the state on which friction and gravity act; its derivative contains their sum.
        Gravity takes it for the velocity of y unless it is zero.
    friction
        Coulomb friction, in units of that derivative.
    strength, rate
        of gravity, ``−strength sin(rate y)`` [1/y-unit].
    """

    linear: LinearPlant
    delay: int = 0
    limit: float = math.inf
    quantum: float = 0.0
    velocity: int = 0
    friction: float = 0.0
    strength: float = 0.0
    rate: float = 1.0
    name: str = "general plant"
    compiled = True

    @property
    def order(self) -> int:
        """Number of states, including the delayed values of u."""
        return STATES + self.delay

    @property
    def disturbances(self) -> int:
        """One."""
        return 1

    def sampled(self, dt: float, interpret: bool = False) -> GeneralModel:
        """Return the parameters for a sample time ``dt`` [s]."""
        n = self.linear.order
        force = np.zeros((n, 1))
        force[self.velocity] = 1.0
        inputs = [self.linear.B, self.linear.E, force]
        phi, columns = zero_order_hold(self.linear.A, inputs, dt)
        transition = np.zeros((STATES, STATES))
        transition[:n, :n] = phi

        def padded(column: Matrix) -> Vector:
            return np.concatenate([np.ravel(column), np.zeros(STATES - n)])

        return GeneralModel(
            transition=transition,
            input=padded(columns[0]),
            disturbance=padded(columns[1]),
            force=padded(columns[2]),
            output=padded(self.linear.C),
            velocity=self.velocity,
            friction=self.friction,
            strength=self.strength,
            rate=self.rate,
            dt=dt,
            limit=self.limit,
            quantum=self.quantum,
        )


# ---- Random plants of the trial, by family ----

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


class DrawnPlant(NamedTuple):
    """A plant, and what its controller and its load have to know."""

    plant: GeneralPlant
    order: int  # of the controller
    b: float  # gain from u to y^(order)
    load: float  # load that acts on f, at low frequencies, as 1 does
    operating_points: tuple[LinearPlant, ...]  # linear plants that it is at its operating points


def draw_plant(family: str, n: int, omega_o: float, dt: float, rng: Rng) -> DrawnPlant:
    """Return a random plant of a family for a controller of order n."""
    if family == "two masses":
        linear = _two_masses(rng)
    elif family in ("friction", "gravity") and n > 2:
        linear = _driven_mass(rng) if n == 3 else _two_masses(rng)
    else:
        linear = _chain(family, n, omega_o, rng)
    b = float((linear.C @ np.linalg.matrix_power(linear.A, n - 1) @ linear.B)[0, 0])
    if b == 0.0:  # a lag in front: its input is scaled so that the gain is that of the chain
        b = float((linear.C @ np.linalg.matrix_power(linear.A, n) @ linear.B)[0, 0])
        b /= -linear.A[-1, -1]
    parts: dict[str, Any] = {}
    slopes = [0.0]
    velocity = {1: 0, 2: 1, 3: 1, 4: 3}[n]
    if family == "delayed":
        parts["delay"] = max(round(log_uniform(rng, 0.02, 0.5) / omega_o / dt), 1)
    elif family == "quantised":
        parts["quantum"] = log_uniform(rng, 1e-4, 1e-2) * 0.2 ** (n - 1)
    elif family == "friction":
        parts |= {"velocity": velocity, "friction": log_uniform(rng, 0.05, 1.0)}
    elif family == "gravity":
        strength, rate = log_uniform(rng, 0.1, 2.0), log_uniform(rng, 0.3, 3.0)
        parts |= {"velocity": velocity, "strength": strength, "rate": rate}
        slopes = [-strength * rate, 0.0, strength * rate]
    points = []
    for slope in slopes:
        A = linear.A.copy()
        A[velocity] += slope * linear.C[0]
        points.append(LinearPlant(A, linear.B, linear.C, linear.E))
    load = 1.0 / load_gain(linear, n)
    return DrawnPlant(GeneralPlant(linear, **parts), n, b, load, tuple(points))


def load_gain(plant: LinearPlant, order: int) -> float:
    """Return the gain from the load to f at low frequencies, of the plant without a lag in front.

    It is the numerator ``C adj(−A) E = det(E C − A) − det(−A)`` of the load's transfer function.
    """
    A, E, C = plant.A[:order, :order], plant.E[:order], plant.C[:, :order]
    return float(np.linalg.det(E @ C - A) - np.linalg.det(-A))


def _two_masses(rng: Rng) -> LinearPlant:
    """Return two masses on a spring, with the load on the second."""
    m1, m2, k = rng.uniform(0.5, 2.0), rng.uniform(0.5, 2.0), rng.uniform(0.3, 3.0)
    plant = two_mass_spring(m1, m2, k)
    return LinearPlant(plant.A, plant.B, plant.C, plant.E[:, 1:])


def _driven_mass(rng: Rng) -> LinearPlant:
    """Return a mass with damping, its load, and a drive with a lag: y, its velocity, the force."""
    damping, lag, gain = log_uniform(rng, 0.05, 2.0), log_uniform(rng, 0.1, 2.0), _gain(rng)
    A = np.array([[0.0, 1.0, 0.0], [0.0, -damping, 1.0], [0.0, 0.0, -1.0 / lag]])
    return LinearPlant(A, [0.0, 0.0, gain], [1.0, 0.0, 0.0], [[0.0], [1.0], [0.0]])


def _chain(family: str, n: int, omega_o: float, rng: Rng) -> LinearPlant:
    """Return ``y^(n) = −a x + b u + w``, with a lag in front of u if it is lagged."""
    b, unit = _gain(rng), np.eye(n)
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -_coefficients(n, family == "unstable", rng)
    B, E, C = b * unit[-1:].T, unit[-1:].T, unit[:1]
    if family == "lagged":
        tau = log_uniform(rng, 0.03, 1.0) / omega_o
        A = np.block([[A, B], [np.zeros((1, n)), np.full((1, 1), -1.0 / tau)]])
        B = np.eye(n + 1)[-1:].T / tau
        E, C = np.append(E, [[0.0]], axis=0), np.eye(n + 1)[:1]
    return LinearPlant(A, B, C, E)


def _gain(rng: Rng) -> float:
    return log_uniform(rng, 0.1, 10.0)


def _coefficients(n: int, unstable: bool, rng: Rng) -> Vector:
    """Return ``a_0 … a_{n−1}`` of ``s^n + a_{n−1} s^(n−1) + … + a_0`` with random poles."""
    poles: list[complex] = []
    while len(poles) < n:
        size = log_uniform(rng, 0.05, 2.0)
        if n - len(poles) >= 2 and rng.random() < 0.5:
            damping = rng.uniform(0.02, 1.0)
            pole = size * complex(-damping, math.sqrt(1.0 - damping**2))
            poles += [pole, pole.conjugate()]
        else:
            poles.append(-size if rng.random() < 0.7 else 0.0)
    if unstable:
        last = complex(poles[-1])
        if last.imag != 0.0:
            poles[-2:] = [-pole.conjugate() for pole in poles[-2:]]
        else:
            poles[-1] = log_uniform(rng, 0.05, 1.0)
    return np.asarray(np.real(np.poly(poles))[:0:-1])


# ---- References of the trial, and the response that the design asks for ----


def _regulation(t: Vector, rng: Rng) -> Vector:
    return np.zeros_like(t)


def _steps_references(t: Vector, rng: Rng) -> Vector:
    """Return steps of up to 1, 15 to 60/omega_c apart."""
    r, at, height = np.zeros_like(t), rng.uniform(0.0, 20.0), 0.0
    while at < t[-1]:
        height += float(np.clip(rng.uniform(-1.0, 1.0), -2.0 - height, 2.0 - height))
        r[t >= at] = height
        at += rng.uniform(15.0, 60.0)
    return r


def _moves(t: Vector, rng: Rng) -> Vector:
    """Return smooth moves of up to 1, 15 to 60/omega_c apart."""
    corners, heights = [0.0], [0.0]
    while corners[-1] < t[-1]:
        rest, move = rng.uniform(5.0, 40.0), rng.uniform(4.0, 20.0)
        corners += [corners[-1] + rest, corners[-1] + rest + move]
        heights += [heights[-1], float(rng.uniform(-1.0, 1.0))]
    at = np.searchsorted(corners, t, side="right") - 1
    at = np.minimum(at, len(corners) - 2)
    low, high = np.asarray(corners)[at], np.asarray(corners)[at + 1]
    share = np.clip((t - low) / (high - low), 0.0, 1.0)
    a, b = np.asarray(heights)[at], np.asarray(heights)[at + 1]
    return a + (b - a) * (10.0 * share**3 - 15.0 * share**4 + 6.0 * share**5)


def _sine_references(t: Vector, rng: Rng) -> Vector:
    return np.sin(log_uniform(rng, 0.1, 1.0) * t)


def _trained(t: Vector, rng: Rng) -> Vector:
    """Return a sinusoid for two fifths of the run, then a step, as the two-mass loops have."""
    return np.where(t < 0.4 * t[-1], np.sin(t), 1.0)


REFERENCES: dict[str, Callable[[Vector, Rng], Vector]] = {
    "regulation": _regulation,
    "steps": _steps_references,
    "smooth moves": _moves,
    "sinusoid": _sine_references,
    "sinusoid, then a step": _trained,
}


def reference_table(kind: str, t: Vector, rng: Rng) -> Vector:
    """Return the reference at the times ``t``."""
    return REFERENCES[kind](t, rng)


def ideal(r: Vector, dt: float, order: int, omega_c: float = 1.0) -> Vector:
    """Return ``(omega_c/(s + omega_c))^n r`` with r held over each sample.

    The first lag is sampled with a held input, exactly; its output is continuous, and the others
    are sampled with an input that is linear between samples (first-order hold).
    """
    from scipy.signal import lfilter

    x = omega_c * dt
    pole = np.exp(-x)
    y = np.append(0.0, lfilter([-np.expm1(-x)], [1.0, -pole], r)[:-1])
    late = 1.0 - (1.0 - pole) / x  # first-order hold: y⁺ = p y + (1 − p − late) u + late u⁺
    for _ in range(order - 1):
        y = lfilter([late, 1.0 - pole - late], [1.0, -pole], y)
    return np.asarray(y)


# ---- Random loops of orders 1 to 4 ----

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


__all__ = ["FAMILIES", "GeneralLoop", "GeneralPlant", "draw_loop"]
