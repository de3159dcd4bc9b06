"""The lag-compensated learner: a Kalman filter that knows the observer's own lag.

With the features φ (state, bias, u) and what the observer shows of them, φ^F (``lag.py``), each sample::

    ε = Δf̂ + f_L^F − θ·φ^F
    g = P φ^F / (φ^F·P φ^F + R/dt),    θ ← θ + g ε,    P ← P − g (P φ^F)ᵀ + Q dt

Q and R are continuous-time densities, so that the tuning does not change with dt.

*Measurement noise.* ``R = τ E[ε² + (0.1 (Δf̂ + f_L^F))² + …]``: the mean is an exponential one, and τ = N/omega_o, the observer's lag, is how
long the noise of Δf̂ is correlated. What the learner cannot explain it takes for noise, and then learns less from it; and it does not
believe that a linear model explains more than nine tenths of what it sees, or the first instant of a motion would settle θ for good.

*Random walk.* The walk of the bias is stated as a tracking bandwidth λ, with ``Q = λ² R``: the steady Kalman gain of a random walk
in white noise is ``sqrt(Q/R)``, so a constant disturbance is learned with the time constant 1/λ, whatever its unit.

*Start.* From rest the observer's own initial error is in Δf̂, and so is not f: the learner watches for 2 N/omega_o seconds before it learns.
Rounding is not data either: no measurement of y counts as better than a billionth of its size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quell import checks
from quell.dispatch import kernel
from quell.learners.base import adapt, coefficients, commit, predict, restart
from quell.learners.lag import Lag, lag_of, lag_push
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# The share of f that a model is taken to leave unexplained, at least.
_DOUBT = 0.1
# No sensor resolves better than about 30 bits of what it measures.
_RESOLUTION = 1e-9
# In units of the observer's lag: after this its initial error has decayed to a part in a thousand.
_WATCH = 2.0


class KalmanDesign(NamedTuple):
    """Parameters for an observer of order n, with p features in the order state, bias, u."""

    lag: Lag
    scale: Vector
    """(p,): a feature is its signal times this, O(1)."""
    walk: Vector
    """(p,): λ² [1/s²]."""
    prior: Vector
    """(p,): standard deviation of θ before anything is known, in scaled units."""
    states: int
    """n, or 0 without state features."""
    bias: bool
    with_u: bool
    slope_low: float
    """Least θ_u, in scaled units."""
    slope_high: float
    """Largest θ_u."""
    dt: float
    forget: float
    """dt over the averaging time of E[ε²]."""
    noise_time: float
    """τ [s]."""
    floor: float
    """What a measurement of y is at best good for, in units of Δf̂ per y."""


class KalmanMemory(NamedTuple):
    """State of the learner."""

    theta: Vector
    """(p,), scaled."""
    covariance: Matrix
    """P (p, p)."""
    chain: Matrix
    """(p + 1, N): the lag filters of the features and, last, of f_L."""
    filtered: Vector
    """(p + 1,): what they show."""
    gain: Vector
    """(p,): room for P φ^F."""
    moment: Vector
    """(3,): E[ε²], how much of its average is filled, seconds since the start from rest."""


@adapt.register(KalmanDesign)
def _adapt(learner: KalmanDesign, memory: KalmanMemory, seen: Vector, u_before: float) -> None:
    theta, covariance, filtered, gain = memory.theta, memory.covariance, memory.filtered, memory.gain
    size = theta.size
    # Plain loops: at this size a call of BLAS costs more than the arithmetic.
    target = seen[seen.size - 1] + filtered[size]
    innovation = target
    spread = 0.0
    for i in range(size):
        innovation -= theta[i] * filtered[i]
        total = 0.0
        for j in range(size):
            total += covariance[i, j] * filtered[j]
        gain[i] = total
        spread += total * filtered[i]
    noise = _noise_density(learner, memory.moment, innovation, _DOUBT * target, learner.floor * seen[0])
    memory.moment[2] += learner.dt
    spread += noise / learner.dt
    if memory.moment[2] > _WATCH * learner.noise_time and spread > 0.0:
        inverse = 1.0 / spread
        for i in range(size):
            share = gain[i] * inverse
            theta[i] += share * innovation
            for j in range(size):
                covariance[i, j] -= share * gain[j]
            covariance[i, i] += learner.walk[i] * noise * learner.dt
        if learner.with_u:
            theta[size - 1] = min(max(theta[size - 1], learner.slope_low), learner.slope_high)


@kernel
def _noise_density(learner: KalmanDesign, moment: Vector, innovation: float, doubt: float, least: float) -> float:
    """Return R; the first values of the mean count fully, so that it starts where the data is."""
    moment[0] += learner.forget * (innovation * innovation + doubt * doubt + least * least - moment[0])
    moment[1] += learner.forget * (1.0 - moment[1])
    return moment[0] / moment[1] * learner.noise_time


@predict.register(KalmanDesign)
def _predict(learner: KalmanDesign, memory: KalmanMemory, seen: Vector, u_before: float) -> tuple[float, float]:
    constant = 0.0
    for i in range(learner.states):
        constant += memory.theta[i] * learner.scale[i] * seen[i]
    if learner.bias:
        constant += memory.theta[learner.states]
    last = memory.theta.size - 1
    slope = memory.theta[last] * learner.scale[last] if learner.with_u else 0.0
    return constant, slope


@commit.register(KalmanDesign)
def _commit(learner: KalmanDesign, memory: KalmanMemory, seen: Vector, u: float, f_learned: float) -> None:
    chain, filtered = memory.chain, memory.filtered
    size = memory.theta.size
    for i in range(learner.states):
        filtered[i] = lag_push(learner.lag, chain, i, learner.scale[i] * seen[i])
    if learner.bias:
        filtered[learner.states] = lag_push(learner.lag, chain, learner.states, 1.0)
    if learner.with_u:
        filtered[size - 1] = lag_push(learner.lag, chain, size - 1, learner.scale[size - 1] * u)
    filtered[size] = lag_push(learner.lag, chain, size, f_learned)


@restart.register(KalmanDesign)
def _restart(learner: KalmanDesign, memory: KalmanMemory) -> None:
    finite = math.isfinite(memory.moment[0])
    for i in range(memory.filtered.size):
        memory.filtered[i] = 0.0
        for j in range(learner.lag.taps.size):
            memory.chain[i, j] = 0.0
    for i in range(memory.theta.size):
        for j in range(memory.theta.size):
            finite = finite and math.isfinite(memory.covariance[i, j])
        finite = finite and math.isfinite(memory.theta[i])
    memory.moment[2] = 0.0
    if not finite:
        memory.moment[0] = memory.moment[1] = 0.0
        for i in range(memory.theta.size):
            memory.theta[i] = 0.0
            for j in range(memory.theta.size):
                memory.covariance[i, j] = learner.prior[i] ** 2 if i == j else 0.0


@coefficients.register(KalmanDesign)
def _coefficients(learner: KalmanDesign, memory: KalmanMemory, theta: Vector) -> None:
    for i in range(theta.size):
        theta[i] = memory.theta[i] * learner.scale[i]


@dataclass(frozen=True)
class Kalman:
    """A linear learner that compensates the observer's lag: ``f_L = θ · (x̂_1 … x̂_n, 1, u)``.

    Parameters
    ----------
    state, bias, u
        which features it has. With ``u`` it can learn that the plant's gain is not b0, which only the excitation of all states and u
        together can tell; it is out by default.
    bias_bandwidth
        how fast the bias follows, λ [rad/s]; ``omega_o`` of the observer by default. Smaller is smoother, larger rejects more.
    state_bandwidth
        the same for the coefficients of the state, and of u [rad/s]; zero by default, as a plant's coefficients do not drift.
    frequency
        a frequency the plant has [rad/s]: feature i is ``x̂_i / frequency^(i−1)``, which should be O(1).
    prior
        how large the coefficients may be, as a multiple of ``frequency^(n−i+1)``.
    innovation_time
        over how long the innovation's power is averaged [s].
    gain_interval
        where the effective gain ``(b0 + θ_u)/b0`` is kept when ``u`` is a feature.

    Raises
    ------
    ValueError
        for a parameter out of range, or where no feature is left.

    References
    ----------
    docs/theory: the paper's Algorithm 1, its three weaknesses, and what cures them.
    """

    state: bool = True
    bias: bool = True
    u: bool = False
    bias_bandwidth: float | None = None
    state_bandwidth: float = 0.0
    frequency: float = 1.0
    prior: float = 10.0
    innovation_time: float = 5.0
    gain_interval: tuple[float, float] = (0.5, 2.0)

    def __post_init__(self) -> None:
        if not (self.state or self.bias or self.u):
            raise ValueError("state = False, bias = False, u = False: at least one feature must be left to learn")
        if self.bias_bandwidth is not None:
            checks.non_negative("bias_bandwidth", self.bias_bandwidth, "rad/s")
        checks.non_negative("state_bandwidth", self.state_bandwidth, "rad/s")
        checks.positive("frequency", self.frequency, "rad/s")
        checks.positive("prior", self.prior)
        checks.positive("innovation_time", self.innovation_time, "s")
        low, high = checks.vector("gain_interval", self.gain_interval, 2)
        if not 0.0 < low <= 1.0 <= high:
            raise ValueError(f"gain_interval = {self.gain_interval!r}: must be (low, high) with 0 < low <= 1 <= high")

    def design(self, observer: ESO) -> KalmanDesign:
        """Return the parameters for ``observer``."""
        n, w = observer.order, float(self.frequency)
        orders = np.arange(n * self.state)
        follow = observer.omega_o if self.bias_bandwidth is None else self.bias_bandwidth
        slow = self.state_bandwidth**2
        slopes = sorted(share - 1.0 for share in self.gain_interval)
        lag_time = (n + 1) / observer.omega_o
        return KalmanDesign(
            lag=lag_of(observer),
            scale=np.array([*w ** -orders.astype(float), *[1.0] * self.bias, *[observer.b0] * self.u]),
            walk=np.array([*[slow] * orders.size, *[follow**2] * self.bias, *[slow] * self.u]),
            # The bias needs no prior: its walk opens P within 1/λ. For u the scale is b0, so that θ_u is a share of it.
            prior=np.array([*[self.prior * w**n] * orders.size, *[0.0] * self.bias, *[1.0] * self.u]),
            states=orders.size,
            bias=self.bias,
            with_u=self.u,
            slope_low=slopes[0],
            slope_high=slopes[1],
            dt=observer.dt,
            forget=-math.expm1(-observer.dt / self.innovation_time),
            noise_time=lag_time,
            floor=_RESOLUTION * observer.omega_o**n,
        )

    def memory(self, parameters: KalmanDesign) -> KalmanMemory:
        """Return θ = 0 with the prior's covariance, and filters at rest."""
        p, size = parameters.scale.size, parameters.lag.taps.size
        return KalmanMemory(
            theta=np.zeros(p),
            covariance=np.diag(parameters.prior**2),
            chain=np.zeros((p + 1, size)),
            filtered=np.zeros(p + 1),
            gain=np.zeros(p),
            moment=np.zeros(3),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1", …, "bias", "u")``, as far as they are features."""
        return (*(f"x{i + 1}" for i in range(order * self.state)), *["bias"] * self.bias, *["u"] * self.u)
