"""``Kalman`` and ``Harmonic``: lag-compensated Kalman filters as learners.

The lag-compensated learner: a Kalman filter that accounts for the observer's own lag.

With the features φ (state, bias, sinusoids, u) and their lag-filtered values φ^F
(``learners/base.py``), each sample::

    ε = Δf̂ + f_L^F − θ·φ^F
    g = P φ̃ / max(φ̃·P φ̃ + 1/dt, φ̃·P φ̃ / (λ_m dt))
    θ ← θ + g ε,    P ← P − g (P φ̃)ᵀ + Q dt

All quantities are continuous-time densities, so the tuning does not change with dt. Coefficients of
the state and of u are measured in noise of density ``R = τ E[ε² + (0.1 f̂)² + σ²]``: for them φ̃ =
φ^F/√R and ε/√R replace φ^F and ε. The coefficient of the bias is measured in units of R itself.

**R follows the innovation.** What the learner cannot explain counts as noise, so it learns less
from it. Two lower bounds keep R positive: a linear model never explains more than nine tenths of f,
and f̂ contains σ, the effect of measurement noise and rounding. The mean is exponential; τ =
N/omega_o, the observer's lag, is the correlation time of the noise in Δf̂. The gain of the bias
does not follow R: a gain that follows the noise shifts its high frequencies to low ones, where the
loop is sensitive.

**Random walk.** A walk is given as a tracking bandwidth λ. For the bias ``Q = λ²``: the steady
Kalman gain of a random walk in white noise is ``sqrt(Q/R)``, so a constant disturbance is learned
with the time constant 1/λ in any unit. For a feature of variance φ² it is ``λ² R/φ²``. All features
together learn at most at the rate λ_m, the larger of omega_o and the bandwidth of the bias, because
the observer cannot verify anything faster.

**Excitation.** A feature that does not move (``learners/base.py``) has a zero in φ̃. With a bias, φ̃
contains the feature less its running mean, and a change of a coefficient is compensated in the
bias at that mean.

**Start.** After a start from rest Δf̂ contains the observer's initial error, which is no
disturbance: the learner does not learn for 2 τ.

docs/theory, "Lag compensation", and docs/theory_learners have derivation and measurements.

The learner ``Kalman``: features, bandwidths and prior of a Kalman filter.

The learner of periodic loads: state, bias and sinusoids of unknown frequency.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quell import checks
from quell.checks import Described
from quell.hints import explained
from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import is_single, sqrt
from quell.kernels.single import add_symmetrically
from quell.kernels.sized import Flag, Scalars, Scratch, Size, clear
from quell.learners.base import (
    AVERAGING_LAGS,
    SIGNAL_TO_NOISE,
    STARTUP_LAGS,
    adapt,
    coefficients,
    commit,
    follow_moments,
    follow_noise,
    forget,
    grown,
    lag_memory,
    lag_of,
    lag_push,
    meaning,
    predict,
    relative_noise,
    reset_lag,
    restart,
)
from quell.learners.frequency_search import (
    LEARN_ANEW,
    NOTHING,
    NoSearch,
    advance_search,
    frequency_search,
    is_locked,
    search_memory,
    start_search_again,
)
from quell.learners.oscillators import (
    Oscillators,
    combined,
    open_pairs,
    push_pairs,
    retune,
    turn_phases,
)
from quell.learners.rls import multiply_lower, reduce_row
from quell.observers.eso import ESO
from quell.types import Matrix, Vector

# ---- The lag-compensated learner ----

# Least share of f that counts as unexplained by a linear model; chosen by hand, not tuned further.
_UNEXPLAINED_SHARE = 0.1
# Variance of amplitudes that are to be learned anew, in units of R: they may be 10³ times what is
# unexplained. Chosen by hand on `benchmarks/close_frequencies.py`: with 10⁴ the result is late;
# with 10⁸ two near sinusoids are learned so quickly that their difference explains anything, and a
# loop was at 15 times MF-ESO's error for ten seconds. In single precision P shrinks to less than
# what rounding leaves of the difference, and θ is lost; with 10⁴ it was not in three loops.
_UNKNOWN, _UNKNOWN_SINGLE = 1e6, 1e4


class KalmanDesign(NamedTuple):
    """Parameters for an observer of order n and p features: state, bias, pairs of sinusoids, u."""

    lag: Any
    scale: Vector  # factor of each feature's signal (p,)
    walk: Vector  # λ² of each feature [1/s²] (p,)
    # Least variance of a feature that is used, in units of that of y − x̂_1 (p,); 0 for bias and
    # sinusoids, which are always used.
    threshold: Vector
    # Initial standard deviation of θ in scaled units (p,); 0 for bias and sinusoids, because their
    # walk makes P grow by itself.
    prior: Vector
    fastest: float  # λ_m [rad/s]
    f_noise: float  # variance that white noise of unit variance in y causes in f̂
    states: Size  # n, or 0 without state features
    bias: Flag
    oscillators: Oscillators
    search: Any  # for the frequencies of the oscillators
    with_u: Flag
    slope_low: float  # least θ_u in scaled units
    slope_high: float  # largest θ_u in scaled units
    dt: float
    forget: float  # dt over the averaging time of mean squares
    lag_time: float  # τ [s]


# Largest share by which means follow in a sample where P has carries in single precision. Learning
# without a walk makes P smaller by dt/t of itself in a sample: after ten averaging times by a tenth
# of ``forget``. Rounding moves each sum by 2⁻²⁵ of it, so this is where the speed of P is wrong by
# one per cent.
_LEAST_WITHOUT_CARRIES = 100.0 * 10.0 * 2.0**-25


def needs_carries(learner: KalmanDesign) -> bool:
    """Return whether rounding would change the speed of P in single precision."""
    return learner.forget < _LEAST_WITHOUT_CARRIES


class KalmanAverages(Scalars):
    """Exponential sums, whose quotient with ``weight`` is a mean, and the time."""

    noise: float  # squares of y − x̂_1
    unexplained: float  # squares of what the model does not explain
    weight: float  # ones: it grows from 0 to 1
    time: float  # since the start from rest [s]; in single precision [samples]


class KalmanMemory(NamedTuple):
    """State of the learner, with p features and m oscillators."""

    theta: Vector  # θ in scaled units (p,)
    # P (p, p), for the bias in units of R; in single precision only the lower triangle, and where
    # ``needs_carries`` the carries of the sums above it (p, p + 1).
    covariance: Matrix
    chain: Matrix  # lag filters of the features (p, …)
    filtered: Vector  # φ^F (p,); from ``adapt`` to the next ``commit`` φ̃ in its place
    mean: Vector  # running means of φ^F (p,); in single precision with carries (2p,)
    variance: Vector  # running variances of φ^F (p,)
    carry: Vector  # what rounding takes of θ (p,) in single precision; else (0,)
    gain: Scratch  # P φ̃ (p,)
    phase: Vector  # ψ of each oscillator [rad] (m,)
    omega: Vector  # ω̂ of each oscillator [rad/s] (m,)
    averages: NDArray[KalmanAverages]  # (1,)
    search: Any


@adapt.register(KalmanDesign)
def _adapt(
    learner: KalmanDesign,
    memory: KalmanMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    theta, covariance, gain = memory.theta, memory.covariance, memory.gain
    regressor, averages = memory.filtered, memory.averages[0]
    size = theta.size
    # Loops, because at this size a call of BLAS takes longer than the arithmetic.
    explained = 0.0
    for i in range(size):
        explained += theta[i] * memory.filtered[i]
    innovation = f_plain - explained
    noise, deviation = _update_averages(learner, averages, y, y - estimates[0], innovation, f_plain)
    if not is_finite(deviation):  # for example after a measurement near the largest float
        restart(learner, memory)
        return
    if deviation == 0.0:
        return
    weight = 1.0 / deviation
    time = averages.time * learner.dt if is_single(learner.dt) else averages.time
    is_started = time > STARTUP_LAGS * learner.lag_time
    result = NOTHING
    if is_started:
        result = advance_search(
            learner.search, memory.search, f_plain, memory.filtered, u_before, memory.omega
        )
    _update_regressor(learner, memory, noise, weight)
    if not is_started:
        return
    # Many orders that are learned anew at once upset the loop: they explain almost anything.
    if result == LEARN_ANEW and learner.oscillators.orders.size == 1:
        unknown = _UNKNOWN_SINGLE if is_single(weight) else _UNKNOWN
        open_pairs(learner.oscillators, covariance, unknown / learner.lag_time)
    spread = 0.0
    if is_single(weight):
        multiply_lower(covariance, regressor, gain)
        for i in range(size):
            spread += gain[i] * regressor[i]
    else:
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += covariance[i, j] * regressor[j]
            gain[i] = total
            spread += total * regressor[i]
    if spread < 0.0:  # by rounding P is no longer a covariance: do not learn
        return
    inverse = 1.0 / max(spread + 1.0 / learner.dt, spread / (learner.fastest * learner.dt))
    # A variable, because a sum in memory waits for each store.
    level = theta[learner.states] if learner.bias else 0.0
    for i in range(size):
        share = gain[i] * inverse
        reduce_row(covariance, i, share, gain)
        if learner.threshold[i] == 0.0:
            theta[i] += share * innovation
            add_symmetrically(covariance, i, i, learner.walk[i] * learner.dt)
        else:
            if memory.carry.size > 0:
                increment = share * innovation * weight + memory.carry[i]
                updated = theta[i] + increment
                memory.carry[i] = increment - (updated - theta[i])
            else:
                updated = theta[i] + share * innovation * weight
            if learner.with_u and i == size - 1:
                updated = min(max(updated, learner.slope_low), learner.slope_high)
            change = updated - theta[i]
            theta[i] = updated
            if learner.bias:
                if learner.with_u and i > learner.states:
                    level = theta[learner.states]
                level -= change * memory.mean[i]
                theta[learner.states] = level
            # In double precision zero is added, too: without, batches change their last bits.
            if regressor[i] != 0.0 and not (is_single(weight) and learner.walk[i] == 0.0):
                grown_by = learner.walk[i] * learner.dt * deviation * deviation / memory.variance[i]
                add_symmetrically(covariance, i, i, grown_by)
    step, unexplained = inverse * innovation, averages.unexplained
    for j in range(memory.omega.size):
        if not is_locked(learner.search, memory.search, j):
            retune(learner.oscillators, memory.omega, j, theta, gain, step, unexplained)


@kernel
def _update_averages(
    learner: KalmanDesign,
    averages: KalmanAverages,
    y: float,
    error: float,
    innovation: float,
    target: float,
) -> tuple[float, float]:
    """Update the averages; return the mean square of y − x̂_1, and √R."""
    doubt = _UNEXPLAINED_SHARE * target
    averages.noise = follow_noise(averages.noise, learner.forget, y, error)
    square = innovation * innovation + doubt * doubt
    averages.unexplained += learner.forget * (square - averages.unexplained)
    averages.weight = grown(averages.weight, learner.forget)
    averages.time += 1.0 if is_single(learner.dt) else learner.dt
    unexplained = averages.unexplained + learner.f_noise * averages.noise
    deviation = sqrt(learner.lag_time * unexplained / averages.weight)
    return averages.noise / averages.weight, deviation


@kernel
def _update_regressor(
    learner: KalmanDesign, memory: KalmanMemory, noise: float, weight: float
) -> None:
    """Put φ̃ in place of φ^F; ``noise`` is the mean square of y − x̂_1, ``weight`` 1/√R."""
    for i in range(learner.states):
        _scale_feature(learner, memory, i, noise, weight)
    if learner.with_u:
        _scale_feature(learner, memory, memory.filtered.size - 1, noise, weight)


@kernel
def _scale_feature(
    learner: KalmanDesign, memory: KalmanMemory, i: int, noise: float, weight: float
) -> None:
    filtered, mean, variance = memory.filtered, memory.mean, memory.variance
    follow_moments(mean, variance, i, filtered[i], learner.forget)
    centre = mean[i] if learner.bias else 0.0
    moves = variance[i] > learner.threshold[i] * noise
    filtered[i] = weight * (filtered[i] - centre) if moves else 0.0


@predict.register(KalmanDesign)
def _predict(
    learner: KalmanDesign, memory: KalmanMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    theta = memory.theta
    constant = 0.0
    for i in range(learner.states):
        constant += theta[i] * learner.scale[i] * estimates[i]
    if learner.bias:
        constant += theta[learner.states]
    constant = combined(learner.oscillators, memory.phase, theta, constant)
    last = theta.size - 1
    slope = theta[last] * learner.scale[last] if learner.with_u else 0.0
    return constant, slope


@commit.register(KalmanDesign)
def _commit(
    learner: KalmanDesign, memory: KalmanMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    chain, filtered = memory.chain, memory.filtered
    for i in range(learner.states):
        filtered[i] = lag_push(learner.lag, chain, i, learner.scale[i] * estimates[i])
    if learner.bias:
        filtered[learner.states] = lag_push(learner.lag, chain, learner.states, 1.0)
    push_pairs(learner.oscillators, learner.lag, chain, filtered, memory.phase)
    turn_phases(memory.phase, memory.omega, learner.dt)
    if learner.with_u:
        last = filtered.size - 1
        filtered[last] = lag_push(learner.lag, chain, last, learner.scale[last] * u)


@restart.register(KalmanDesign)
def _restart(learner: KalmanDesign, memory: KalmanMemory) -> None:
    _reset_filters(learner, memory)
    memory.averages[0].time = 0.0
    if not _all_finite(memory):
        forget(learner, memory)


@kernel
def _reset_filters(learner: KalmanDesign, memory: KalmanMemory) -> None:
    reset_lag(memory.chain)
    start_search_again(learner.search, memory.search)
    for i in range(memory.filtered.size):
        memory.filtered[i] = 0.0


@kernel
def _all_finite(memory: KalmanMemory) -> bool:
    """Return whether everything that was learned is finite."""
    averages = memory.averages[0]
    finite = is_finite(averages.noise) and is_finite(averages.unexplained)
    for j in range(memory.omega.size):
        finite = finite and is_finite(memory.omega[j]) and is_finite(memory.phase[j])
    for i in range(memory.theta.size):
        finite = finite and is_finite(memory.theta[i])
        finite = finite and is_finite(memory.mean[i]) and is_finite(memory.variance[i])
        if memory.carry.size > 0:
            finite = finite and is_finite(memory.carry[i])
        for j in range(memory.covariance.shape[1]):
            finite = finite and is_finite(memory.covariance[i, j])
    return finite


@forget.register(KalmanDesign)
def _forget(learner: KalmanDesign, memory: KalmanMemory) -> None:
    _reset_filters(learner, memory)
    clear(memory.averages)
    for j in range(memory.omega.size):
        memory.phase[j] = 0.0
        memory.omega[j] = learner.oscillators.omega[j]
    for i in range(memory.mean.size):
        memory.mean[i] = 0.0
    for i in range(memory.carry.size):
        memory.carry[i] = 0.0
    for i in range(memory.theta.size):
        memory.theta[i] = memory.variance[i] = 0.0
        memory.gain[i] = 0.0
        for j in range(memory.covariance.shape[1]):
            memory.covariance[i, j] = learner.prior[i] ** 2 if i == j else 0.0


@coefficients.register(KalmanDesign)
def _coefficients(learner: KalmanDesign, memory: KalmanMemory, theta: Vector) -> None:
    for i in range(theta.size):
        theta[i] = memory.theta[i] * learner.scale[i]


@meaning.register(KalmanDesign)
def _meaning(learner: KalmanDesign) -> Any:
    which = (learner.states, learner.bias, learner.with_u, learner.oscillators.orders)
    return learner.scale, learner.dt, *which, type(learner.search).__name__


# ---- The learner Kalman ----


@explained("quell.learners.Kalman()")
@dataclass(frozen=True, repr=False)
class Kalman(Described):
    """A linear learner that compensates the observer's lag: ``f_L = θ · (x̂_1 … x̂_n, 1, u)``.

    It does not depend on the units of y and u. The docstring of this module has the equations.

    Parameters
    ----------
    state, bias, u
        features that are used. Without a bias a constant load is learned as a property of the
        plant. With ``u`` the learner can learn that the plant's gain is not b0; by default it is
        not used, because a loop that rejects a disturbance makes u a copy of that disturbance.
    bias_bandwidth
        bandwidth λ with which the bias follows [rad/s]; ``omega_o`` of the observer by default. A
        smaller one is smoother, a larger one rejects more.
    state_bandwidth
        the same for the coefficients of the state [rad/s], one for all or one for each; zero by
        default, because a plant's coefficients do not drift. For the coefficient of u it is zero.
    frequency
        a typical frequency of the plant [rad/s]; ``omega_c`` of the controller by default. It
        scales the states to one size.
    prior
        size of the coefficients: coefficient i is of the order of ``prior · frequency^(n−i+1)``;
        for a plant with zeros from f, n is the relative degree from f to y.
    gain_interval
        interval of the effective gain ``(b0 + θ_u)/b0`` when ``u`` is a feature.

    Raises
    ------
    ValueError
        for a parameter out of range, or if no feature is left.

    References
    ----------
    docs/paper, docs/theory_learners: Algorithm 1 of the paper, its weaknesses and their remedies.
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
            raise ValueError("state = False, bias = False, u = False: keep at least one feature")
        if self.bias_bandwidth is not None:
            checks.non_negative("bias_bandwidth", self.bias_bandwidth, "rad/s")
        for value in checks.vector("state_bandwidth", self.state_bandwidth).tolist():
            checks.non_negative("state_bandwidth", value, "rad/s")
        if self.frequency is not None:
            checks.positive("frequency", self.frequency, "rad/s")
        checks.positive("prior", self.prior)
        checks.around_one("gain_interval", self.gain_interval)
        self._check_used()

    def _check_used(self) -> None:
        """Raise a ``ValueError`` for options of features that there are not."""
        slow = np.any(checks.vector("state_bandwidth", self.state_bandwidth))
        unused = {
            "bias_bandwidth": ("bias", self.bias_bandwidth is not None),
            "state_bandwidth": ("state", bool(slow)),
            "prior": ("state", self.prior != Kalman.prior),
            "frequency": ("state", self.frequency is not None),
            "gain_interval": ("u", tuple(self.gain_interval) != Kalman.gain_interval),
        }
        for option, (feature, is_given) in unused.items():
            if is_given and not getattr(self, feature) and not self._uses(option):
                raise ValueError(
                    f"{option} = {getattr(self, option)!r}: has no effect with {feature} = False; "
                    f"leave it out, or take {feature} = True"
                )

    def _uses(self, option: str) -> bool:
        """Return whether an option has an effect without its feature."""
        return False

    def design(self, observer: ESO, omega_c: float) -> KalmanDesign:
        """Return the parameters for an observer and the controller's bandwidth [rad/s].

        Raises
        ------
        ValueError
            if ``state_bandwidth`` is neither one number nor one for each state.
        """
        n, lag_time = observer.order, observer.lag_time
        slow = checks.vector("state_bandwidth", self.state_bandwidth)
        slow = np.full(n, slow[0]) if slow.size == 1 else checks.vector("state_bandwidth", slow, n)
        fast = observer.omega_o if self.bias_bandwidth is None else self.bias_bandwidth
        frequency = omega_c if self.frequency is None else float(self.frequency)
        scale = frequency ** -np.arange(n, dtype=np.float64)
        noise = relative_noise(observer)
        # The feature b0 u is compared with the noise in f̂, because u cancels f̂.
        threshold = (SIGNAL_TO_NOISE * np.append(scale, 1.0)) ** 2 * noise
        size = self.prior * frequency**observer.f_degree
        oscillators, pair_bandwidth = self.oscillators(observer, omega_c)

        def by_feature(state: Any, bias: float, pair: float, u: float) -> Vector:
            """Return one number for each feature."""
            states = np.broadcast_to(state, n)[: n * self.state]
            pairs = np.full(2 * oscillators.omega.size * oscillators.orders.size, pair)
            return np.concatenate([states, [bias] * self.bias, pairs, [u] * self.u])

        return KalmanDesign(
            lag=lag_of(observer),
            scale=by_feature(scale, 1.0, 1.0, observer.b0),
            walk=by_feature(slow**2, fast**2, pair_bandwidth**2, 0.0),
            threshold=by_feature(threshold[:n], 0.0, 0.0, threshold[n]),
            prior=by_feature(size, 0.0, 0.0, 1.0),
            fastest=max(fast, observer.omega_o),
            f_noise=float(noise[n]),
            states=n * self.state,
            bias=self.bias,
            oscillators=oscillators,
            search=self.frequency_search(observer, omega_c, oscillators),
            with_u=self.u,
            slope_low=self.gain_interval[0] - 1.0,
            slope_high=self.gain_interval[1] - 1.0,
            dt=observer.dt,
            forget=-math.expm1(-observer.dt / (AVERAGING_LAGS * lag_time)),
            lag_time=lag_time,
        )

    def oscillators(self, observer: ESO, omega_c: float) -> tuple[Oscillators, float]:
        """Return the parameters of the oscillators, here none, and the bandwidth of their pairs."""
        first, none = observer.order * self.state + self.bias, np.zeros(0)
        return Oscillators(first, none, 0.0, 0.0, none), 0.0

    def frequency_search(self, observer: ESO, omega_c: float, oscillators: Oscillators) -> Any:
        """Return the parameters of the search for frequencies, here none."""
        return NoSearch()

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
            carry=np.zeros(0),
            gain=np.zeros(p),
            phase=np.zeros(parameters.oscillators.omega.size),
            omega=parameters.oscillators.omega.copy(),
            averages=KalmanAverages.zeros(),
            search=search_memory(parameters.search, parameters.oscillators),
        )

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return those of ``("x1", …, "bias", "u")`` that are features."""
        states = (f"x{i + 1}" for i in range(order * self.state))
        return (*states, *["bias"] * self.bias, *["u"] * self.u)


# ---- The learner of periodic loads ----

# Initial frequencies by default: omega_c, then each this multiple of the one before. This and the
# other defaults are from 300 random loops (quell.experiments.stress.study;
# studies/notes/harmonic.md).
_SPREAD = 0.3
# Default limits of the frequencies as multiples of omega_c and omega_o.
_LOWEST, _HIGHEST = 0.02, 0.5
# Default bandwidth of the pairs as a multiple of the bias's bandwidth.
_PAIR_BANDWIDTH = 2.5
# Most sinusoids: the time of a sample grows with the square of their number. And the highest order.
_MOST_PAIRS, _HIGHEST_ORDER = 16, 1000


@dataclass(frozen=True, repr=False)
class Harmonic(Kalman):
    """A ``Kalman`` learner with sinusoids of unknown frequency.

    ``f_L = θ · (x̂_1 … x̂_n, 1, sin ψ_1, cos ψ_1, …, u)``. Once the frequency of a rotating or
    repeating load is found (``learners/oscillators.py``), the load is rejected completely, and it
    does not disturb what is learned of the plant.

    Parameters
    ----------
    count
        number of sinusoids, 1 to 8.
    omegas
        initial frequencies [rad/s] within ``limits``, one for each sinusoid; by default ``omega_c``
        of the controller, 0.3 omega_c, 0.09 omega_c …
    limits
        least and largest frequency [rad/s]; ``0.02 omega_c`` (of ``omega_o``, if that is smaller)
        and ``0.5 omega_o`` by default, or the largest with which the highest order is at
        ``omega_o``.
    orders
        multiples of each frequency that a load may contain, different whole numbers from 1, the
        strongest first: for example (1, 3, 5, 7) for a square wave. Together ``count`` and
        ``orders`` make 16 sinusoids at most.
    search
        whether frequencies are searched in the past (``learners/frequency_search.py``), instead of
        near the initial ones alone. It separates sinusoids whose frequencies differ by a factor of
        1.2 within a beat period, and finds loads of several orders.
    pair_bandwidth
        bandwidth λ with which the sinusoids follow [rad/s]; 2.5 times that of the bias by default.
        An oscillator at ω learns at about the rate ``ω · pair_bandwidth / bias_bandwidth``.

    All other parameters are those of ``Kalman``.

    Raises
    ------
    ValueError
        for a parameter out of range.
    """

    count: int = 1
    omegas: Sequence[float] | None = None
    limits: tuple[float, float] | None = None
    pair_bandwidth: float | None = None
    orders: Sequence[int] = (1,)
    search: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.whole("count", self.count, 1, 8)
        checks.flag("search", self.search)
        self._check_orders()
        if self.omegas is not None:
            for omega in checks.vector("omegas", self.omegas, self.count).tolist():
                checks.positive("omegas", omega, "rad/s")
        if self.limits is not None:
            low, high = checks.vector("limits", self.limits, 2).tolist()
            if not 0.0 < low < high:
                rule = "must be (low, high) with 0 < low < high [rad/s]"
                raise ValueError(f"limits = {self.limits!r}: {rule}")
        if self.pair_bandwidth is not None:
            checks.positive("pair_bandwidth", self.pair_bandwidth, "rad/s")

    def _uses(self, option: str) -> bool:
        return option == "bias_bandwidth" and self.pair_bandwidth is None  # which follows from it

    def _check_orders(self) -> None:
        if not checks.is_sequence(self.orders) or len(self.orders) == 0:
            rule = "must be a tuple of whole numbers, for example (1, 3, 5)"
            raise ValueError(f"orders = {self.orders!r}: {rule}")
        for i, order in enumerate(self.orders):
            checks.whole(f"orders[{i}]", order, 1, _HIGHEST_ORDER)
        if len(set(self.orders)) < len(self.orders):
            raise ValueError(f"orders = {self.orders!r}: must not repeat an order")
        if self.count * len(self.orders) > _MOST_PAIRS:
            rule = f"must make {_MOST_PAIRS} sinusoids at most"
            raise ValueError(f"count = {self.count}, orders = {self.orders!r}: {rule}")

    def oscillators(self, observer: ESO, omega_c: float) -> tuple[Oscillators, float]:
        """Return the parameters of the oscillators, and the bandwidth of their pairs [rad/s].

        Raises
        ------
        ValueError
            for an initial frequency outside of the limits.
        """
        # A law may be faster than the observer, as one that was tuned; loads of use are not.
        slower = min(omega_c, observer.omega_o)
        low, high = _LOWEST * slower, _HIGHEST * observer.omega_o
        if len(self.orders) > 1:
            high = min(high, observer.omega_o / max(self.orders))
        if self.limits is not None:
            low, high = self.limits
        if self.omegas is None:
            start = np.clip(slower * _SPREAD ** np.arange(self.count), low, high)
        else:
            start = checks.vector("omegas", self.omegas)
        if not np.all((low <= start) & (start <= high)):
            rule = f"must lie within limits = ({low:g}, {high:g}) rad/s"
            raise ValueError(f"omegas = {self.omegas!r} rad/s: {rule}")
        first = observer.order * self.state + self.bias
        bandwidth = self.pair_bandwidth
        if bandwidth is None:
            bias = observer.omega_o if self.bias_bandwidth is None else self.bias_bandwidth
            bandwidth = _PAIR_BANDWIDTH * bias
        orders = np.array(self.orders, dtype=np.float64)
        return Oscillators(first, start, float(low), float(high), orders), bandwidth

    def frequency_search(self, observer: ESO, omega_c: float, oscillators: Oscillators) -> Any:
        """Return the parameters of the search for frequencies, if there is one."""
        if not self.search:
            return NoSearch()
        return frequency_search(observer, omega_c, oscillators, observer.order * self.state)

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return ``("x1", …, "bias", "sin1", "cos1", …, "u")``, as far as they are features.

        With several orders the sinusoids are ``"sin1 ·1", "cos1 ·1", "sin1 ·3", …``.
        """
        names = super().feature_names(order)
        several = len(self.orders) > 1
        labels = [
            f"{j + 1}" + f" ·{order}" * several for j in range(self.count) for order in self.orders
        ]
        pairs = tuple(f"{wave}{label}" for label in labels for wave in ("sin", "cos"))
        split = len(names) - self.u
        return (*names[:split], *pairs, *names[split:])
