"""The lag-compensated learner: a Kalman filter that accounts for the observer's own lag.

With the features φ (state, bias, sinusoids, u) and their lag-filtered values φ^F
(``learners/lag.py``), each sample::

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

**Excitation.** A feature that does not move (``noise_gate.py``) has a zero in φ̃. With a bias, φ̃
contains the feature less its running mean, and a change of a coefficient is compensated in the
bias at that mean.

**Start.** After a start from rest Δf̂ contains the observer's initial error, which is no
disturbance: the learner does not learn for 2 τ.

docs/theory, "Learning without lag", has the derivation and measurements.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

from quell.kernels.dispatch import is_finite, kernel
from quell.kernels.functions import is_single, sqrt
from quell.kernels.scalars import Scalars, clear
from quell.kernels.sized import Flag, Scratch, Size
from quell.kernels.sums import add_small, add_symmetrically
from quell.learners.base import adapt, coefficients, commit, forget, predict, restart
from quell.learners.kalman.oscillators import (
    Oscillators,
    combined,
    open_pairs,
    push_pairs,
    retune,
    turn_phases,
)
from quell.learners.kalman.search import advance_search, is_locked, start_search_again
from quell.learners.kalman.search_verdict import LEARN_ANEW, NOTHING
from quell.learners.lag import STARTUP_LAGS, lag_push, reset_lag
from quell.learners.least_squares import multiply_lower, reduce_row
from quell.learners.noise_gate import grown, resolution
from quell.types import Matrix, Vector

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
    seen: Vector,
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
    noise, deviation = _update_averages(learner, averages, y, y - seen[0], innovation, f_plain)
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
    rounding, doubt = resolution(learner.dt) * y, _UNEXPLAINED_SHARE * target
    averages.noise += learner.forget * (error * error + rounding * rounding - averages.noise)
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
    away = filtered[i] - mean[i]
    add_small(mean, filtered.size, i, learner.forget * away)
    variance[i] += learner.forget * (away * away - variance[i])
    centre = mean[i] if learner.bias else 0.0
    moves = variance[i] > learner.threshold[i] * noise
    filtered[i] = weight * (filtered[i] - centre) if moves else 0.0


@predict.register(KalmanDesign)
def _predict(
    learner: KalmanDesign, memory: KalmanMemory, seen: Vector, u_before: float
) -> tuple[float, float]:
    theta = memory.theta
    constant = 0.0
    for i in range(learner.states):
        constant += theta[i] * learner.scale[i] * seen[i]
    if learner.bias:
        constant += theta[learner.states]
    constant = combined(learner.oscillators, memory.phase, theta, constant)
    last = theta.size - 1
    slope = theta[last] * learner.scale[last] if learner.with_u else 0.0
    return constant, slope


@commit.register(KalmanDesign)
def _commit(
    learner: KalmanDesign, memory: KalmanMemory, seen: Vector, u: float, f_learned: float
) -> None:
    chain, filtered = memory.chain, memory.filtered
    for i in range(learner.states):
        filtered[i] = lag_push(learner.lag, chain, i, learner.scale[i] * seen[i])
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
