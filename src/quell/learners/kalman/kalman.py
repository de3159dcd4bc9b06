"""The lag-compensated learner: a Kalman filter that knows the observer's own lag.

With the features φ (state, bias, u) and what the observer shows of them, φ^F (``lag.py``), each sample::

    ε = Δf̂ + f_L^F − θ·φ^F
    g = P φ̃ / max(φ̃·P φ̃ + 1/dt, φ̃·P φ̃ / (λ_m dt)),    θ ← θ + g ε,    P ← P − g (P φ̃)ᵀ + Q dt

All are continuous-time densities, so the tuning does not change with dt. Coefficients of the state and of u are measured in noise of
density ``R = τ E[ε² + (0.1 f̂)² + σ²]``: for them φ̃ = φ^F/√R and ε/√R take the place of φ^F and ε. The bias is measured in units of R
itself.

*R follows the innovation.* What the learner can't explain it takes for noise, and learns less from it. Nor does it believe that a linear
model explains more than nine tenths of f, or that f̂ is better than σ, what the measurement noise, or rounding, leaves in it. The mean is
an exponential one; τ = N/omega_o, the observer's lag, is how long the noise of Δf̂ is correlated. The bias does not follow R: a gain that
follows the noise folds its high frequencies down to where the loop is sensitive.

*Random walk.* A walk is given as a tracking bandwidth λ. For the bias ``Q = λ²``: the steady Kalman gain of a random walk in white noise is
``sqrt(Q/R)``, so a constant disturbance is learned with the time constant 1/λ, whatever its unit. For a feature of variance φ² it is
``λ² R/φ²``. All features together learn no faster than λ_m, the larger of omega_o and the bias's bandwidth: the observer can't check what
is faster.

*What teaches.* The observer's estimates of higher derivatives are noisy. At rest they are nothing but noise, and regression on noise finds
something, slowly and confidently. So a feature teaches only while its variance is ``SIGNAL_TO_NOISE²`` times what the measurement noise, seen in
y − x̂_1, puts into it; else its place in φ̃ is zero. Rounding counts as noise too. What is constant in a feature is the bias's business,
where there is one: φ̃ has the feature less its running mean, and the bias gives up at the mean what a coefficient gains.

*Start.* From rest the observer's own initial error is in Δf̂, and so is not f: the learner watches for 2 τ before it learns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quell import checks
from quell.kernels.dispatch import is_finite, kernel
from quell.learners.base import adapt, coefficients, commit, predict, restart
from quell.learners.kalman.oscillators import Oscillators, retune, turn_phases
from quell.learners.lag import STARTUP_LAGS, lag_memory, lag_of, lag_push
from quell.learners.noise_gate import AVERAGING_LAGS, RESOLUTION, SIGNAL_TO_NOISE, relative_noise
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# The share of f that a linear model is taken to leave unexplained, at least.
_DOUBT = 0.1

# Places in KalmanMemory.moment.
_NOISE, _UNEXPLAINED, _FILLED, _SINCE = range(4)


class KalmanDesign(NamedTuple):
    """Parameters for an observer of order n, with p features in the order state, bias, oscillators' pairs, u."""

    lag: Any
    scale: Vector
    """(p,): a feature is its signal times this."""
    walk: Vector
    """(p,): λ² [1/s²]."""
    threshold: Vector
    """(p,): least variance with which a feature teaches, in units of that of y − x̂_1; 0 for the bias, which always does."""
    prior: Vector
    """(p,): standard deviation of θ before anything is known, in scaled units; 0 for the bias, whose walk opens P by itself."""
    fastest: float
    """λ_m [rad/s]."""
    f_noise: float
    """Variance that white noise of unit variance in y leaves in f̂."""
    states: int
    """n, or 0 without state features."""
    bias: bool
    oscillators: Oscillators
    with_u: bool
    slope_low: float
    """Least θ_u, in scaled units."""
    slope_high: float
    """Largest θ_u."""
    dt: float
    forget: float
    """dt over the averaging time of mean squares."""
    lag_time: float
    """τ [s]."""


class KalmanMemory(NamedTuple):
    """State of the learner."""

    theta: Vector
    """(p,), scaled."""
    covariance: Matrix
    """P (p, p); for the bias in units of R."""
    chain: Matrix
    """(p, N): the lag filters of the features."""
    filtered: Vector
    """(p,): what they show."""
    mean: Vector
    """(p,): running means of the features."""
    variance: Vector
    """(p,): their running variances."""
    taught: Vector
    """(p,): φ̃ of the newest sample."""
    gain: Vector
    """(p,): room for P φ̃."""
    phase: Vector
    """ψ of each oscillator [rad] (m,)."""
    omega: Vector
    """ω̂ of each [rad/s] (m,)."""
    moment: Vector
    """(4,): mean squares of y − x̂_1 and of what is not explained, how much of them is filled, seconds since the start from rest."""


@adapt.register(KalmanDesign)
def _adapt(
    learner: KalmanDesign,
    memory: KalmanMemory,
    seen: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    theta, covariance, filtered, mean, variance = (
        memory.theta,
        memory.covariance,
        memory.filtered,
        memory.mean,
        memory.variance,
    )
    taught, gain, moment = memory.taught, memory.gain, memory.moment
    size = theta.size
    # Plain loops: at this size a call of BLAS costs more than the arithmetic.
    innovation = f_plain
    for i in range(size):
        innovation -= theta[i] * filtered[i]
    noise, deviation = _watch(learner, moment, y, y - seen[0], innovation, f_plain)
    if not is_finite(deviation):  # a measurement beyond all numbers, perhaps
        restart(learner, memory)
        return
    if deviation == 0.0:
        return
    weight = 1.0 / deviation
    for i in range(size):
        if learner.threshold[i] == 0.0:
            taught[i] = filtered[i]
        else:
            away = filtered[i] - mean[i]
            mean[i] += learner.forget * away
            variance[i] += learner.forget * (away * away - variance[i])
            centre = mean[i] if learner.bias else 0.0
            taught[i] = (
                weight * (filtered[i] - centre)
                if variance[i] > learner.threshold[i] * noise
                else 0.0
            )
    if moment[_SINCE] <= STARTUP_LAGS * learner.lag_time:
        return
    spread = 0.0
    for i in range(size):
        total = 0.0
        for j in range(size):
            total += covariance[i, j] * taught[j]
        gain[i] = total
        spread += total * taught[i]
    if spread < 0.0:  # P is no covariance any more: rather learn nothing
        return
    inverse = 1.0 / max(spread + 1.0 / learner.dt, spread / (learner.fastest * learner.dt))
    for i in range(size):
        share = gain[i] * inverse
        for j in range(size):
            covariance[i, j] -= share * gain[j]
        if learner.threshold[i] == 0.0:
            theta[i] += share * innovation
            covariance[i, i] += learner.walk[i] * learner.dt
        else:
            wished = theta[i] + share * innovation * weight
            if learner.with_u and i == size - 1:
                wished = min(max(wished, learner.slope_low), learner.slope_high)
            change = wished - theta[i]
            theta[i] = wished
            if learner.bias:
                theta[learner.states] -= change * mean[i]
            if taught[i] != 0.0:
                covariance[i, i] += (
                    learner.walk[i] * learner.dt * deviation * deviation / variance[i]
                )
    step = inverse * innovation
    for j in range(memory.omega.size):
        at = learner.oscillators.first + 2 * j
        retune(
            learner.oscillators,
            memory.omega,
            j,
            theta,
            step * gain[at],
            step * gain[at + 1],
            moment[_UNEXPLAINED],
        )


@kernel
def _watch(
    learner: KalmanDesign, moment: Vector, y: float, error: float, innovation: float, target: float
) -> tuple[float, float]:
    """Take note of a sample; return the mean square of y − x̂_1, and √R. In the means the first values count fully."""
    rounding, doubt = RESOLUTION * y, _DOUBT * target
    moment[_NOISE] += learner.forget * (error * error + rounding * rounding - moment[_NOISE])
    moment[_UNEXPLAINED] += learner.forget * (
        innovation * innovation + doubt * doubt - moment[_UNEXPLAINED]
    )
    moment[_FILLED] += learner.forget * (1.0 - moment[_FILLED])
    moment[_SINCE] += learner.dt
    unexplained = moment[_UNEXPLAINED] + learner.f_noise * moment[_NOISE]
    return moment[_NOISE] / moment[_FILLED], math.sqrt(
        learner.lag_time * unexplained / moment[_FILLED]
    )


@predict.register(KalmanDesign)
def _predict(
    learner: KalmanDesign, memory: KalmanMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    constant = 0.0
    for i in range(learner.states):
        constant += memory.theta[i] * learner.scale[i] * seen[i]
    if learner.bias:
        constant += memory.theta[learner.states]
    for j in range(memory.phase.size):
        at = learner.oscillators.first + 2 * j
        constant += memory.theta[at] * math.sin(memory.phase[j]) + memory.theta[at + 1] * math.cos(
            memory.phase[j]
        )
    last = memory.theta.size - 1
    slope = memory.theta[last] * learner.scale[last] if learner.with_u else 0.0
    return constant, slope


@commit.register(KalmanDesign)
def _commit(
    learner: KalmanDesign, memory: KalmanMemory, seen: Vector, u: float, f_learned: float
) -> None:
    chain, filtered = memory.chain, memory.filtered
    size = memory.theta.size
    for i in range(learner.states):
        filtered[i] = lag_push(learner.lag, chain, i, learner.scale[i] * seen[i])
    if learner.bias:
        filtered[learner.states] = lag_push(learner.lag, chain, learner.states, 1.0)
    for j in range(memory.phase.size):
        at = learner.oscillators.first + 2 * j
        filtered[at] = lag_push(learner.lag, chain, at, math.sin(memory.phase[j]))
        filtered[at + 1] = lag_push(learner.lag, chain, at + 1, math.cos(memory.phase[j]))
    turn_phases(memory.phase, memory.omega, learner.dt)
    if learner.with_u:
        filtered[size - 1] = lag_push(learner.lag, chain, size - 1, learner.scale[size - 1] * u)


@restart.register(KalmanDesign)
def _restart(learner: KalmanDesign, memory: KalmanMemory) -> None:
    size = memory.theta.size
    finite = is_finite(memory.moment[_NOISE]) and is_finite(memory.moment[_UNEXPLAINED])
    for i in range(size):
        memory.filtered[i] = 0.0
        for j in range(memory.chain.shape[1]):
            memory.chain[i, j] = 0.0
    for j in range(memory.omega.size):
        finite = finite and is_finite(memory.omega[j]) and is_finite(memory.phase[j])
    for i in range(size):
        finite = (
            finite
            and is_finite(memory.theta[i])
            and is_finite(memory.mean[i])
            and is_finite(memory.variance[i])
        )
        for j in range(size):
            finite = finite and is_finite(memory.covariance[i, j])
    memory.moment[_SINCE] = 0.0
    if not finite:
        for k in range(memory.moment.size):
            memory.moment[k] = 0.0
        for j in range(memory.omega.size):
            memory.phase[j] = 0.0
            memory.omega[j] = learner.oscillators.omega[j]
        for i in range(size):
            memory.theta[i] = memory.mean[i] = memory.variance[i] = memory.taught[i] = memory.gain[
                i
            ] = 0.0
            for j in range(size):
                memory.covariance[i, j] = learner.prior[i] ** 2 if i == j else 0.0


@coefficients.register(KalmanDesign)
def _coefficients(learner: KalmanDesign, memory: KalmanMemory, theta: Vector) -> None:
    for i in range(theta.size):
        theta[i] = memory.theta[i] * learner.scale[i]


@dataclass(frozen=True)
class Kalman:
    """A linear learner that compensates the observer's lag: ``f_L = θ · (x̂_1 … x̂_n, 1, u)``.

    Nothing in it depends on the unit of y or u.

    Parameters
    ----------
    state, bias, u
        which features it has. Without a bias a load that stays is taken for a property of the plant. With ``u`` the learner can learn
        that the plant's gain is not b0; it is out by default, because a loop that rejects a disturbance makes u a copy of it.
    bias_bandwidth
        how fast the bias follows, λ [rad/s]; ``omega_o`` of the observer by default. Smaller is smoother, larger rejects more.
    state_bandwidth
        the same for the coefficients of the state [rad/s], one for all or one for each; zero by default, as a plant's coefficients do
        not drift. The coefficient of u, where it is a feature, does not either.
    frequency
        a frequency the plant has [rad/s]; ``omega_c`` of the controller by default. By it state i is scaled, to one size with the others.
    prior
        how large the coefficients may be: coefficient i is of the order of ``prior · frequency^(n−i+1)``, for a plant
        with zeros in f's way with the relative degree from f in the place of n.
    gain_interval
        where the effective gain ``(b0 + θ_u)/b0`` is kept when ``u`` is a feature.

    Raises
    ------
    ValueError
        for a parameter out of range, or where no feature is left.

    References
    ----------
    docs/theory: the paper's Algorithm 1, its weaknesses, and what cures them.
    """

    state: bool = True
    bias: bool = True
    u: bool = False
    bias_bandwidth: float | None = None
    state_bandwidth: float | Sequence[float] = 0.0
    frequency: float | None = None
    prior: float = 10.0
    gain_interval: tuple[float, float] = (0.5, 2.0)

    def __post_init__(self) -> None:
        for name in ("state", "bias", "u"):
            checks.flag(name, getattr(self, name))
        if not (self.state or self.bias or self.u):
            raise ValueError(
                "state = False, bias = False, u = False: at least one feature must be left to learn"
            )
        if self.bias_bandwidth is not None:
            checks.non_negative("bias_bandwidth", self.bias_bandwidth, "rad/s")
        for value in checks.vector("state_bandwidth", self.state_bandwidth).tolist():
            checks.non_negative("state_bandwidth", value, "rad/s")
        if self.frequency is not None:
            checks.positive("frequency", self.frequency, "rad/s")
        checks.positive("prior", self.prior)
        checks.around_one("gain_interval", self.gain_interval)

    def design(self, observer: ESO, omega_c: float) -> KalmanDesign:
        """Return the parameters for ``observer`` and a controller of bandwidth ``omega_c`` [rad/s].

        Raises
        ------
        ValueError
            where ``state_bandwidth`` is neither one number nor one for each state.
        """
        n = observer.order
        slow = checks.vector("state_bandwidth", self.state_bandwidth)
        slow = np.full(n, slow[0]) if slow.size == 1 else checks.vector("state_bandwidth", slow, n)
        follow = observer.omega_o if self.bias_bandwidth is None else self.bias_bandwidth
        lag_time = observer.lag_time
        frequency = omega_c if self.frequency is None else float(self.frequency)
        scale = frequency ** -np.arange(n, dtype=np.float64)
        # What noise in y leaves in x̂_i; what it leaves in f̂ is also in b0 u.
        noise = relative_noise(observer)
        threshold = (SIGNAL_TO_NOISE * np.append(scale, 1.0)) ** 2 * noise
        size = self.prior * frequency**observer.f_degree
        oscillators, pair_bandwidth = self.oscillators(observer, omega_c)
        pairs = 2 * oscillators.omega.size
        return KalmanDesign(
            lag=lag_of(observer),
            scale=np.array(
                [
                    *scale[: n * self.state],
                    *[1.0] * self.bias,
                    *[1.0] * pairs,
                    *[observer.b0] * self.u,
                ]
            ),
            walk=np.array(
                [
                    *slow[: n * self.state] ** 2,
                    *[follow**2] * self.bias,
                    *[pair_bandwidth**2] * pairs,
                    *[0.0] * self.u,
                ]
            ),
            threshold=np.array(
                [
                    *threshold[: n * self.state],
                    *[0.0] * self.bias,
                    *[0.0] * pairs,
                    *[threshold[n]] * self.u,
                ]
            ),
            fastest=max(follow, observer.omega_o),
            f_noise=float(noise[n]),
            prior=np.array(
                [*[size] * (n * self.state), *[0.0] * self.bias, *[0.0] * pairs, *[1.0] * self.u]
            ),
            states=n * self.state,
            bias=self.bias,
            oscillators=oscillators,
            with_u=self.u,
            slope_low=self.gain_interval[0] - 1.0,
            slope_high=self.gain_interval[1] - 1.0,
            dt=observer.dt,
            forget=-math.expm1(-observer.dt / (AVERAGING_LAGS * lag_time)),
            lag_time=lag_time,
        )

    def oscillators(self, observer: ESO, omega_c: float) -> tuple[Oscillators, float]:
        """Return the parameters of no oscillators, and how fast their pairs would follow; ``Harmonic`` has some."""
        return Oscillators(observer.order * self.state + self.bias, np.zeros(0), 0.0, 0.0), 0.0

    def memory(self, parameters: KalmanDesign) -> KalmanMemory:
        """Return a state with nothing learned."""
        p = parameters.scale.size
        return KalmanMemory(
            theta=np.zeros(p),
            covariance=np.diag(parameters.prior**2),
            chain=lag_memory(parameters.lag, p),
            filtered=np.zeros(p),
            mean=np.zeros(p),
            variance=np.zeros(p),
            taught=np.zeros(p),
            gain=np.zeros(p),
            phase=np.zeros(parameters.oscillators.omega.size),
            omega=parameters.oscillators.omega.copy(),
            moment=np.zeros(4),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1", …, "bias", "u")``, as far as they are features."""
        return (
            *(f"x{i + 1}" for i in range(order * self.state)),
            *["bias"] * self.bias,
            *["u"] * self.u,
        )
