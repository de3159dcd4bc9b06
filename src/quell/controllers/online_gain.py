"""b0 estimated while the loop runs: an inertia that no table knows.

A learner's coefficient of u is no estimate of the gain where loads act: the loop makes u a copy of
the load, and least squares take one for the other. What moves u and y'' together without any load
is the reference. So b is estimated with the reference as an instrument (Young, *Recursive
Estimation and Time-Series Analysis*, 2011; Söderström & Stoica, *Instrumental Variable Methods for
System Identification*, 1983), from the differences that hold exactly for ``y^(n) = b u + f`` with
held u::

    n = 1:  (y_k − y_{k−1})/dt              = b u_{k−1}               + f
    n = 2:  (y_k − 2 y_{k−1} + y_{k−2})/dt² = b (u_{k−1} + u_{k−2})/2 + f

Both sides, a and v, pass the same band filter, two lags 1/ω_f and a high-pass ω_f/5, which leaves
out constant loads and the noise of the differences. The instrument ζ is the same difference of r
behind the law's own response and the same filter. With a memory of T seconds of motion::

    S_a ← λ S_a + ζ a,    S_v ← λ S_v + ζ v,    S_e ← λ S_e + (ζ e)²,    e = a − b̂ v
    b̂ = S_a/S_v,          σ = √(N S_e)/|S_v|,   N = 4/(ω_f dt) + 1 samples that are correlated

From rest to rest an acceleration is orthogonal to viscous and to Coulomb friction, so these do not
bias b̂. Loads that do not follow the reference make σ large and leave b̂ in its place.

**The excitation test.** b0 follows b̂ only while σ is below ``tolerance`` of b̂ and (Σζ²)²/Σζ⁴, the
number of samples that count, is at least 10 N; within the limits, and without a jump of u
(``controllers/schedule.py``). Without motion nothing is forgotten. A load
that repeats with each move, as gravity does, is no disturbance to this estimate but part of it.

**What is certified.** The feedback of an ADRC with b0 is 1/b0 times one that does not depend on
b0, so at a fixed b0 the loop depends on b/b0 alone, and with both in [low, high] it is stable if it
is for all b/b0 in [low/high, high/low]: ``quell.analysis.certify_online`` tells, whatever the
estimate does in there, for a b0 that moves slowly against the loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.controllers import schedule
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import sqrt
from quell.kernels.sized import Flag, Scalars, Size
from quell.observers.eso import ESO
from quell.observers.forms import DelayedModel
from quell.types import Vector

# The high-pass of the filter, as a share of its bandwidth; and the time after which the largest ζ²
# is forgotten [memory times]: samples with less than 1e-4 of it tell nothing and forget nothing.
# Tried on the moves of benchmarks/schedule.py with a share from 0.1 to 0.5: chosen by hand.
_HIGH_PASS, _PEAK_TIME, _NOTHING = 0.2, 10.0, 1e-4
# Least number of independent samples: with 10, σ is known within a fourth.
_LEAST_SAMPLES = 10.0
# Time in which samples are correlated, and the usual memory, in units of 1/ω_f.
_CORRELATED, _MEMORY = 4.0, 300.0


class OnlineDesign(NamedTuple):
    """Parameters of an estimate of b0, for a plant of order 1 or 2."""

    low: float
    high: float
    tolerance: float
    forget: float  # λ
    forget_peak: float
    correlated: float  # N
    lag: float  # pole of the two lags
    edge: float  # pole of the high-pass
    response: float  # pole of the law's response
    per_sample: float  # 1/dt^n
    inverse_b0: float  # 1/b0 of the observer
    order: Size
    is_delayed: Flag


class OnlineLoop(Scalars):
    """Scalars of the estimate, kept from one sample to the next."""

    b0: float  # in use
    found: float  # 1 after the first sample of a loop, else 0
    y: float  # of the sample before
    y_change: float  # the last y less the one before
    r: float
    r_change: float
    u: float  # that acted before the last one
    of_y: float  # S_a
    of_u: float  # S_v
    of_error: float  # S_e
    energy: float  # Σ ζ²
    energy_squared: float  # Σ ζ⁴
    peak: float  # largest ζ² of late
    estimate: float  # b̂ of the last sample with motion; zero before
    deviation: float  # its σ
    excited: float  # 1 if b0 follows, else 0


class OnlineMemory(NamedTuple):
    """State of the estimate."""

    of_y: Vector  # filter of a: two lags, input and output of the high-pass (4,)
    of_u: Vector  # of v (4,)
    of_r: Vector  # of ζ (4,)
    response: Vector  # of the law to r (n,)
    loop: NDArray[OnlineLoop]  # (1,)


@schedule.gain_in_use.register(OnlineDesign)
def _gain_in_use(design: OnlineDesign, memory: OnlineMemory, b0: float) -> float:
    return memory.loop[0].b0


@schedule.control_as_observed.register(OnlineDesign)
def _as_observed(design: OnlineDesign, memory: OnlineMemory, u: float) -> float:
    if design.is_delayed:
        return u
    return u * (memory.loop[0].b0 * design.inverse_b0)


@schedule.known_with_schedule.register(OnlineDesign)
def _known(design: OnlineDesign, memory: OnlineMemory, known: float, b0: float, u: float) -> float:
    if design.is_delayed:
        return known + (memory.loop[0].b0 - b0) * u
    return known


@kernel
def _filtered(design: OnlineDesign, memory: Vector, value: float) -> float:
    """Return a signal behind two lags and a high-pass."""
    for i in range(2):
        memory[i] += (1.0 - design.lag) * (value - memory[i])
        value = memory[i]
    found = design.edge * memory[3] + 0.5 * (1.0 + design.edge) * (value - memory[2])
    memory[2], memory[3] = value, found
    return found


@kernel
def _moves(design: OnlineDesign, own: Any, energy: float) -> bool:
    """Return whether the reference moves enough to tell anything."""
    own.peak = max(own.peak * design.forget_peak, energy)
    return energy > _NOTHING * own.peak


@schedule.follow_signals.register(OnlineDesign)
def _follow(
    design: OnlineDesign, memory: OnlineMemory, loop: Any, z: Vector, estimates: Vector,
    reference: Vector, at_f: int, u: float, continues: bool, safe_set: Any, set_memory: Any,
    held: Any, held_memory: Any,
) -> int:  # fmt: skip
    own = memory.loop[0]
    if own.found == 0.0:
        own.y, own.r, own.u = loop.y, loop.r, u
        own.y_change = own.r_change = 0.0
        own.found = 1.0
        return 0
    y_change, r_change = loop.y - own.y, loop.r - own.r
    of_y, of_r, of_u = y_change, r_change, u
    if design.order == 2:
        of_y, of_r, of_u = y_change - own.y_change, r_change - own.r_change, 0.5 * (u + own.u)
    own.y, own.r, own.u = loop.y, loop.r, u
    own.y_change, own.r_change = y_change, r_change
    a = _filtered(design, memory.of_y, of_y * design.per_sample)
    v = _filtered(design, memory.of_u, of_u)
    of_r *= design.per_sample * design.inverse_b0
    for i in range(design.order):
        memory.response[i] += (1.0 - design.response) * (of_r - memory.response[i])
        of_r = memory.response[i]
    instrument = _filtered(design, memory.of_r, of_r)
    if not _moves(design, own, instrument * instrument):
        return 0
    own.of_y = design.forget * own.of_y + instrument * a
    own.of_u = design.forget * own.of_u + instrument * v
    energy = instrument * instrument
    own.energy = design.forget * own.energy + energy
    own.energy_squared = design.forget * own.energy_squared + energy * energy
    known = own.of_y / own.of_u if own.of_u > 0.0 else own.b0
    error = instrument * (a - known * v)
    own.of_error = design.forget * own.of_error + error * error
    if not (own.of_u > 0.0 and is_finite(own.of_y) and is_finite(own.of_error)):
        if not (is_finite(own.of_u) and is_finite(own.of_y) and is_finite(own.of_error)):
            own.of_y = own.of_u = own.of_error = own.peak = 0.0
            own.energy = own.energy_squared = 0.0
        return 0
    own.estimate = known
    own.excited = 0.0
    own.deviation = sqrt(design.correlated * own.of_error) / own.of_u
    # As many samples count as would have the same Σ ζ² and Σ ζ⁴ with equal ζ: a single move fits
    # any b̂ well.
    counted = own.energy * own.energy
    if (
        own.deviation <= design.tolerance * own.estimate * _sign(design)
        and counted >= _LEAST_SAMPLES * design.correlated * own.energy_squared
    ):
        own.excited = 1.0
        b0 = min(max(own.estimate, design.low), design.high)
        change = (own.b0 - b0) * u
        z[at_f] += change
        estimates[at_f] += change
        own.b0 = b0
    return 0


@kernel
def _sign(design: OnlineDesign) -> float:
    """Return the sign of b0."""
    return 1.0 if design.inverse_b0 > 0.0 else -1.0


@schedule.forget_signals.register(OnlineDesign)
def _forget_motion(design: OnlineDesign, memory: OnlineMemory, b0: float) -> None:
    memory.loop[0].found = 0.0
    for i in range(4):
        memory.of_y[i] = memory.of_u[i] = memory.of_r[i] = 0.0
    for i in range(memory.response.size):
        memory.response[i] = 0.0


# ---- The part of a controller ----


class GainEstimate(NamedTuple):
    """The state of an online estimate of b0."""

    b0: float
    """b0 in use [y-unit/u-unit/s^n]."""
    estimate: float
    """b̂ of the last sample with motion, also outside of the limits; zero before."""
    deviation: float
    """Its standard deviation σ."""
    is_excited: bool
    """Whether the test of the excitation was passed: whether b0 followed."""


@dataclass(frozen=True)
class OnlineGain:
    """b0 that follows an estimate from the reference's motion, for ``ADRC(…, schedule=…)``.

    The module's docstring has the equations. It is off unless it is given. For a plant of order 1
    or 2 without zeros, whose reference moves; not together with a learner, to whom each step of b0
    is a change of f.

    Parameters
    ----------
    low, high
        limits of b0 [y-unit/u-unit/s^n], which the observer's lies within; both of its sign.
    memory_time
        T, the seconds of motion after which a sample has the weight 1/e; ``300/bandwidth`` by
        default, and at least ``80/bandwidth``, or there would never be samples enough.
    tolerance
        largest σ, as a share of b̂, with which b0 follows.
    bandwidth
        ω_f of the filter [rad/s]; omega_c of the controller by default.

    Raises
    ------
    ValueError
        for numbers out of range; in a controller, for a plant of another order.

    Examples
    --------
    >>> import quell as ql
    >>> observer = ql.ESO.model_free(order=2, b0=2000.0, omega_o=300.0, dt=5e-4)
    >>> online = OnlineGain(low=1000.0, high=3000.0)
    >>> controller = ql.ADRC(observer, omega_c=60.0, schedule=online)
    >>> controller.gain_estimate.b0
    2000.0
    """

    low: float
    high: float
    memory_time: float | None = None
    tolerance: float = 0.1
    bandwidth: float | None = None

    def __post_init__(self) -> None:
        low, high = checks.finite("low", self.low), checks.finite("high", self.high)
        if not (low < high and low * high > 0.0):
            raise ValueError(f"low = {low!r}, high = {high!r}: must increase and have one sign")
        checks.optional(checks.positive, "memory_time", self.memory_time, "s")
        if not checks.positive("tolerance", self.tolerance) < 1.0:
            raise ValueError(f"tolerance = {self.tolerance!r}: must be below 1, a share of b")
        checks.optional(checks.positive, "bandwidth", self.bandwidth, "rad/s")

    omega_c = omega_o = None
    external = 0
    signals = ("b0",)

    @property
    def b0(self) -> Sequence[float]:
        """The limits of b0: what it has instead of a table."""
        return (self.low, self.high)

    @property
    def largest_ratio(self) -> float:
        """Largest b/b0 with both within the limits."""
        ends = abs(self.low), abs(self.high)
        return max(ends) / min(ends)

    def at(self, values: Sequence[float], base: schedule.Point) -> schedule.Point:
        """Return the gains for a b0, of which one outside of the limits is at the end."""
        return base._replace(b0=float(min(max(values[0], self.low), self.high)))

    check_retuning = schedule.Schedule.check_retuning

    def design(
        self, observer: ESO, omega_c: float, law: Callable[[float], Vector] | None
    ) -> OnlineDesign:
        """Return the parameters for an observer and a bandwidth [rad/s]."""
        n, dt = observer.order, observer.dt
        if n > 2:
            raise ValueError(
                f"schedule = OnlineGain(...): the observer is of order {n}; the estimate is for "
                "plants of order 1 and 2, and a table (Schedule) for any"
            )
        schedule.check_b0_of(observer)
        if not self.low <= observer.b0 <= self.high:
            raise ValueError(
                f"schedule: b0 = {observer.b0!r} of the observer is outside of low = {self.low!r} "
                f"… high = {self.high!r}: it begins there"
            )
        if law is None:
            raise ValueError(
                "schedule = OnlineGain(...): a compensator has u_0 and not the reference, from "
                "whose motion b is estimated; give it to an ADRC, or take a table (Schedule)"
            )
        omega = omega_c if self.bandwidth is None else float(self.bandwidth)
        memory_time = _MEMORY / omega if self.memory_time is None else float(self.memory_time)
        least = 2.0 * _LEAST_SAMPLES * _CORRELATED / omega
        if memory_time < least:
            raise ValueError(
                f"memory_time = {memory_time!r} s: must be at least {least:.3g} s with a bandwidth "
                f"of {omega:.4g} rad/s, or there would never be samples enough"
            )
        return OnlineDesign(
            low=float(self.low),
            high=float(self.high),
            tolerance=float(self.tolerance),
            forget=math.exp(-dt / memory_time),
            forget_peak=math.exp(-dt / (_PEAK_TIME * memory_time)),
            correlated=_CORRELATED / (omega * dt) + 1.0,
            lag=math.exp(-omega * dt),
            edge=math.exp(-_HIGH_PASS * omega * dt),
            response=math.exp(-omega_c * dt),
            per_sample=dt**-n,
            inverse_b0=1.0 / observer.b0,
            order=n,
            is_delayed=isinstance(observer.model, DelayedModel),
        )

    def memory(self, design: OnlineDesign) -> OnlineMemory:
        """Return the state before the first sample."""
        loop = OnlineLoop.zeros()
        loop[0].b0 = 1.0 / design.inverse_b0
        response = np.zeros(design.order)
        return OnlineMemory(np.zeros(4), np.zeros(4), np.zeros(4), response, loop)

    def read(self, memory: OnlineMemory) -> GainEstimate:
        """Return what is known of b."""
        own = memory.loop[0]
        estimate, deviation = float(own.estimate), float(own.deviation)
        return GainEstimate(float(own.b0), estimate, deviation, bool(own.excited))
