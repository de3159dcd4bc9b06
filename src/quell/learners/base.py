"""The base of learners: contract, recovery, noise gate, lag filter, learners on features.

The contract between a controller and its learner.

A learner is an immutable description (``Kalman(...)``). ``design(observer, omega_c)`` returns its
parameters (a NamedTuple), and ``memory(parameters)`` its whole state (a NamedTuple of arrays). The
functions below are registered for the type of the parameters. In each sample the controller calls

1. ``adapt`` with the newest estimates of the observer, then ``learner_flags``;
2. ``predict`` for the feedforward ``f_L = constant + slope · u``, which is affine in u so that a
   learner with u among its features is compensated exactly, not one sample late;
3. ``commit`` with the u that was applied.

``restart`` is called when the loop starts from rest, ``forget`` when the learner has lost its
numbers, ``coefficients`` when a run is recorded.

A learner whose memory refers to objects outside of its arrays, for example to a Python model, has
three more members: ``external_fields``, the names of the fields that refer to them;
``snapshot(memory)``, which returns copies of the objects by name; and ``recall(memory,
snapshots)``, which replaces the objects by copies of the snapshots, or raises an error if they do
not fit. A controller's ``state`` contains the snapshots in place of these fields.

Detection of a learner that has lost its numbers, for all learners alike.

Samples that are absurd, but finite, can take a learner to where it does not return from: scales and
mean squares are then so large that it no longer sees what comes, or its output is so large that
u stays at its limits. Four comparisons find this, in any unit, all but the third over windows
of ``WINDOW_LAGS`` lags of the observer:

* *range*: while y moves, the largest ``|f_plain|`` of a window is below 2⁻⁴⁰ of the largest ever.
  No real loop works over such a range: sensors resolve ``RESOLUTION`` of theirs. Where y moves by
  less than that, and where ``|f_plain|`` still decays, nothing is concluded, so a loop that comes
  to rest, also without any noise, forgets nothing. If u is at its limits in most samples of the
  window, 2⁻¹⁰ suffices: features that are so small correct nothing within the memory of a learner,
  and what it learned at the larger scale may be what keeps u at its limits;
* *output*: in most samples of a window the law asks for more than 2¹⁰ times the u that is applied,
  and the learner's output is more than 2¹⁰ times the largest ``|f_plain|``. Without limits this can
  not happen;
* *escape*: the learner's output is more than 2⁴⁰ times the largest ``|f_plain|`` of all windows
  before, and the law asks for more than 2¹⁰ times the u that is applied. Then estimates and output
  drive each other, for example with a cube of x̂, while y is still good; f_plain contains them, so
  that no later comparison with it would be of use;
* *harm*: in most samples of ten windows ``|Δf̂|`` is more than 4 times ``|f_plain|``: the output
  adds to the disturbance. A learner that can correct this has done so by then. One with a fixed
  rate can not if θ comes from motions that were 100 times larger. This is asked without a guard,
  which judges the output itself, of learners that have something to forget.

The controller then calls ``forget``.

A gate that separates motion from measurement noise.

The observer's estimates of higher derivatives are noisy, and at rest they are only noise. From
noise, a regression slowly learns coefficients that mean nothing. So a signal counts as moving only
while its variance exceeds ``SIGNAL_TO_NOISE²`` times the variance that measurement noise, estimated
from y − x̂_1, causes in it; rounding counts as noise. Otherwise it is replaced by its running mean,
an exponential one over ``AVERAGING_LAGS`` lags of the observer.

The same noise is in the learning target f̂, where it grows with the power n + 1 of omega_o.
``confidence`` compares it with what a motion at a frequency ω of the plant would show,
``F = ω^n |x_1|``.

The lag filter: the observer's exact response to an input that enters where f does.

The ESO is linear. An input φ that enters where f does and that its measurement does not show causes
the error

    s⁺ = (I − L C)(Φ s + Γ_f φ),        φ^F = −s_{n+1}

so ``Δf̂ = (f − f_L)^F`` exactly, except for noise and for changes of f between samples, and
``Δf̂ + f_L^F ≈ θ·φ^F`` is a regression without lag bias. All poles of this filter are at
β = exp(−omega_o dt) in one Jordan chain, so φ^F is a weighted sum of a chain of N first-order lags,

    v_1⁺ = β v_1 + (1−β) φ,      v_j⁺ = β v_j + (1−β) v_{j−1},      φ^F = Σ c_j v_j

which costs O(N) per input instead of O(N²). An observer of other tuning or structure has other
poles: then the filter is used in its full form (``DenseLag``).

The common part of learners on features: choice of features, scaling, noise gate, bias, start.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple, Protocol

import numpy as np

from quell import checks
from quell.checks import Described
from quell.features import Bias, Features, State
from quell.features.base import (
    Indices,
    checked_design,
    initial_scale,
    initial_sizes,
    scale_by_sizes,
    scaling,
    unscaled_indices,
    update_sizes,
    write,
    write_physical,
)
from quell.kernels import user_functions
from quell.kernels.dispatch import generic, generic_with_default, kernel
from quell.kernels.functions import is_single
from quell.kernels.single import add_small
from quell.kernels.sized import Flag, Scalars
from quell.observers.design import Response, f_lag, f_learned_response, response, scaled_response
from quell.observers.eso import ESO, noise_gains
from quell.observers.forms import without_delay
from quell.types import Matrix, Vector, warn

# ---- The contract between a controller and its learner ----


class Learner(Protocol):
    """A description of a learner."""

    def design(self, observer: ESO, omega_c: float) -> Any:
        """Return the parameters for an observer and the controller's bandwidth [rad/s]."""

    def memory(self, parameters: Any) -> Any:
        """Return the state before anything is learned (a NamedTuple of arrays)."""

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return the names of the features that θ multiplies, for a plant of order ``order``."""


@generic
def adapt(
    learner: Any, memory: Any, estimates: Vector, y: float, u_before: float, f_plain: float
) -> None:
    """Learn from the observer's ``estimates = (x̂_1 … x̂_n, Δf̂, Δf̂', …)``.

    They follow from the measurement ``y`` and from the u applied before it. An ESO without a
    learner would have estimated ``f_plain = Δf̂ + f_L^F``.
    """
    raise TypeError


@generic
def predict(learner: Any, memory: Any, estimates: Vector, u_before: float) -> tuple[float, float]:
    """Return ``(constant, slope)`` of ``f_L = constant + slope · u`` [y-unit/s^n]."""
    raise TypeError


@generic
def commit(learner: Any, memory: Any, estimates: Vector, u: float, f_learned: float) -> None:
    """Store the ``u`` that was applied and the ``f_learned`` that the observer is given.

    A guard may have reduced ``f_learned``.
    """
    raise TypeError


@generic
def restart(learner: Any, memory: Any) -> None:
    """Reset the filters; keep what was learned if it is finite, else start from the beginning."""
    raise TypeError


@generic_with_default
def forget(learner: Any, memory: Any) -> None:
    """Return to the state before anything was learned; by default only ``restart``."""
    restart(learner, memory)


@generic
def coefficients(learner: Any, memory: Any, theta: Vector) -> None:
    """Write θ into ``theta`` (p,), in the plant's units: ``f_L = θ · features``."""
    raise TypeError


@generic_with_default
def learner_flags(learner: Any, memory: Any) -> int:
    """Return the learner's ``Status`` flags for this sample; by default none."""
    return 0


@functools.singledispatch
def meaning(parameters: Any) -> Any:
    """Return those parameters without which the numbers in a learner's memory mean something else.

    A memory image fits where they are equal (``controllers/memory.py``). By default these are all;
    a learner registers its own, without gains and times, for the type of its parameters.
    """
    return parameters


def checked_learner_design(learner: Learner, observer: ESO, omega_c: float) -> Any:
    """Return ``learner.design(observer, omega_c)``; check a user-defined learner first.

    All functions of the contract are called once, interpreted, on a memory that is discarded.
    """
    if not user_functions.is_user_defined(learner):
        return learner.design(observer, omega_c)
    name, order = type(learner).__name__, observer.order
    what = f"{name}.design(observer, {omega_c:g})"
    rule = "design takes (observer, omega_c)"
    parameters = user_functions.attempt(what, rule, learner.design, observer, omega_c)
    user_functions.check_named_tuple(what, parameters, "numbers and arrays")
    user_functions.check_registered(name, parameters, adapt, predict, commit, restart, coefficients)
    what = f"{name}.memory(...)"
    memory = user_functions.attempt(what, "memory takes (parameters)", learner.memory, parameters)
    user_functions.check_arrays(f"{name}.memory", memory, nested=True)
    what = f"{name}.feature_names({order})"
    rule = "feature_names takes the plant's order"
    names = user_functions.attempt(what, rule, learner.feature_names, order)
    if not isinstance(names, tuple) or not all(isinstance(label, str) for label in names):
        rule = "must return a tuple with a name for each coefficient"
        raise ValueError(f"{what} returns {names!r}: {rule}")

    def call(
        function: Any, *arguments: Any, rule: str = "docs/extend describes its arguments"
    ) -> Any:
        what = f"{name}: {function.__name__}"
        return user_functions.attempt_kernel(what, rule, function, parameters, memory, *arguments)

    estimates = user_functions.sample_values(order + 1)
    call(adapt, estimates, 0.9, 0.5, 0.1)
    predicted = call(predict, estimates, 0.5)
    if predicted is not user_functions.UNKNOWN:
        if not (isinstance(predicted, tuple) and len(predicted) == 2):
            rule = "must return (constant, slope), two numbers"
            raise ValueError(f"{name}: predict returns {predicted!r}: {rule}")
        for label, value in zip(("constant", "slope"), predicted, strict=True):
            user_functions.check_number(f"{name}: predict, {label},", value)
    call(commit, estimates, 0.5, 0.1)
    call(coefficients, np.zeros(len(names)), rule=f"it has {len(names)} names")
    call(restart)
    return parameters


class NoLearner(Described):
    """The absence of a learner: the L-ESO is a plain ESO."""

    def design(self, observer: ESO, omega_c: float) -> NoLearnerDesign:
        """Return no parameters."""
        return NoLearnerDesign()

    def memory(self, parameters: NoLearnerDesign) -> NoLearnerMemory:
        """Return an empty state."""
        return NoLearnerMemory(np.zeros(0))

    def feature_names(self, order: int) -> tuple[str, ...]:
        """Return no names."""
        return ()


class NoLearnerDesign(NamedTuple):
    """Parameters of ``NoLearner``: none."""


class NoLearnerMemory(NamedTuple):
    """State of ``NoLearner``."""

    theta: Vector  # (0,)


@adapt.register(NoLearnerDesign)
def _adapt(
    learner: NoLearnerDesign,
    memory: NoLearnerMemory,
    estimates: Vector,
    y: float,
    u_before: float,
    f_plain: float,
) -> None:
    pass


@predict.register(NoLearnerDesign)
def _predict(
    learner: NoLearnerDesign, memory: NoLearnerMemory, estimates: Vector, u_before: float
) -> tuple[float, float]:
    return 0.0, 0.0


@commit.register(NoLearnerDesign)
def _commit(
    learner: NoLearnerDesign, memory: NoLearnerMemory, estimates: Vector, u: float, f_learned: float
) -> None:
    pass


def nothing_to_restart(learner: Any, memory: Any) -> None:
    """Do nothing: ``restart`` of a learner that keeps nothing of a run."""


def no_coefficients(learner: Any, memory: Any, theta: Vector) -> None:
    """Write nothing: ``coefficients`` of a learner without features."""


restart.register(NoLearnerDesign)(nothing_to_restart)
coefficients.register(NoLearnerDesign)(no_coefficients)


# ---- A gate that separates motion from measurement noise ----

# Least ratio of a moving signal's standard deviation to that of its noise. White noise has ratio 1,
# noise that is constant for ten samples 3; with a margin of two above that, not tuned further.
SIGNAL_TO_NOISE = 6.0
# Standard deviations of noise in f that ``confidence`` counts: a three-sigma bound.
NOISE_DEVIATIONS = 3.0
# Rounding in y counts as noise of this share of y: no sensor resolves better. In single precision
# y itself is rounded, by 2⁻²⁶ to 2⁻²⁵ of it in the root mean square.
_RESOLUTION, _RESOLUTION_SINGLE = 1e-8, 2.0**-25
# Averaging time of means and variances in lags of the observer; chosen by hand, not tuned further.
AVERAGING_LAGS = 10.0


class NoiseGate(NamedTuple):
    """Parameters for a plant of order n."""

    # Least variance of moving x_1 … x_n and u, in units of the variance of y − x̂_1 (n + 1,).
    threshold: Vector
    forget: float  # dt over the averaging time
    f_noise: float  # variance that white noise of unit variance in y causes in f̂
    power: float  # ω^n


class NoiseGateMemory(NamedTuple):
    """Running means of the signals and of the noise."""

    mean: Vector  # of x_1 … x_n and u (n + 1,); in single precision with carries (2n + 2,)
    variance: Vector  # (n + 1,)
    # Mean square of y − x̂_1; sum of its weights, which grows from 0 to 1 (2,). With the states of
    # other axes also theirs.
    noise: Vector


def relative_noise(observer: ESO) -> Vector:
    """Return the variances of noise in x̂ and f̂ (n + 1,), in units of that of ``y − x̂_1``.

    Raises ``ValueError`` for an observer of reduced form: its x̂_1 is y, so y − x̂_1 does not show
    the noise.
    """
    if observer.form == "reduced":
        raise ValueError(
            "form = 'reduced': x̂_1 = y, so this learner cannot separate motion from noise; "
            "use form='current'"
        )
    return noise_gains(observer)


@functools.singledispatch
def noise_gate(observer: Any, frequency: float) -> Any:
    """Return the gate for an observer and a frequency of the plant [rad/s]."""
    noise = relative_noise(observer)
    f_noise = float(noise[-1])
    noise[-1] /= observer.b0**2  # noise in f̂ reaches u through u = −f̂/b0
    return NoiseGate(
        SIGNAL_TO_NOISE**2 * noise,
        -math.expm1(-observer.dt / (AVERAGING_LAGS * observer.lag_time)),
        f_noise,
        frequency**observer.f_degree,
    )


def noise_gate_memory(gate: Any) -> NoiseGateMemory:
    """Return the state of a gate before the first sample."""
    signals, sources = gate.threshold.size, getattr(gate, "sources", 1)
    return NoiseGateMemory(np.zeros(signals), np.zeros(signals), np.zeros(2 * sources))


@kernel
def resolution(like: float) -> float:
    """Return the share of y that counts as rounding, in the precision of ``like``."""
    return _RESOLUTION_SINGLE if is_single(like) else _RESOLUTION


@kernel
def grown(weight: float, forget: float) -> float:
    """Return the sum of weights of an exponential mean after a sample; it grows from 0 to 1."""
    more = weight + forget * (1.0 - weight)
    # Rounding would stop it before, and all means would be too large.
    return 1.0 if is_single(weight) and more == weight else more


@kernel
def follow_noise(noise: float, forget: float, y: float, error: float) -> float:
    """Return the mean square ``noise`` of ``error = y − x̂_1`` after a sample; rounding counts."""
    rounding = resolution(forget) * y
    return noise + forget * (error * error + rounding * rounding - noise)


@kernel
def follow_moments(mean: Vector, variance: Vector, i: int, value: float, forget: float) -> None:
    """Update mean and variance of signal ``i`` with a sample."""
    away = value - mean[i]
    add_small(mean, variance.size, i, forget * away)
    variance[i] += forget * (away * away - variance[i])


@generic_with_default
def update_gate(gate: Any, memory: NoiseGateMemory, estimates: Vector, y: float, u: float) -> bool:
    """Update the means with a sample; return whether any state moves."""
    memory.noise[0] = follow_noise(memory.noise[0], gate.forget, y, y - estimates[0])
    memory.noise[1] = grown(memory.noise[1], gate.forget)
    order = memory.variance.size - 1
    moves = False
    for i in range(order + 1):
        value = estimates[i] if i < order else u
        follow_moments(memory.mean, memory.variance, i, value, gate.forget)
        # u alone does not count: without motion it is the answer to a load.
        moves = moves or (i < order and is_moving(gate, memory, i))
    return moves


@generic_with_default
def is_moving(gate: Any, memory: NoiseGateMemory, i: int) -> bool:
    """Return whether signal ``i`` moves."""
    return memory.variance[i] * memory.noise[1] > gate.threshold[i] * memory.noise[0]


@kernel
def gated(gate: Any, memory: NoiseGateMemory, i: int, value: float) -> float:
    """Return ``value`` of signal ``i`` if it moves, else its mean."""
    return value if is_moving(gate, memory, i) else memory.mean[i]


@kernel
def confidence(gate: Any, memory: NoiseGateMemory, size: float) -> float:
    """Return ``F²/(F² + (3σ)²)`` with the noise σ in f; ``size`` is that of x_1."""
    motion = gate.power * size
    noise = NOISE_DEVIATIONS * NOISE_DEVIATIONS * gate.f_noise * memory.noise[0]
    return motion * motion * memory.noise[1] / (motion * motion * memory.noise[1] + noise)


@kernel
def reset_gate(memory: NoiseGateMemory) -> None:
    """Go back to the state before the first sample."""
    for i in range(memory.mean.size):
        memory.mean[i] = 0.0
    for i in range(memory.variance.size):
        memory.variance[i] = 0.0
    for i in range(memory.noise.size):
        memory.noise[i] = 0.0


# ---- Detection of a learner that has lost its numbers, for all learners alike ----

# The time over which learners average: what has decayed in it is gone from them as well.
WINDOW_LAGS = AVERAGING_LAGS
# 2⁻⁴⁰ = 9e-13: three decades below what noise of RESOLUTION leaves of f at omega_o dt = 0.01,
# and with 12 of the 52 bits left to a learner whose scale is so much too large.
_LEAST_SHARE = 2.0**-40
# An output so many times larger than f is no prediction; ten times what a guard cuts off.
_TOO_LARGE = 2.0**10
# With features of this size a regression learns 2⁻²⁰ of what it learns at its scale from a sample.
_LEAST_SHARE_AT_LIMITS = 2.0**-10
# In single precision a y that rests may still change by its last digit, 2⁻²³ of it at most.
_STEP_OF_SINGLE = 2.0**-22
# A window counts only if |f_plain| has not decayed to less than this share of the last one. At
# rest without noise a loop with omega_c = omega_o/10 decays faster.
_STEADY = 0.5

# In the recoveries of benchmarks/hostile_steps.py the ratio was larger in 1 to 8 % of the samples
# with new learners, and in 84 to 95 % with those that did not recover.
_HARM = 4.0
_HARM_WINDOWS = 10.0


class LearnerWatch(Scalars):
    """Extremes and counts of a window, and the extremes before it."""

    peak: float  # largest |f_plain| since the learner began
    most: float  # largest |f_plain| in this window
    most_before: float  # largest |f_plain| in the last window
    y_low: float  # least y in this window
    y_high: float  # largest y in this window
    excessive: float  # samples in this window with an output that is too large
    limited: float  # samples in this window in which u was at its limits
    samples: float  # samples in this window
    harmful: float  # samples in which the output did harm
    compared: float  # samples in which that was asked


def window_samples(observer: ESO) -> int:
    """Return the length of a window in samples."""
    return max(round(WINDOW_LAGS * observer.lag_time / observer.dt), 1)


@kernel
def is_in_proportion(watch: LearnerWatch, output: float) -> bool:
    """Return whether ``output`` could be a prediction of the f of the last window."""
    return abs(output) <= _TOO_LARGE * watch.most_before


@kernel
def is_excessive(unlimited: float, u: float, smallest: float) -> bool:
    """Return whether the law asks for far more than the u that is applied, or ``smallest``."""
    return abs(unlimited) > _TOO_LARGE * max(abs(u), smallest)


@kernel
def has_escaped(watch: LearnerWatch, output: float, excessive: bool) -> bool:
    """Return whether ``output`` grows without bound; the window then begins anew.

    The arguments are those of ``has_lost_range``.
    """
    if not (excessive and watch.peak > 0.0):
        return False
    if abs(output) * _LEAST_SHARE <= watch.peak:
        return False
    # The window before may contain the beginning, but not the peak.
    watch.most_before = min(watch.most_before, watch.peak)
    watch.most = watch.excessive = watch.limited = watch.samples = 0.0
    return True


@kernel
def has_lost_range(
    watch: LearnerWatch,
    window: int,
    y: float,
    f_plain: float,
    output: float,
    excessive: bool,
    limited: bool,
) -> bool:
    """Return whether the learner has to start again; call it once for each good sample.

    ``output`` is the learner's own, before a guard; ``excessive`` tells whether the law asks for
    far more than the u that is applied, ``limited`` whether limits have changed it.
    """
    size = abs(f_plain)
    if watch.samples == 0.0:
        watch.y_low = watch.y_high = y
    watch.samples += 1.0
    if size > watch.most:  # false for a NaN
        watch.most = size
    watch.y_low, watch.y_high = min(watch.y_low, y), max(watch.y_high, y)
    if excessive and abs(output) > _TOO_LARGE * max(watch.most, watch.most_before):
        watch.excessive += 1.0
    if limited:
        watch.limited += 1.0
    if watch.samples < window:
        return False
    watch.peak = max(watch.peak, watch.most)
    largest = max(abs(watch.y_low), abs(watch.y_high))
    still = _STEP_OF_SINGLE if is_single(watch.peak) else resolution(watch.peak)
    moves = watch.y_high - watch.y_low > still * largest
    steady = watch.most >= _STEADY * watch.most_before
    least = _LEAST_SHARE_AT_LIMITS if 2.0 * watch.limited > watch.samples else _LEAST_SHARE
    out_of_range = moves and steady and watch.most < least * watch.peak
    lost = out_of_range or 2.0 * watch.excessive > watch.samples
    if lost:
        watch.peak = watch.most
    watch.most_before = watch.most
    watch.most = watch.excessive = watch.limited = watch.samples = 0.0
    return bool(lost)


@kernel
def does_harm(watch: LearnerWatch, window: int, residual: float, f_plain: float) -> bool:
    """Return whether the output adds to the disturbance; call it once for each good sample.

    ``residual`` is the Δf̂ that the output leaves of ``f_plain``.
    """
    watch.compared += 1.0
    if abs(residual) > _HARM * abs(f_plain):
        watch.harmful += 1.0
    if watch.compared < _HARM_WINDOWS * window:
        return False
    harm = 2.0 * watch.harmful > watch.compared
    watch.compared = watch.harmful = 0.0
    return bool(harm)


# ---- The lag filter ----

# Duration of the start in units of the observer's lag: its initial error decays to 0.1 % in it.
STARTUP_LAGS = 2.0


class Lag(NamedTuple):
    """The lag filter of an observer with all poles in one place, N = n + m states per input."""

    pole: float  # β
    rise: float  # 1 − β, without cancellation
    taps: Vector  # c (N,)
    predictor: Flag  # whether the observer is in predictor form: its estimate is a sample later

    @property
    def width(self) -> int:
        """Numbers stored per input."""
        return int(self.taps.size)


class DenseLag(NamedTuple):
    """The lag filter of any linear observer, with m states per input."""

    transition: Matrix  # M (m, m)
    input: Vector  # g (m,)
    taps: Vector  # c (m,): effect of the state on the next estimate
    through: float  # d: effect of the input

    @property
    def width(self) -> int:
        """Numbers stored per input: the states and work space of the same size."""
        return 2 * int(self.taps.size)


NO_LAG = Lag(0.0, 0.0, np.zeros(0), False)
"""The filter of a loop without feedforward; its output is zero."""


def startup_samples(observer: ESO) -> int:
    """Return the number of samples after a start from rest in which Δf̂ shows the initial error."""
    return round(STARTUP_LAGS * observer.lag_time / observer.dt)


def lag_memory(lag: Lag | DenseLag, count: int) -> Matrix:
    """Return the state of the lag filters for ``count`` inputs, at rest."""
    return np.zeros((count, lag.width))


@kernel
def reset_lag(memory: Matrix) -> None:
    """Return lag filters, all of ``memory``, to rest."""
    for i in range(memory.shape[0]):
        for j in range(memory.shape[1]):
            memory[i, j] = 0.0


@functools.singledispatch
def lag_of(observer: Any, every: int = 1) -> Lag | DenseLag:
    """Return the lag filter of an observer, or of each m-th of its samples.

    It is a ``Lag`` if all poles are in one place, else a ``DenseLag``. A delay of u has no effect:
    the feedforward is not delayed. With ``every`` = m it is exact for an input that is constant
    over m samples. Raises ``ValueError`` for a nonlinear observer, which has no lag filter.
    """
    if observer.has_one_pole and (every == 1 or not without_delay(observer.model).predictor):
        return _chain(observer, every)
    return DenseLag(*f_learned_response(_response(observer), every))


def _response(observer: ESO) -> Response:
    return response(without_delay(observer.model), observer.estimates, observer.order)


# Most samples of lag for which a learner keeps or calculates something in each: 100 s at 1 kHz.
_LONGEST_LAG = 100_000


def check_lag(observer: Any, learner: str) -> None:
    """Raise a ``ValueError`` for an observer too slow for a learner with memory of its lag."""
    samples = observer.lag_time / observer.dt
    if not samples <= _LONGEST_LAG:
        raise ValueError(
            f"observer: its omega_o is so low that its lag is {observer.lag_time:.3g} s, "
            f"{samples:.3g} samples of dt = {observer.dt!r} s: must be at most {_LONGEST_LAG} for "
            f"{learner}, which keeps something for each; raise omega_o, or take learner=Kalman()"
        )


@functools.singledispatch
def group_delay(observer: Any) -> float:
    """Return the lag in samples of f^F, as the next estimate shows it, behind slow changes of f.

    The j-th lag of the chain delays by ``β/(1−β) + (j−1)/(1−β)``, and the taps sum to one.
    """
    if not observer.has_one_pole:
        return f_lag(scaled_response(observer.model, observer.units, observer.order))
    lag = _chain(observer)
    stage = np.arange(lag.taps.size)
    return float(lag.taps @ (lag.pole / lag.rise + stage / lag.rise)) + float(lag.predictor)


def _chain(observer: ESO, every: int = 1) -> Lag:
    """Return the filter of each m-th sample as a chain of first-order lags.

    With ``M = (I − L C) Φ`` and ``g = (I − L C) Γ_f``, the chain is ``s = V v`` with ``V_1 =
    g/(1−β)`` and ``V_{j+1} = (M − βI) V_j/(1−β)``, which ends after N by Cayley-Hamilton; ``c_j =
    −(V_j)_{n+1}``, in predictor form ``−(Φ V_j)_{n+1}`` for the next sample.
    """
    model, at_f = without_delay(observer.model), observer.order
    size = observer.estimates
    # In the coordinates x_i dt^(i−1) all entries are O(1).
    scale = observer.dt ** np.arange(size)
    correct = np.eye(size)
    correct[:, 0] -= model.gain * scale
    transition = correct @ (model.transition * scale[:, None] / scale[None, :])
    given = column = correct @ (model.feed * scale)
    for _ in range(every - 1):
        column = transition @ column + given
    transition = np.linalg.matrix_power(transition, every)
    rise = -np.expm1(-observer.omega_o * observer.dt * every)
    shifted = transition - np.eye(size) + rise * np.eye(size)
    column = column / rise
    # In predictor form f̂ is the f that is predicted from these states: f itself, or f + dt f' + ….
    row = np.eye(size)[at_f]
    if model.predictor and observer.disturbance_order > 1:
        row = model.transition[at_f] * scale[at_f] / scale
    taps = np.empty(size)
    for j in range(size):
        taps[j] = -(row @ column) / scale[at_f]
        column = shifted @ column / rise
    return Lag(observer.pole if every == 1 else 1.0 - rise, rise, taps, model.predictor)


@generic
def lag_push(lag: Any, memory: Matrix, i: int, value: float) -> float:
    """Advance filter ``i`` of ``lag_memory`` by a sample with the input ``value``.

    Return its output, the effect of the inputs on the next estimate of f.
    """
    raise TypeError


@lag_push.register(Lag)
def _push_chain(lag: Lag, chain: Matrix, i: int, value: float) -> float:
    before = 0.0
    if lag.predictor:
        for j in range(lag.taps.size):
            before += lag.taps[j] * chain[i, j]
    carry = lag.rise * value
    after = 0.0
    for j in range(lag.taps.size):
        old = chain[i, j]
        new = lag.pole * old + carry
        carry = lag.rise * old
        chain[i, j] = new
        after += lag.taps[j] * new
    return before if lag.predictor else after


@lag_push.register(DenseLag)
def _push_dense(lag: DenseLag, memory: Matrix, i: int, value: float) -> float:
    size = lag.taps.size
    output = lag.through * value
    for j in range(size):
        output += lag.taps[j] * memory[i, j]
        total = lag.input[j] * value
        for k in range(size):
            total += lag.transition[j, k] * memory[i, k]
        memory[i, size + j] = total
    for j in range(size):
        memory[i, j] = memory[i, size + j]
    return output


# ---- The common part of learners on features ----


class Inputs(NamedTuple):
    """Parameters that all learners on features share, for a plant of order n."""

    features: Any
    unscaled: Indices  # of the features whose size is unknown (k,)
    scaling: Any
    gate: Any
    bias_gain: float  # λ dt, at most 1
    startup: int  # samples after a start from rest in which nothing is learned

    @property
    def order(self) -> int:
        """Order n of the plant."""
        return int(self.scaling.floors.size) - 2


@meaning.register(Inputs)
def _meaning(inputs: Inputs) -> Any:
    return inputs.features, inputs.unscaled


@kernel
def write_features(inputs: Inputs, memory: Any, estimates: Vector, u: float, out: Vector) -> None:
    """Write the features of ``estimates`` (n + 1,) and ``u`` into ``out`` (p,).

    A signal that does not move is replaced by its mean. ``memory`` is the learner's, with ``gate``,
    ``scale`` (n + 2,), which divides x_1 … x_n, u and f, ``sizes`` (k,), which divides the features
    of unknown size, and the work space ``scaled`` (n,).
    """
    scale, scaled = memory.scale, memory.scaled
    moving_u = _write_physical(inputs, memory, estimates, u, out)
    scale_by_sizes(inputs.unscaled, memory.sizes, out)
    for i in range(scaled.size):
        scaled[i] /= scale[i]
    write(inputs.features, scaled, moving_u / scale[scaled.size], out)


@kernel
def _write_physical(inputs: Inputs, memory: Any, estimates: Vector, u: float, out: Vector) -> float:
    """Write the features of signals in the plant's units, and these signals into ``scaled``.

    Return the control signal, or its mean if it does not move.
    """
    gate, scaled = memory.gate, memory.scaled
    for i in range(scaled.size):
        scaled[i] = gated(inputs.gate, gate, i, estimates[i])
    moving_u = gated(inputs.gate, gate, scaled.size, u)
    write_physical(inputs.features, scaled, moving_u, out)
    return moving_u


@kernel
def update_feature_sizes(
    inputs: Inputs, memory: Any, estimates: Vector, u: float, powers: bool
) -> bool:
    """Let ``memory.sizes`` cover the features of a sample; return whether one grew."""
    if inputs.unscaled.size == 0:
        return False
    _write_physical(inputs, memory, estimates, u, memory.features)
    return update_sizes(inputs.unscaled, memory.sizes, memory.features, powers)


def features_first(features: Any, number: Any, default: Any, name: str) -> tuple[Any, Any]:
    """Return features and the number behind them; a call in the old order warns.

    The number came first before version 0.2. The types of the arguments tell the orders apart.
    """
    if isinstance(features, int | float) and (number is default or isinstance(number, Features)):
        features, number = None if number is default else number, features
    elif isinstance(number, Features) and features is None:
        features, number = number, default
    else:
        return features, number
    rule = f"features are the first argument now; give {name}= by its name"
    warn(f"{name} = {number!r} came first: {rule}", DeprecationWarning)
    return features, number


class FeatureLearner(Described):
    """Base class of the learners that are given scaled features of the state and of u.

    Parameters
    ----------
    features
        blocks of features, for example ``State() + Bias()``, which is the default.
    frequency
        a frequency of the plant [rad/s], for the automatic scaling; ``omega_c`` of the controller
        by default.
    scale
        what x_1 … x_n, u and f are divided by, (n + 2,); found automatically by default.
    bias_bandwidth
        bandwidth λ of a bias that follows what is not learned otherwise [rad/s]; ``omega_o`` of the
        observer by default, 0 for no bias.
    """

    def __init__(
        self,
        features: Features | None,
        frequency: float | None,
        scale: Any,
        bias_bandwidth: float | None,
    ) -> None:
        self.features = State() + Bias() if features is None else features
        if not isinstance(self.features, Features):
            raise ValueError(
                f"features = {features!r}: must be made of blocks from quell.features, "
                "for example State() + Bias()"
            )
        self.frequency = checks.optional(checks.positive, "frequency", frequency, "rad/s")
        self.scale = checks.optional(checks.positive_vector, "scale", scale)
        check = checks.non_negative
        self.bias_bandwidth = checks.optional(check, "bias_bandwidth", bias_bandwidth, "rad/s")

    def _inputs(self, observer: ESO, omega_c: float) -> Inputs:
        order, frequency = observer.order, self.frequency or omega_c
        if self.scale is not None:
            checks.vector("scale", self.scale, order + 2)
        bandwidth = observer.omega_o if self.bias_bandwidth is None else self.bias_bandwidth
        return Inputs(
            features=checked_design(self.features, order),
            unscaled=unscaled_indices(self.features, order),
            scaling=scaling(observer, frequency, self.scale is not None),
            gate=noise_gate(observer, frequency),
            bias_gain=min(bandwidth * observer.dt, 1.0),
            startup=startup_samples(observer),
        )

    def _initial_scale(self, inputs: Inputs) -> Vector:
        return initial_scale(inputs.scaling) if self.scale is None else self.scale.copy()

    def _initial_sizes(self, inputs: Inputs) -> Vector:
        return initial_sizes(inputs.unscaled)
